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
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, ClassVar

from sierra.config.cluster_table import ClusterTable
from sierra.config.field_types import Table
from sierra.errors import Full, Missing, SierraError
from sierra.model import Result, Times
from sierra.runners import schedulers
from sierra.runners.base import Look, Work
from sierra.runners.cluster import batch_state, submission_record
from sierra.runners.cluster.batch_state import Answer, BatchState, Phase, on_poll
from sierra.runners.cluster.collect import AT_ONCE, Collector, Share, refresh
from sierra.runners.cluster.preflight_job import Preflight
from sierra.runners.cluster.shard import deal, deal_first, deal_rest, deal_sized
from sierra.runners.cluster.sizing import Size, Timing, elements_of, note_on_gpus, runs_of_element, size, slots_of, timing
from sierra.runners.cluster.submission_record import Sent, Submission
from sierra.runners.schedulers.base import Carries, NodeVariables, Scheduler, State, Task
from sierra.store.layout import SessionPaths
from sierra.store.segments import disk_errors
from sierra.util import worker_zip
from sierra.util.fs import write_whole
from sierra.util.lazy_logger import Log
from sierra.util.text import counted, few, verb
from sierra.worker.files import remove

log = Log(__name__)
FIRST_POLL_S, LAST_POLL_S = 1.0, 15.0
"""Shortest and longest time between two queries to the scheduler. The time grows while nothing happens."""
QUIET_S = 3.0
"""Seconds without new records after which an element that the scheduler does not know is treated as gone."""
FULL_S = 30.0
"""Seconds after which a scheduler that takes no more jobs is tried again."""
LAST_WORD_S = 20.0
"""Seconds that elements may take to end by themselves after they have executed everything."""
STOPPING_S = 60.0
UNREACHABLE_S = 20.0
"""Seconds that the scheduler may be unreachable while jobs are to be cancelled. After that, the next command cancels them."""


