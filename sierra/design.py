"""From a query to a design: the axes, and what each experiment and each run changes in the template.

Changes are made in this order, later ones over earlier ones: the platform's, the project's own, the
controller's, the scenario's, the criteria's (in their order), `--set`; then, in each run, the seed and the
project's `run_changes`.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Mapping, Sequence

from sierra import scales
from sierra.config import ChangeTable, Group, Project
from sierra.errors import ConfigError, QueryError
from sierra.model import (
    Add,
    Axis,
    Cell,
    Change,
    Criterion,
    Design,
    Listed,
    MonteCarlo,
    Point,
    Query,
    Remove,
    Rename,
    Set,
    Value,
)
from sierra.platforms import Platform, Reader

GROUPED = ("controller", "scenario")
AT_MOST = 1_000_000
"""Runs that a batch may have."""


def design(query: Query, project: Project, platform: Platform, template: Reader) -> Design:
    """What `query` asks for. Raises QueryError, ConfigError for names that are not there."""
    spanned = [_span(criterion, project, platform, template) for criterion in query.criteria]
    axes = tuple(axis for axis, _ in spanned)
    _check_independent(spanned)
    _check_count(query, axes)
    chosen = _chosen(query, project, axes)
    common = (
        *platform.changes(template),
        *changes(project.changes, "sierra.toml: changes"),
        *(change for kind, name in chosen.items() if name for change in _group(project, kind, name)),
    )
    cells = tuple(
        _cell(ordinal, axes, points, chosen, common, query.sets)
        for ordinal, points in enumerate(itertools.product(*(points for _, points in spanned)))
    )
    per_run = (*_seed_changes(project, platform), *changes(project.run_changes, "sierra.toml: run_changes"))
    _check_lists(project, axes)
    _check_effect(project, cells, per_run)
    return Design(
        query=query,
        axes=axes,
        cells=cells,
        per_run=per_run,
        lists=dict(project.per_run),
        independent_seeds=project.seed.independent,
    )


def changes(tables: tuple[ChangeTable, ...], why: str, value: str | None = None) -> tuple[Change, ...]:
    """Changes as they are written in `sierra.toml`; `value` is what a `set` without one gives."""
    return tuple(_change(table, why, value) for table in tables)


def _change(table: ChangeTable, why: str, value: str | None) -> Change:
    if table.set is not None:
        given = table.value if table.value is not None else value
        if given is None:
            raise ConfigError(f'{why}: the "set" of {table.set!r} needs a "value"')
        return Set(table.set, given, table.attribute, table.expect, why)
    if table.add is not None:
        return Add(table.add, table.xml or "", table.at, table.expect, why)
    if table.remove is not None:
        return Remove(table.remove, table.expect, why)
    return Rename(table.rename or "", table.to or "", table.expect, why)


def _span(criterion: Criterion, project: Project, platform: Platform, template: Reader) -> tuple[Axis, tuple[Point, ...]]:
    """The axis of one criterion, and what each of its values changes."""
    if isinstance(criterion.scale, MonteCarlo):
        values = scales.values(criterion.scale)
        return Axis(criterion.name, values), tuple(Point(v, (), stream) for stream, v in enumerate(values))
    if criterion.name in GROUPED:
        return _grouped(criterion, project)
    if criterion.name in project.variables:
        variable = project.variables[criterion.name]
        why = f"variable {criterion.name!r}"
        own = "{" + criterion.name + "}"
        first = (Set(variable.set, own, why=why),) if variable.set else ()
        made = (*first, *changes(variable.changes, why, own))
        values = scales.values(criterion.scale)
        axis = Axis(criterion.name, values, variable.label, variable.unit)
        return axis, tuple(Point(value, made) for value in values)
    found = platform.criterion(criterion, template)
    if found is None:
        raise QueryError(_unknown(criterion.name, project, platform))
    return found


def _check_independent(spanned: Sequence[tuple[Axis, tuple[Point, ...]]]) -> None:
    """Two axes that set the same thing would make each other's values untrue."""
    setters: dict[tuple[str, str | None], str] = {}
    for axis, points in spanned:
        for change in {change for point in points for change in point.changes if isinstance(change, Set)}:
            place = (change.path, change.attribute)
            other = setters.setdefault(place, axis.name)
            if other != axis.name:
                raise QueryError(f"{other!r} and {axis.name!r} both set {change.path!r}; ask for one of them")


