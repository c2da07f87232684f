"""What the elements of a batch have recorded, read from their packs as they grow: how far each has come, and what is missing.

Of two copies of a run the first that is seen is the run's; the others are told of as copies.
"""

from __future__ import annotations

import contextlib
import glob
import gzip
import json
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sierra.errors import Damaged
from sierra.model import Result
from sierra.provenance import environment
from sierra.runners.cluster.result_log import Attempt, Ended, Event, Finished, Pack, Requeued, Started, Trouble
from sierra.runners.cluster.submission import Submission
from sierra.runners.journal import Stalled
from sierra.store.layout import SessionPaths
from sierra.store.segments import disk_errors
from sierra.util.fs import write_whole
from sierra.util.text import counted
from sierra.worker import worker

AT_ONCE = 256
"""Runs that one look tells of at most."""
READ_S = 0.2
"""Between two readings of packs, while nothing comes."""
LATE_S = 60.0
"""How long a network file system may take to show what was written."""
REQUEUED = "its time was nearly over: it asked to be begun anew"
CLOCK_S = 2.0
"""How far a node's clock may be from the shared file system's; times are told by the latter where it is farther."""


@dataclass(slots=True)
class Share:
    """One element: how far it has come."""

    count: int
    done: int = 0
    progress: int = 0
    """What was done when it was last submitted."""
    tries: int = 0
    """How many times it was submitted since it last got on."""
    gone: int = 0
    """How many times in a row the scheduler knew nothing of it."""
    grew: float = 0.0
    begun: dict[str, int] = field(default_factory=dict)
    """Executions that have not ended, and how many times they were begun."""
    trouble: str = ""
    """Why the last attempt could not go on, as it said."""
    word: str = ""
    """How it ended, as the scheduler says."""
    queued: bool = False
    """Whether it waited for a node when the scheduler last knew of it."""
    cancelled: bool = False
    """Whether somebody has cancelled it, as the scheduler says; and `ours`: whether this process has."""
    ours: bool = False
    node: str = ""

    @property
    def missing(self) -> int:
        return self.count - self.done


@dataclass(slots=True)
class Track:
    """One attempt: its pack, and what was read in it."""

    pack: Pack
    element: int
    attempt: Attempt | None = None
    environment: str | None = None
    ended: float = 0.0
    runs: int = 0
    ahead: float = 0.0
    """Seconds to take from the node's times."""
    begun: set[str] = field(default_factory=set)
    first: set[str] = field(default_factory=set)
    """Runs that began before any had ended: nothing of the attempt's time had gone by."""
    alone: set[str] = field(default_factory=set)
    """Runs that had the element for themselves."""
    requeued: str | None = None
    word: str = ""
    """How it ended, as the scheduler says."""
    stalled: dict[str, Stalled] = field(default_factory=dict)
    """Runs that were told of as stopped by a signal, and have not ended."""
    finished: bool = False
    trouble: str | None = None
    late: list[tuple[float, Ended]] = field(default_factory=list)
    """Runs whose files are not there as they were recorded, and since when."""

    @property
    def since(self) -> float:
        """When it began, by the shared file system's clock; 0 if that was not read yet."""
        return self.attempt.started - self.ahead if self.attempt else 0.0


def last_of(tracks: Iterable[Track], element: int) -> Track | None:
    """Return the last attempt at an element, though the nodes' clocks differ."""
    own = (track for track in tracks if track.element == element and track.attempt)
    return max(own, key=lambda track: track.since, default=None)


