"""The cluster runner: one array job whose elements execute many runs each.

The only source of results is what elements have recorded in their result logs (packs). The scheduler is only asked whether more
may come. So one procedure handles two copies of a task, a requeue, a lost node, a job that the scheduler has forgotten, an
unreachable controller and a submitting process that was killed: read what is recorded, ask what is alive, and submit again what
is missing.

If somebody other than SIERRA cancels an element, the session ends, unless the project sets `cancelled = "resubmit"`. An element
that has executed all of its runs is never cancelled.

An element that is gone while runs are missing is submitted again as long as it makes progress. If it ends `attempts` times in a
row without having executed any run, the session ends: the cause is the cluster or the project, not a run.

A run that was begun `attempts` times and never ended has failed if it was cut off while it had the element for itself. If
several runs execute at a time, one of them may end the element (for example by its memory use) and the others with it. So the
last time, the runs that were in flight are executed one by one. If the time limit of the element ended it, only a run that had
all of that time has failed.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import ClassVar

from sierra.config.cluster_table import ClusterTable
from sierra.config.field_types import Table
from sierra.errors import Full, Missing, SierraError
from sierra.model import Result, Times
from sierra.runners import schedulers
from sierra.runners.base import Look, Work
from sierra.runners.cluster import submission_record
from sierra.runners.cluster.calibrate import Calibration, Timing
from sierra.runners.cluster.collect import AT_ONCE, Collector, Share, refresh
from sierra.runners.cluster.preflight_job import Preflight
from sierra.runners.cluster.shard import deal, deal_first, deal_rest
from sierra.runners.cluster.sizing import Size, elements_of, size
from sierra.runners.cluster.submission_record import Sent, Submission
from sierra.runners.schedulers.base import NodeVariables, State, Task
from sierra.store.layout import SessionPaths
from sierra.store.segments import disk_errors
from sierra.util import worker_zip
from sierra.util.fs import write_whole
from sierra.util.lazy_definitions import regex
from sierra.util.lazy_logger import Log
from sierra.util.text import counted, few, verb
from sierra.worker.files import remove

log = Log(__name__)
FIRST_POLL_S, LAST_POLL_S = 1.0, 15.0
"""Shortest and longest time between two queries to the scheduler. The time grows while nothing happens."""
QUIET_S = 3.0
"""Seconds without new records after which an element that the scheduler does not know is treated as gone."""
PROBE_UNKNOWN = 3
"""Number of consecutive times that the scheduler may not know a preflight job without records, before the job has failed."""
FULL_S = 30.0
"""Seconds after which a scheduler that takes no more jobs is tried again."""
LAST_WORD_S = 20.0
"""Seconds that elements may take to end by themselves after they have executed everything."""
STOPPING_S = 60.0
UNREACHABLE_S = 20.0
"""Seconds that the scheduler may be unreachable while jobs are to be cancelled. After that, the next command cancels them."""
TIMED = regex(r"time ?limit|timeout|walltime", re.IGNORECASE)
"""Matches an end reason that means that the element's time was over."""
ASKED = regex(r"asked to end after (\d+) s$")
"""Matches an element's own message that it was asked to end; the number is the time that it had lasted."""
MISHAP = regex(rf"{TIMED.pattern}|node|preempt|memory|boot|requeue|deadline", re.IGNORECASE)
"""Matches a scheduler's end reason that means that nobody ended the element on purpose."""
RELAUNCHED = "launch failed"
"""Text in the scheduler's reason for a job that could not be started, though it can. Such a job is submitted again."""


