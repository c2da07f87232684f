"""Poll loop: a runner is followed until it ends, and its results are recorded.

`attach` follows a session on a cluster that another process has submitted, or records what has finished and leaves it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from sierra import runners
from sierra.errors import Missing, SierraError
from sierra.execution import recover, session_records
from sierra.execution.observer import ProgressCounter
from sierra.execution.sessions import Session
from sierra.ingest.consistency import find_inconsistent
from sierra.ingest.recorder import Recorder
from sierra.ingest.recording_context import Context
from sierra.model import Purpose, Status
from sierra.runners.base import Look, Runner, Work
from sierra.runners.cluster.submission_record import Submission
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass
from sierra.util.signals import noted

POLL_S, WATCHED_S = 0.05, 0.01
"""Seconds between two looks, and while a person watches a run."""
MANY = 100
"""Number of results in one poll from which on the next poll follows without a pause."""


@dataclass(frozen=True, slots=True)
class Followed:
    """Result of following a session."""

    left: bool
    """True if the runs continue without this process."""
    interrupted: bool
    """True if the user ended it."""
    inconsistent: set[str]
    """Runs with an execution, new or old, that is inconsistent with other executions."""
    notes: tuple[str, ...]
    left_out: tuple[str, ...] = ()
    """Runs that the runner has left out."""


def follow(
    runner: Runner,
    recorder: Recorder,
    store: Store,
    session: Session,
    counter: ProgressCounter,
    work: Work | None,
    *,
    detach: bool = False,
    enough: Callable[[], bool] = lambda: False,
) -> Followed:
    """Execute the work of a session until it ends, and record it; without `work`, follow jobs that were submitted before.

    `detach`: act from the start as if the user had interrupted; the counter decides then to leave the jobs.
    If `enough` returns True, the rest is ended. Raises the runner's errors.
    """
    with noted(detach) as signals:
        follower = _Follower(runner, recorder, store, session, counter)
        with follower.giving_up():
            follower.begin(work)
            follower.poll(signals, enough)
        complete = recorder.context.purpose == Purpose.RUN and (work is not None or not follower.left)
        inconsistent: set[str] = set()
        if complete:
            inconsistent = find_inconsistent(store, session.paths, recorder.context, recorder.lost, final=runner.stays)
            inconsistent |= recorder.find_astray()
        interrupted = bool(signals) and not detach
        return Followed(follower.left, interrupted, inconsistent, tuple(recorder.notes()), tuple(follower.left_out))


class Executed(NamedTuple):
    """A recorded execution, and the attempt at an array task that executed it."""

    execution: str
    attempt: str | None


class _Follower:
    """One runner and the recorder of its results."""

    def __init__(self, runner: Runner, recorder: Recorder, store: Store, session: Session, counter: ProgressCounter) -> None:
        self._runner = runner
        self._recorder = recorder
        self._store = store
        self._session = session
        self._counter = counter
        self.left = False
        """True if the runs were left to continue without this process."""
        self.left_out: list[str] = []
        self._submitted = self._over = False

    def begin(self, work: Work | None) -> None:
        """Submit jobs; without `work`, resume those that another process has submitted."""
        if work is not None:
            self._runner.submit(work, self._session.paths)
            self._submitted = True
            return
        self._submitted = True
        executed = "SELECT execution, attempt FROM executions WHERE session = $s"
        recorded = dict(self._store.select(Executed, executed, s=self._session.id))
        self._runner.resume(self._session.paths, recorded)

    def poll(self, signals: Sequence[int], enough: Callable[[], bool]) -> None:
        """Record the results of all jobs until they end.

        If `signals` is not empty or `enough` returns True, end the running jobs, or leave them.
        """
        alive, handled = True, 0
        while alive:
            look = self._poll()
            self._take(look)
            if self._recorder.due():
                self._count_failed(self._recorder.flush())
            self._counter.report(look.running, look.queued, look.waits)
            self._session.beat()
            if len(signals) > handled or (enough() and not handled):
                if self._runner.stays and len(signals) > handled and self._counter.leave():
                    self._leave()
                    break
                handled = max(len(signals), 1)
                self._runner.stop()
            alive = look.alive
            if alive and len(look.results) < MANY:
                time.sleep(WATCHED_S if look.watched else POLL_S)
        self._count_failed(self._recorder.flush(last=True))
        if self.left:
            self._session.leave()
        self._counter.report(0)

    def _leave(self) -> None:
        """Leave the jobs to continue without this process, and take the results that they have until then."""
        self._runner.leave()
        look = self._poll()
        self._take(look)
        while look.results:
            look = self._poll()
            self._take(look)
        self.left = look.alive

    def _poll(self) -> Look:
        """Return the runner's new results. If the runner cannot continue, record its results first and raise its error."""
        try:
            look = self._runner.look()
        except SierraError:
            self._count_failed(self._recorder.flush())
            raise
        if look.wrong is not None:
            self._over = True
            self._take(look)
            self._count_failed(self._recorder.flush())
            raise look.wrong
        return look

    def _take(self, look: Look) -> None:
        """Pass new results on to the recorder, the counter and the observer."""
        for result in look.results:
            status = self._recorder.add(result)
            if status is not Status.INTERRUPTED:
                self._counter.ended(result.run, status)
        self.left_out += look.left_out
        self._recorder.add_rows(look.rows, look.copies)
        self._recorder.add_late(look.late)
        for text in look.notes:
            self._counter.observer.notice(text)

    def _count_failed(self, recorded: Iterable[tuple[str, Status, str]]) -> None:
        """Count the runs that recording has found to be unsuccessful."""
        for run, status, _ in recorded:
            self._counter.ended(run, status)
        self._counter.doubted |= self._recorder.doubted

    @contextlib.contextmanager
    def giving_up(self) -> Iterator[None]:
        """Handle any error in the block, and raise it again.

        Jobs that can continue without this process do so; all others are ended and recorded, or left for the next session to
        record.
        """
        try:
            yield
        except BaseException:
            if not self._runner.stays:
                self._give_up()
            elif self._submitted and not self._over:
                try:
                    with contextlib.suppress(SierraError, OSError):
                        self._runner.leave()
                finally:  # otherwise the session would be removed
                    self._session.leave()
            raise
        finally:
            self._runner.close()

    def _give_up(self) -> None:
        self._session.recorded = False
        with contextlib.suppress(Exception):
            self._runner.stop()
            while self._runner.look().alive:
                time.sleep(POLL_S)
        with contextlib.suppress(Missing, OSError):
            recover.recover(self._store, self._session.paths)
            self._session.recorded = True


