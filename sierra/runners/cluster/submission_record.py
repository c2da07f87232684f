"""Record of a session's submission to a cluster. It suffices for any process to continue the session.

`submission.json` is written before anything is submitted. If some runs go first (see `sierra.runners.cluster.sizing`), it is
written again after the others have been sharded and before they are submitted. Each submitted job has a file of its own,
`sent/<number>.json`. This is written before the submission without the job's id, and after it with the id. If the submitting
process dies in between, there is no id, and the job is found by its name.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict

from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError, Damaged
from sierra.runners import schedulers
from sierra.runners.schedulers.base import Bounds, Carries, Request, Scheduler, State, Task
from sierra.store.layout import SessionPaths
from sierra.store.segments import disk_errors
from sierra.util.fs import read_record, write_whole
from sierra.util.json_types import Json, JsonView
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import few

NAMED = 8
"""Number of digits of the session's id in the name of its jobs."""
UNFOLLOWED = (
    "an array task that reaches its time limit continues by itself only if the site lets tasks requeue themselves; "
    "otherwise, run sierra attach (or submit the query again) to submit the missing runs"
)
SHOWN_REASONS, LONGEST = 2, 70
"""Largest number of reasons for waiting that are shown, and of characters of each."""


@dataclass(frozen=True, slots=True)
class Sent:
    """One job that was submitted, or was about to be."""

    elements: tuple[int, ...]
    when: float
    """Time in seconds since the epoch."""
    why: str = ""
    """The reason why these elements were submitted again; empty at first."""
    job: str | None = None


@dataclass(frozen=True, slots=True)
class Submission:
    """Record of what was submitted, and for which batch."""

    runner: str
    scheduler: str
    version: str
    """Name and version of the scheduler."""
    table: Mapping[str, Json]
    batch: str
    counts: tuple[int, ...]
    """Number of runs of each element."""
    around: Mapping[str, JsonView]
    """The row of `environments` of the submitting process."""
    probed: bool = False
    """True if a preflight job (probe) goes before all elements."""
    rest: int = 0
    """Number of runs that are not sharded yet."""
    allowed: Bounds = field(default_factory=Bounds)
    """Limits of the site at that time."""
    estimated: bool = False
    """True if the time limit of an element is SIERRA's own estimate, and not the project's setting."""
    first_s: float | None = None
    """Expected mean time of the runs that go first; `rest_s` is that of the others. None if it was unknown."""
    rest_s: float | None = None
    slots: int | None = None
    """Number of runs that an element executes at a time, if that is not the number of its cores."""
    past: tuple[str, ...] = ()
    """Jobs of earlier submissions of the session. They have the same name, but do not belong to this one."""

    @property
    def runs(self) -> int:
        return sum(self.counts) + self.rest

    @property
    def at_once(self) -> int:
        """Return how many runs an element executes at a time."""
        return self.slots or self.cluster.cpus

    @property
    def cluster(self) -> ClusterTable:
        """The project's table for the cluster at that time. Raises ConfigError if its scheduler is not installed any more."""
        return schedulers.recorded_table(self.scheduler, self.table)

    def save(self, session: SessionPaths) -> None:
        with disk_errors(session.root):
            session.sent.mkdir(exist_ok=True)
            write_whole(session.submission, json.dumps(asdict(self), default=str).encode())

    @classmethod
    def load(cls, session: SessionPaths) -> Submission:
        """Read a session's submission. Raises FileNotFoundError, and Damaged if another version of SIERRA wrote it."""
        fields = read_record(session.submission)
        try:
            fields |= {name: tuple(fields[name]) for name in ("counts", "past") if name in fields}
            fields["allowed"] = Bounds(**fields.get("allowed", {}))
            submission = cls(**fields)
            with contextlib.suppress(ConfigError):  # the scheduler is not installed any more: its jobs are kept
                submission.cluster  # noqa: B018 - it is validated
        except (TypeError, ValueError, LookupError) as error:
            raise Damaged(f"{session.submission}: was written by another version of SIERRA; use that version") from error
        return submission


