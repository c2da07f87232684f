"""Collector of a batch's results: it reads the result logs (packs) of the elements while they grow.

It knows the progress of each element, and the runs that are missing. If a run has two copies, the first one seen is the run's
result. The others are reported as copies.
"""

from __future__ import annotations

import contextlib
import glob
import gzip
import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from sierra.errors import Damaged
from sierra.model import Result
from sierra.provenance import environment
from sierra.runners.cluster.result_log_reader import Ended, Event, Pack
from sierra.runners.cluster.submission_record import Submission, last_line
from sierra.runners.journal_reader import Stalled
from sierra.store.layout import SessionPaths
from sierra.store.segments import disk_errors
from sierra.util.fs import write_whole
from sierra.util.json_types import RecordValue
from sierra.util.lazy_definitions import dataclass, field, replace
from sierra.util.text import counted, often
from sierra.worker import checkpoints
from sierra.worker.files import remove
from sierra.worker.result_log import Attempt, Finished, Requeued, Started, Trouble

AT_ONCE = 256
"""Largest number of runs that one look reports."""
READ_S = 0.2
"""Seconds between two readings of result logs while nothing new comes."""
LATE_S = 60.0
"""Seconds that a network file system may take to show what was written."""
REQUEUED = "its time was nearly over: it requested to be started again"
CLOCK_S = 2.0
"""Largest accepted difference between a node's clock and the shared file system's, in seconds. If it is larger, times are
converted to the shared file system's clock."""


@dataclass(slots=True)
class Share:
    """The progress of one element."""

    count: int
    done: int = 0
    progress: int = 0
    """Value of `done` when the element was last submitted."""
    tries: int = 0
    """Number of submissions since the element last made progress."""
    gone: int = 0
    """Number of consecutive times that the scheduler did not know the element."""
    gone_at: float = 0.0
    """Time of the first of these answers."""
    grew_at: float = 0.0
    begun: Counter[str] = field(default_factory=Counter)
    """Executions that have not ended, and how many times each was begun."""
    suspects: Sequence[str] = ()
    """Executions that may have caused its end."""
    trouble: str = ""
    """The reason that the last attempt gave for not being able to go on."""
    reason: str = ""
    """The reason for its end, in the scheduler's words."""
    queued: bool = False
    """True if it waited for a node when the scheduler last knew it."""
    cancelled: bool | None = None
    """`cancelled`: the scheduler says that somebody has cancelled it. `ours`: this process has cancelled it."""
    ours: bool = False
    blameless: bool = False
    """True if no run can be the cause of its last end."""
    node: str = ""

    @property
    def missing(self) -> int:
        return self.count - self.done


class Evidence(NamedTuple):
    """Remains of an element that is gone."""

    message: str
    """The last line of its log."""
    allowed_s: float | None
    """Time that its last attempt had; None if its scheduler did not pass an end time."""
    alone: AbstractSet[str]
    """Executions that were cut off while they had the element for themselves."""
    by_limit: AbstractSet[str]
    """Executions that the end of its last attempt cut off, and that had begun with the attempt."""
    continued: AbstractSet[str] = frozenset()
    """Executions that wrote to their checkpoints during the last attempt: the next one continues from there."""


@dataclass(slots=True)
class Track:
    """One attempt: its result log, and what was read from it."""

    pack: Pack
    element: int
    attempt: Attempt | None = None
    environment: str | None = None
    ended: float = 0.0
    runs: int = 0
    ahead: float = 0.0
    """Seconds to subtract from the node's times."""
    begun: set[str] = field(default_factory=set)
    first: set[str] = field(default_factory=set)
    """Runs that began before any run had ended, so that they had all of the attempt's time."""
    alone: set[str] = field(default_factory=set)
    """Runs that had the element for themselves."""
    requeued: str | None = None
    reason: str = ""
    """The reason for its end, in the scheduler's words."""
    stalled: dict[str, Stalled] = field(default_factory=dict)
    """Runs that were reported as stopped by a signal, and have not ended."""
    finished: bool = False
    forgiven: bool = False
    """True if its end is no fault of the runs that it had begun."""
    trouble: str | None = None
    late: list[tuple[float, Ended]] = field(default_factory=list)
    """Runs whose files do not match their record yet, and since when."""

    @property
    def since(self) -> float:
        """Start time by the shared file system's clock; 0 if it was not read yet."""
        return self.attempt.started - self.ahead if self.attempt else 0.0


def last_of(tracks: Iterable[Track], element: int) -> Track | None:
    """Return the last attempt at an element. The nodes' clocks may differ."""
    own = (track for track in tracks if track.element == element and track.attempt)
    return max(own, key=lambda track: track.since, default=None)