class Cluster:
    """The runner of one named cluster, with its scheduler."""

    stays = True
    remote = True
    Options: ClassVar[type[Table]] = ClusterTable

    def __init__(self, slots: int, table: ClusterTable, *, name: str, scheduler: str) -> None:
        self.name = name
        self._kind = scheduler
        self._table = table
        self._scheduler = schedulers.find(scheduler)(table)
        self._opened = contextlib.ExitStack()
        self._calibration: Calibration | None = None

    def submit(self, work: Work, session: SessionPaths) -> None:
        bounds, version = self._scheduler.bounds(), self._scheduler.version()
        sized = size(work.count, work.times, self._table, bounds, waits=work.waits)
        estimated = self._table.wall is None and sized.wall_s is not None
        self._table = self._table.model_copy(update={"wall": sized.wall_s})
        past = submission_record.past(session)
        with disk_errors(session.root):
            forget(session)
            session.results.mkdir()
            session.logs.mkdir()
            counts, rest = self._deal(work, sized, session)
            write_whole(session.worker, worker_zip.packed())
            write_whole(session.element_settings, json.dumps(self._settings(work, session)).encode())
        probed = Preflight(self.name, self._table, session).is_needed()
        table = self._table.model_dump(mode="json")
        dealt = (work.batch, counts, dict(work.around), probed, rest)
        means = _means(work.times, sized.first)
        submission = Submission(self.name, self._kind, version, table, *dealt, bounds, estimated, *means, past)
        submission.save(session)
        self._begin(submission, session, {})
        self._is_own = True
        if rest:
            unknown = "runs with these values were never timed" if work.times else "the duration of runs is not known yet"
            self._note(f"{unknown}: {counted(counts[0], 'run')} of {work.count} {verb(counts[0], 'is', 'are')} executed first")
        self._submit_all()

    def _deal(self, work: Work, sized: Size, session: SessionPaths) -> tuple[tuple[int, ...], int]:
        """Write the job files; return the number of runs of each element, and the number of runs that are sharded later."""
        if not sized.first:
            return deal(work.jobs, sized.elements, session), 0
        first, rest = deal_first(work.jobs, frozenset(sized.first), session)
        return (first,), rest

    def _submit_all(self) -> None:
        """Submit the preflight job, if one is needed, and all elements."""
        if self._submission.probed:
            self._probe_job = self._scheduler.submit(self._probe.request())
            self._note(f"{self._kind} job {self._probe_job} ({self._probe.name}) runs first: it checks the nodes")
        try:
            self._submit_tasks(tuple(range(len(self._shares))), "", after=self._probe_job)
        except SierraError:
            self._cancel()
            raise

    def _settings(self, work: Work, session: SessionPaths) -> dict[str, object]:
        return {
            "session": session.root.name,
            "slots": self._table.cpus,
            "scratch": self._table.scratch,
            "needs": [asdict(one) for one in work.needs],
            "record": list(work.record),
            "requeue": list(self._scheduler.requeue),
            "node": asdict(getattr(self._scheduler, "node", NodeVariables())),
        }

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        submission = Submission.load(session)
        self._table = submission.cluster
        self._begin(submission, session, recorded)
        with self._ending_on_error():
            if session.cancelled.exists():
                self.stop()
            elif not any(session.sent.iterdir()):  # the submitting process died before it submitted
                self._submit_all()
            elif never := self._never_sent():  # or it died after it had sharded the runs that follow the calibration
                self._submit_tasks(never, "")

    def _never_sent(self) -> tuple[int, ...]:
        """Return the elements that no process has tried to submit."""
        sent = {index for one in submission_record.sent(self._session) for index in one.elements}
        return tuple(index for index in range(len(self._shares)) if index not in sent)

    def _begin(self, submission: Submission, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        self._submission, self._session = submission, session
        self._name = submission_record.name_of(session)
        self._probe = Preflight(self.name, self._table, session)
        self._probing = submission.probed
        self._probe_unknown = self._probe_attempts = 0
        self._collector = Collector(submission, session, recorded, self._note)
        self._opened.callback(self._collector.close)
        self._shares = self._collector.shares
        self._calibration = Calibration(session) if submission.rest else None
        self._timing: Timing | None = None
        self._probe_job = ""
        self._is_own = False
        self._connect()
        self._due = time.monotonic() + FIRST_POLL_S
        self._pause = FIRST_POLL_S
        self._queued: set[int] = set()
        self._waits = ""
        self._alive: set[int] | None = None
        self._notes: list[str] = []
        self._noted: set[str] = set()
        self._resubmit: dict[int, str] = {}
        self._read_at = 0.0
        self._resubmit_at = 0.0
        self._stopping: float | None = None
        self._complete_since: float | None = None
        self._over = self._uncancelled = self._unreachable = False
        self._wrong: SierraError | None = None

    def leave(self) -> None:
        if self._stopping is not None or self._session.cancelled.exists():
            return
        if self._is_own:
            self._note(submission_record.UNFOLLOWED)
        if self._calibration is None:
            return
        if self._table.wall is None and self._submission.allowed.wall_s is not None:
            self._set_wall(self._submission.allowed.wall_s)  # nobody will submit again a run that takes longer than usual
        try:
            self._deal_rest(self._timing or Timing(None, "no process waits for the first runs"))
        except SierraError as error:
            self._note(f"{error}; the next sierra process that follows the session tries again")

    def close(self) -> None:
        self._opened.close()

    def look(self) -> Look:
        collector = self._collector
        results, copies = self._read() if collector.is_due() else ([], [])
        if len(results) < AT_ONCE:
            results += collector.failed
            collector.failed = []
            was_over = self._over
            self._poll_scheduler(bool(results))
            if self._over and not was_over:  # read what was recorded before the last job ended
                refresh(self._session.results)
                for known, more in zip((results, copies), self._read(), strict=True):
                    known += more
        notes, self._notes = tuple(self._notes), []
        rows, collector.rows = collector.rows, []
        alive = not self._over or bool(results) or collector.has_late_files()
        if not alive:
            rows += collector.attempts("cancelled" if self._stopping is not None and self._wrong is None else None)
        running = 0 if self._over else collector.running(self._alive)
        wrong = None if alive else self._wrong
        return Look(tuple(results), running, alive, tuple(rows), notes, len(self._queued), self._waits, tuple(copies), wrong)

    def _read(self) -> tuple[list[Result], list[Result]]:
        """Read new results and copies. Also notice a cancellation by another process and the preflight job's outcome."""
        if self._stopping is None and self._session.cancelled.exists():
            self.stop()
        if self._timing is not None and self._stopping is None:  # the caller could have stopped after the first results
            with self._ending_on_error():
                self._deal_rest(self._timing)
        self._read_at = time.monotonic()
        results = self._collector.read()
        if self._probing and self._stopping is None:
            self._probing = not self._nodes_work()
        self._timing = self._calibration.result(over=self._collector.is_complete()) if self._calibration is not None else None
        return results

    def _poll_scheduler(self, new_results: bool) -> None:
        """If it is time, ask the scheduler what is alive, and act on its answer."""
        now = time.monotonic()
        if self._over:
            return
        if self._collector.is_complete() and not self._submission.rest:
            self._finish(now)
            return
        if new_results:
            self._pause = FIRST_POLL_S
        if now >= self._due and self._poll.ask(self._probe.name if self._probing and self._stopping is None else self._name):
            self._due = float("inf")
        if (answer := self._poll.answer()) is not None:
            self._pause = min(self._pause * 1.5, LAST_POLL_S)
            self._due = now + self._pause
            name, tasks = answer
            if name != self._name:
                self._handle_probe_answer(tasks)
            else:  # the results of the session's earlier submissions are recorded
                self._handle_answer(tasks and tuple(task for task in tasks if task.job not in self._submission.past))
        if self._stopping is not None:
            self._await_end(now - self._stopping)
        if self._resubmit and now >= self._resubmit_at and self._stopping is None:
            self._submit_again()

    def _await_end(self, waited: float) -> None:
        """Wait for cancelled jobs to end. Raises Missing if the scheduler cannot be reached to cancel them."""
        if waited > UNREACHABLE_S and (self._uncancelled or self._unreachable):
            why = f"{self._wrong}; " if self._wrong else ""
            session = self._session.root.name
            again = f"run sierra cancel {session} or sierra ls --jobs, or submit the query again"
            raise Missing(f"{why}{self._kind} cannot be reached, so jobs of session {session} are not cancelled yet: {again}")
        if waited > STOPPING_S:
            self._note(f"{self._name}: {self._kind} does not report the end of jobs that SIERRA has cancelled")
            self._over = True

    def _handle_answer(self, tasks: tuple[Task, ...] | None) -> None:
        """Process the scheduler's answer about the elements."""
        self._unreachable = tasks is None
        if tasks is None:
            self._note(f"{self._kind} cannot be reached; SIERRA tries again, and still collects the recorded results")
            return
        living = [task for task in tasks if task.state in (State.QUEUED, State.RUNNING)]
        self._queued = self._elements(task for task in tasks if task.state is State.QUEUED)
        self._waits = submission_record.waits(tasks)
        self._alive = self._elements(living)
        self._note_ends(tasks)
        if self._stopping is not None:
            self._over = not living
            if self._uncancelled:
                self._cancel()
            return
        self._handle_stuck([task for task in tasks if task.state is State.STUCK])
        for index, share in enumerate(self._shares):
            share.gone = share.gone + 1 if share.missing and index not in self._alive and index not in self._resubmit else 0
            if share.gone == 1:
                share.gone_at = time.monotonic()
            share.queued = index in self._queued or (share.queued and index not in self._alive)
        gone = [index for index, share in enumerate(self._shares) if share.gone]
        if gone:
            self._due = time.monotonic() + FIRST_POLL_S
        if any(self._shares[index].gone > 1 for index in gone):
            refresh(self._session.results)
            # what was recorded before the end must have been read since: it tells which runs had begun
            read = [index for index in gone if self._read_at > self._shares[index].gone_at]
            self._handle_lost([index for index in read if self._is_quiet(self._shares[index])])

    def _note_ends(self, tasks: Iterable[Task]) -> None:
        """Keep the end reasons of the elements that were submitted last."""
        ended = (task for task in tasks if task.state is State.ENDED)
        for index, task in submission_record.last(self._session, ended):
            if index < len(self._shares):
                share = self._shares[index]
                share.reason = task.reason or share.reason
                share.cancelled = task.cancelled

    def _nodes_work(self) -> bool:
        """Return True if the preflight job, or an element that has begun since, shows that nodes can execute elements."""
        try:
            return self._collector.has_begun() or self._probe.is_fine()
        except Missing as error:
            self._end(error)
            return True

    def _handle_probe_answer(self, tasks: tuple[Task, ...] | None) -> None:
        """Process the scheduler's answer about the preflight job, as long as the job has recorded nothing itself."""
        if tasks is None:
            self._handle_answer(None)
        if tasks is None or self._stopping is not None or not self._probing:
            return
        stuck = [task for task in tasks if task.state is State.STUCK]
        if any(is_mishap(task) for task in stuck) and self._probe_attempts + 1 < self._table.attempts:
            self._restart()
            return
        self._handle_stuck(stuck)
        living = [task for task in tasks if task.state in (State.QUEUED, State.RUNNING)]
        self._queued = {0} if any(task.state is State.QUEUED for task in living) else set()
        self._waits = submission_record.waits(tasks)
        self._probe_unknown = 0 if living else self._probe_unknown + 1
        if not living and any(task.cancelled for task in tasks) and self._table.cancelled == "stop":
            self._end_as_cancelled([task.job for task in tasks if task.cancelled], "before any node was checked", sure=True)
            return
        self._due = min(self._due, time.monotonic() + FIRST_POLL_S)
        if self._probe_unknown > 1:
            refresh(self._session.results)
            self._probing = not self._nodes_work()
            if self._probing and self._probe_unknown > PROBE_UNKNOWN:
                self._handle_lost_probe(tasks)

    def _restart(self) -> None:
        """Submit everything again: the preflight job could not be started, by mishap, and the elements depend on it."""
        self._probe_unknown, self._probe_attempts = 0, self._probe_attempts + 1
        self._cancel()
        with self._ending_on_error():
            self._submit_all()

    def _handle_lost_probe(self, tasks: tuple[Task, ...]) -> None:
        """Handle a preflight job that is gone without a record. If the scheduler no longer knows it, it is submitted again."""
        wrong = self._probe.gone(next((task.reason for task in tasks if task.reason), ""))
        self._probe_unknown, self._probe_attempts = 0, self._probe_attempts + 1
        if tasks or self._probe_attempts >= self._table.attempts or submission_record.last_line(self._session, "0"):
            self._end(wrong)
            return
        with self._ending_on_error():
            self._probe_job = self._scheduler.submit(self._probe.request())

    def _is_quiet(self, share: Share) -> bool:
        return share.gone > 1 and time.monotonic() - share.grew_at > QUIET_S

    def _handle_stuck(self, stuck: Sequence[Task]) -> None:
        """Cancel tasks that will never begin, to submit them again. If the reason is not a mishap, end the session."""
        mishaps = [task for task in stuck if is_mishap(task)]
        if mishaps:
            held = sorted(self._elements(mishaps))
            for index in held:  # the cancellation that follows is not the reason
                self._shares[index].trouble = mishaps[0].reason
            self._cancel(held)
        wrong = [task for task in stuck if task not in mishaps]
        if wrong:
            why = self._scheduler.explain(wrong[0].reason)
            self._end(Missing(f"{self._kind} will never start job {wrong[0].job}: {why}; see [runners.{self.name}]"))

    def _elements(self, tasks: Iterable[Task]) -> set[int]:
        return submission_record.elements(self._session, tasks) & set(range(len(self._shares)))

    def _finish(self, now: float) -> None:
        """Everything is recorded: let elements end that have executed all of their runs, and cancel the other living jobs.

        An element without missing runs is not cancelled: the scheduler would list it as cancelled, though it did all of its
        work.
        """
        self._complete_since = self._complete_since or now
        closing = self._collector.finishing_tasks() if self._alive is None else self._collector.finishing_tasks() & self._alive
        if closing and now - self._complete_since < LAST_WORD_S:
            return
        self._over = True
        if self._submission.probed:  # it may have been requeued, and wait
            with contextlib.suppress(Missing):
                self._scheduler.cancel(self._probe.name)
        tasks = self._scheduler.look(self._name) or ()
        ending = self._collector.finished_tasks() | closing
        living = [task for task in tasks if task.state is not State.ENDED]
        needless = [task for task in living if not (task.state is State.RUNNING and task.element in ending)]
        if needless:
            self._cancel(sorted(self._elements(needless)))

    def _handle_lost(self, indices: Sequence[int]) -> None:
        """Handle elements that are gone while runs of theirs are missing."""
        foreign = [index for index in indices if self._is_cancelled_by_others(index)]
        if foreign and self._table.cancelled == "stop":
            sent = submission_record.sent(self._session)
            jobs = [one.job for one in sent if one.job and set(one.elements) & set(foreign)][-1:]
            what = f"{counted(len(foreign), 'array task')}: {few([self._end_reason(index) for index in foreign], 2)}"
            self._end_as_cancelled(jobs, what, sure=any(self._shares[index].cancelled for index in foreign))
            return
        for index in indices:
            share = self._shares[index]
            self._collector.count_given_up(index)
            word = self._end_reason(index)
            if share.done > share.progress:
                share.tries = 0
            timed = bool(TIMED.search(word))
            cut = self._collector.interrupted_by_limit(index) if timed else self._collector.interrupted_alone(index)
            guilty = [one for one in self._suspects(share, self._table.attempts) if one in cut]
            self._collector.give_up_on(index, guilty, word)
            if not share.missing:
                continue
            if share.done > share.progress:
                share.tries = 0
            suspects = [] if timed else self._suspects(share, self._table.attempts - 1)
            if share.tries >= self._table.attempts * (2 if suspects else 1):
                times = f"{share.tries} times" if share.tries > 1 else "once"
                self._end(Missing(f"array task {index} was executed {times} and ended before any of its runs ended: {word}"))
                return
            self._collector.isolate(index, suspects)
            self._resubmit[index] = word

    def _is_cancelled_by_others(self, index: int) -> bool:
        """Return True if somebody other than SIERRA has ended an element, as far as this can be known.

        The scheduler may not report what has ended an element. Then an element was cancelled if it was asked to end before its
        time was over, or if it never began and the scheduler forgets ended jobs at once.
        """
        share = self._shares[index]
        if share.ours or share.cancelled is not None:
            return bool(share.cancelled) and not share.ours
        message = share.trouble or submission_record.last_line(self._session, str(index))
        if message:
            return bool(ASKED.search(message)) and not (self._overdue(index, message) or MISHAP.search(share.reason))
        return share.queued and not share.reason and self._scheduler.forgets

    def _end_as_cancelled(self, jobs: Sequence[str], what: str, *, sure: bool) -> None:
        """End the session because somebody else has cancelled a part of it; if not `sure`, because it looks like that."""
        job = f"{self._kind} job {jobs[0]}" if jobs else f"a {self._kind} job"
        table = f"[runners.{self.name}]"
        unknown = f", unless a time limit that SIERRA does not know has ended it: set wall in {table}"
        more = "" if sure or self._table.wall is not None else unknown
        self._note(
            f"{job} was cancelled, but not by SIERRA{more} ({what}): the whole session ends now; submit the query again to "
            f'execute the missing runs, or set cancelled = "resubmit" in {table}'
        )
        self.stop()

    def _suspects(self, share: Share, times: int) -> list[str]:
        """Return the runs of an element that may have ended it: those that were begun at least `times` times.

        If the element was submitted `times` times without progress and gave no reason, these are all runs that have not ended.
        """
        stuck = share.tries >= times and not share.trouble
        return [one for one, begun in share.begun.items() if stuck or begun >= times]

    def _end_reason(self, index: int) -> str:
        """Return the reason why an element is gone, in its own words and the scheduler's."""
        share = self._shares[index]
        message = share.trouble or submission_record.last_line(self._session, str(index))
        word = share.reason or self._overdue(index, message)
        if not message or (word and word in message):
            return share.trouble or word or "unknown reason"
        return f"{message} ({word})" if word else message

    def _overdue(self, index: int, message: str) -> str:
        """Return the words for an exceeded time limit if an element's time was over: a scheduler may not report it."""
        asked, wall = ASKED.search(message), self._table.wall or self._collector.allowed(index)
        return f"walltime of {wall:g} s exceeded" if asked and wall and int(asked[1]) >= wall - 1 else ""

    def _submit_again(self) -> None:
        words = list(dict.fromkeys(self._resubmit.values()))
        count = len(self._resubmit)
        indices, why = tuple(sorted(self._resubmit)), few(words, 2)
        self._resubmit = {}
        self._note(f"{count} {'array task is' if count == 1 else 'array tasks are'} submitted again: {why}")
        if any(TIMED.search(word) for word in words):
            self._give_more_time()
        for index in indices:
            self._collector.note_end(index)
            share = self._shares[index]
            share.tries, share.progress, share.gone = share.tries + 1, share.done, 0
            share.trouble = share.reason = ""
            share.cancelled, share.ours, share.queued = None, False, False
        with self._ending_on_error():
            self._submit_tasks(indices, why)

    def _give_more_time(self) -> None:
        """Double the time limit of later elements if it was an estimate. It stays within the site's limit."""
        before = self._table.wall
        if not self._submission.estimated or before is None:
            return
        wall = min(2 * before, self._submission.allowed.wall_s or math.inf)
        self._set_wall(wall)
        if wall > before:
            self._note(f"the time limit of array tasks is now {wall / 60:g} minutes; {before / 60:g} minutes were too short")

    def _set_wall(self, wall: float) -> None:
        """Set the time limit that elements request from now on."""
        self._table = self._table.model_copy(update={"wall": wall})
        self._submission = replace(self._submission, table=self._table.model_dump(mode="json"), estimated=True)
        self._submission.save(self._session)
        self._connect()  # the old scheduler object does not know what the new one submits

    def _connect(self) -> None:
        self._scheduler = schedulers.find(self._kind)(self._table)
        self._poll = Poll(self._scheduler)

    def _expected_mean(self, result: Timing) -> float | None:
        """Return the expected mean time of the other runs. If calibration shows that it is longer, raise the time limit."""
        submission, wall = self._submission, self._table.wall
        if result.seconds is None or submission.first_s is None or submission.rest_s is None:
            return submission.rest_s if result.seconds is None else result.seconds
        slower = max(1.0, result.seconds / submission.first_s)
        if submission.estimated and wall is not None and slower > 1:
            self._set_wall(min(wall * slower, submission.allowed.wall_s or math.inf))
        return submission.rest_s * slower

    def _deal_rest(self, result: Timing) -> None:
        """Shard the other runs according to the calibration, and submit them. Raises the scheduler's refusals."""
        self._calibration = self._timing = None
        count, why = elements_of(
            self._submission.rest, self._expected_mean(result), self._table, self._submission.allowed, before=True
        )
        begin = len(self._shares)
        counts = deal_rest(count, begin, self._session)
        self._submission = replace(self._submission, counts=(*self._submission.counts, *counts), rest=0)
        self._submission.save(self._session)
        self._shares += [Share(each, tries=1) for each in counts]
        runs = f"the other {counted(sum(counts), 'run')} {verb(sum(counts), 'is', 'are')}"
        self._note(f"{result.how}: {runs} split into {counted(count, 'array task')} ({why})")
        self._submit_tasks(tuple(range(begin, begin + count)), "", after=self._probe_job if self._probing else "")
        with disk_errors(self._session.root):
            self._session.rest.unlink()

    def _submit_tasks(self, indices: tuple[int, ...], why: str, after: str = "") -> None:
        """Submit elements. If they are too many now, some are submitted later. Raises the scheduler's refusals."""
        number = len(list(self._session.sent.iterdir()))
        intent = Sent(indices, time.time(), why)
        submission_record.note(self._session, number, intent)
        request = replace(submission_record.elements_request(self._session, self._name, indices, self._table), after=after)
        self._due = time.monotonic() + FIRST_POLL_S
        try:
            job = self._scheduler.submit(request)
        except Full as error:
            self._postpone(number, indices, why, error, after)
        except Missing as error:
            self._note(f"{error}; SIERRA will check whether the job was accepted")
        else:
            submission_record.note(self._session, number, replace(intent, job=job))
            self._note(f"submitted as {self._kind} job {job} ({self._name}): {counted(len(indices), 'array task')}")

    def _postpone(self, number: int, indices: tuple[int, ...], why: str, error: Full, after: str) -> None:
        """Submit half of the elements now and the others later, or all later.

        Raises `error` if the site takes not even one element and has no other job of the session.
        """
        (self._session.sent / f"{number}.json").unlink()
        half = len(indices) // 2
        if half:
            self._submit_tasks(indices[:half], why, after)
        elif not self._submission.probed and not any(submission_record.jobs(self._session)):
            raise error
        else:
            self._note(f"{error}; SIERRA tries again every {FULL_S:g} s")
        for index in indices[half:]:
            self._shares[index].tries -= 1
            self._resubmit[index] = why or "the site accepted no more jobs at first"
        self._resubmit_at = time.monotonic() + FULL_S

    def stop(self) -> None:
        if self._stopping is None:
            self._stopping = time.monotonic()
            self._session.cancelled.touch()
        if not self._uncancelled:
            self._cancel()
        self._due, self._pause = time.monotonic(), FIRST_POLL_S / 2

    def _cancel(self, elements: Sequence[int] | None = None) -> None:
        """Cancel jobs, or some elements. If the scheduler cannot be reached, this is tried again at its next answer."""
        self._uncancelled = False
        for index in elements or ():
            self._shares[index].ours = True
        try:
            if self._submission.probed and elements is None:
                self._scheduler.cancel(self._probe.name)
            self._scheduler.cancel(self._name, elements)
        except Missing as error:
            self._uncancelled = True
            self._note(f"{error}; the jobs are cancelled as soon as {self._kind} can be reached")

    def _end(self, error: SierraError) -> None:
        """End the session with an error: submitting again would end the same way until something is done about it."""
        self._wrong = self._wrong or error
        self.stop()

    @contextlib.contextmanager
    def _ending_on_error(self) -> Iterator[None]:
        try:
            yield
        except SierraError as error:
            self._end(error)

    def _note(self, text: str) -> None:
        if text not in self._noted:
            self._noted.add(text)
            self._notes.append(text)
            log.info("%s", text)


def _means(times: Times | None, first: Sequence[int]) -> tuple[float | None, float | None]:
    """Return the expected mean times of the runs at the places `first`, and of the other runs."""
    if times is None or not first:
        return None, times.mean if times else None
    chosen = [times.each[place] for place in first]
    rest = len(times.each) - len(chosen)
    return sum(chosen) / len(chosen), (sum(times.each) - sum(chosen)) / max(rest, 1)


class Poll:
    """Queries to a scheduler, one at a time, in another thread, because an unreachable scheduler takes long to fail."""

    def __init__(self, scheduler: schedulers.Scheduler) -> None:
        self._scheduler = scheduler
        self._thread: threading.Thread | None = None
        self._answers: list[tuple[str, tuple[Task, ...] | None]] = []

    def ask(self, name: str) -> bool:
        """Ask for the jobs of a name; return False if a query is still open."""
        if self._thread is not None and self._thread.is_alive():
            return False
        self._thread = threading.Thread(target=self._look, args=(name,), daemon=True)
        self._thread.start()
        return True

    def answer(self) -> tuple[str, tuple[Task, ...] | None] | None:
        """Return the name and the tasks (None: unknown) of a query that has ended since the last call; None without one."""
        return self._answers.pop() if self._answers else None

    def _look(self, name: str) -> None:
        try:
            tasks = self._scheduler.look(name)
        except (SierraError, OSError):
            tasks = None
        self._answers.append((name, tasks))


def is_mishap(task: Task) -> bool:
    """Return True if a task that will never begin could begin if it were submitted again."""
    return RELAUNCHED in task.reason.lower()


def forget(session: SessionPaths) -> None:
    """Remove the session's earlier, recorded submission. Since then, other sessions have released more runs."""
    session.submission.unlink(missing_ok=True)
    session.cancelled.unlink(missing_ok=True)
    for folder in (session.results, session.logs, session.sent, session.jobs(0).parent):
        remove(str(folder))
