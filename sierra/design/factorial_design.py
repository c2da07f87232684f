"""The design of a query: its axes, and the changes that each experiment and each run make to the template.

Changes are made in this order, and later ones overwrite earlier ones: those of the platform, the project, the controller, the
scenario, the criteria (in their order, the platform's own criteria last), `--set`, and what follows from these by rules of the
platform (walls follow the arena). In each run, the seed and the project's `run_changes` follow.

A platform's own criterion may depend on the changed template: a density needs the arena. Therefore the platform receives the
template with all other changes made, once for each combination of the other axes' values. It must return the same axis for all
of them.

The values that an axis or `--set` sets must not be overwritten in the input of a run: see `sierra.design.overwritten`.
"""

from __future__ import annotations

import dataclasses
import difflib
import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property

from sierra.config import group_names
from sierra.config.change_tables import ChangeTable, Group, Variable
from sierra.config.project_file import Project
from sierra.design import overwritten
from sierra.design.overwritten import Layer
from sierra.design.platforms.base import Following, Platform, Reader, Spanned
from sierra.design.query import ranges
from sierra.errors import ConfigError, QueryError
from sierra.model import (
    Add,
    Axis,
    Cell,
    Change,
    Computed,
    Criterion,
    Design,
    Listed,
    MonteCarlo,
    Point,
    Query,
    Remove,
    Rename,
    Repeat,
    Set,
    Value,
)
from sierra.templates.base import FOLDERS, OF_WORKER, Template
from sierra.util.lazy_definitions import dataclass, field, replace

GROUPED = ("controller", "scenario")
AT_MOST = 1_000_000
"""Maximum number of runs in a batch."""


Placed = tuple[Axis, Point]


@dataclasses.dataclass(frozen=True)
class Changed:
    """A template after changes, which are made when it is first read."""

    template: Template
    changes: tuple[Change, ...]
    values: Mapping[str, Value]

    def find(self, path: str) -> tuple[str, ...]:
        return self._read.find(path)

    @cached_property
    def _read(self) -> Template:
        rendered = self.template.changed(self.changes, overwritten.with_seed(self.changes, self.values)).render()
        return self.template.reread(rendered, "the changed template")


PlanningProgress = Callable[[int, int, int], None]
"""A progress callback: number of planned experiments, number of all experiments, number of all runs. It may raise errors."""


def ignore_progress(done: int, experiments: int, runs: int) -> None:
    """Ignore the progress."""


def design(
    query: Query, project: Project, platform: Platform, template: Template, report: PlanningProgress = ignore_progress
) -> Design:
    """Return the design of a query. Raises QueryError, ConfigError, TemplateError, and any error that `report` raises."""
    chosen = _chosen(query, project)
    own = platform.changes(template)
    common = (
        *own,
        *changes(project.changes, "sierra.toml: changes"),
        *(change for group in chosen.values() for change in group.changes),
    )
    before = Changed(template, common, {**FOLDERS, **_values(chosen)})
    follow = Follower(platform, Changed(template, own, before.values))
    spans = _spans(query, project, platform, before, follow, report)
    placed = tuple(_cells(query, spans, before, follow))
    cells = tuple(cell for cell, _, _ in placed)
    seed, run_changes = _seed_changes(project, platform), changes(project.run_changes, "sierra.toml: run_changes")
    per_run = (*seed, *run_changes)
    _check_lists(project, spans.axes)
    _check_effect(project, cells, per_run, (*platform.command(), *project.environment.set.values()))
    designed = Design(
        query=query,
        axes=spans.axes,
        cells=cells,
        per_run=per_run,
        lists=dict(project.per_run),
        independent_seeds=project.seed.independent,
        largest_seed=project.seed.max,
        on_robots=project.robots is not None,
    )
    sure: set[tuple[tuple[Change, ...], ...]] = set()
    runs = overwritten.different_runs(designed)[: None if project.run_changes else 1]
    for cell, where, following in placed:
        report(0, len(cells), len(cells) * query.runs)
        layers = (Layer("", common), *_layers(where, spans.theirs, query.sets, following, seed, run_changes))
        alike = tuple(layer.changes for layer in layers)
        if alike not in sure and not overwritten.check(template, designed, cell, layers):
            sure.add(alike)
        for of_run in runs:
            platform.check(Changed(template, (*cell.changes, *designed.per_run), {**cell.values, **of_run}), template)
    return designed