class Cluster:
    """The runner of one named cluster, with its scheduler."""

    stays = True
    remote = True
    Options: ClassVar[type[Table]] = ClusterTable

    def __init__(self, slots: int, table: ClusterTable, *, name: str, scheduler: str) -> None:
        self.name = name
        self._kind = scheduler
        self._table = table
        self._use(schedulers.find(scheduler)(table))
        self._opened = contextlib.ExitStack()
        self._batch = BatchState(())

    def _use(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._carrier = scheduler if isinstance(scheduler, Carries) else None
        """The same scheduler, if it carries files to its hosts."""

    def submit(self, work: Work, session: SessionPaths) -> None:
        bounds, version = self._scheduler.bounds(), self._scheduler.version()
        if self._carrier:
            self._submit_carried(self._carrier, work, session, version)
            return
        sized = size(work.count, work.times, self._table, bounds, waits=work.waits, gpus=work.gpus, cores=work.cores)
        estimated = self._table.wall is None and sized.wall_s is not None
        self._table = self._table.model_copy(update={"wall": sized.wall_s})
        past = submission_record.past(session)
        with disk_errors(session.root):
            forget(session)
            counts, rest = self._deal(work, sized, session)
            self._write_programs(work, session)
        probed = Preflight(self.name, self._table, session).is_needed()
        table = self._table.model_dump(mode="json")
        dealt = (work.batch, counts, dict(work.around), probed, rest)
        means = _means(work.times, sized.first)
        slots = runs_of_element(self._table, work.gpus, work.cores)
        submission = Submission(self.name, self._kind, version, table, *dealt, bounds, estimated, *means, slots, past)
        submission.save(session)
        self._begin(submission, session, {})
        self._is_own = True
        if note := note_on_gpus(self._table, work.gpus):
            self._note(note)
        if rest:
            unknown = "runs with these values were never timed" if work.times else "the duration of runs is not known yet"
            self._note(f"{unknown}: {counted(counts[0], 'run')} of {work.count} {verb(counts[0], 'is', 'are')} executed first")
        self._submit_all()

    def _submit_carried(self, scheduler: Carries, work: Work, session: SessionPaths, version: str) -> None:
        """Submit to a scheduler that carries files to its hosts, whose number and speed decide on the elements."""
        past = submission_record.past(session)
        with disk_errors(session.root):
            forget(session)
            self._opened.callback(self._disconnect, scheduler)
            scheduler.open(session, work, follows=True)
            each = work.times.each if work.times else (1.0,) * work.count
            order = sorted(range(work.count), key=lambda number: -each[number])
            counts = tuple(scheduler.sizes([each[number] for number in order]))
            deal_sized((replace(job, checkpoint=None) for job in work.jobs), order, counts, session)
            self._write_programs(work, session)
        own = (self.name, self._kind, version, self._table.model_dump(mode="json"), work.batch, counts, dict(work.around))
        submission = Submission(*own, rest_s=work.times.mean if work.times else None, past=past)
        submission.save(session)
        self._begin(submission, session, {})
        self._is_own = True
        self._submit_all()

    def _write_programs(self, work: Work, session: SessionPaths) -> None:
        """Write the programs of elements, and their settings."""
        write_whole(session.worker, worker_zip.packed())
        write_whole(session.element_settings, json.dumps(self._settings(work, session)).encode())

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
            self._submit_tasks(tuple(range(len(self._batch.shares))), "", after=self._probe_job)
        except SierraError:
            self._cancel()
            raise

    def _settings(self, work: Work, session: SessionPaths) -> dict[str, object]:
        return {
            "session": session.root.name,
            "slots": 1 if self._carrier else slots_of(self._table, work.gpus),
            "scratch": self._table.scratch,
            "needs": [asdict(one) for one in work.needs],
            "record": list(work.record),
            "requeue": list(self._scheduler.requeue),
            "node": asdict(getattr(self._scheduler, "node", NodeVariables())),
        }

    def resume(self, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        submission = Submission.load(session)
        self._table = submission.cluster
        self._use(schedulers.find(self._kind)(self._table))
        self._begin(submission, session, recorded)
        if self._carrier:
            self._opened.callback(self._disconnect, self._carrier)
            self._carrier.open(session, None, follows=True)
        if not session.worker.exists():  # another version of SIERRA has submitted it, with programs of other names
            write_whole(session.worker, worker_zip.packed())
        with self._ending_on_error():
            if session.cancelled.exists():
                self.stop()
            elif not any(session.sent.iterdir()):  # the submitting process died before it submitted
                self._submit_all()
            else:  # or it died after it had sharded the runs that follow the calibration
                sent = {index for job in submission_record.sent(session) for index in job.elements}
                if never := tuple(index for index in range(len(self._batch.shares)) if index not in sent):
                    self._submit_tasks(never, "")

    def _begin(self, submission: Submission, session: SessionPaths, recorded: Mapping[str, str | None]) -> None:
        self._submission, self._session = submission, session
        self._name = submission_record.name_of(session)
        self._probe = Preflight(self.name, self._table, session)
        self._collector = Collector(submission, session, recorded, self._note)
        self._opened.callback(self._collector.close)
        self._batch = BatchState(self._collector.shares, Phase.PROBING if submission.probed else Phase.EXECUTING)
        self._is_calibrating = submission.rest > 0
        self._timing: Timing | None = None
        self._probe_job = ""
        self._is_own = False
        self._connect()
        self._due = time.monotonic() + FIRST_POLL_S
        self._pause = FIRST_POLL_S
        self._notes: list[str] = []
        self._noted: set[str] = set()
        self._read_at = self._resubmit_at = 0.0
        self._stopping: float | None = None
        self._complete_since: float | None = None
        self._wrong: SierraError | None = None

    def leave(self) -> None:
        if self._stopping is not None or self._session.cancelled.exists():
            return
        if self._carrier:
            self._carrier.leave()
            return
        if self._is_own:
            self._note(submission_record.UNFOLLOWED)
        if not self._is_calibrating:
            return
        if self._table.wall is None and self._submission.allowed.wall_s is not None:
            self._set_wall(self._submission.allowed.wall_s)  # nobody will submit again a run that takes longer than usual
        try:
            self._deal_rest(self._timing or Timing(None, "no process waits for the first runs"))
        except SierraError as error:
            self._note(f"{error}; the next sierra process that follows the session tries again")

    def close(self) -> None:
        self._opened.close()

    def _disconnect(self, scheduler: Carries) -> None:
        scheduler.close(over=self._batch.phase is Phase.OVER)

    def look(self) -> Look:
        collector = self._collector
        results, copies = self._read() if collector.is_due() else ([], [])
        if len(results) < AT_ONCE:
            results += collector.failed
            collector.failed = []
            before = self._batch.phase
            self._poll_scheduler(bool(results))
            if before is not self._batch.phase is Phase.OVER:  # read what was recorded before the last job ended
                refresh(self._session.results)
                for known, more in zip((results, copies), self._read(), strict=True):
                    known += more
        for note in self._carrier.notes() if self._carrier else ():
            self._note(note)
        notes, self._notes = tuple(self._notes), []
        rows, collector.rows = collector.rows, []
        batch = self._batch
        alive = batch.phase is not Phase.OVER or bool(results) or collector.has_late_files()
        if not alive:
            rows += collector.attempts("cancelled" if self._stopping is not None and self._wrong is None else None)
        running = 0 if batch.phase is Phase.OVER else collector.running(batch.alive)
        wrong = None if alive else self._wrong
        return Look(tuple(results), running, alive, tuple(rows), notes, len(batch.queued), batch.waits, tuple(copies), wrong)

    def _read(self) -> tuple[list[Result], list[Result]]:
        """Read new results and copies. Also notice a cancellation by another process and the preflight job's outcome."""
        if self._stopping is None and self._session.cancelled.exists():
            self.stop()
        if self._timing is not None and self._stopping is None:  # the caller could have stopped after the first results
            with self._ending_on_error():
                self._deal_rest(self._timing)
        self._read_at = time.monotonic()
        results = self._collector.read()
        self._check_nodes()
        self._timing = self._calibrate() if self._is_calibrating else None
        return results

    def _calibrate(self) -> Timing | None:
        now, began_at = time.time(), self._collector.began_at
        waited = now - min((sent.when for sent in submission_record.sent(self._session)), default=now)
        lasted = None if began_at is None else time.monotonic() - began_at
        return timing(self._collector.durations.values(), waited, lasted, over=self._collector.is_complete())

    def _poll_scheduler(self, new_results: bool) -> None:
        """If it is time, ask the scheduler what is alive, and act on its answer."""
        now = time.monotonic()
        if self._batch.phase is Phase.OVER:
            return
        if self._collector.is_complete() and not self._submission.rest:
            self._finish(now)
            return
        if new_results:
            self._pause = FIRST_POLL_S
        if now >= self._due and (self._query is None or not self._query.is_alive()):
            self._ask()
        if self._answers:
            self._pause = min(self._pause * 1.5, LAST_POLL_S)
            self._due = now + self._pause
            self._handle_answer(*self._answers.pop())
        if self._stopping is not None:
            self._await_end(now - self._stopping)
        if self._batch.resubmit and now >= self._resubmit_at and self._stopping is None:
            self._submit_again()

    def _await_end(self, waited: float) -> None:
        """Wait for cancelled jobs to end. Raises Missing if the scheduler cannot be reached to cancel them."""
        if waited > UNREACHABLE_S and (self._batch.uncancelled or not self._batch.reachable):
            why = f"{self._wrong}; " if self._wrong else ""
            session = self._session.root.name
            again = f"run sierra cancel {session} or sierra ls --jobs, or submit the query again"
            raise Missing(f"{why}{self._kind} cannot be reached, so jobs of session {session} are not cancelled yet: {again}")
        if waited > STOPPING_S:
            self._note(f"{self._name}: {self._kind} does not report the end of jobs that SIERRA has cancelled")
            self._change(phase=Phase.OVER)

    def _handle_answer(self, name: str, tasks: tuple[Task, ...] | None) -> None:
        """Decide about the scheduler's answer, and act."""
        if tasks is None:
            self._change(reachable=False)
            self._note(f"{self._kind} cannot be reached; SIERRA tries again, and still collects the recorded results")
            return
        if name == self._probe.name and self._batch.phase is not Phase.PROBING:
            return
        answer = self._answer([task for task in tasks if task.job not in self._submission.past])
        self._carry_out(*on_poll(self._batch, answer, self._table))
        probing = self._batch.phase is Phase.PROBING
        is_gone = self._batch.phase is Phase.EXECUTING and any(share.gone for share in self._batch.shares)
        if probing or is_gone:
            self._due = min(self._due, time.monotonic() + FIRST_POLL_S)
        if is_gone or (probing and self._batch.probe_unknown > 1):
            refresh(self._session.results)  # before the next answer, everything is read that was recorded before the end

    def _answer(self, tasks: Sequence[Task]) -> Answer:
        """Return these tasks with what else is known now. The results of the session's earlier submissions are recorded."""
        if self._carrier:
            self._collector.forgive(self._carrier.blameless())
        now, shares = time.monotonic(), dict(enumerate(self._batch.shares))
        last = submission_record.last(self._session, (task for task in tasks if task.state is State.ENDED))
        evidence = {
            index: self._collector.evidence(index)
            for index, share in shares.items()
            if share.gone and share.gone_at < self._read_at and share.grew_at < now - QUIET_S
        }
        pairs = [(task, submission_record.elements(self._session, [task]) & shares.keys()) for task in tasks]
        ended = [(index, task) for index, task in last if index in shares]
        return Answer(pairs, ended, evidence, now, self._scheduler.forgets, self._wall_is_longest())

    def _wall_is_longest(self) -> bool:
        """Return whether elements that are submitted again get no more time."""
        most, wall = self._submission.allowed.wall_s, self._table.wall
        return not self._submission.estimated or (most is not None and wall is not None and wall >= most)

    def _carry_out(self, batch: BatchState, actions: Sequence[batch_state.Action]) -> None:
        """Go on with the state of the batch, and carry out the actions."""
        self._batch, self._collector.shares = batch, batch.shares
        for action in actions:
            match action:
                case batch_state.Cancel(elements):
                    self._cancel(elements)
                case batch_state.Restart():
                    self._cancel()
                    with self._ending_on_error():
                        self._submit_all()
                case batch_state.LostProbe(reason, again):
                    with self._ending_on_error():
                        if not again or submission_record.last_line(self._session, "0"):
                            raise self._probe.gone(reason)
                        self._probe_job = self._scheduler.submit(self._probe.request())
                case batch_state.Refused(task):
                    why = self._scheduler.explain(task.reason)
                    self._end(Missing(f"{self._kind} will never start job {task.job}: {why}; see [runners.{self.name}]"))
                case batch_state.Cancelled():
                    self._end_as_cancelled(action)
                case batch_state.GiveUp(_, _, _, why):
                    self._collector.give_up_on(*action[:3], f"{why}{self._more_time(why)}")
                case batch_state.End(error):
                    self._end(error)

    def _change(self, **changes: Any) -> None:
        self._carry_out(replace(self._batch, **changes), ())

    def _check_nodes(self) -> None:
        """Let elements execute if the preflight job, or an element that has begun since, shows that nodes can do this."""
        try:
            if self._batch.phase is Phase.PROBING and (self._collector.has_begun() or self._probe.has_passed()):
                self._change(phase=Phase.EXECUTING)
        except Missing as error:
            self._end(error)

    def _finish(self, now: float) -> None:
        """Everything is recorded: let elements end that have executed all of their runs, and cancel the other living jobs.

        An element without missing runs is not cancelled: the scheduler would list it as cancelled, though it did all of its
        work.
        """
        self._complete_since = self._complete_since or now
        closing = self._collector.finishing_tasks(self._batch.alive)
        if closing and now - self._complete_since < LAST_WORD_S:
            return
        self._change(phase=Phase.OVER)
        if self._submission.probed:  # it may have been requeued, and wait
            with contextlib.suppress(Missing):
                self._scheduler.cancel(self._probe.name)
        tasks = self._scheduler.look(self._name) or ()
        ending = {(State.RUNNING, index) for index in self._collector.finished_tasks() | closing}
        needless = [task for task in tasks if task.state is not State.ENDED and (task.state, task.element) not in ending]
        if needless:
            self._cancel(sorted(submission_record.elements(self._session, needless) & set(range(len(self._batch.shares)))))

    def _end_as_cancelled(self, cancelled: batch_state.Cancelled) -> None:
        """End the session because somebody else has cancelled a part of it."""
        elements = set(cancelled.elements)
        jobs = [sent.job for sent in submission_record.sent(self._session) if sent.job and elements & set(sent.elements)]
        number = cancelled.job or next(reversed(jobs), None)
        job = f"{self._kind} job {number}" if number else f"a {self._kind} job"
        table = f"[runners.{self.name}]"
        unknown = f", unless a time limit that SIERRA does not know has ended it: set wall in {table}"
        more = "" if cancelled.sure or self._table.wall is not None else unknown
        self._note(
            f"{job} was cancelled, but not by SIERRA{more} ({cancelled.what}): the whole session ends now; submit the query "
            f'again to execute the missing runs, or set cancelled = "resubmit" in {table}'
        )
        self.stop()

    def _submit_again(self) -> None:
        words = list(dict.fromkeys(self._batch.resubmit.values()))
        indices, why = tuple(sorted(self._batch.resubmit)), few(words, 2)
        self._change(resubmit={})
        for index in indices:
            self._collector.isolate(index)
        self._note(f"{counted(len(indices), 'array task')} {verb(len(indices), 'is', 'are')} submitted again: {why}")
        if any(batch_state.TIMED.search(word) for word in words):
            self._give_more_time()
        for index in indices:
            self._collector.note_end(index)
            share = self._batch.shares[index]
            share.tries, share.progress, share.gone = share.tries + 1, share.done, 0
            share.trouble = share.reason = ""
            share.cancelled, share.ours, share.queued = None, False, False
        with self._ending_on_error():
            self._submit_tasks(indices, why)

    def _more_time(self, why: str) -> str:
        """Return what helps a run that the time limit of its element has ended; empty for another end."""
        if not batch_state.TIMED.search(why):
            return ""
        most = self._submission.allowed.wall_s
        limit = f" (the site allows {most:g} s)" if most is not None else ""
        return f"; it had all of that time: set a longer wall in [runners.{self.name}]{limit}"

    def _give_more_time(self) -> None:
        """Double the time limit of later elements if it was an estimate. It stays within the site's limit."""
        before = self._table.wall
        if not self._submission.estimated or before is None:
            return
        if (wall := self._set_wall(2 * before)) > before:
            self._note(f"the time limit of array tasks is now {wall / 60:g} minutes; {before / 60:g} minutes were too short")

    def _set_wall(self, wall: float) -> float:
        """Set the time limit that elements request from now on, within the site's limit; return it."""
        wall = min(wall, self._submission.allowed.wall_s or math.inf)
        self._table = self._table.model_copy(update={"wall": wall})
        self._submission = replace(self._submission, table=self._table.model_dump(mode="json"), estimated=True)
        self._submission.save(self._session)
        self._connect()  # the old scheduler object does not know what the new one submits
        return wall

    def _connect(self) -> None:
        if not self._carrier:
            self._use(schedulers.find(self._kind)(self._table))
        self._query: threading.Thread | None = None
        self._answers: list[tuple[str, tuple[Task, ...] | None]] = []

    def _ask(self) -> None:
        """Ask the scheduler in another thread, because an unreachable one takes long to fail."""
        name = self._probe.name if self._batch.phase is Phase.PROBING else self._name
        self._query = threading.Thread(target=_look, args=(self._scheduler, name, self._answers), daemon=True)
        self._query.start()
        self._due = math.inf

    def _expected_mean(self, result: Timing) -> float | None:
        """Return the expected mean time of the other runs. If calibration shows that it is longer, raise the time limit."""
        submission, wall = self._submission, self._table.wall
        if result.seconds is None or submission.first_s is None or submission.rest_s is None:
            return submission.rest_s if result.seconds is None else result.seconds
        slower = max(1.0, result.seconds / submission.first_s)
        if submission.estimated and wall is not None and slower > 1:
            self._set_wall(wall * slower)
        return submission.rest_s * slower

    def _deal_rest(self, result: Timing) -> None:
        """Shard the other runs according to the calibration, and submit them. Raises the scheduler's refusals."""
        self._is_calibrating, self._timing = False, None
        submission, mean = self._submission, self._expected_mean(result)
        count, why = elements_of(submission.rest, mean, self._table, submission.allowed, slots=submission.at_once, before=True)
        begin = len(self._batch.shares)
        counts = deal_rest(count, begin, self._session)
        self._submission = replace(self._submission, counts=(*self._submission.counts, *counts), rest=0)
        self._submission.save(self._session)
        self._change(shares=(*self._batch.shares, *(Share(each, tries=1) for each in counts)))
        runs = f"the other {counted(sum(counts), 'run')} {verb(sum(counts), 'is', 'are')}"
        self._note(f"{result.how}: {runs} split into {counted(count, 'array task')} ({why})")
        after = self._probe_job if self._batch.phase is Phase.PROBING else ""
        self._submit_tasks(tuple(range(begin, begin + count)), "", after)
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
            self._batch.shares[index].tries -= 1
        later = dict.fromkeys(indices[half:], why or "the site accepted no more jobs at first")
        self._change(resubmit={**self._batch.resubmit, **later})
        self._resubmit_at = time.monotonic() + FULL_S

    def stop(self) -> None:
        if self._stopping is None:
            self._stopping = time.monotonic()
            self._session.cancelled.touch()
        if self._batch.phase is not Phase.OVER:
            self._change(phase=Phase.STOPPING)
        if not self._batch.uncancelled:
            self._cancel()
        self._due, self._pause = time.monotonic(), FIRST_POLL_S / 2

    def _cancel(self, elements: Sequence[int] | None = None) -> None:
        """Cancel jobs, or some elements. If the scheduler cannot be reached, this is tried again at its next answer."""
        self._change(uncancelled=False)
        for index in elements or ():
            self._batch.shares[index].ours = True
        try:
            if self._submission.probed and elements is None:
                self._scheduler.cancel(self._probe.name)
            self._scheduler.cancel(self._name, elements)
        except Missing as error:
            self._change(uncancelled=True)
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


def _look(scheduler: schedulers.Scheduler, name: str, answers: list[tuple[str, tuple[Task, ...] | None]]) -> None:
    """Add the tasks of the jobs of that name to the answers; None if the scheduler cannot be reached."""
    try:
        answers.append((name, scheduler.look(name)))
    except (SierraError, OSError):
        answers.append((name, None))


def forget(session: SessionPaths) -> None:
    """Remove the session's earlier, recorded submission, and make empty folders for another one.

    Since then, other sessions have released more runs.
    """
    session.submission.unlink(missing_ok=True)
    session.cancelled.unlink(missing_ok=True)
    for folder in (session.results, session.logs, session.sent, session.jobs(0).parent):
        remove(str(folder))
    session.results.mkdir()
    session.logs.mkdir()