class Collector:
    """All packs of one session."""

    def __init__(
        self, made: Submission, session: SessionPaths, recorded: Mapping[str, str | None], note: Callable[[str], None]
    ) -> None:
        """`recorded`: the executions that the store has, and by which attempt. `note` takes what a user should know."""
        self.shares = [Share(count, tries=1) for count in made.counts]
        self.rows: list[tuple[str, dict[str, Any]]] = []
        """Of the store's tables, beside results."""
        self.failed: list[Result] = []
        """Results of runs that were given up."""
        self._made, self._session, self._note = made, session, note
        self._tracks: dict[str, Track] = {}
        self._ended: set[bytes] = set()
        self._recorded = {bytes.fromhex(execution): attempt for execution, attempt in recorded.items()}
        prefix = f"sierra-taken-{session.root.name}-"
        for left in Path(tempfile.gettempdir()).glob(f"{glob.escape(prefix)}*"):  # by one who followed before, and was killed
            worker.remove(str(left))
        self._folder = Path(tempfile.mkdtemp(prefix=prefix))
        """Of this host, for the files of runs, until they are recorded."""
        self._number = 0
        self._due = 0.0

    def close(self) -> None:
        worker.remove(str(self._folder))

    def is_due(self) -> bool:
        """Whether packs were not read just now, with nothing new in them."""
        return time.monotonic() >= self._due

    def is_whole(self) -> bool:
        """Whether no run is missing."""
        return all(share.missing == 0 for share in self.shares)

    def has_begun(self) -> bool:
        return bool(self._tracks)

    def waits(self) -> bool:
        """Whether files are still to come that a pack tells of."""
        return any(track.late for track in self._tracks.values())

    def ending(self) -> set[int]:
        """Elements that end by themselves."""
        return {track.element for track in self._tracks.values() if track.finished}

    def closing(self) -> set[int]:
        """Elements that have executed all that they began, and have not said yet that they have finished."""
        last = {track.element: track for track in self._tracks.values()}
        return {index for index, track in last.items() if not (track.finished or track.trouble or track.begun)}

    def running(self, alive: set[int] | None) -> int:
        """How many runs go on, where these elements live (None: nobody has said which)."""
        last = {track.element: track for track in self._tracks.values()}  # of the attempts at one element, the newest
        return sum(
            len(track.begun)
            for track in last.values()
            if not (track.finished or track.trouble or (alive is not None and track.element not in alive))
        )

    # ------------------------------------------------------------ reading

    def read(self) -> tuple[list[Result], list[Result]]:
        """What packs have since the last time: results, AT_ONCE at most, and copies of such as were taken before."""
        results: list[Result] = []
        copies: list[Result] = []
        for path in sorted(self._session.results.glob("[0-9]*.pack")):
            track = self._tracks.setdefault(path.name, Track(Pack(path), int(path.name.partition(".")[0])))
            for event in self._events(track):
                self.shares[track.element].grew = time.monotonic()
                match event:
                    case Attempt():
                        self._begun(track, event)
                    case Started():
                        self._started(track, event)
                    case Requeued():
                        track.requeued = f"{REQUEUED}, and that is refused: {event.refused}" if event.refused else REQUEUED
                    case Stalled():
                        track.stalled[event.execution] = event
                    case Ended():
                        self._take(track, event, results, copies)
                    case Trouble():
                        self._failed_by(track, event)
                    case Finished():
                        track.finished, track.ended = True, event.time
                if len(results) >= AT_ONCE:
                    return results, copies
            for stalled in track.stalled.values():
                self._note(stalled.told(f" on {self.shares[track.element].node}"))
            self._take_late(track, results, copies)
        if not results:
            self._due = time.monotonic() + READ_S
        return results, copies

    def _events(self, track: Track) -> Iterator[Event]:
        """What a pack has since the last time; a file that can't be read now, perhaps later."""
        try:
            yield from track.pack.read()
        except OSError as error:
            self._note(f"{track.pack.path} cannot be read: {error.strerror}")

    def _begun(self, track: Track, event: Attempt) -> None:
        around = environment.elsewhere(self._made.around, event.facts, event.variables)
        track.attempt, track.environment, track.ended = event, around["environment"], event.started
        track.ahead = event.clock if abs(event.clock) > CLOCK_S else 0.0
        self.shares[track.element].node = event.node
        self.rows.append(("environments", around))

    def _started(self, track: Track, event: Started) -> None:
        track.begun.add(event.execution)
        if not track.runs:
            track.first.add(event.execution)
        if event.alone:
            track.alone.add(event.execution)
        track.ended = event.time
        if bytes.fromhex(event.execution) not in self._ended:
            begun = self.shares[track.element].begun
            begun[event.execution] = begun.get(event.execution, 0) + 1

    def _failed_by(self, track: Track, event: Trouble) -> None:
        """Why an attempt could not go on; where a disk was full, its runs count as not begun."""
        share = self.shares[track.element]
        track.trouble = share.trouble = event.reason
        for execution in track.begun & share.begun.keys() if event.full else ():
            share.begun[execution] -= 1
            if not share.begun[execution]:
                del share.begun[execution]

    def _take(self, track: Track, event: Ended, results: list[Result], copies: list[Result]) -> None:
        """One run that has ended: the first time that it is seen, it is the run's."""
        execution = event.result.execution
        key = bytes.fromhex(execution)
        if key not in self._ended and key not in self._recorded:
            self._number += 1
            try:
                result = track.pack.extract(event, self._folder / str(self._number))
            except Damaged:
                track.late.append((time.monotonic(), event))
                return
            results.append(self._of(track, result))
        elif self._recorded.get(key, "") != track.pack.attempt:
            copies.append(self._of(track, event.result))
        track.begun.discard(execution)
        track.stalled.pop(execution, None)
        track.runs += 1
        track.ended = event.result.ended
        share = self.shares[track.element]
        if key not in self._ended:
            share.done += 1
            share.begun.pop(execution, None)
            self._ended.add(key)

    def _take_late(self, track: Track, results: list[Result], copies: list[Result]) -> None:
        """What was not there yet: now perhaps. What never comes was never recorded; nor is it taken for done any more."""
        late, track.late = track.late, []
        for since, event in late:
            before = len(track.late)
            self._take(track, event, results, copies)
            if len(track.late) > before:
                track.late[-1] = (since, event)
        if track.late and time.monotonic() - track.late[0][0] > LATE_S:
            track.late = []
            self._note(f"{track.pack.path.name} is damaged; the runs in snapshot are executed again")
            track.pack.path.rename(track.pack.path.with_suffix(".damaged"))

    def _of(self, track: Track, result: Result) -> Result:
        """The result, where it was executed; its times are by the shared file system's clock."""
        ahead = track.ahead
        return replace(
            result,
            attempt=track.pack.attempt,
            environment=track.environment,
            started=result.started - ahead,
            ended=result.ended - ahead,
        )

    # ------------------------------------------------------------ attempts

    def attempts(self, word: str | None) -> list[tuple[str, dict[str, Any]]]:
        """All attempts as rows; `word` is what ended those that do not say it themselves, else the scheduler's word is."""
        for index in range(len(self.shares)):
            self.note_end(index)
        return [("attempts", self._row(track, track.attempt, word)) for track in self._tracks.values() if track.attempt]

    def note_end(self, index: int) -> None:
        """Keep how the scheduler says that an element has ended with the last attempt at it: another one may follow."""
        last = self._last(index)
        if last is not None and not last.word:
            last.word = self.shares[index].word

    def _last(self, index: int) -> Track | None:
        """The last attempt at an element."""
        return last_of(self._tracks.values(), index)

    def _row(self, track: Track, begun: Attempt, word: str | None) -> dict[str, Any]:
        return {
            "attempt": begun.attempt,
            "session": self._session.root.name,
            "batch": self._made.batch,
            "element": track.element,
            "scheduler": self._made.version,
            "job": begun.job,
            "node": begun.node,
            "started": moment(track.since),
            "ended": moment(track.ended - track.ahead),
            "clock": begun.clock,
            "cpus": begun.cpus,
            "memory": begun.memory,
            "gpus": begun.gpus,
            "allocation": json.dumps(dict(begun.allocation), sort_keys=True),
            "runs": track.runs,
            "cut": len(track.begun),
            "state": "finished" if track.finished else "cut off",
            "trouble": track.trouble or (None if track.finished else track.requeued or track.word or word or None),
            "environment": track.environment,
        }

    # ------------------------------------------------------------ failing

    def given_up_before(self, index: int) -> None:
        """Count the runs that have failed because another process, which followed before this one, gave them up."""
        share = self.shares[index]
        for execution, _ in jobs_of(self._session, index) if self._recorded else ():
            key = bytes.fromhex(execution)
            if key in self._recorded and key not in self._ended:
                self._ended.add(key)
                share.begun.pop(execution, None)
                share.done += 1

    def allowed(self, index: int) -> float | None:
        """Seconds that the last attempt at an element had, where its scheduler told it when they are over."""
        last = self._last(index)
        if last is None or last.attempt is None:
            return None
        end = last.attempt.allocation.get("SLURM_JOB_END_TIME", "")
        return float(end) - last.since if end.isdigit() else None

    def cut_alone(self, index: int) -> set[str]:
        """Runs of an element that were cut off while they had it for themselves."""
        return {one for track in self._tracks.values() if track.element == index for one in track.begun & track.alone}

    def cut_late(self, index: int) -> set[str]:
        """Runs that were cut off by the end of the element's last attempt, and had begun with it."""
        last = self._last(index)
        return last.begun & last.first if last else set()

    def isolate(self, index: int, executions: Sequence[str]) -> None:
        """Have these, and no others, executed one by one when the element is submitted again."""
        alone = self._session.alone(index)
        if executions:
            with disk_errors(self._session.root):
                write_whole(alone, "".join(f"{one}\n" for one in executions).encode())
            self._note(f"{counted(len(executions), 'run')} of element {index} may be what ended it: executed one by one now")
        else:
            alone.unlink(missing_ok=True)

    def give_up_on(self, index: int, executions: Sequence[str], word: str) -> None:
        """These executions were begun as many times as they may be, and never ended: their runs have failed."""
        if not executions:
            return
        share, wanted, now = self.shares[index], set(executions), time.time()
        times = 0
        for execution, run in jobs_of(self._session, index):
            if execution in wanted:
                times = max(share.begun.pop(execution), share.tries)
                reason = f"its element was cut off {times} times while it ran: {word}"
                self.failed.append(failed(run, execution, share.node, now, reason, self._folder))
                self._ended.add(bytes.fromhex(execution))
                share.done += 1
        with disk_errors(self._session.root), self._session.given_up(index).open("a") as file:
            file.writelines(f"{execution}\n" for execution in executions)
        which = "a run" if len(wanted) == 1 else f"{len(wanted)} runs"
        self._note(f"{which} of element {index} failed, cut off {times} times: {word}")


def jobs_of(session: SessionPaths, index: int) -> Iterator[tuple[str, str]]:
    """Execution and run of each job of an element; see `sierra.worker.array_task.jobs` for the format."""
    with gzip.open(session.jobs(index), "rt", encoding="utf-8") as lines:
        common = json.loads(next(lines))["common"]
        for line in lines:
            job = {**common, **json.loads(line)}
            if "end" not in job:
                yield job["execution"], job["run"]


def failed(run: str, execution: str, node: str, now: float, reason: str, folder: Path) -> Result:
    """The result of a run that nobody has a result of."""
    return Result(run, execution, str(folder / "none"), now, now, None, None, None, None, None, None, node, 0, (), reason)


def refresh(folder: Path) -> None:
    """Make a network file system look again at what is in a folder: by changing it, where there is room for that."""
    with contextlib.suppress(OSError), tempfile.TemporaryFile(dir=folder):
        pass


def moment(seconds: float) -> datetime:
    """Seconds since the epoch as a time."""
    return datetime.fromtimestamp(seconds, UTC)