@dataclass(frozen=True, slots=True)
class Follower:
    """The platform's changes that follow from others, if it has such changes."""

    platform: Platform
    base: Changed
    bases: dict[tuple[tuple[str, Value], ...], Changed] = field(default_factory=dict)
    """The base with the values that its changes use: a controller that is an axis has another one in each experiment."""

    def __call__(self, document: Changed) -> tuple[Change, ...]:
        return self.platform.follow(document, self._base(document.values)) if isinstance(self.platform, Following) else ()

    def _base(self, values: Mapping[str, Value]) -> Changed:
        used = {kind: values[kind] for kind in GROUPED if kind in values}
        return self.bases.setdefault(tuple(used.items()), replace(self.base, values={**self.base.values, **used}))

    def complete(self, document: Changed) -> Changed:
        """Return an input with the changes that follow from its own."""
        following = self(document)
        return replace(document, changes=(*document.changes, *following)) if following else document


def changes(tables: tuple[ChangeTable, ...], why: str, value: str | None = None) -> tuple[Change, ...]:
    """Return the changes in tables of `sierra.toml`; `value` is the value of a `set` without one."""
    return tuple(_change(table, why, value) for table in tables)


def _change(table: ChangeTable, why: str, value: str | None) -> Change:
    if table.set is not None:
        given = table.value if table.value is not None else value
        if given is None:
            raise ConfigError(f'{why}: the "set" of {table.set!r} needs a "value"')
        return Set(table.set, given, table.attribute, table.expect, why)
    if table.add is not None:
        return Add(table.add, table.json_ or table.xml or "", table.at, table.expect, why)
    if table.remove is not None:
        return Remove(table.remove, table.expect, why)
    return Rename(table.rename or "", table.to or "", table.expect, why)


@dataclass(frozen=True, slots=True)
class Spans:
    """All axes with their points. The points of the platform's own axes depend on the places on the other axes."""

    axes: tuple[Axis, ...]
    own: tuple[bool, ...]
    """True for each axis that is the platform's own."""
    points: Mapping[tuple[int, ...], tuple[tuple[Point, ...], ...]]
    """The points of each axis, by the places on the other axes; the key is () if no axis is the platform's own."""

    @property
    def theirs(self) -> frozenset[str]:
        """The names of the platform's own axes."""
        return frozenset(axis.name for axis, own in zip(self.axes, self.own, strict=True) if own)

    def at(self, places: tuple[int, ...]) -> list[Placed]:
        """Return one point of each axis, in the order of their changes: the platform's own last."""
        others = tuple(place for place, own in zip(places, self.own, strict=True) if not own)
        points = self.points[others if any(self.own) else ()]
        placed = [(axis, all_of[place]) for axis, all_of, place in zip(self.axes, points, places, strict=True)]
        theirs = itertools.compress(placed, self.own)
        return [pair for pair, own in zip(placed, self.own, strict=True) if not own] + list(theirs)


def _spans(
    query: Query, project: Project, platform: Platform, common: Changed, follow: Follower, report: PlanningProgress
) -> Spans:
    """Return the axes and points. Raises QueryError if a criterion's axis depends on the values of the other criteria."""
    known = [_span(criterion, project) for criterion in query.criteria]
    own = tuple(span is None for span in known)
    _check_names(query, project, platform)
    others = [span for span in known if span is not None]
    _check_count(query, [axis for axis, _ in others], report)
    others = others if any(own) else []
    names = [criterion.name for criterion, theirs in zip(query.criteria, own, strict=True) if theirs]
    by_places: dict[tuple[int, ...], tuple[Spanned, ...]] = {}
    for places in itertools.product(*(range(len(axis.values)) for axis, _ in others)):
        chosen = [(axis, points[position]) for (axis, points), position in zip(others, places, strict=True)]
        template = _without(common, chosen, query.sets, names)
        template = follow.complete(template) if any(own) else template
        by_places[places] = tuple(
            span or _of_platform(criterion, project, platform, template)
            for criterion, span in zip(query.criteria, known, strict=True)
        )
        _check_same(next(iter(by_places.values())), by_places[places], chosen)
    first = next(iter(by_places.values()))
    axes = tuple(axis for axis, _ in first)
    _check_independent(first)
    _check_count(query, axes, report)
    return Spans(axes, own, {places: tuple(points for _, points in spanned) for places, spanned in by_places.items()})