class Collector:
    """Reader of all result logs of one session."""

    def __init__(
        self, submission: Submission, session: SessionPaths, recorded: Mapping[str, str | None], note: Callable[[str], None]
    ) -> None:
        """Start reading. `recorded` maps the store's executions to their attempts; `note` receives messages for the user."""
        self.shares = tuple(Share(count, tries=1) for count in submission.counts)
        self.rows: list[tuple[str, Mapping[str, RecordValue]]] = []
        """Rows for the store's tables, in addition to results."""
        self.failed: list[Result] = []
        """Results of runs that were given up."""
        self.began_at: float | None = None
        """Time when a run was first seen to have begun."""
        self.durations: dict[str, float | None] = {}
        """Durations of the first runs that have ended (see `sierra.runners.cluster.sizing`); None for a run that failed."""
        self._submission, self._session, self._note = submission, session, note
        self._tracks: dict[str, Track] = {}
        self._ended: set[bytes] = set()
        self._recorded = {bytes.fromhex(execution): attempt for execution, attempt in recorded.items()}
        prefix = f"sierra-taken-{session.root.name}-"
        for left in Path(tempfile.gettempdir()).glob(f"{glob.escape(prefix)}*"):  # of an earlier process that was killed
            remove(str(left))
        self._folder = Path(tempfile.mkdtemp(prefix=prefix))
        """A folder on this host for the files of runs until they are recorded."""
        self._number = 0
        self._due = 0.0

    def close(self) -> None:
        remove(str(self._folder))

    def is_due(self) -> bool:
        """Return False if result logs were read just now and had nothing new."""
        return time.monotonic() >= self._due

    def is_complete(self) -> bool:
        """Return True if no run is missing."""
        return all(share.missing == 0 for share in self.shares)

    def has_begun(self) -> bool:
        return bool(self._tracks)

    def has_late_files(self) -> bool:
        """Return True if a result log reports files that have not arrived yet."""
        return any(track.late for track in self._tracks.values())

    def finished_tasks(self) -> set[int]:
        """Return the elements that end by themselves."""
        return {track.element for track in self._tracks.values() if track.finished}

    def _unfinished(self, alive: AbstractSet[int] | None) -> list[Track]:
        """Return the newest attempts at these living elements (None: not known) that can go on."""
        last = {track.element: track for track in self._tracks.values() if alive is None or track.element in alive}
        return [track for track in last.values() if not (track.finished or track.trouble)]

    def finishing_tasks(self, alive: AbstractSet[int] | None) -> set[int]:
        """Return the elements that have executed every run they began, but have not recorded yet that they have finished."""
        return {track.element for track in self._unfinished(alive) if not track.begun}

    def running(self, alive: AbstractSet[int] | None) -> int:
        """Return the number of runs in flight; `alive` are the living elements (None: not known)."""
        return sum(len(track.begun) for track in self._unfinished(alive))

    def read(self) -> tuple[list[Result], list[Result]]:
        """Return new results (at most AT_ONCE) and new copies of runs whose result was read or recorded before."""
        results: list[Result] = []
        copies: list[Result] = []
        for path in sorted(self._session.results.glob("[0-9]*.pack")):
            track = self._tracks.setdefault(path.name, Track(Pack(path), int(path.name.partition(".")[0])))
            for event in self._events(track):
                self.shares[track.element].grew_at = time.monotonic()
                match event:
                    case Attempt():
                        self._note_attempt(track, event)
                    case Started():
                        self._note_start(track, event)
                    case Requeued():
                        track.requeued = f"{REQUEUED}, but this is refused: {event.refused}" if event.refused else REQUEUED
                    case Stalled():
                        track.stalled[event.execution] = event
                    case Ended():
                        self._add(track, event, results, copies)
                    case Trouble():
                        self._note_trouble(track, event)
                    case Finished():
                        track.finished, track.ended = True, event.time
                if len(results) >= AT_ONCE:
                    return results, copies
            for stalled in track.stalled.values():
                self._note(stalled.message(f" on {self.shares[track.element].node}"))
            self._add_late(track, results, copies)
        if not results:
            self._due = time.monotonic() + READ_S
        return results, copies

    def _events(self, track: Track) -> Iterator[Event]:
        """Yield the new events of a result log. A file that cannot be read now may be readable later."""
        try:
            yield from track.pack.read()
        except OSError as error:
            self._note(f"{track.pack.path} cannot be read: {error.strerror}")

    def _note_attempt(self, track: Track, event: Attempt) -> None:
        row = environment.elsewhere(self._submission.around, event.facts, event.variables)
        track.attempt, track.environment, track.ended = event, str(row["environment"]), event.started
        track.ahead = event.clock if abs(event.clock) > CLOCK_S else 0.0
        self.shares[track.element].node = event.node
        self.rows.append(("environments", row))

    def _note_start(self, track: Track, event: Started) -> None:
        self.began_at = self.began_at or time.monotonic()
        track.begun.add(event.execution)
        if not track.runs:
            track.first.add(event.execution)
        if event.alone:
            track.alone.add(event.execution)
        track.ended = event.time
        if bytes.fromhex(event.execution) not in self._ended:
            self.shares[track.element].begun[event.execution] += 1

    def _note_trouble(self, track: Track, event: Trouble) -> None:
        """Keep the reason why an attempt could not go on. If a disk was full, its unfinished runs count as not begun."""
        share = self.shares[track.element]
        track.trouble = share.trouble = event.reason
        if event.full:
            share.begun -= Counter(track.begun)

    def _add(self, track: Track, event: Ended, results: list[Result], copies: list[Result]) -> None:
        """Take one run that has ended. The first result seen is the run's; later ones are copies."""
        execution = event.result.execution
        if self._submission.rest and track.element == 0:
            self.durations[execution] = duration(event.result)
        key = bytes.fromhex(execution)
        if key not in self._ended and key not in self._recorded:
            self._number += 1
            try:
                result = track.pack.extract(event, self._folder / str(self._number))
            except Damaged:
                track.late.append((time.monotonic(), event))
                return
            results.append(self._with_shared_clock(track, result))
        elif self._recorded.get(key, "") != track.pack.attempt:
            copies.append(self._with_shared_clock(track, event.copy()))
        track.begun.discard(execution)
        track.stalled.pop(execution, None)
        track.runs += 1
        track.ended = event.result.ended
        share = self.shares[track.element]
        if key not in self._ended:
            share.done += 1
            share.begun.pop(execution, None)
            self._ended.add(key)

    def _add_late(self, track: Track, results: list[Result], copies: list[Result]) -> None:
        """Try again to take the results whose files had not arrived.

        After LATE_S seconds, the result log is treated as damaged. Its remaining runs were never recorded, and are executed
        again.
        """
        late, track.late = track.late, []
        for since, event in late:
            before = len(track.late)
            self._add(track, event, results, copies)
            if len(track.late) > before:
                track.late[-1] = (since, event)
        if track.late and time.monotonic() - track.late[0][0] > LATE_S:
            track.late = []
            self._note(f"{track.pack.path.name} is damaged; the runs in it are executed again")
            track.pack.path.rename(track.pack.path.with_suffix(".damaged"))

    def _with_shared_clock(self, track: Track, result: Result) -> Result:
        """Return the result with its attempt and environment, and with times by the shared file system's clock."""
        ahead = track.ahead
        return replace(
            result,
            attempt=track.pack.attempt,
            environment=track.environment,
            started=result.started - ahead,
            ended=result.ended - ahead,
        )

    def attempts(self, reason: str | None) -> list[tuple[str, Mapping[str, RecordValue]]]:
        """Return all attempts as rows. `reason` is that of attempts without their own or the scheduler's."""
        for index in range(len(self.shares)):
            self.note_end(index)
        return [("attempts", self._row(track, track.attempt, reason)) for track in self._tracks.values() if track.attempt]

    def note_end(self, index: int) -> None:
        """Store the scheduler's reason for the end of an element in its last attempt, before another attempt may follow."""
        last = last_of(self._tracks.values(), index)
        if last is not None and not last.reason:
            last.reason = self.shares[index].reason

    def _row(self, track: Track, begun: Attempt, reason: str | None) -> dict[str, RecordValue]:
        return {
            "attempt": begun.attempt,
            "session": self._session.root.name,
            "batch": self._submission.batch,
            "array_task": track.element,
            "scheduler": self._submission.version,
            "job": begun.job,
            "node": begun.node,
            "started": datetime.fromtimestamp(track.since, UTC),
            "ended": datetime.fromtimestamp(track.ended - track.ahead, UTC),
            "clock_offset_s": begun.clock,
            "cpus": begun.cpus,
            "memory": begun.memory,
            "gpus": begun.gpus,
            "allocation": json.dumps(dict(begun.allocation), sort_keys=True),
            "runs": track.runs,
            "interrupted_runs": len(track.begun),
            "state": "finished" if track.finished else "cut off",
            "error": track.trouble or (None if track.finished else track.requeued or track.reason or reason or None),
            "environment": track.environment,
        }

    def evidence(self, index: int) -> Evidence:
        """Return what an element has left behind. Its failed runs that an earlier process gave up count as ended now."""
        share, last = self.shares[index], last_of(self._tracks.values(), index)
        for execution, _ in jobs_of(self._session, index) if self._recorded else ():
            key = bytes.fromhex(execution)
            if key in self._recorded and key not in self._ended:
                self._ended.add(key)
                share.begun.pop(execution, None)
                share.done += 1
        end = last.attempt.end if last and last.attempt else None
        return Evidence(
            last_line(self._session, str(index)),
            end - last.since if last and end is not None else None,
            {run for track in self._tracks.values() if track.element == index for run in track.begun & track.alone},
            last.begun & last.first if last else set(),
            self._continued(index, last) if last else set(),
        )

    def _continued(self, index: int, last: Track) -> set[str]:
        """Return the executions that the end of the last attempt cut off, and that can continue from what they did in it."""
        cut_off = ((execution, path) for execution, path in checkpoints_of(self._session, index) if execution in last.begun)
        return {execution for execution, path in cut_off if checkpoints.changed_since(path, last.since)}

    def forgive(self, jobs: Collection[str]) -> None:
        """Count the runs in flight of the attempts of these jobs as not begun. An attempt's name begins with its job's id."""
        for track in self._tracks.values():
            if track.begun and track.pack.attempt.partition(".")[0] in jobs and not track.forgiven:
                track.forgiven = True
                self.shares[track.element].begun -= Counter(track.begun)

    def isolate(self, index: int) -> None:
        """Have the suspects of an element, and no other runs, executed one by one when it is submitted again."""
        alone, executions = self._session.alone(index), self.shares[index].suspects
        if executions:
            with disk_errors(self._session.root):
                write_whole(alone, "".join(f"{one}\n" for one in executions).encode())
            count = counted(len(executions), "run")
            self._note(f"{count} of array task {index} may have caused its end: executed one by one now")
        else:
            alone.unlink(missing_ok=True)

    def give_up_on(self, index: int, executions: Sequence[str], tries: int, why: str) -> None:
        """Record the runs of these executions as failed: they were begun as often as allowed, and never ended."""
        share, wanted, now = self.shares[index], set(executions), time.time()
        times = 0
        for execution, run in jobs_of(self._session, index):
            if execution in wanted:
                times = max(share.begun.pop(execution), tries)
                reason = f"its array task was cut off {often(times)} while the run executed: {why}"
                self.failed.append(failed(run, execution, share.node, now, reason, self._folder))
                self._ended.add(bytes.fromhex(execution))
                share.done += 1
        with disk_errors(self._session.root), self._session.given_up(index).open("a") as file:
            file.writelines(f"{execution}\n" for execution in executions)
        which = "a run" if len(wanted) == 1 else f"{len(wanted)} runs"
        self._note(f"{which} of array task {index} failed, cut off {often(times)}: {why}")


