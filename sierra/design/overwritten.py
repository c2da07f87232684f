"""Whether what an axis or a `--set` has set is still so in the input of a run.

Where something else changes it later (another of these, the seed, `run_changes`), its values would be untrue, however
the paths are written. So what each has set is set again in the input of a run, and must change nothing. It is tried
with a mark in place of the values, once for all experiments that make the same changes. Only where the mark does not
last, or a later path may select by the values, are the real ones tried.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from sierra.design import seeds
from sierra.errors import QueryError, TemplateError
from sierra.model import Cell, Change, Design, Set, Value
from sierra.platforms.base import Reader

MARK = "sierraMarkInPlaceOfAValue"
CONSTANT = re.compile(r"""\[\s*(?:\d+|@([\w:.-]+)\s*=\s*(?:'[^']*'|"[^"]*"))\s*\]""")
"""A test in a path, by number or of an attribute."""
SOME_SEED = seeds.LARGEST - 271_828


class Document(Protocol):
    """A template with changes made; see `sierra.templates.base.Document`."""

    def render(self) -> bytes: ...

    def per_run(self, changes: Sequence[Change]) -> Callable[[Mapping[str, Value]], bytes]: ...


class Template(Reader, Protocol):
    """What a design asks of a template; see `sierra.templates.base.Template`."""

    def __init__(self, data: bytes, name: str) -> None: ...

    def changed(self, changes: Sequence[Change], values: Mapping[str, Value]) -> Document: ...


@dataclass(frozen=True, slots=True)
class Layer:
    """What one of those who change an input changes in it, under the name that messages give it."""

    name: str
    changes: tuple[Change, ...]
    axis: bool = False
    each_run: bool = False

    @property
    def sets(self) -> tuple[Set, ...]:
        return tuple(change for change in self.changes if isinstance(change, Set))

    def marked(self, sets: Sequence[Set]) -> Layer:
        """With the mark as the value of some of its sets."""
        made = tuple(_mark(change) if isinstance(change, Set) and change in sets else change for change in self.changes)
        return replace(self, changes=made)


Layers = tuple[Layer, ...]


def _mark(change: Set) -> Set:
    return replace(change, value=MARK)


@dataclass(frozen=True, slots=True)
class Input:
    """The input of a run, by the layers of its changes."""

    template: Template
    layers: Layers
    values: Mapping[str, Value]
    of_run: Mapping[str, Value]

    def render(self) -> bytes:
        document = self.template.changed(self._changes(each_run=False), self.values)
        per_run = self._changes(each_run=True)
        return document.per_run(per_run)({**self.values, **self.of_run}) if per_run else document.render()

    def until(self, number: int) -> Input:
        """As it is once a layer's changes are made."""
        return replace(self, layers=self.layers[: number + 1])

    def without(self, number: int) -> Input:
        return replace(self, layers=(*self.layers[:number], *self.layers[number + 1 :]))

    def marked(self, number: int, sets: Sequence[Set]) -> Input:
        layer = self.layers[number].marked(sets)
        return replace(self, layers=(*self.layers[:number], layer, *self.layers[number + 1 :]))

    def holds(self, sets: Sequence[Set]) -> bool | None:
        """Whether these, set again, change nothing; None where they select nothing now."""
        again = [replace(change, expect=None) for change in sets]
        made = type(self.template)(self.render(), "an input")
        before = made.changed((), self.values).render()
        try:
            return made.changed(again, self.values).render() == before
        except TemplateError:
            return None

    def _changes(self, *, each_run: bool) -> tuple[Change, ...]:
        return tuple(change for layer in self.layers if layer.each_run == each_run for change in layer.changes)


def check(template: Template, designed: Design, cell: Cell, layers: Layers) -> bool:
    """Raises QueryError where what an axis or `--set` sets is not so in the runs; whether only real values could tell."""
    runs = different_runs(designed)
    first = Input(template, layers, cell.values, runs[0])
    setting = [number for number, layer in enumerate(layers) if number and layer.sets and not layer.each_run]
    doubtful = [number for number in setting if _by_value(layers, number) or not _lasts_marked(first, number)]
    for number, of_run in itertools.product(doubtful, runs):
        made = replace(first, of_run=of_run)
        if not made.holds(layers[number].sets):
            _check_each(made, number)
    return bool(doubtful)


def _check_each(made: Input, number: int) -> None:
    for change in made.layers[number].sets:
        if not _lasts(made, number, change):
            raise QueryError(_overwritten(made, number, change))


def different_runs(designed: Design) -> list[Mapping[str, Value]]:
    """Return what per-run changes know in some runs: all values of the lists, and a seed that nobody has set by chance."""
    count = min(designed.query.runs, max([2, *map(len, designed.lists.values())]) if designed.per_run else 1)
    lists = [{name: values[number % len(values)] for name, values in designed.lists.items()} for number in range(count)]
    return [{**values, "seed": SOME_SEED, "run": number} for number, values in enumerate(lists)]


def _by_value(layers: Layers, number: int) -> bool:
    """Whether a later path may select by a value that a layer sets: has more than tests of attributes that it doesn't set."""
    own = " ".join(f"{CONSTANT.sub('', change.path)} {change.attribute or ''}" for change in layers[number].sets)
    any_name = "*" in own or "(" in own

    def left(test: re.Match[str]) -> str:
        return "[" if test[1] and (any_name or test[1].rpartition(":")[2] in own) else ""

    return any("[" in CONSTANT.sub(left, change.path) for layer in layers[number + 1 :] for change in layer.changes)


def _lasts_marked(made: Input, number: int) -> bool:
    """Whether the mark lasts in place of all that a layer sets, and so any value does."""
    marked = made.marked(number, made.layers[number].sets)
    sets = marked.layers[number].sets
    try:
        return marked.holds(sets) or all(_lasts(marked, number, change) for change in sets)
    except TemplateError:  # a path selects by the value
        return False


def _lasts(made: Input, number: int, change: Set) -> bool:
    """Whether what a layer sets is so in the end, as far as can be told."""
    held = made.holds((change,))
    if held is None or (held is False and not made.until(number).holds((change,))):  # it may be its own layer's doing
        return not _lost(made.marked(number, (change,)), number)
    return held


def _lost(marked: Input, number: int) -> bool:
    """Whether a mark stands in fewer places in the end than once its layer's changes were made."""
    try:
        return _marks(marked.render()) < _marks(marked.until(number).render())
    except TemplateError:
        return False


def _marks(rendered: bytes) -> int:
    return rendered.replace(b"\0", b"").count(MARK.encode())  # also in UTF-16


def _overwritten(made: Input, number: int, change: Set) -> str:
    layer = made.layers[number]
    found = next((n for n in range(number + 1, len(made.layers)) if _blamed(made, n, number, change)), None)
    who = made.layers[found] if found is not None else Layer("what comes later", ())
    order = ", or in another order" if layer.axis and who.axis else ""
    right = "only one of them can set it" if who.each_run else f"ask for one of them{order}"
    return f"{layer.name} does not last: {who.name} changes what it sets; {right}"


def _blamed(made: Input, later: int, number: int, change: Set) -> bool:
    try:
        return _lasts(made.without(later), number, change)
    except TemplateError:  # what comes after it needs it
        return False
