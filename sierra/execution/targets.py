"""Targets of queries: what a query needs of a target, the pairs of its runs in several targets, and the recorded target."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from sierra.config import group_names
from sierra.config.field_types import NAME
from sierra.config.project_file import LoadedProject
from sierra.design import platforms
from sierra.design.factorial_design import GROUPED
from sierra.errors import QueryError, UsageError
from sierra.model import Batch, Computed, Listed, Query
from sierra.store.store import Store
from sierra.util.text import few

if TYPE_CHECKING:
    from sierra.execution.plan import Plan

LAST = "SELECT coalesce(target, '') FROM sessions WHERE batch = $b ORDER BY lamport DESC LIMIT 1"


def check(project: LoadedProject, query: Query) -> None:
    """Raise QueryError if a variable, controller or scenario of a query has no changes for the chosen target."""
    if project.declared is None:
        return
    config, name = project.config, project.config.target
    chosen = [kind for kind in GROUPED if kind in config.variables and (getattr(query, kind) or getattr(config, kind))]
    lacking = [kind for kind in chosen if not config.changes_with(kind)] + [
        criterion.name
        for criterion in query.criteria
        if criterion.name in config.variables
        and not config.changes_with(criterion.name)
        and not (isinstance(criterion.scale, Computed) and criterion.scale.has_changes)
    ]
    own = platforms.find(config.platform, config).criteria() if lacking else ()
    if others := [name for name in lacking if name not in own]:
        raise QueryError(_lacking(project, "variable", others[0]))
    for kind, group in _groups(project, query):
        tables = project.declared.controllers if kind == "controller" else project.declared.scenarios
        for part in (part for member in group_names.resolve(group, tables) for part in member.declared):
            if tables[part].targets and "changes" not in tables[part].model_fields_set and name not in tables[part].targets:
                raise QueryError(_lacking(project, kind, part))


def _groups(project: LoadedProject, query: Query) -> Iterator[tuple[str, str]]:
    """Yield the controllers and scenarios of a query."""
    spanned = {criterion.name: criterion.scale for criterion in query.criteria}
    for kind in GROUPED:
        if isinstance(scale := spanned.get(kind), Listed):
            yield from ((kind, str(value)) for value in scale.values)
        elif name := getattr(query, kind) or getattr(project.config, kind):
            yield kind, name


def _lacking(project: LoadedProject, kind: str, called: str) -> str:
    if name := project.config.target:
        key = called if re.fullmatch(NAME, called) else f'"{called}"'
        return f"{kind} {called!r} has no change for target {name!r}; add [{kind}s.{key}.targets.{name}]"
    return f"{kind} {called!r} has no change without a target; use --target with {' or '.join(project.targets)}"


def of_batch(project: LoadedProject, store: Store, batch: str) -> LoadedProject:
    """Return the project for the target that a batch was last requested for, if the project still has that target."""
    if project.declared is None:
        return project
    name = recorded(store, batch)
    return project.for_target(name) if name in project.targets else project


def notes(project: LoadedProject, store: Store, batch: str) -> tuple[str, ...]:
    """Return a note if `of_batch` returns the project for another target than the batch was last requested for."""
    if project.declared is None:
        return ()
    name, default = recorded(store, batch), project.config.target
    if name in project.targets or name == default:
        return ()
    was = "without a target" if name is None else f"for target {name!r}, which sierra.toml no longer has"
    used = f"of the default target {default!r}" if default else "outside [targets]"
    return (f"the batch was requested {was}; its outputs, units and times are taken to be those {used}",)


def recorded(store: Store, batch: str) -> str | None:
    """Return the target that a batch was last requested for; None if it was none."""
    return next(iter(store.values(str, LAST, b=batch)), None) or None


def check_names(names: Sequence[str]) -> None:
    """Raise UsageError if there is no target, or the same one twice."""
    if not names or not all(names):
        raise UsageError("--target needs names of targets, as in --target sim,robots")
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"--target has {twice[0]!r} twice; name each target once")


def check_pairs(plans: Sequence[Plan]) -> None:
    """Raise QueryError if the batches of one query for several targets do not have the same values and seeds."""
    first, *others = plans
    for other in others:
        if (found := _unlike(first.batch, other.batch)) is not None:
            one, two = (plan.project.config.target for plan in (first, other))
            raise QueryError(f"the runs for targets {one!r} and {two!r} are no pairs: {found}")


def _unlike(one: Batch, other: Batch) -> str | None:
    """Return the first difference between the values and seeds of two batches, in words."""
    for mine, theirs in zip(one.axes, other.axes, strict=True):
        if (mine.name, mine.values) != (theirs.name, theirs.values):
            values = " and ".join(few(list(map(str, axis.values)), 4) for axis in (mine, theirs))
            return f"the values of {mine.name} are {values}; use a variable that has the same values for both"
    if [run.seed for run in one.runs] != [run.seed for run in other.runs]:
        return "their seeds differ"
    return None