def checkpoints_of(session: SessionPaths, index: int) -> Iterator[tuple[str, str]]:
    """Yield the execution and the checkpoint of each job of an element that has one."""
    return ((job["execution"], job["checkpoint"]) for job in _records(session, index) if "checkpoint" in job)


def jobs_of(session: SessionPaths, index: int) -> Iterator[tuple[str, str]]:
    """Yield execution and run of each job of an element."""
    return ((job["execution"], job["run"]) for job in _records(session, index))


def _records(session: SessionPaths, index: int) -> Iterator[dict[str, Any]]:
    """Yield the record of each job of an element; see `sierra.worker.element_jobs` for the format."""
    with gzip.open(session.jobs(index), "rt", encoding="utf-8") as lines:
        common = json.loads(next(lines))["common"]
        for line in lines:
            job = {**common, **json.loads(line)}
            if "end" not in job:
                yield job


def failed(run: str, execution: str, node: str, now: float, reason: str, folder: Path) -> Result:
    """Return a failed result for a run that has recorded none."""
    return Result(run, execution, str(folder / "none"), now, now, None, None, None, None, None, None, node, 0, (), reason)


def duration(result: Result) -> float | None:
    """Return a run's duration if it ended successfully, as far as this is known before the run is recorded; else None."""
    is_good = result.exit_code == 0 and result.error is None and result.stopped is None
    return result.ended - result.started if is_good else None


def refresh(folder: Path) -> None:
    """Make a network file system refresh a folder's listing: create and remove a file in it, if there is room."""
    with contextlib.suppress(OSError), tempfile.TemporaryFile(dir=folder):
        pass