def scheduler_of(submission: Submission, session: SessionPaths) -> Scheduler:
    """Return the scheduler of a session that another process may follow. Raises ConfigError if it is not installed any more."""
    scheduler = schedulers.find(submission.scheduler)(submission.cluster)
    if isinstance(scheduler, Carries):
        scheduler.open(session, None, follows=False)
    return scheduler


def name_of(session: SessionPaths, what: str = "sierra") -> str:
    """Return the name of a session's jobs. The preflight job (`probe`) has another name than the elements."""
    return f"{what}-{session.root.name[:NAMED]}"


def elements_request(session: SessionPaths, name: str, elements: tuple[int, ...], table: ClusterTable) -> Request:
    """Return the request for the array job that executes these elements, with their time limit as an option."""
    return request(session, name, elements, table.python, *([f"--wall={table.wall:g}"] if table.wall else []))


def request(session: SessionPaths, name: str, elements: tuple[int, ...], python: str, *options: str) -> Request:
    """Return the request for an array job that calls `sierra.worker.array_task` for these elements."""
    command = (python, "-I", "-S", str(session.worker), "array_task", str(session.root), *options)
    return Request(name, f"sierra {session.root.name}", elements, session.root, session.logs, command)


def last_line(session: SessionPaths, index: str) -> str:
    """Return the last line of an element's newest log; an empty text if there is none."""
    newest = max(session.logs.glob(f"*[._]{index}.out"), key=lambda file: file.stat().st_mtime, default=None)
    lines = newest.read_bytes()[-4096:].decode("utf-8", "replace").strip().splitlines() if newest else []
    return lines[-1] if lines else ""


def sent(session: SessionPaths) -> list[Sent]:
    """Return all jobs that were submitted, or were about to be, in order."""
    jobs = []
    for file in sorted(session.sent.glob("*.json"), key=lambda file: int(file.stem)):
        with contextlib.suppress(FileNotFoundError):  # removed since: the site took no more jobs
            record = read_record(file)
            jobs.append(Sent(**{**record, "elements": tuple(record["elements"])}))
    return jobs


def note(session: SessionPaths, number: int, one: Sent) -> None:
    """Write the record of one job."""
    with disk_errors(session.root):
        write_whole(session.sent / f"{number}.json", json.dumps(asdict(one)).encode())


def last(session: SessionPaths, tasks: Iterable[Task]) -> Iterator[tuple[int, Task]]:
    """Yield each element of which these tasks are the last submission, with its task. Tasks of earlier jobs are left out."""
    handed = sent(session)
    known = {one.job for one in handed}
    latest = {index: one.job for one in handed for index in one.elements}
    for task in tasks:
        for index in elements(session, [task]):
            if index in latest and (latest[index] == task.job or (latest[index] is None and task.job not in known)):
                yield index, task


def waits(tasks: Iterable[Task]) -> str:
    """Return the most frequent reasons why tasks are queued, in the scheduler's words, shortened; empty if it gives none."""
    words = Counter(task.reason for task in tasks if task.state is State.QUEUED and task.reason)
    shown = [word if len(word) <= LONGEST else f"{word[: LONGEST - 1]}…" for word, _ in words.most_common()]
    return few(shown, SHOWN_REASONS)


def jobs(session: SessionPaths) -> Iterator[str]:
    """Yield the ids of all jobs that are known to have been submitted."""
    return (one.job for one in sent(session) if one.job is not None)


def past(session: SessionPaths) -> tuple[str, ...]:
    """Return the ids of the session's jobs so far, before it submits something else."""
    return (*Submission.load(session).past, *jobs(session)) if session.submission.exists() else ()


def elements(session: SessionPaths, tasks: Iterable[Task]) -> set[int]:
    """Return the elements of tasks. A task that names no element stands for all elements of its job."""
    tasks = tuple(tasks)
    handed = sent(session) if any(task.element is None for task in tasks) else []
    found: set[int] = set()
    for task in tasks:
        known = [one for one in handed if one.job == task.job] or [one for one in handed if one.job is None]
        found |= {index for one in known for index in one.elements} if task.element is None else {task.element}
    return found
