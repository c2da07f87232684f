"""Check that later changes do not overwrite axis or `--set` values in the input of a run.

If a later change (of another axis or `--set`, the seed, or `run_changes`) overwrites a value, the recorded value would be
wrong. Paths to the same place can be written differently. Therefore each value is set again in the input of a run, which must
change nothing. This is tested with a mark instead of the values, once for all experiments that make the same changes. The real
values are only tested if the mark is overwritten or does not fit, or if a later path may select by the values.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence

from sierra.design import seeds
from sierra.errors import QueryError, TemplateError
from sierra.model import Cell, Change, Design, Repeat, Set, Value
from sierra.templates.base import Rendered, Template
from sierra.util.lazy_definitions import dataclass, regex, replace
from sierra.util.random_poses import RandomPoses

MARKS = ("sierraMarkInPlaceOfAValue", "8150376429918273641")
"""A text, and a number for places in templates that accept only numbers."""
CONSTANT = regex(r"""\[\s*(?:\d+|@([\w:.-]+)\s*=\s*(?:'[^']*'|"[^"]*"))\s*\]""")
"""A test in a path, by number or by the value of an attribute."""
SOME_SEED = seeds.LARGEST - 271_828


@dataclass(frozen=True, slots=True)
class Layer:
    """The changes to an input from one origin, with its name for messages."""

    name: str
    changes: tuple[Change, ...]
    axis: bool = False
    each_run: bool = False
    last: bool = False
    """True for an axis of the platform's own, whose changes come after those of other axes in any order."""
    yields: bool = False
    """True for a controller or scenario, which sets only the rest where a criterion `replaces` what it sets."""
    replaces: frozenset[Change] = frozenset()

    @property
    def sets(self) -> tuple[Set, ...]:
        return tuple(change for change in self.changes if isinstance(change, Set))

    def marked(self, sets: Sequence[Set], mark: str) -> Layer:
        """Return a layer with a mark as the value of some of its sets."""
        marked = (
            replace(change, value=mark) if change in sets and isinstance(change, Set) else change for change in self.changes
        )
        return replace(self, changes=tuple(marked))


Layers = tuple[Layer, ...]


@dataclass(frozen=True, slots=True)
class Input:
    """The input of a run, with its changes as layers."""

    template: Template
    layers: Layers
    values: Mapping[str, Value]
    of_run: Mapping[str, Value]

    def render(self) -> Rendered:
        common = self._changes(each_run=False)
        document = self.template.changed(common, with_seed(common, self.values))
        per_run = self._changes(each_run=True)
        return document.per_run(per_run)({**self.values, **self.of_run}) if per_run else document.render()

    def until(self, number: int) -> Input:
        """Return the input after a layer's changes, without later layers."""
        return replace(self, layers=self.layers[: number + 1])

    def without(self, number: int) -> Input:
        return replace(self, layers=(*self.layers[:number], *self.layers[number + 1 :]))

    def marked(self, number: int, sets: Sequence[Set], mark: str) -> Input:
        layer = self.layers[number].marked(sets, mark)
        return replace(self, layers=(*self.layers[:number], layer, *self.layers[number + 1 :]))

    def holds(self, sets: Sequence[Set]) -> bool | None:
        """Return True if setting these values again changes nothing, or None if their paths select nothing now."""
        again = [replace(change, expect=None) for change in sets]
        rendered = self.template.reread(self.render(), "an input")
        before = rendered.changed((), self.values).render()
        try:
            return rendered.changed(again, self.values).render() == before
        except TemplateError:
            return None

    def _changes(self, *, each_run: bool) -> tuple[Change, ...]:
        return tuple(change for layer in self.layers if layer.each_run == each_run for change in layer.changes)


def check(template: Template, designed: Design, cell: Cell, layers: Layers) -> bool:
    """Raise QueryError if a value is overwritten. Return True if that depends on the values, and so on the experiment."""
    runs = different_runs(designed)
    first = Input(template, layers, cell.values, runs[0])
    setting = [number for number, layer in enumerate(layers) if number and layer.sets and not layer.each_run]
    doubtful = [number for number in setting if _by_value(layers, number) or not _lasts_marked(first, number)]
    for number, of_run in itertools.product(doubtful, runs):
        run_input, sets = replace(first, of_run=of_run), layers[number].sets
        lost = () if run_input.holds(sets) else tuple(change for change in sets if not _lasts(run_input, number, change))
        for change in lost:
            if not _is_replaced(run_input, number, change):
                raise QueryError(_overwritten(run_input, number, change))
        if lost and len(lost) == len(layers[number].changes):
            raise QueryError(_without_effect(run_input, number, lost[0]))
    return bool(doubtful)


def draws_poses(changes: Sequence[Change]) -> bool:
    """Return True if changes draw poses from the seed of a run, so that each run needs its own copies."""
    return any(isinstance(change, Repeat) and isinstance(change.poses, RandomPoses) for change in changes)


def with_seed(changes: Sequence[Change], values: Mapping[str, Value]) -> Mapping[str, Value]:
    """Return the values for the changes of an experiment, with some seed if they draw poses."""
    return {"seed": SOME_SEED, **values} if draws_poses(changes) else values


def different_runs(designed: Design) -> list[Mapping[str, Value]]:
    """Return values of per-run changes in some runs: all values of the lists, and a seed that nobody has set by chance."""
    count = min(designed.query.runs, max([2, *map(len, designed.lists.values())]) if designed.per_run else 1)
    lists = [{name: values[number % len(values)] for name, values in designed.lists.items()} for number in range(count)]
    robot = {"robot": 1} if designed.on_robots else {}
    return [{**values, "seed": SOME_SEED, "run": number, **robot} for number, values in enumerate(lists)]


def _by_value(layers: Layers, number: int) -> bool:
    """Return True if a later path may select by a value that a layer sets: by more than tests of other attributes."""
    own = " ".join(f"{CONSTANT.sub('', change.path)} {change.attribute or ''}" for change in layers[number].sets)
    any_name = "*" in own or "(" in own

    def left(test: re.Match[str]) -> str:
        return "[" if test[1] and (any_name or test[1].rpartition(":")[2] in own) else ""

    return any("[" in CONSTANT.sub(left, change.path) for layer in layers[number + 1 :] for change in layer.changes)


def _lasts_marked(run_input: Input, number: int) -> bool:
    """Return True if the mark is not overwritten in any place that a layer sets; then no value is overwritten."""
    for mark in MARKS:
        marked = run_input.marked(number, run_input.layers[number].sets, mark)
        sets = marked.layers[number].sets
        try:
            return marked.holds(sets) or all(_lasts(marked, number, change) for change in sets)
        except TemplateError:
            if _fits(marked, number):  # a path selects by the value
                return False
    return False


def _fits(marked: Input, number: int) -> bool:
    try:
        marked.until(number).render()
    except TemplateError:
        return False
    return True


def _lasts(run_input: Input, number: int, change: Set) -> bool:
    """Return True if a value of a layer is not overwritten in the end, as far as this can be determined."""
    held = run_input.holds((change,))
    if held is None or (
        held is False and not run_input.until(number).holds((change,))
    ):  # its own layer may have overwritten it
        return not _lost(run_input, number, change)
    return held


def _lost(run_input: Input, number: int, change: Set) -> bool:
    """Return True if a mark is in fewer places at the end than directly after its layer's changes."""
    for mark in MARKS:
        marked = run_input.marked(number, (change,), mark)
        try:
            return _marks(marked.render(), mark) < _marks(marked.until(number).render(), mark)
        except TemplateError:
            if _fits(marked, number):
                return False
    return False


def _marks(rendered: Rendered, mark: str) -> int:
    contents = [rendered] if isinstance(rendered, bytes) else [content for _, content in rendered]
    return sum(content.replace(b"\0", b"").count(mark.encode()) for content in contents)  # also in UTF-16


def _is_replaced(run_input: Input, number: int, change: Set) -> bool:
    """Return True if a value that a controller or scenario sets is overwritten only by changes that may replace it."""
    if not run_input.layers[number].yields:
        return False
    kept = tuple(
        replace(layer, changes=tuple(own_change for own_change in layer.changes if own_change not in layer.replaces))
        for layer in run_input.layers
    )
    try:
        return _lasts(replace(run_input, layers=kept), number, change)
    except TemplateError:
        return False


def _without_effect(run_input: Input, number: int, change: Set) -> str:
    name = run_input.layers[number].name
    return f"{name} has no effect: {_later(run_input, number, change).name} sets all that it sets; leave {name} out"


def _overwritten(run_input: Input, number: int, change: Set) -> str:
    layer, who = run_input.layers[number], _later(run_input, number, change)
    order = ", or in another order" if layer.axis and who.axis and not who.last else ""
    right = "only one of them can set it" if who.each_run else f"use one of them{order}"
    return f"{layer.name} is overwritten: {who.name} changes the same value later; {right}"


def _later(run_input: Input, number: int, change: Set) -> Layer:
    """Return the layer that overwrites a change of an earlier one."""
    found = next((n for n in range(number + 1, len(run_input.layers)) if _blamed(run_input, n, number, change)), None)
    return run_input.layers[found] if found is not None else Layer("a later change", ())


def _blamed(run_input: Input, later: int, number: int, change: Set) -> bool:
    try:
        return _lasts(run_input.without(later), number, change)
    except TemplateError:  # a later layer needs this one
        return False