def _check_names(query: Query, project: Project, platform: Platform) -> None:
    """Raise QueryError for a range with changes of its own for a criterion of the platform, which has other changes."""
    for one in query.criteria:
        changes_too = isinstance(one.scale, Computed) and one.scale.has_changes
        if changes_too and one.name not in project.variables and one.name in platform.criteria():
            raise QueryError(f"{one.name} is a criterion of the platform, but its range has changes of its own; rename it")


def _without(common: Changed, chosen: Sequence[Placed], sets: Sequence[Set], names: Sequence[str]) -> Changed:
    """Return an input without the criteria with these names, and without the changes that use their values."""
    every = (*common.changes, *(change for _, point in chosen for change in point.changes), *sets)
    others = tuple(change for change in every if not any(mentions(change, name) for name in names))
    return Changed(common.template, others, _together(common.values, chosen))


def _of_platform(criterion: Criterion, project: Project, platform: Platform, template: Reader) -> Spanned:
    found = platform.criterion(criterion, template)
    if found is None:
        raise QueryError(_unknown(criterion.name, project, platform))
    return found


def _check_same(first: Sequence[Spanned], spans: Sequence[Spanned], chosen: Sequence[Placed]) -> None:
    """Raise QueryError if an axis has several meanings in a batch; `first` has the axes at the first value of each."""
    for (before, _), (now, _) in zip(first, spans, strict=True):
        if before != now:
            starts = {axis.name: axis.values[0] for axis, _ in chosen}
            differ = [(axis.name, point.value) for axis, point in chosen if point.value != starts[axis.name]]
            start = ", ".join(f"{name}={starts[name]}" for name, _ in differ)
            point = ", ".join(f"{name}={value}" for name, value in differ)
            raise QueryError(
                f"{before.name} is {_few(before)} with {start}, but {_few(now)} with {point}; use one of these per query"
            )


def _few(axis: Axis) -> str:
    return ", ".join(map(str, axis.values[:4])) + (", …" if len(axis.values) > 4 else "")


def _span(criterion: Criterion, project: Project) -> Spanned | None:
    """Return the axis of one criterion, and the changes of each value; None if only the platform may know it."""
    if isinstance(criterion.scale, MonteCarlo):
        values = ranges.values(criterion.scale)
        return Axis(criterion.name, values), tuple(Point(v, (), stream) for stream, v in enumerate(values))
    if criterion.name in GROUPED:
        return _grouped(criterion, project)
    own_changes = isinstance(criterion.scale, Computed) and criterion.scale.has_changes
    declared = criterion.name in project.variables and project.changes_with(criterion.name)
    if not declared and not own_changes:
        return None
    variable = project.variables.get(criterion.name, Variable())
    every = _of_variable(criterion.name, variable)
    values = ranges.values(criterion.scale)
    axis = Axis(criterion.name, values, variable.label, variable.unit)
    if isinstance(criterion.scale, Computed):
        return axis, tuple(_with_changes(point, every, f"criterion {criterion.name!r}") for point in criterion.scale.points)
    return axis, tuple(Point(value, every) for value in values)


def _of_variable(name: str, variable: Variable) -> tuple[Change, ...]:
    """Return the changes that each value of a variable makes."""
    why, own = f"variable {name!r}", f"{{{name}}}"
    poses, seed = variable.start, f"{{seed}}/{name}"
    copies = (Repeat(variable.repeat, own, why=why, poses=poses, seed=seed),) if variable.repeat else ()
    first = (Set(variable.set, own, why=why),) if variable.set else ()
    return (*copies, *first, *changes(variable.changes, why, own))


def _with_changes(point: Point, first: tuple[Change, ...], why: str) -> Point:
    """Return a point of a plug-in with the changes of its variable before its own."""
    return replace(point, changes=(*first, *(replace(change, why=change.why or why) for change in point.changes)))


