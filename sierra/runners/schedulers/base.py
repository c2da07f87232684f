"""The Scheduler contract, and a function that finds a scheduler by its name.

SIERRA ships `slurm` and `pbs`. Plug-ins for others (LSF, HTCondor) come as entry points of the group `sierra.schedulers` (see
`sierra.plugin`). `sierra.testing.runners` has the conformance suite, which needs a real cluster.

A scheduler's answer is only a hint. The truth about a run is what an element has recorded (see `sierra.worker.array_task`). The
scheduler is asked for one thing: whether more may come. So it need not know how jobs ended, it may forget them, and it may be
unreachable for a day. Its commands are called as argv tuples, with text formats that are the same in all its versions.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

from sierra.config.cluster_table import ClusterTable, check_directives
from sierra.config.plugin_registry import SCHEDULERS
from sierra.config.validate import options
from sierra.store.layout import SessionPaths
from sierra.util.lazy_definitions import dataclass, field

if TYPE_CHECKING:
    from sierra.runners.base import Work

NAME_LENGTH = 15
"""Length of the longest job name that all schedulers accept."""


class State(StrEnum):
    """State of one task, as the scheduler reports it."""

    QUEUED = "queued"
    RUNNING = "running"
    STUCK = "stuck"
    """It will never begin as it is: no node satisfies the request, a dependency failed, or it is held after a failed launch."""
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class Task:
    """One element of a job, as the scheduler reports it."""

    job: str
    """The job's id, which `cancel` accepts."""
    element: int | None
    """Index in the array; None if the job is not an array, or if no element of the array has begun."""
    state: State
    reason: str = ""
    """The scheduler's own words for why it waits or how it ended (NODE_FAIL, TIMEOUT, OUT_OF_MEMORY)."""
    node: str = ""
    cancelled: bool | None = None
    """True if it ended because somebody cancelled it, False if it certainly ended for another reason. None if it has not
    ended, or if the scheduler cannot tell.
    """
    blameless: bool = False
    """True if it ended and no run of it can be the cause: its host was switched off, or lost its connection."""


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit of a site."""

    most: float
    whose: str
    """The place where it is set, in the scheduler's words, for example `MaxWall of QOS short`."""


def least(*limits: Limit | None) -> Limit | None:
    """Return the lowest of these limits; None if there are none."""
    return min(filter(None, limits), key=lambda limit: limit.most, default=None)


@dataclass(frozen=True, slots=True)
class Bounds:
    """The limits of a site. None means unknown or unlimited."""

    array: int | None = None
    """Largest number of elements of one array."""
    jobs: int | None = None
    """Largest number of queued and running jobs at a time; each element counts as a job."""
    wall_s: float | None = None
    """Largest number of seconds that an element may take in the requested partition."""
    running: int | None = None
    """Largest number of jobs that run at a time; others wait."""
    whose: Mapping[str, str] = field(default_factory=dict)
    """The place where each limit is set, in the scheduler's words, by the name of the limit."""

    @classmethod
    def of(cls, **limits: Limit | None) -> Bounds:
        """Make the bounds from limits by the names of the fields."""
        known = {name: limit for name, limit in limits.items() if limit is not None}
        most = {name: limit.most if name == "wall_s" else int(limit.most) for name, limit in known.items()}
        return cls(**most, whose={name: limit.whose for name, limit in known.items()})  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Request:
    """One array job to submit."""

    name: str
    """At most NAME_LENGTH letters, digits and `-`. It is the same for all jobs of a session, which are found by it."""
    comment: str
    elements: tuple[int, ...]
    """Indices in ascending order, with or without gaps."""
    folder: Path
    """A folder on the shared file system: the working directory, and the folder of the script."""
    logs: Path
    """The folder for the output of the script: one file for each element and job."""
    command: tuple[str, ...]
    """The command that the script executes in the end, by `exec`. The index of the element is added as its last argument."""
    after: str = ""
    """A job that must have ended successfully before. If it fails, this job may be cancelled or become STUCK."""


@dataclass(frozen=True, slots=True)
class NodeVariables:
    """The variables of the environment by which a scheduler tells a task what the node gives it.

    All are texts with names in braces, such as `{SLURM_JOB_ID}`. The first text counts whose variables are all set.
    Variables that belong to no scheduler, such as CUDA_VISIBLE_DEVICES and TMPDIR, are tried after these.
    """

    task: tuple[str, ...] = ()
    """The task's id, as `requeue` takes it."""
    job: tuple[str, ...] = ()
    """An id that no other task of the cluster has; empty: that of the task."""
    restarts: tuple[str, ...] = ()
    """The number of times that the task was started again."""
    host: tuple[str, ...] = ()
    """The scheduler's name for the node."""
    cores: tuple[str, ...] = ()
    memory_mib: tuple[str, ...] = ()
    """A number of MiB, or a product, such as `{SLURM_MEM_PER_CPU}*{SLURM_CPUS_ON_NODE}`."""
    gpus: tuple[str, ...] = ()
    """The indices of the devices."""
    scratch: tuple[str, ...] = ()
    """A folder on a disk of the node."""
    end: tuple[str, ...] = ()
    """When the task will be ended, in seconds since 1970."""
    clock: tuple[str, ...] = ()
    """The seconds that the node's clock is ahead of the submitting host's; empty: compared with the shared file system's."""
    others: tuple[str, ...] = ()
    """Further variables that are recorded with the allocation."""


