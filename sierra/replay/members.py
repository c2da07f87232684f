"""Members of replayed runs, which are robots: who may execute them again, and which other processors they had."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import NamedTuple

from sierra.config.project_file import LoadedProject
from sierra.errors import Missing, UsageError
from sierra.execution.members import check_places
from sierra.execution.plan import session_step
from sierra.runners.base import Runner, RunsMembers
from sierra.store.store import Store
from sierra.templates.base import Files
from sierra.util.hashing import short

PROCESSORS = """
SELECT DISTINCT was.place, was.machine, now.machine AS found
FROM robots was JOIN executions e USING (execution) JOIN executions f USING (run)
JOIN robots now ON now.execution = f.execution AND now.place = was.place
WHERE list_contains($recorded, e.execution) AND list_contains($made, f.execution) AND was.machine <> now.machine
ORDER BY ALL
"""
"""SQL: the places whose robots had another processor."""


def check(runner: Runner, name: str, of: str, inputs: Iterable[Files], groups: Collection[str]) -> None:
    """Raise UsageError if a runner cannot execute runs on robots again, ConfigError if its fleet does not fit them.

    `of` is the id of what is replayed, and `groups` are the groups of places that the project declares.
    """
    if not isinstance(runner, RunsMembers):
        raise UsageError(
            f"{short(of)} was executed on robots, and runner {name!r} cannot execute it again; use --on robots (a replay "
            "needs robots, but not the same ones)"
        )
    check_places(runner, inputs, groups)


def check_attended(of: str, project: LoadedProject) -> None:
    """Raise Missing if robots would move without a person, although an extension executes their runs one by one."""
    if step := session_step(project):
        raise Missing(
            f"{short(of)} has {step.runs} ([trials]), and a replay asks nobody before the robots move: use --yes if they "
            "may start at once, one run after the other"
        )


class _Processor(NamedTuple):
    place: int
    machine: str
    found: str


def other_processors(store: Store, recorded: Collection[str], made: Collection[str]) -> list[str]:
    """Return a note on each place whose robot had another processor in the executions `made` than in the recorded ones."""
    rows = store.select(_Processor, PROCESSORS, recorded=list(recorded), made=list(made))
    return [f"different processor at place {row.place}: was {row.machine}, is now {row.found}" for row in rows]
