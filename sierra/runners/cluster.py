"""Runs on a cluster: one array job whose elements execute many runs each, and what becomes of it.

Truth is what elements have recorded in their packs; a scheduler is only asked whether anything may still come. Two copies of
one task, a requeue, a lost node, a job that nobody remembers, a controller out of reach and a submitter that died are all one
case: see what is recorded, ask whether anything lives, submit again what is missing.

An element that is gone with runs missing is submitted again as long as it gets on. One that ends without having executed
anything, `attempts` times in a row, ends all: something is wrong with the cluster or the project, and no run is to blame. A run
that was begun `attempts` times and never ended has failed.
"""

from __future__ import annotations

import contextlib
import gzip
import json
import shutil
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sierra import worker
from sierra.config import ClusterTable
from sierra.errors import Damaged, Full, Missing, SierraError
from sierra.model import Result
from sierra.paths import SessionPaths, write_whole
from sierra.provenance import environment, machine
from sierra.runners import Look, Work, element, schedulers, submission
from sierra.runners.dealing import deal
from sierra.runners.packs import Attempt, Ended, Event, Finished, Pack, Started, Trouble
from sierra.runners.probe import Probe
from sierra.runners.schedulers import State, Task
from sierra.runners.sizing import size
from sierra.runners.submission import Submission
from sierra.store.segments import disk_errors
from sierra.wording import counted, few

AT_ONCE = 256
"""Runs that one look tells of at most."""
READ_S = 0.2
"""Between two readings of packs, while nothing comes."""
FIRST_POLL_S, LAST_POLL_S = 1.0, 15.0
"""Between two questions to the scheduler, which get rarer while nothing happens."""
QUIET_S = 3.0
"""How long an element that the scheduler does not know must have recorded nothing, before it is taken for gone."""
LATE_S = 60.0
"""How long a network file system may take to show what was written."""
UNHEARD = 3
"""How many times in a row the scheduler must not know a probe that has recorded nothing, before it is taken for failed."""
FULL_S = 30.0
"""Until a scheduler that takes no more jobs is tried again."""
STOPPING_S = 60.0
CLOCK_S = 2.0
"""How far a node's clock may be from the shared file system's; times are told by the latter where it is farther."""
RELAUNCHED = "launch failed"
"""What schedulers say of a job that they could not begin, though it can: it is submitted again."""


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
    finished: bool = False
    trouble: str | None = None
    late: list[tuple[float, Ended]] = field(default_factory=list)
    """Runs whose files are not there as they were recorded, and since when."""