class Scheduler(Protocol):
    """One way to execute elements on a cluster's nodes.

    A class may also have an attribute `node`, its NodeVariables. Without it, nothing is known of what a node gives. A class
    whose nodes share no file system with this machine is a `Carries`.
    """

    name: str
    Options: ClassVar[type[ClusterTable]]
    """The model of `[runners.…]` for clusters with this scheduler: `ClusterTable`, or a subclass with keys of its own."""

    def __init__(self, table: ClusterTable) -> None:
        """Make a scheduler from the project's `table` for the cluster, an object of `Options`."""
        ...

    @staticmethod
    def refuses(line: str) -> str | None:
        """Return the reason why a line of `directives` cannot be added to scripts, with an alternative; None if it can.

        Lines that contradict what `script` writes must be refused: many schedulers use one of the two without a message.
        """
        ...

    @property
    def requeue(self) -> tuple[str, ...]:
        """Command by which a task asks to be started again later; the task adds its own id. Empty if there is none."""
        ...

    @property
    def forgets(self) -> bool:
        """True if `look` omits ended tasks. A task that vanishes while it waits was cancelled then."""
        ...

    def version(self) -> str:
        """Return the scheduler and its version, for example `slurm 22.05.8`.

        Raises Missing if its commands are not on this host.
        """
        ...

    def bounds(self) -> Bounds:
        """Return the site's limits. Raises Missing if the scheduler cannot be reached."""
        ...

    def script(self, request: Request) -> str:
        """Return the whole script that `submit` submits: directives, modules, the command. It contains no secret."""
        ...

    def submit(self, request: Request) -> str:
        """Submit the job and return its id. Nothing of the caller's environment is passed on.

        Raises ConfigError, with the scheduler's own words, for a request that it refuses (a partition, an account, a limit).
        Raises Full if it refuses because too many jobs are there at a time. Raises Missing if it cannot be reached. It may have
        taken the job all the same then; `look` will show this.
        """
        ...

    def look(self, name: str) -> tuple[Task, ...] | None:
        """Return all tasks of the caller's jobs of that name that the scheduler knows, by one call.

        Ended tasks may be left out. Return None if the scheduler cannot be reached, so that nothing is known.
        """
        ...

    def explain(self, words: str) -> str:
        """Return an explanation of the scheduler's words about a request that it refuses or will never begin.

        The explanation is one line. It begins with these words. It names the settings of the table that they are about and what
        the site offers, as far as these are known. It raises nothing.
        """
        ...

    def cancel(self, name: str, elements: Sequence[int] | None = None) -> None:
        """Cancel the jobs of that name, or only these elements of them. It is idempotent, and there may be no such job."""
        ...


@runtime_checkable
class Carries(Protocol):
    """A scheduler that itself carries the files of a session to its hosts, and the result logs back.

    Each element is executed with one core. No job checks the nodes first. Each execution begins with an empty checkpoint.
    """

    def open(self, session: SessionPaths, work: Work | None, *, follows: bool) -> None:
        """Begin to work for a session. It is called before all other methods that have to do with jobs.

        `follows`: this process follows the session. Otherwise, only `look` and `cancel` are called. `work` is None if the
        session was submitted before. Raises ConfigError, and Missing if no host can be reached.
        """

    def sizes(self, durations: Sequence[float]) -> Sequence[int]:
        """Return the numbers of runs of the elements into which runs of these durations (in s) are divided, in this order.

        It may be called before `open`, to estimate this.
        """

    def notes(self) -> Sequence[str]:
        """Return the messages for the user since the last call."""

    def blameless(self) -> Collection[str]:
        """Return the ids of tasks, by NodeVariables.job, that ended through no fault of their runs."""

    def leave(self) -> None:
        """Let the hosts execute everything that is submitted, also if no process follows."""

    def close(self, *, over: bool) -> None:
        """End the connections. `over`: everything is recorded, so hosts may forget the session. It may be called again."""


def find(name: str) -> type[Scheduler]:
    """Return the scheduler of that name. Raises ConfigError if there is none."""
    kind: type[Scheduler] = SCHEDULERS.load(name)
    return kind


def table(scheduler: str, settings: Mapping[str, object], name: str) -> ClusterTable:
    """Return the table of a cluster, validated by its scheduler. `name` is the cluster's, for messages. Raises ConfigError."""
    kind, where = find(scheduler), f"[runners.{name}]"
    validated = options(kind.Options, settings, where)
    check_directives(validated, kind.refuses, where, name)
    return validated


def recorded_table(scheduler: str, settings: Mapping[str, object]) -> ClusterTable:
    """Return the table of a cluster from its JSON form. Raises ConfigError for an unknown scheduler, ValueError otherwise."""
    return find(scheduler).Options.model_validate({**settings, "scheduler": scheduler})
