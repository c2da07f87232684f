"""The Runner contract, and functions that find a runner by its name.

SIERRA ships `local`, `slurm` and `pbs`. The last two are one runner over two schedulers (see `sierra.runners.schedulers.base`).
Plug-ins add others as entry points of the groups `sierra.runners` and `sierra.schedulers` (see `sierra.plugin`). The options of
a runner are in `[runners.NAME]`; those of a scheduler are in the table of each cluster that uses it.
`sierra.testing.runners` has the conformance suite.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from sierra.config.field_types import Table
from sierra.config.plugin_registry import Tables
from sierra.containers.on_hosts import HostContainers
from sierra.errors import Missing, SierraError, UsageError
from sierra.model import Job, LateFiles, Requirement, Result, Times
from sierra.provenance.dependency_model import INSTALLED, Kind, Program, Programs
from sierra.provenance.hash_cache import HashCache
from sierra.store.layout import SessionPaths
from sierra.util.json_types import JsonView, RecordValue
from sierra.util.lazy_definitions import dataclass, field


@dataclass(frozen=True, slots=True)
class Work:
    """The jobs of one session, and what a runner needs to know to execute them."""

    jobs: Iterable[Job]
    """The runner reads them as slots become free, perhaps in another thread."""
    count: int
    batch: str
    needs: tuple[Requirement, ...] = ()
    times: Times | None = None
    """Expected durations of the runs; None if they are unknown."""
    waits: bool = True
    """True if a process follows the session from now on."""
    record: tuple[str, ...] = ()
    """Names or patterns of the environment variables that are recorded."""
    around: Mapping[str, JsonView] = field(default_factory=dict)
    """The row of `environments` of this process. It supplies what a node does not report about itself."""
    code: Path | None = None
    """The folder of the code, which robots get; None if the runs do not need it."""
    store: str = ""
    """The id of the store to which results go: robots keep files for it."""
    containers: HostContainers | None = None
    """The containers in which robots execute runs; None without containers."""
    files: tuple[Path, ...] = ()
    """Files and folders that jobs name beside the code, for hosts that share no file system: the image, and mounts."""
    gpus: float | None = None
    """The most GPUs that one of the runs holds, or its share of one (`Limits.gpus`). None: they request none.

    A runner that does not give GPUs to runs raises ConfigError in `submit` if there are any: the
    variables of such jobs have marks, in whose place only `sierra.worker` puts GPUs (see `sierra.worker.devices`).
    """
    links: Tables = field(default_factory=dict)
    """The options of links to hosts, as `[links.NAME]` has them, for runners that reach hosts by a link."""
    cores: int = 1
    """The most cores that one of the runs holds (`Limits.cores`). Runners that start several runs at a time heed the limit."""


@dataclass(frozen=True, slots=True)
class Beat:
    """The last sign of life of a robot that takes part in a run."""

    name: str
    age_s: float
    battery: float | None = None
    """The charge of its battery in percent; None if it is unknown."""


@dataclass(frozen=True, slots=True)
class Look:
    """Everything that has happened since the previous look."""

    results: tuple[Result, ...]
    running: int
    """Number of runs in flight now."""
    alive: bool
    """True if more results may come."""
    rows: tuple[tuple[str, Mapping[str, RecordValue]], ...] = ()
    """Further rows to record: pairs of a table's name and a row.

    Rows of `robots` and `trials` belong to an execution. They come before its result, or in the same look, and are recorded
    with it; if it was interrupted, they are left out. The recorder sets `trials.lamport`.
    """
    notes: tuple[str, ...] = ()
    """Messages for the user."""
    queued: int = 0
    """Number of elements that wait for a node."""
    waits: str = ""
    """The reason why they wait, in the scheduler's words; empty if the scheduler gives none."""
    copies: tuple[Result, ...] = ()
    """Results of runs that were executed once more than requested, without a directory."""
    wrong: SierraError | None = None
    """The error that ended the session while runs are missing. The caller raises it. Submitting again would not help."""
    beats: tuple[Beat, ...] = ()
    """The last signs of life of the robots that execute runs now."""
    left_out: tuple[str, ...] = ()
    """Runs that cannot execute. They have no result, and are not submitted again in this session."""
    ready: bool = False
    """True while a run is prepared and waits until it may begin: see `Holds`."""
    watched: bool = False
    """True while a person may stop the run with a key, so that the next look must follow soon."""
    late: tuple[LateFiles, ...] = ()
    """Files of executions that were recorded without them. As with a result, a directory belongs to the caller."""
    stopping: bool = False
    """True while the run is being stopped, for example because a robot was lost. `stop` cannot change that it ends."""
    collecting: bool = False
    """True while the run is over, and its files are being collected."""