def _check_count(query: Query, axes: Sequence[Axis]) -> None:
    experiments = math.prod(len(axis.values) for axis in axes)
    if experiments * query.runs > AT_MOST:
        raise QueryError(
            f"{experiments} experiments of {query.runs} runs are {experiments * query.runs} runs; a batch has at most {AT_MOST}"
        )


def _check_lists(project: Project, axes: Sequence[Axis]) -> None:
    """A list may not be called as what expressions know already."""
    for name in project.per_run:
        if name in {"seed", "run", *GROUPED, *(axis.name for axis in axes)}:
            raise ConfigError(f"[per_run] {name}: expressions know another {name!r} already; take another name")


def _check_effect(project: Project, cells: Sequence[Cell], per_run: tuple[Change, ...]) -> None:
    """A controller or scenario that is no group, and that nothing in the template takes the name of, is a mistake."""
    for kind in GROUPED:
        for cell in cells:
            name = cell.values.get(kind)
            if name is None or name in _groups(project, kind):
                continue
            if not any(_mentions(change, kind) for change in (*cell.changes, *per_run)):
                raise QueryError(f"{kind} {name!r} changes nothing; sierra.toml declares none ([{kind}s.{name}])")


def _mentions(change: Change, name: str) -> bool:
    """Whether an expression in a change uses a name."""
    match change:
        case Set(value=text) | Add(xml=text) | Rename(to=text):
            return re.search(rf"\{{[^}}]*\b{name}\b", text) is not None
        case Remove():
            return False


def _unknown(name: str, project: Project, platform: Platform) -> str:
    known = [*project.variables, *platform.criteria(), *(kind for kind in GROUPED if _groups(project, kind)), "montecarlo"]
    close = difflib.get_close_matches(name, known, 1, cutoff=0.5)
    hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}"
    return f"unknown variable {name!r}; {hint} (sierra.toml: [variables] declares them)"


def _grouped(criterion: Criterion, project: Project) -> tuple[Axis, tuple[Point, ...]]:
    if not isinstance(criterion.scale, Listed):
        raise QueryError(f"{criterion.name!r} takes names, as in {criterion.name}=one,two")
    values = criterion.scale.values
    points = tuple(Point(value, _group(project, criterion.name, str(value))) for value in values)
    return Axis(criterion.name, tuple(map(str, values)), criterion.name.capitalize()), points


def _groups(project: Project, kind: str) -> Mapping[str, Group]:
    return project.controllers if kind == "controller" else project.scenarios


def _group(project: Project, kind: str, name: str) -> tuple[Change, ...]:
    groups = _groups(project, kind)
    if name not in groups:
        if groups:
            raise QueryError(f"unknown {kind} {name!r}; known are {', '.join(groups)}")
        return ()
    return changes(groups[name].changes, f"{kind} {name!r}")


def _chosen(query: Query, project: Project, axes: tuple[Axis, ...]) -> dict[str, str | None]:
    """Controller and scenario where they are no axes: asked for, or the project's own."""
    chosen: dict[str, str | None] = {}
    spanned = {axis.name for axis in axes}
    for kind in GROUPED:
        asked = getattr(query, kind)
        if kind in spanned:
            if asked:
                raise QueryError(f"{kind} is an axis of this query; leave out --{kind} {asked}")
            continue
        chosen[kind] = asked or getattr(project, kind)
    return chosen


def _cell(
    ordinal: int,
    axes: tuple[Axis, ...],
    points: tuple[Point, ...],
    chosen: Mapping[str, str | None],
    common: tuple[Change, ...],
    sets: tuple[Set, ...],
) -> Cell:
    values: dict[str, Value] = {axis.name: point.value for axis, point in zip(axes, points, strict=True)}
    names = {kind: name for kind, name in chosen.items() if name}
    own = tuple(change for point in points for change in point.changes)
    stream = max((point.stream for point in points), default=0)
    return Cell(ordinal, {**names, **values}, (*common, *own, *sets), stream)


def _seed_changes(project: Project, platform: Platform) -> tuple[Change, ...]:
    if project.seed.set is not None:
        return (Set(project.seed.set, "{seed}", why="seed"),)
    return platform.seed_changes()
