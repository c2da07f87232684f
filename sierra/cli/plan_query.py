"""The plan of a query that a command gets as criteria, as the id of a batch, or as a file with a request."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from sierra.cli.output import note
from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.execution.observer import Observer
    from sierra.execution.plan import Plan


class Settings(TypedDict):
    """The settings of a query that are given as options."""

    runs: int | None
    controller: str | None
    scenario: str | None
    sets: list[tuple[str, str]]


def plans(
    project: Project, query: list[str], settings: Settings, targets: str | None, *, engine: str | None, observer: Observer
) -> list[Plan]:
    """Return a plan for each target; `targets` are names that are separated by commas. Without any, return one plan."""
    from sierra.design.query import query_request

    if targets is None:
        return [plan(project, query, settings, engine=engine, observer=observer)]
    if query[0].endswith(query_request.SUFFIX):
        raise UsageError(f'{query[0]} is a complete request; leave out --target, and write "target" into the file')
    return project.plans.of_targets(*query, **settings, targets=targets.split(","), engine=engine, observer=observer)


def plan(project: Project, query: list[str], settings: Settings, *, engine: str | None, observer: Observer) -> Plan:
    """Return the plan of a query, or of the request in a file.

    Prints a note if the file names a batch that the request no longer gives.
    """
    from sierra.design.query import query_request
    from sierra.util.hashing import short

    if not query[0].endswith(query_request.SUFFIX):
        return project.plan(*query, **settings, engine=engine, observer=observer)
    if len(query) > 1 or any(settings.values()):
        raise UsageError(
            f"{query[0]} is a complete request; leave out other criteria, --runs, --controller, --scenario and --set"
        )
    recorded = query_request.read(Path(query[0]))
    planned = project.plans.resolve(recorded.request, engine=engine, observer=observer)
    if recorded.batch not in (None, planned.batch.id):
        inside = Path(query[0]).resolve().is_relative_to(project.root)
        hint = " (the file is part of its source: move it elsewhere, or let git ignore it)" if inside else ""
        note(f"the project has changed since {query[0]} was written{hint}: then it was batch {short(recorded.batch)}")
    return planned
