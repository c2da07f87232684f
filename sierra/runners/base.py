"""Where runs execute: the Runner contract, and the door to find one by name.

Shipped: `local`, and `slurm` and `pbs`, which are one runner over two schedulers (see `sierra.runners.schedulers.base`). Others
come as entry points of the group `sierra.runners`, each naming a class that fulfils `Runner`, or of `sierra.schedulers`.
`sierra.testing.runners` holds them to it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

from sierra.config.project_file import ClusterTable
from sierra.errors import ConfigError, SierraError
from sierra.model import Job, Requirement, Result, Times
from sierra.provenance.program import INSTALLED, Kind, Program, Programs
from sierra.runners import schedulers
from sierra.store.layout import SessionPaths
from sierra.util import entry_points

SHIPPED = {"local": "sierra.runners.local:Local"}


@dataclass(frozen=True, slots=True)
class Work:
    """What is to be executed."""

    jobs: Iterable[Job]
    """Read as slots become free, perhaps in another thread."""
    count: int
    batch: str
    needs: tuple[Requirement, ...] = ()
    times: Times | None = None
    """What runs are expected to take; None where nobody knows."""
    waits: bool = True
    """Whether somebody follows it from now on."""
    record: tuple[str, ...] = ()
    """Variables (or patterns) that are recorded of what is around runs."""
    around: Mapping[str, Any] = field(default_factory=dict)
    """The row of `environments` of this process: what a node does not say of itself is taken from it."""


@dataclass(frozen=True, slots=True)
class Look:
    """What has happened since the last look."""

    results: tuple[Result, ...]
    running: int
    """Runs in flight now."""
    alive: bool
    """Whether more may come."""
    rows: tuple[tuple[str, dict[str, Any]], ...] = ()
    """What is to be recorded beside: rows by their table."""
    notes: tuple[str, ...] = ()
    """What the user should know, now."""
    queued: int = 0
    """Elements that wait for a node."""
    waits: str = ""
    """Why they wait, in the scheduler's words; empty where it does not say."""
    copies: tuple[Result, ...] = ()
    """Runs that were executed once more than was asked; without a directory."""
    wrong: SierraError | None = None
    """Why nothing more will come although runs are missing; it is raised then. Asking again would end the same way."""


class Runner(Protocol):
    """One place where runs execute. What it says of a run is only ever what the run's worker recorded."""

    name: str
    stays: bool
    """Whether what it has started lives on without this process; else it ends with it."""

    def __init__(self, slots: int, table: ClusterTable) -> None:
        """`slots`: how many runs execute at a time, where this machine executes them; `table` is the project's."""
        ...

    def submit(self, work: Work, session: SessionPaths) -> None:
        """Start executing; called once for a session.

        Raises ConfigError, Missing for what is refused or not there; nothing runs then.
        """
        ...

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        """Take over, instead of `submit`, what another process has submitted, however far that came.

        `recorded` are the executions that the store has, with their attempts: `look` does not tell of them. Only where `stays`.
        """
        ...

    def look(self) -> Look:
        """What has happened; returns at once and may be called at any time after `submit` or `resume`.

        A result's directory is its reader's from then on, to be removed. What was lost (a node, a job that nobody knows) is
        started again in here, a bounded number of times; then its runs have failed. What somebody else has cancelled is not: it
        ends all, as `stop` does.

        Raises SierraError where the runner itself cannot go on (a full disk, no worker); asking again goes on then.
        """
        ...

    def leave(self) -> None:
        """This process goes, and nobody may follow for long: hand over what was held back. Only where `stays`."""
        ...

    def stop(self) -> None:
        """Start nothing more and end what runs; `look` tells the end of those too. May be called again."""
        ...

    def close(self) -> None:
        """Give back what this process holds, once all results are recorded; what lives on, lives on. May be called again."""
        ...


def needed(programs: Programs, search: str) -> tuple[Requirement, ...]:
    """The files among what runs depend on, whose PATH is `search`; of what a Python has installed, names and versions alone.

    The command's own program, which is the first, is called by its path: see `sierra.execution.commands.CommandBuilder`.
    """
    from sierra.worker import array_task

    files = [one for one in programs.all if one.kind != Kind.DISTRIBUTIONS]
    called = {one.path for one in files[1:] if _is_called(one, search)}
    folders = (one for one in programs.all if one.kind == Kind.DISTRIBUTIONS and one.name.endswith(INSTALLED))
    return (
        *(
            Requirement(one.name, one.path, one.sha256, search if one.path in called else "", link=one.kind == Kind.LINK)
            for one in files
        ),
        *(Requirement(one.name, one.path, holds=array_task.installed(one.path)) for one in folders),
    )


def _is_called(program: Program, search: str) -> bool:
    """Whether it is found by its name alone."""
    return os.sep not in program.name and shutil.which(program.name, path=search) == program.path


def find(name: str, tables: Mapping[str, ClusterTable] | None = None) -> Callable[[int], Runner]:
    """What makes the runner of that name, for a number of slots. `tables`: the clusters that the project names.

    Raises ConfigError where there is none.
    """
    found = scheduler_of(name, tables)
    if found is None:
        return partial(_runner(name), table=ClusterTable())
    from sierra.runners.cluster.runner import Cluster

    scheduler, table = found
    made: Callable[[int], Runner] = partial(Cluster, table=table, name=name, scheduler=scheduler)
    return made


def scheduler_of(name: str, tables: Mapping[str, ClusterTable] | None = None) -> tuple[str, ClusterTable] | None:
    """The scheduler of the cluster of that name, and what the project says of it; None where the name is another runner's.

    Raises ConfigError where there is none of that name.
    """
    table = (tables or {}).get(name)
    if table is None and name in entry_points.names("runner", SHIPPED):
        return None
    known = entry_points.names("scheduler", schedulers.SHIPPED)
    scheduler = (table and table.scheduler) or name
    if scheduler in known:
        return scheduler, table or ClusterTable()
    if table is not None:
        raise ConfigError(f"[runners.{name}] needs a scheduler: {', '.join(known)}")
    named = dict.fromkeys((*entry_points.names("runner", SHIPPED), *known, *(tables or {})))
    raise ConfigError(f"unknown runner {name!r}; known are {', '.join(named)}")


def _runner(name: str) -> Callable[..., Runner]:
    made: Callable[..., Runner] = entry_points.find("runner", SHIPPED, name)
    return made