def _check_independent(spanned: Sequence[Spanned]) -> None:
    """Raise QueryError if two axes set the same place, because one would overwrite the other's values.

    A controller or scenario may set what a point of another axis replaces.
    """
    setters: dict[tuple[str, str | None] | None, str] = {}
    replaced = {_target(change) for _, points in spanned for point in points for change in point.replaces}
    for axis, points in spanned:
        for change in {change for point in points for change in point.changes if isinstance(change, Set | Repeat)}:
            target = _target(change)
            if axis.name in GROUPED and target in replaced:
                continue
            other = setters.setdefault(target, axis.name)
            if other != axis.name:
                raise QueryError(f"{other!r} and {axis.name!r} both set {change.path!r}; use only one of them")


def _target(change: Change) -> tuple[str, str | None] | None:
    if isinstance(change, Repeat):  # all items of the list
        return re.sub(r"\[[^\]]*\]$", "", change.path), "repeat"
    return (change.path, change.attribute) if isinstance(change, Set) else None


def _check_count(query: Query, axes: Sequence[Axis], report: PlanningProgress) -> None:
    experiments = math.prod(len(axis.values) for axis in axes)
    if experiments * query.runs > AT_MOST:
        raise QueryError(
            f"{experiments} experiments of {query.runs} runs are {experiments * query.runs} runs; a batch has at most {AT_MOST}"
        )
    report(0, experiments, experiments * query.runs)


def _check_lists(project: Project, axes: Sequence[Axis]) -> None:
    """Raise ConfigError if a list has a name that already has a meaning in expressions."""
    for name in project.per_run:
        if name in {"seed", "run", *GROUPED, *(axis.name for axis in axes)}:
            raise ConfigError(f"[per_run] {name}: expressions already have another {name!r}; use another name")


def _check_effect(project: Project, cells: Sequence[Cell], per_run: tuple[Change, ...], command: Sequence[str]) -> None:
    """Raise QueryError for a controller or scenario that is not declared, and whose name no change and no command uses."""
    for kind in GROUPED:
        for cell in cells:
            name = cell.values.get(kind)
            if name is None or _groups(project, kind):
                continue
            variable = project.variables.get(kind)
            in_command = any(f"{{{kind}}}" in word for word in command) or (variable and variable.environment)
            if not in_command and not any(mentions(change, kind) for change in (*cell.changes, *per_run)):
                raise QueryError(f"{kind} {name!r} changes nothing; sierra.toml does not declare it ([{kind}s.{name}])")


def mentions(change: Change, name: str) -> bool:
    """Return True if an expression in a change uses a name."""
    match change:
        case Set(value=text) | Add(xml=text) | Rename(to=text) | Repeat(count=text):
            return re.search(rf"\{{[^}}]*\b{name}\b", text) is not None
        case Remove():
            return False


def _unknown(name: str, project: Project, platform: Platform) -> str:
    known = [
        *project.variables,
        *platform.criteria(),
        *(kind for kind in GROUPED if _groups(project, kind) and kind not in project.variables),
        "montecarlo",
    ]
    close = difflib.get_close_matches(name, known, 1, cutoff=0.5)
    hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}"
    return f"unknown variable {name!r}; {hint} ([variables] in sierra.toml declares them)"


def _grouped(criterion: Criterion, project: Project) -> Spanned:
    if not isinstance(criterion.scale, Listed):
        raise QueryError(f"the values of {criterion.name!r} must be names; use {criterion.name}=one,two")
    values = tuple(map(str, criterion.scale.values))
    groups = [_group(project, criterion.name, value) for value in values]
    points = tuple(Point(group.name, group.changes, parameters=group.parameters) for group in groups)
    variable = project.variables.get(criterion.name, Variable())
    return Axis(criterion.name, values, variable.label or criterion.name.capitalize(), variable.unit), points


def _groups(project: Project, kind: str) -> Mapping[str, Group]:
    return project.controllers if kind == "controller" else project.scenarios


@dataclass(frozen=True, slots=True)
class ChosenGroup:
    """A controller or scenario with its changes, and the numbers in its name."""

    name: str
    changes: tuple[Change, ...] = ()
    parameters: Mapping[str, Value] = field(default_factory=dict)


