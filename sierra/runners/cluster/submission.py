"""What a session has submitted to a cluster, as its folder has it: enough for any process to go on with it.

`submission.json` is written before anything is handed over. Where some runs go first (see `sierra.runners.cluster.calibrate`),
it is written again when the others have been dealt out, before these are handed over. Each job that is handed over has a file
of its own, `sent/<number>.json`. It is written before that without the job's id, and again with it: a submitter that dies in
between leaves no id, and the job is found by its name.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from sierra.config.project_file import ClusterTable
from sierra.errors import Damaged
from sierra.runners.schedulers.base import Bounds, Request, State, Task
from sierra.store.layout import SessionPaths
from sierra.store.segments import disk_errors
from sierra.util.fs import read_record, write_whole
from sierra.util.text import few

NAMED = 8
"""Digits of a session's id in the name of its jobs."""
UNFOLLOWED = (
    "an element that its time limit ends goes on by itself only where the site lets tasks requeue themselves; otherwise, "
    "sierra attach (or asking again) submits what is missing"
)
SHOWN_REASONS, LONGEST = 2, 70
"""Reasons why elements wait that are told of, and letters of each."""


@dataclass(frozen=True, slots=True)
class Sent:
    """One job that was, or was to be, handed over."""

    elements: tuple[int, ...]
    when: float
    """Seconds since the epoch."""
    why: str = ""
    """Why these elements were submitted again; empty at first."""
    job: str | None = None


@dataclass(frozen=True, slots=True)
class Submission:
    """What was dealt out, and for whom."""

    runner: str
    scheduler: str
    version: str
    """Of the scheduler, with its name."""
    table: Mapping[str, Any]
    batch: str
    counts: tuple[int, ...]
    """The runs of each element."""
    around: Mapping[str, Any]
    """The row of `environments` of the submitting process."""
    probed: bool = False
    """Whether a probe goes before all elements."""
    rest: int = 0
    """Runs that are not dealt out to elements yet."""
    allowed: Mapping[str, Any] = field(default_factory=dict)
    """What the site allowed then: the fields of `Bounds`."""
    estimated: bool = False
    """Whether the time of an element is SIERRA's own guess, and not the project's."""
    first_s: float | None = None
    """What those that go first were expected to take in the mean, and (`rest_s`) the others; None where nobody knew."""
    rest_s: float | None = None
    past: tuple[str, ...] = ()
    """Jobs of the same name that have nothing to do with it: of what the session had submitted before."""

    @property
    def bounds(self) -> Bounds:
        return Bounds(**self.allowed)

    @property
    def runs(self) -> int:
        return sum(self.counts) + self.rest

    @property
    def cluster(self) -> ClusterTable:
        """What the project said of the cluster then."""
        return ClusterTable.model_validate({**self.table, "scheduler": self.scheduler})

    def save(self, session: SessionPaths) -> None:
        with disk_errors(session.root):
            session.sent.mkdir(exist_ok=True)
            write_whole(session.submission, json.dumps(asdict(self), default=str).encode())

    @classmethod
    def load(cls, session: SessionPaths) -> Submission:
        """Raises FileNotFoundError, and Damaged where another version of SIERRA has written it."""
        fields = read_record(session.submission)
        try:
            made = cls(**{**fields, "counts": tuple(fields["counts"]), "past": tuple(fields.get("past", ()))})
            made.cluster, made.bounds  # noqa: B018 - they are validated
        except (TypeError, ValueError, LookupError) as error:
            raise Damaged(f"{session.submission}: was written by another version of SIERRA; go on with that one") from error
        return made


def name_of(session: SessionPaths, what: str = "sierra") -> str:
    """What the jobs of a session are called; its `probe` has another name than its elements."""
    return f"{what}-{session.root.name[:NAMED]}"


def elements_request(session: SessionPaths, name: str, elements: tuple[int, ...], table: ClusterTable) -> Request:
    """The array job that executes these elements, each of which knows how much time it has."""
    return request(session, name, elements, table.python, *([f"--wall={table.wall:g}"] if table.wall else []))


def request(session: SessionPaths, name: str, elements: tuple[int, ...], python: str, *options: str) -> Request:
    """The array job that calls `array_task.py` for these elements."""
    command = (python, "-I", "-S", str(session.root / "array_task.py"), str(session.root), *options)
    return Request(name, f"sierra {session.root.name}", elements, session.root, session.logs, command)


def last_line(session: SessionPaths, index: str) -> str:
    """The last that the newest log of an element says; empty where it says nothing."""
    newest = max(session.logs.glob(f"*[._]{index}.out"), key=lambda file: file.stat().st_mtime, default=None)
    said = newest.read_bytes()[-4096:].decode("utf-8", "replace").strip().splitlines() if newest else []
    return said[-1] if said else ""


def sent(session: SessionPaths) -> list[Sent]:
    """All that was, or was to be, handed over, in order."""
    files = sorted(session.sent.glob("*.json"), key=lambda file: int(file.stem))
    return [Sent(**{**found, "elements": tuple(found["elements"])}) for found in map(_read, files) if found]


def note(session: SessionPaths, number: int, one: Sent) -> None:
    """Write what is handed over, or was."""
    with disk_errors(session.root):
        write_whole(session.sent / f"{number}.json", json.dumps(asdict(one)).encode())


def last(session: SessionPaths, tasks: Iterable[Task]) -> Iterator[tuple[int, Task]]:
    """Each element of which these tasks are the last submission, with its task; those of earlier jobs are left out."""
    handed = sent(session)
    known = {one.job for one in handed}
    latest = {index: one.job for one in handed for index in one.elements}
    for task in tasks:
        for index in elements(session, [task]):
            if index in latest and (latest[index] == task.job or (latest[index] is None and task.job not in known)):
                yield index, task


def intent(elements: tuple[int, ...], why: str) -> Sent:
    return Sent(elements, time.time(), why)


def waits(tasks: Iterable[Task]) -> str:
    """Why tasks are queued, as the scheduler says it, in short and the most frequent first; empty where it does not."""
    words = Counter(task.reason for task in tasks if task.state is State.QUEUED and task.reason)
    told = [word if len(word) <= LONGEST else f"{word[: LONGEST - 1]}…" for word, _ in words.most_common()]
    return few(told, SHOWN_REASONS)


def _read(file: Any) -> dict[str, Any]:
    try:
        return read_record(file)
    except FileNotFoundError:  # taken back meanwhile: the site took no more
        return {}


def jobs(session: SessionPaths) -> Iterator[str]:
    """The ids of all jobs that are known to have been handed over."""
    return (one.job for one in sent(session) if one.job is not None)


def past(session: SessionPaths) -> tuple[str, ...]:
    """The jobs of what was submitted so far, when the session submits something else."""
    return (*Submission.load(session).past, *jobs(session)) if session.submission.exists() else ()


def elements(session: SessionPaths, tasks: Iterable[Task]) -> set[int]:
    """The elements that tasks are of; of a job that does not say, all that it has."""
    tasks = tuple(tasks)
    handed = sent(session) if any(task.element is None for task in tasks) else []
    found: set[int] = set()
    for task in tasks:
        known = [one for one in handed if one.job == task.job] or [one for one in handed if one.job is None]
        found |= {index for one in known for index in one.elements} if task.element is None else {task.element}
    return found
