"""What shares a cluster's nodes out: the Scheduler contract, and the door to find one by name.

Shipped: `slurm` and `pbs`. Others (LSF, HTCondor) come as entry points of the group `sierra.schedulers`, each naming a
class that fulfils `Scheduler`; `sierra.testing.runners` holds them to it, on a real cluster.

A scheduler's word is a hint, never the truth of a run: only what an element has recorded is (see `sierra.worker.array_task`).
It is asked for one thing, whether anything may still come. So a scheduler need not know how jobs ended, may forget them, and
may be out of reach for a day. Its commands are called as argv, with text formats that are the same in all its versions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from sierra.config.project_file import ClusterTable
from sierra.util import entry_points

SHIPPED = {
    "slurm": "sierra.runners.schedulers.slurm:Slurm",
    "pbs": "sierra.runners.schedulers.pbs:Pbs",
}
NAME_LENGTH = 15
"""The longest name of a job that all schedulers take."""


class State(StrEnum):
    """What a scheduler says of one task."""

    QUEUED = "queued"
    RUNNING = "running"
    STUCK = "stuck"
    """It will never begin as it is: a request that no node satisfies, a dependency that failed, held after a failed launch."""
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class Task:
    """One element of a job, as the scheduler tells of it."""

    job: str
    """The job's id, which `cancel` takes."""
    element: int | None
    """Its index in the array; None where the job is no array, or where no element of one has begun."""
    state: State
    reason: str = ""
    """The scheduler's own words: why it waits, or how it ended (NODE_FAIL, TIMEOUT, OUT_OF_MEMORY)."""
    node: str = ""
    cancelled: bool = False
    """Whether it has ended because somebody cancelled it, and not by a limit, a lost node or preemption."""


@dataclass(frozen=True, slots=True)
class Limit:
    """Something that a site allows."""

    most: float
    whose: str
    """Where it is set, in the scheduler's words: `MaxWall of QOS short`."""


def least(*limits: Limit | None) -> Limit | None:
    """The one that is met first."""
    return min(filter(None, limits), key=lambda limit: limit.most, default=None)


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a site allows; None is not known, or without bound."""

    array: int | None = None
    """Elements of one array."""
    jobs: int | None = None
    """Jobs (elements count each) that may be there at a time."""
    wall_s: float | None = None
    """Seconds that an element may take in the partition that is asked for."""
    running: int | None = None
    """Jobs that may run at a time; others wait."""
    whose: Mapping[str, str] = field(default_factory=dict)
    """Where each of these is set, by its name, in the scheduler's words."""

    @classmethod
    def of(cls, **limits: Limit | None) -> Bounds:
        """By the names of the above."""
        known = {name: limit for name, limit in limits.items() if limit is not None}
        most = {name: limit.most if name == "wall_s" else int(limit.most) for name, limit in known.items()}
        return cls(**most, whose={name: limit.whose for name, limit in known.items()})  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Request:
    """One array job that is asked for."""

    name: str
    """At most NAME_LENGTH letters, digits and `-`; the same for all jobs of a session, by which they are found again."""
    comment: str
    elements: tuple[int, ...]
    """The indices, ascending, without gaps or with."""
    folder: Path
    """On the shared file system: the working directory, and where the script lies."""
    logs: Path
    """The folder of what the script prints: one file for each element and job."""
    command: tuple[str, ...]
    """What the script executes in the end, by `exec`; the index of the element is put after it, as its last argument."""
    after: str = ""
    """A job that must have ended well before; where it has not, these may be cancelled, or be STUCK."""


class Scheduler(Protocol):
    """One way to have elements executed on a cluster's nodes."""

    name: str

    def __init__(self, table: ClusterTable) -> None:
        """`table`: what the project says of this cluster."""
        ...

    @property
    def requeue(self) -> tuple[str, ...]:
        """The command by which a task has itself begun anew later, to which its own id is added; empty where there is none."""
        ...

    @property
    def forgets(self) -> bool:
        """Whether `look` leaves out what has ended. A task that vanishes while it waits was cancelled then."""
        ...

    def version(self) -> str:
        """The scheduler and its version, as in `slurm 22.05.8`. Raises Missing where its commands are not here."""
        ...

    def bounds(self) -> Bounds:
        """What the site allows. Raises Missing where it can't be reached."""
        ...

    def script(self, request: Request) -> str:
        """The whole script that `submit` hands over: directives, modules, the command. Nothing of it is secret."""
        ...

    def submit(self, request: Request) -> str:
        """Hand it over; the job's id. Nothing of the caller's environment goes along.

        Raises ConfigError for what the scheduler refuses (a partition, an account, a limit), in its own words; Full where it
        refuses because too much is there at a time; Missing where it can't be reached, and then it may have been taken all
        the same: `look` will tell.
        """
        ...

    def look(self, name: str) -> tuple[Task, ...] | None:
        """All tasks of the caller's jobs of that name that the scheduler knows of, by one call; those that have ended may be
        left out. None where it can't be reached: nothing is known then.
        """
        ...

    def explain(self, words: str) -> str:
        """The scheduler's words on a request that it refuses, or will never begin, and what they are about: which of the
        table's settings, and what the site has, as far as these are known. In one line; raises nothing.
        """
        ...

    def cancel(self, name: str, elements: Sequence[int] | None = None) -> None:
        """Ask that the jobs of that name end (or only these elements of them); idempotent, also where there is none."""
        ...


def find(name: str) -> type[Scheduler]:
    """The scheduler of that name. Raises ConfigError where there is none."""
    found: type[Scheduler] = entry_points.find("scheduler", SHIPPED, name)
    return found