def _group(project: Project, kind: str, name: str) -> ChosenGroup:
    """Return a group. Raises QueryError if its name is unknown, ambiguous or a category."""
    groups = _groups(project, kind)
    if not groups:
        variable = project.variables.get(kind)
        return ChosenGroup(name, _of_variable(kind, variable) if variable else ())
    if members := [other for other in groups if other.startswith(f"{name}.") and name in groups]:
        raise QueryError(f"{kind} {name!r} is a category; use one of {', '.join(members)}")
    resolved = group_names.resolve(name, groups)
    if not resolved:
        known = [member for member in groups if not group_names.is_category(member, groups)]
        raise QueryError(f"unknown {kind} {name!r}; known are {', '.join(known)}")
    if len(resolved) > 1:
        raise QueryError(f"{kind} {name!r} is ambiguous: it fits {' and '.join(member.declared[-1] for member in resolved)}")
    every = [change for member in resolved[0].declared for change in changes(groups[member].changes, f"{kind} {member!r}")]
    return ChosenGroup(name, tuple(every), resolved[0].parameters)


def _chosen(query: Query, project: Project) -> dict[str, ChosenGroup]:
    """Return the controller and the scenario if they are not axes: the requested ones, or the project's own."""
    chosen: dict[str, ChosenGroup] = {}
    spanned = {criterion.name for criterion in query.criteria}
    for kind in GROUPED:
        requested = getattr(query, kind)
        if kind in spanned:
            if requested:
                raise QueryError(f"{kind} is an axis of this query; leave out --{kind} {requested}")
        elif name := requested or getattr(project, kind):
            chosen[kind] = _group(project, kind, name)
    return chosen


def _values(chosen: Mapping[str, ChosenGroup]) -> dict[str, Value]:
    """Return the names of the controller and the scenario, and the numbers in them. Raises QueryError if two have one name."""
    values: dict[str, Value] = {kind: group.name for kind, group in chosen.items()}
    for group in chosen.values():
        values = _joined(values, group.parameters)
    return values


def _together(values: Mapping[str, Value], placed: Sequence[Placed]) -> dict[str, Value]:
    """Return values with those of points, and with their parameters. Raises QueryError for a name that has two values."""
    together = {**values, **{axis.name: point.value for axis, point in placed}}
    for _, point in placed:
        together = _joined(together, point.parameters)
    return together


def _joined(values: Mapping[str, Value], parameters: Mapping[str, Value]) -> dict[str, Value]:
    if both := sorted(name for name in values.keys() & parameters.keys() if values[name] != OF_WORKER.get(name)):
        raise QueryError(
            f"{both[0]!r} has two values: it is also a parameter in the name of a controller or scenario; rename it"
        )
    return {**values, **parameters}


def _cells(
    query: Query, spans: Spans, common: Changed, follow: Follower
) -> Iterator[tuple[Cell, list[Placed], tuple[Change, ...]]]:
    """Yield the experiments, each with its place on the axes, and the last of its changes: those that follow from others."""
    every = itertools.product(*(range(len(axis.values)) for axis in spans.axes))
    for ordinal, places in enumerate(every):
        placed = spans.at(places)
        values = {axis.name: axis.values[position] for axis, position in zip(spans.axes, places, strict=True)}
        own = sorted((change for _, point in placed for change in point.changes), key=_is_value)
        stream = max((point.stream for _, point in placed), default=0)
        together = {**_together(common.values, placed), **values}
        document = Changed(common.template, (*common.changes, *own, *query.sets), together)
        following = follow(document)
        yield Cell(ordinal, together, (*document.changes, *following), stream), placed, following


def _is_value(change: Change) -> bool:
    """Return False for copies, which are made before the values of other variables are set in them."""
    return not isinstance(change, Repeat)


def _layers(
    placed: Sequence[Placed],
    theirs: frozenset[str],
    sets: Sequence[Set],
    following: tuple[Change, ...],
    seed: tuple[Change, ...],
    run_changes: tuple[Change, ...],
) -> Iterator[Layer]:
    """Yield all layers that follow the common changes of a batch, in order; `theirs` are the platform's own axes."""
    for axis, point in placed:
        name, last = f"{axis.name}={point.value}", axis.name in theirs
        yield Layer(name, point.changes, axis=True, last=last, yields=axis.name in GROUPED, replaces=point.replaces)
    for change in sets:
        yield Layer(f"--set {change.path}", (change,))
    if following:
        yield Layer("the platform's rule", following)
    yield Layer("the seed", seed, each_run=True)
    yield Layer("run_changes", run_changes, each_run=True)


def _seed_changes(project: Project, platform: Platform) -> tuple[Change, ...]:
    if project.seed.set is not None:
        return (Set(project.seed.set, "{seed}", why="seed"),)
    return platform.seed_changes()