class Cluster:
    """The runner of a cluster's name, over its scheduler."""

    stays = True

    def __init__(self, slots: int, table: ClusterTable, *, name: str, scheduler: str) -> None:
        self.name = name
        self._kind = scheduler
        self._table = table
        self._scheduler = schedulers.find(scheduler)(table)
        self._folder = Path(tempfile.gettempdir(), "none")
        """Of this host, for the files of runs, until they are recorded."""

    # ------------------------------------------------------------ beginning

    def submit(self, work: Work, session: SessionPaths) -> None:
        bounds, version = self._scheduler.bounds(), self._scheduler.version()
        sized = size(work.count, work.seconds, self._table, bounds)
        self._table = self._table.model_copy(update={"wall": sized.wall_s})
        with disk_errors(session.root):
            forget(session)
            session.results.mkdir()
            session.logs.mkdir()
            counts = deal(work.jobs, sized.elements, session)
            for module in (worker, element, machine):
                shutil.copyfile(str(module.__file__), session.root / Path(str(module.__file__)).name)
            write_whole(session.element_settings, json.dumps(self._settings(work, session)).encode())
        probed = Probe(self.name, self._table, session).is_needed()
        table = self._table.model_dump(mode="json")
        made = Submission(self.name, self._kind, version, table, work.batch, counts, dict(work.around), probed)
        made.save(session)
        self._scheduler = schedulers.find(self._kind)(self._table)
        self._begin(made, session, {})
        self._hand_all_over()

    def _hand_all_over(self) -> None:
        """Submit the probe, if there is to be one, and all elements."""
        job = self._scheduler.submit(self._probe.request()) if self._made.probed else ""
        try:
            self._hand_over(tuple(range(len(self._shares))), "", after=job)
        except SierraError:
            self._cancel()
            raise

    def _settings(self, work: Work, session: SessionPaths) -> dict[str, Any]:
        return {
            "session": session.root.name,
            "slots": self._table.cpus,
            "scratch": self._table.scratch,
            "needs": [{"name": one.name, "path": one.path, "sha256": one.sha256} for one in work.needs],
            "record": list(work.record),
        }

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        made = Submission.load(session)
        self._table = made.cluster
        self._scheduler = schedulers.find(self._kind)(self._table)
        self._begin(made, session, recorded)
        if session.cancelled.exists():
            self.stop()
        elif not any(session.sent.iterdir()):  # who made it died before
            self._hand_all_over()

    def _begin(self, made: Submission, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        self._made, self._session = made, session
        self._name = submission.name_of(session)
        self._probe = Probe(self.name, self._table, session)
        self._probing = made.probed
        self._unheard = self._probes = 0
        self._shares = [Share(count, tries=1) for count in made.counts]
        self._tracks: dict[str, Track] = {}
        self._ended: set[bytes] = set()
        self._recorded = {bytes.fromhex(execution): attempt for execution, attempt in recorded.items()}
        prefix = f"sierra-taken-{session.root.name}-"
        for left in Path(tempfile.gettempdir()).glob(f"{prefix}*"):  # by one who followed before, and was killed
            worker.remove(str(left))
        self._folder = Path(tempfile.mkdtemp(prefix=prefix))
        self._number = 0
        self._poll = Poll(self._scheduler)
        self._due = time.monotonic() + FIRST_POLL_S
        self._pause = FIRST_POLL_S
        self._read_at = 0.0
        self._queued: set[int] = set()
        self._alive: set[int] | None = None
        self._notes: list[str] = []
        self._said: set[str] = set()
        self._failed: list[Result] = []
        self._again: dict[int, str] = {}
        self._again_at = 0.0
        self._stopping: float | None = None
        self._over = self._deaf = False
        self._wrong: SierraError | None = None

    def close(self) -> None:
        worker.remove(str(self._folder))

    # ------------------------------------------------------------ looking

    def look(self) -> Look:
        rows: list[tuple[str, dict[str, Any]]] = []
        results, copies = self._read(rows)
        if len(results) < AT_ONCE:
            results += self._failed
            self._failed = []
            was_over = self._over
            self._go_on(bool(results))
            if self._over and not was_over:
                self._read_on(rows, results, copies)
        notes, self._notes = tuple(self._notes), []
        alive = not self._over or bool(results) or any(track.late for track in self._tracks.values())
        if not alive:
            rows += [("attempts", self._row(track, track.attempt)) for track in self._tracks.values() if track.attempt]
        last = {track.element: track for track in self._tracks.values()}  # of the attempts at one element, the newest
        running = sum(len(track.begun) for track in last.values() if self._lives(track))
        return Look(
            tuple(results), running, alive, tuple(rows), notes, len(self._queued), tuple(copies), None if alive else self._wrong
        )

    def _go_on(self, came: bool) -> None:
        """Find out what lives, where it is time to, and do what follows from that."""
        now = time.monotonic()
        if self._over:
            return
        if all(share.missing == 0 for share in self._shares):
            self._settle()
            return
        if came:
            self._pause = FIRST_POLL_S
        if now >= self._due and self._poll.ask(self._probe.name if self._probing and self._stopping is None else self._name):
            self._due = float("inf")
        if (answer := self._poll.answer()) is not None:
            self._pause = min(self._pause * 1.5, LAST_POLL_S)
            self._due = now + self._pause
            if answer.name == self._name:
                self._hear(answer.tasks)
            else:
                self._hear_of_probe(answer.tasks)
        if self._stopping is not None and now - self._stopping > STOPPING_S:
            self._note(f"{self._name}: {self._kind} does not say that it has ended; it was asked to")
            self._over = True
        if self._again and now >= self._again_at and self._stopping is None:
            self._submit_again()

    def _hear(self, tasks: tuple[Task, ...] | None) -> None:
        """What the scheduler says."""
        if tasks is None:
            self._note(f"{self._kind} cannot be reached; what has been recorded is taken, and it is asked again")
            return
        living = [task for task in tasks if task.state in (State.QUEUED, State.RUNNING)]
        self._queued = self._elements(task for task in tasks if task.state is State.QUEUED)
        self._alive = self._elements(living)
        for task in tasks:
            if task.state is State.ENDED and task.element is not None and task.reason:
                self._shares[task.element].word = task.reason
        if self._stopping is not None:
            self._over = not living
            if self._deaf:
                self._cancel()
            return
        self._unstick([task for task in tasks if task.state is State.STUCK])
        for index, share in enumerate(self._shares):
            share.gone = share.gone + 1 if share.missing and index not in self._alive and index not in self._again else 0
        gone = [index for index, share in enumerate(self._shares) if share.gone]
        if gone:
            self._due = time.monotonic() + FIRST_POLL_S
        if any(self._shares[index].gone > 1 for index in gone):
            refresh(self._session.results)
            self._lost([index for index in gone if self._is_quiet(self._shares[index])])

    def _is_fine(self) -> bool:
        """Whether the probe, or an element that has begun since, says that nodes can execute elements."""
        try:
            return bool(self._tracks) or self._probe.is_fine()
        except Missing as error:
            self._end(error)
            return True

    def _hear_of_probe(self, tasks: tuple[Task, ...] | None) -> None:
        """What the scheduler says of the probe, as long as it has said nothing itself."""
        if tasks is None:
            self._hear(None)
        if tasks is None or self._stopping is not None or not self._probing:
            return
        self._unstick([task for task in tasks if task.state is State.STUCK])
        living = [task for task in tasks if task.state in (State.QUEUED, State.RUNNING)]
        self._queued = {0} if any(task.state is State.QUEUED for task in living) else set()
        self._unheard = 0 if living else self._unheard + 1
        self._due = min(self._due, time.monotonic() + FIRST_POLL_S)
        if self._unheard > 1:
            refresh(self._session.results)
            self._probing = not self._is_fine()
            if self._probing and self._unheard > UNHEARD:
                self._lost_probe(tasks)

    def _lost_probe(self, tasks: tuple[Task, ...]) -> None:
        """The probe is gone, and has recorded nothing. One that nobody knows anything of (any more) is submitted again."""
        wrong = self._probe.gone(next((task.reason for task in tasks if task.reason), ""))
        self._unheard, self._probes = 0, self._probes + 1
        if tasks or self._probes >= self._table.attempts or submission.last_line(self._session, "0"):
            self._end(wrong)
            return
        try:
            self._scheduler.submit(self._probe.request())
        except SierraError as error:
            self._end(error)

    def _is_quiet(self, share: Share) -> bool:
        return share.gone > 1 and time.monotonic() - share.grew > QUIET_S

    def _unstick(self, stuck: Sequence[Task]) -> None:
        """Cancel what will never begin; where that is not by mishap, nothing will."""
        mishaps = [task for task in stuck if RELAUNCHED in task.reason.lower()]
        if mishaps:
            self._cancel(sorted(self._elements(mishaps)))
        wrong = [task for task in stuck if task not in mishaps]
        if wrong:
            where = f"[runners.{self.name}]"
            self._end(Missing(f"{self._kind} will never begin job {wrong[0].job}: {wrong[0].reason}; see {where}"))

    def _elements(self, tasks: Iterable[Task]) -> set[int]:
        return submission.elements(self._session, tasks) & set(range(len(self._shares)))

    def _settle(self) -> None:
        """All is recorded: end what may still live, but for what is ending by itself."""
        self._over = True
        if self._made.probed:  # it may have been requeued, and wait
            with contextlib.suppress(Missing):
                self._scheduler.cancel(self._probe.name)
        tasks = self._scheduler.look(self._name) or ()
        ending = {track.element for track in self._tracks.values() if track.finished}
        living = [task for task in tasks if task.state is not State.ENDED]
        needless = [task for task in living if not (task.state is State.RUNNING and task.element in ending)]
        if needless:
            self._cancel(sorted(self._elements(needless)))

    # ------------------------------------------------------------ going on

    def _lost(self, indices: Sequence[int]) -> None:
        """These elements are gone, and runs of theirs are missing."""
        for index in indices:
            share = self._shares[index]
            self._given_up_before(index)
            word = self._why(index)
            self._give_up_on(index, [one for one, times in share.begun.items() if times >= self._table.attempts], word)
            if not share.missing:
                continue
            if share.done > share.progress:
                share.tries = 0
            if share.tries >= self._table.attempts and share.begun and not share.trouble:
                self._give_up_on(index, list(share.begun), word)
                share.tries = 0
            elif share.tries >= self._table.attempts:
                times = f"{share.tries} times" if share.tries > 1 else "once"
                self._end(Missing(f"element {index} was executed {times} and ended before any run had: {word}"))
                return
            if share.missing:
                self._again[index] = word

    def _why(self, index: int) -> str:
        """Why an element is gone: by its own words, and the scheduler's."""
        share = self._shares[index]
        told = share.trouble or submission.last_line(self._session, str(index))
        if not told or (share.word and share.word in told):
            return share.trouble or share.word or "nobody says by what"
        return f"{told} ({share.word})" if share.word else told

    def _submit_again(self) -> None:
        words = list(dict.fromkeys(self._again.values()))
        count = len(self._again)
        indices, why = tuple(sorted(self._again)), few(words, 2)
        self._again = {}
        self._note(f"{count} {'element is' if count == 1 else 'elements are'} submitted again: {why}")
        for index in indices:
            share = self._shares[index]
            share.tries, share.progress, share.gone = share.tries + 1, share.done, 0
            share.trouble = share.word = ""
        try:
            self._hand_over(indices, why)
        except SierraError as error:
            self._end(error)

    def _hand_over(self, indices: tuple[int, ...], why: str, after: str = "") -> None:
        """Submit elements; those that are too many now are submitted later. Raises what the scheduler refuses."""
        number = len(list(self._session.sent.iterdir()))
        intent = submission.intent(indices, why)
        submission.note(self._session, number, intent)
        request = replace(submission.request(self._session, self._name, indices, self._table.python), after=after)
        self._due = time.monotonic() + FIRST_POLL_S
        try:
            job = self._scheduler.submit(request)
        except Full as error:
            self._put_off(number, indices, why, error, after)
        except Missing as error:
            self._note(f"{error}; whether it has taken the job will be seen")
        else:
            submission.note(self._session, number, replace(intent, job=job))
            self._note(f"submitted as {self._kind} job {job} ({self._name}): {counted(len(indices), 'element')}")

    def _put_off(self, number: int, indices: tuple[int, ...], why: str, error: Full, after: str) -> None:
        """Try half of them, and the others later; or all later. Raises where the site takes not even one, and has none yet."""
        (self._session.sent / f"{number}.json").unlink()
        half = len(indices) // 2
        if half:
            self._hand_over(indices[:half], why, after)
        elif not any(submission.jobs(self._session)):
            raise error
        else:
            self._note(f"{error}; tried again every {FULL_S:g} s")
        for index in indices[half:]:
            self._shares[index].tries -= 1
            self._again[index] = why or "the site took no more jobs at first"
        self._again_at = time.monotonic() + FULL_S

    def stop(self) -> None:
        if self._stopping is None:
            self._stopping = time.monotonic()
            self._session.cancelled.touch()
        self._cancel()
        self._due, self._pause = time.monotonic(), FIRST_POLL_S / 2

    def _cancel(self, elements: Sequence[int] | None = None) -> None:
        """Have jobs, or elements, ended; where nobody can be asked to, that is tried again with the next question."""
        self._deaf = False
        try:
            if self._made.probed and elements is None:
                self._scheduler.cancel(self._probe.name)
            self._scheduler.cancel(self._name, elements)
        except Missing as error:
            self._deaf = True
            self._note(f"{error}; what is to end is cancelled as soon as {self._kind} can be reached")

    def _end(self, error: SierraError) -> None:
        """End all: asking again will do no better unless something is done about it."""
        self._wrong = self._wrong or error
        self.stop()

    def _note(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._notes.append(text)

    # ------------------------------------------------------------ reading

    def _read_on(self, rows: list[tuple[str, dict[str, Any]]], results: list[Result], copies: list[Result]) -> None:
        """Read what was written until nothing lived any more."""
        refresh(self._session.results)
        self._read_at = 0.0
        more, others = self._read(rows)
        results += more
        copies += others

    def _read(self, rows: list[tuple[str, dict[str, Any]]]) -> tuple[list[Result], list[Result]]:
        """What packs have since the last time: results, and copies of such as were taken before."""
        results: list[Result] = []
        copies: list[Result] = []
        if time.monotonic() < self._read_at:
            return results, copies
        if self._stopping is None and self._session.cancelled.exists():  # by another process
            self.stop()
        for path in sorted(self._session.results.glob("[0-9]*.pack")):
            track = self._tracks.setdefault(path.name, Track(Pack(path), int(path.name.partition(".")[0])))
            for event in self._events(track):
                self._shares[track.element].grew = time.monotonic()
                match event:
                    case Attempt():
                        self._begun(track, event, rows)
                    case Started():
                        self._started(track, event)
                    case Ended():
                        self._take(track, event, results, copies)
                    case Trouble():
                        self._failed_by(track, event)
                    case Finished():
                        track.finished, track.ended = True, event.time
                if len(results) >= AT_ONCE:
                    return results, copies
            self._take_late(track, results, copies)
        if self._probing and self._stopping is None:
            self._probing = not self._is_fine()
        if not results:
            self._read_at = time.monotonic() + READ_S
        return results, copies

    def _events(self, track: Track) -> Iterator[Event]:
        """What a pack has since the last time; a file that can't be read now, perhaps later."""
        try:
            yield from track.pack.read()
        except OSError as error:
            self._note(f"{track.pack.path} cannot be read: {error.strerror}")

    def _begun(self, track: Track, event: Attempt, rows: list[tuple[str, dict[str, Any]]]) -> None:
        around = environment.elsewhere(self._made.around, event.facts, event.variables)
        track.attempt, track.environment, track.ended = event, around["environment"], event.started
        track.ahead = event.clock if abs(event.clock) > CLOCK_S else 0.0
        self._shares[track.element].node = event.node
        rows.append(("environments", around))

    def _started(self, track: Track, event: Started) -> None:
        track.begun.add(event.execution)
        track.ended = event.time
        if bytes.fromhex(event.execution) not in self._ended:
            begun = self._shares[track.element].begun
            begun[event.execution] = begun.get(event.execution, 0) + 1

    def _failed_by(self, track: Track, event: Trouble) -> None:
        """Why an attempt could not go on; where a disk was full, its runs count as not begun."""
        share = self._shares[track.element]
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
        track.runs += 1
        track.ended = event.result.ended
        share = self._shares[track.element]
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
            self._note(f"{track.pack.path.name} is damaged; the runs in question are executed again")
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

    def _lives(self, track: Track) -> bool:
        lost = self._alive is not None and track.element not in self._alive
        return not (track.finished or track.trouble or lost or self._over)

    def _ended_by(self, track: Track) -> str | None:
        """What ended an attempt that has not said so itself."""
        if self._stopping is not None and self._wrong is None:
            return "cancelled"
        return self._shares[track.element].word or None

    def _row(self, track: Track, begun: Attempt) -> dict[str, Any]:
        """The attempt as a row of `attempts`."""
        return {
            "attempt": begun.attempt,
            "session": self._session.root.name,
            "batch": self._made.batch,
            "element": track.element,
            "scheduler": self._made.version,
            "job": begun.job,
            "node": begun.node,
            "started": moment(begun.started - track.ahead),
            "ended": moment(track.ended - track.ahead),
            "clock": begun.clock,
            "cpus": begun.cpus,
            "memory": begun.memory,
            "gpus": begun.gpus,
            "allocation": json.dumps(dict(begun.allocation), sort_keys=True),
            "runs": track.runs,
            "cut": len(track.begun),
            "state": "finished" if track.finished else "cut off",
            "trouble": track.trouble or (None if track.finished else self._ended_by(track)),
            "environment": track.environment,
        }

    # ------------------------------------------------------------ failing

    def _given_up_before(self, index: int) -> None:
        """Count the runs that have failed because another process, which followed before this one, gave them up."""
        share = self._shares[index]
        for execution, _ in jobs_of(self._session, index) if self._recorded else ():
            key = bytes.fromhex(execution)
            if key in self._recorded and key not in self._ended:
                self._ended.add(key)
                share.begun.pop(execution, None)
                share.done += 1

    def _give_up_on(self, index: int, executions: Sequence[str], word: str) -> None:
        """These executions were begun as many times as they may be, and never ended: their runs have failed."""
        if not executions:
            return
        share, wanted, now = self._shares[index], set(executions), time.time()
        times = 0
        for execution, run in jobs_of(self._session, index):
            if execution in wanted:
                times = max(share.begun.pop(execution), share.tries)
                reason = f"its element was cut off {times} times while it ran: {word}"
                self._failed.append(failed(run, execution, share.node, now, reason, self._folder))
                self._ended.add(bytes.fromhex(execution))
                share.done += 1
        with disk_errors(self._session.root), self._session.given_up(index).open("a") as file:
            file.writelines(f"{execution}\n" for execution in executions)
        which = "a run" if len(wanted) == 1 else f"{len(wanted)} runs"
        self._note(f"{which} of element {index} failed, cut off {times} times: {word}")


class Answer:
    """What a scheduler has answered."""

    def __init__(self, name: str, tasks: tuple[Task, ...] | None) -> None:
        self.name = name
        self.tasks = tasks


class Poll:
    """Questions to a scheduler, one at a time, in another thread: one that is out of reach takes its time to say so."""

    def __init__(self, scheduler: schedulers.Scheduler) -> None:
        self._scheduler = scheduler
        self._thread: threading.Thread | None = None
        self._answers: list[Answer] = []

    def ask(self, name: str) -> bool:
        """Ask for the jobs of a name, where no question is open."""
        if self._thread is not None and self._thread.is_alive():
            return False
        self._thread = threading.Thread(target=self._look, args=(name,), daemon=True)
        self._thread.start()
        return True

    def answer(self) -> Answer | None:
        return self._answers.pop() if self._answers else None

    def _look(self, name: str) -> None:
        try:
            tasks = self._scheduler.look(name)
        except (SierraError, OSError):
            tasks = None
        self._answers.append(Answer(name, tasks))


def jobs_of(session: SessionPaths, index: int) -> Iterator[tuple[str, str]]:
    """Execution and run of each job of an element; see `sierra.runners.element.jobs` for the format."""
    with gzip.open(session.jobs(index), "rt", encoding="utf-8") as lines:
        common = json.loads(next(lines))["common"]
        for line in lines:
            job = {**common, **json.loads(line)}
            if "end" not in job:
                yield job["execution"], job["run"]


def failed(run: str, execution: str, node: str, now: float, reason: str, folder: Path) -> Result:
    """The result of a run that nobody has a result of."""
    return Result(run, execution, str(folder / "none"), now, now, None, None, None, None, None, None, node, 0, (), reason)


def forget(session: SessionPaths) -> None:
    """Remove what was submitted before in the same session, and is recorded: others have given more runs back meanwhile."""
    session.submission.unlink(missing_ok=True)
    session.cancelled.unlink(missing_ok=True)
    for folder in (session.results, session.logs, session.sent, session.jobs(0).parent):
        worker.remove(str(folder))


def refresh(folder: Path) -> None:
    """Make a network file system look again at what is in a folder: by changing it, where there is room for that."""
    with contextlib.suppress(OSError), tempfile.TemporaryFile(dir=folder):
        pass


def moment(seconds: float) -> datetime:
    """Seconds since the epoch as a time."""
    return datetime.fromtimestamp(seconds, UTC)