class Runner(Protocol):
    """One place where runs execute. A runner reports only what a run's worker has recorded."""

    name: str
    stays: bool
    """True if the work that it starts survives this process. Otherwise, the work ends with the process."""
    remote: bool
    """True if runs execute on other hosts, from a copy of the code."""
    Options: ClassVar[type[Table]]
    """The model of `[runners.NAME]`. Options must not change the results of runs, because they are not part of identities."""

    def __init__(self, slots: int, options: Table) -> None:
        """Make a runner. `slots` is the number of runs that this machine executes at a time; `options` is of `Options`."""
        ...

    def submit(self, work: Work, session: SessionPaths) -> None:
        """Start executing. This is called once for a session.

        Raises ConfigError for a refused request and Missing for something that does not exist. Nothing runs then.
        """
        ...

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        """Take over a session that another process has submitted, in whatever state it is. This is called instead of `submit`.

        `recorded` maps each execution in the store to its attempt; `look` does not report these. Called only if `stays` is
        true.
        """
        ...

    def look(self) -> Look:
        """Return what has happened since the last call. It returns at once.

        It may be called at any time after `submit` or `resume`. From then on, a result's directory belongs to the caller, who
        removes it. Lost work (a lost node, a job that the scheduler does not know) is started again in this call, a bounded
        number of times; after that, its runs have failed. If somebody else has cancelled work, it is not started again: the
        session ends as with `stop`.

        Raises SierraError if the runner itself cannot go on (a full disk, no worker). Submitting the query again continues the
        work.
        """
        ...

    def leave(self) -> None:
        """Submit what was held back: this process ends, and nobody may follow for long. Called only if `stays` is true."""
        ...

    def stop(self) -> None:
        """Start nothing more and end the runs in flight; `look` reports their ends too. It may be called again."""
        ...

    def close(self) -> None:
        """Release what this process holds, after all results are recorded.

        Work that survives the process goes on. It may be called again.
        """
        ...


@runtime_checkable
class Holds(Protocol):
    """A runner that can prepare a run, and begin it when it is told to. Other runners begin at once."""

    def hold(self) -> None:
        """Prepare the first run, but do not begin it. This is called before `submit`, if at all.

        `Look.ready` is true while the run waits. If it cannot begin any more, `look` reports the reason as `wrong`. `stop`
        undoes the preparation; then the run has no result.
        """

    def begin(self) -> None:
        """Begin the run that was held back; this is called once, after `submit`. It returns at once."""


@runtime_checkable
class Wraps(Protocol):
    """A runner that executes runs by another one."""

    wrapped: Runner


@runtime_checkable
class RunsMembers(Protocol):
    """A runner that executes the members of jobs (see `sierra.model.Job`), and no other jobs: on robots."""

    def check_robots(self, runs: Collection[Sequence[tuple[int, str]]], groups: Collection[str]) -> None:
        """Raise ConfigError if the fleet cannot execute one of the runs; it is called before anything moves.

        `runs` are the places of each kind of run, with their groups; that of a base station is 0. `groups` are the groups of
        places that the project declares.
        """


@runtime_checkable
class NamesRobots(RunsMembers, Protocol):
    """A runner that knows before a run which of its robots take part, so that a person can place them."""

    def robot_names(self, places: Sequence[tuple[int, str]]) -> Mapping[int, str]:
        """Return the names of the robots that would take these places of a run now, by place.

        `places` are as in `check_robots`. It is called before each supervised trial, because the answer may change within a
        session. Raises ConfigError if the fleet cannot execute such a run.
        """


@runtime_checkable
class ContainsMembers(RunsMembers, Protocol):
    """A runner that executes the members of jobs in the containers of `Work.containers`, if there are any.

    A runner without `contains_members` gets no runs in containers, because it would execute them on the robots themselves.
    """

    contains_members: bool
    """True if members execute in containers; false for a runner that cannot do this with its options."""


def check_members(runner: Runner, name: str, *, on_robots: bool, contained: bool = False) -> None:
    """Raise UsageError if a runner cannot execute runs on robots, or if it can execute only these.

    `contained`: the runs execute in containers.
    """
    able = isinstance(runner, RunsMembers)
    if on_robots and able and contained and not (isinstance(runner, ContainsMembers) and runner.contains_members):
        raise UsageError(f"runner {name!r} cannot execute runs on robots in containers; use --on robots, or --engine none")
    if on_robots and not able:
        raise UsageError(f"runner {name!r} cannot execute runs on robots ([robots] in sierra.toml); use --on robots")
    if able and not on_robots:
        raise UsageError(f"runner {name!r} executes runs on robots only; declare [robots] in sierra.toml, or use --on local")


def needed(programs: Programs, search: str) -> tuple[Requirement, ...]:
    """Return the files that runs depend on and that must be the same on every node; `search` is the runs' PATH.

    For what a Python installation contains, only names and versions are compared. The first program is the command's own. It is
    called by its path: see `sierra.execution.commands.CommandBuilder`.
    """
    from sierra.worker import allocation

    digests = HashCache()
    files = [program for program in programs.all if program.kind != Kind.DISTRIBUTIONS]
    called = {program.path for program in files[1:] if _is_called(program, search)}
    folders = (program for program in programs.all if program.kind == Kind.DISTRIBUTIONS and program.name.endswith(INSTALLED))
    return (
        *(
            Requirement(
                program.name, program.path, sha256, search if program.path in called else "", link=program.kind == Kind.LINK
            )
            for program, sha256 in ((program, _content(program, digests)) for program in files)
        ),
        *(Requirement(program.name, program.path, holds=allocation.installed(program.path)) for program in folders),
    )


def _content(program: Program, digests: HashCache) -> str:
    """Return the SHA-256 of a program's whole file, because nodes compare that."""
    with contextlib.suppress(Missing):
        if program.kind == Kind.PROGRAM and digests.counted(program.path) == program.sha256:
            return digests.of(program.path)
    return program.sha256


def _is_called(program: Program, search: str) -> bool:
    """Return True if the program is found by its name alone."""
    return os.sep not in program.name and shutil.which(program.name, path=search) == program.path