@dataclass(frozen=True, slots=True)
class Attached:
    """Progress of a reattached session on a cluster."""

    batch: str
    executed: int
    """Number of runs that were recorded while it was followed. `failed`: how many of these did not succeed."""
    failed: int
    left: bool
    """True if the session continues without this process; False if it has ended."""
    interrupted: bool
    """True if the user or another process ended it while it was followed."""
    notes: tuple[str, ...] = ()
    unfinished: int | None = None
    """Number of its runs that were not executed, if it was limited to a part of its batch; None if it was not."""


def attach(store: Store, session: Session, counter: ProgressCounter, *, detach: bool = False) -> Attached:
    """Follow a session that was taken over, and close it; with `detach`, record what has finished and leave it.

    Raises the errors of a runner that cannot continue.
    """
    cancelled = session.paths.cancelled.exists()
    try:
        context, runner = _submitted(session)
        followed = follow(runner, Recorder(store, session.paths, context), store, session, counter, None, detach=detach)
        unfinished = None
        if not followed.left:
            unfinished = session_records.finish(store, session, interrupted=session.paths.cancelled.exists())
        ended = not (cancelled or followed.left) and session.paths.cancelled.exists()  # by others, or on the cluster
        interrupted = followed.interrupted or ended
        return Attached(
            context.batch, len(counter.statuses), len(counter.failed), followed.left, interrupted, followed.notes, unfinished
        )
    finally:
        session.close()


def _submitted(session: Session) -> tuple[Context, Runner]:
    """Return the recorded context of a submitted session, and its runner.

    If either cannot be loaded, the session is left as it is, and the error is raised again.
    """
    try:
        context, submission = Context.load(session.paths.context), Submission.load(session.paths)
        return context, runners.on_cluster(submission.runner, submission.scheduler, submission.cluster)(1)
    except BaseException:
        session.leave()
        raise
