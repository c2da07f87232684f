"""Poll loop: a runner is followed until it ends, and its results are recorded."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from sierra.errors import Missing, SierraError
from sierra.execution import recover
from sierra.execution.observer import Tally
from sierra.execution.sessions import Session
from sierra.ingest.consistency import find_odd
from sierra.ingest.recorder import Recorder
from sierra.model import Purpose, Status
from sierra.runners.base import Look, Runner, Work
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


def follow(
    runner: Runner,
    recorder: Recorder,
    store: Store,
    session: Session,
    tally: Tally,
    work: Work | None,
    *,
    detach: bool = False,
    enough: Callable[[], bool] = lambda: False,
) -> Followed:
    """Execute the work of a session until it ends, and record it; without `work`, follow jobs that were submitted before.

    `detach`: act from the start as if the user had interrupted; the observer decides then to leave the jobs.
    If `enough` returns True, the rest is ended. Raises the runner's errors.
    """
    with noted(detach) as signals:
        following = _Following(runner, recorder, store, session, tally)
        if work is None:
            following.go_on(signals)
        else:
            following.execute(work, signals, enough)
        complete = recorder.context.purpose == Purpose.RUN and (work is not None or not following.left)
        odd: set[str] = set()
        if complete:
            odd = find_odd(store, session.paths, recorder.context, recorder.lost, settle=runner.stays) | recorder.find_astray()
        return Followed(following.left, bool(signals) and not detach, odd, tuple(recorder.notes()))


class Executed(NamedTuple):
    """A recorded execution, and the attempt at an array task that executed it."""

    execution: str
    attempt: str | None


class _Following:
    """One runner and the recorder of its results."""

    def __init__(self, runner: Runner, recorder: Recorder, store: Store, session: Session, tally: Tally) -> None:
        self._runner = runner
        self._recorder = recorder
        self._store = store
        self._session = session
        self._tally = tally
        self.left = False
        """True if the runs were left to continue without this process."""
        self._submitted = self._over = False

    def execute(self, work: Work, signals: Sequence[int], enough: Callable[[], bool]) -> None:
        """Execute all jobs until they end.

        If `signals` is not empty or `enough` returns True, end the running jobs, or leave them. After an error, results of
        finished runs are recorded, or left for the next session to record.
        """
        with self._giving_up():
            self._runner.submit(work, self._session.paths)
            self._submitted = True
            self._follow(signals, enough)

    def go_on(self, signals: Sequence[int]) -> None:
        """Follow jobs that another process has submitted, as `execute` does."""
        self._submitted = True
        with self._giving_up():
            executed = "SELECT execution, attempt FROM executions WHERE session = $s"
            recorded = dict(self._store.select(Executed, executed, s=self._session.id))
            self._runner.resume(self._session.paths, recorded)
            self._follow(signals, lambda: False)

    def _follow(self, signals: Sequence[int], enough: Callable[[], bool]) -> None:
        alive, handled = True, 0
        while alive:
            look = self._look()
            self._take(look)
            if self._recorder.due():
                self._flush()
            self._tally.report(look.running, look.queued, look.waits)
            self._session.beat()
            if len(signals) > handled or (enough() and not handled):
                if self._runner.stays and len(signals) > handled and self._tally.observer.leave():
                    self._runner.leave()
                    look = self._look()
                    self._take(look)
                    while look.results:
                        look = self._look()
                        self._take(look)
                    self.left = look.alive
                    break
                handled = max(len(signals), 1)
                self._runner.stop()
            alive = look.alive
            if alive and len(look.results) < MANY:
                time.sleep(WATCHED_S if look.watched else POLL_S)
        self._flush(last=True)
        if self.left:
            self._session.leave()
        self._tally.report(0)

    def _look(self) -> Look:
        """Return the runner's new results. If the runner cannot continue, record its results first and raise its error."""
        try:
            look = self._runner.look()
        except SierraError:
            self._flush()
            raise
        if look.wrong is not None:
            self._over = True
            self._take(look)
            self._flush()
            raise look.wrong
        return look

    def _take(self, look: Look) -> None:
        for result in look.results:
            status = self._recorder.add(result)
            if status is not Status.INTERRUPTED:
                self._tally.ended(result.run, status)
        self._recorder.add_rows(look.rows, look.copies)
        self._recorder.add_late(look.late)
        for text in look.notes:
            self._tally.observer.notice(text)

    def _flush(self, *, last: bool = False) -> None:
        for run, status, _ in self._recorder.flush(last=last):
            self._tally.ended(run, status)
        self._tally.doubted |= self._recorder.doubted

    @contextlib.contextmanager
    def _giving_up(self) -> Iterator[None]:
        """Handle any error in the block, and raise it again.

        Jobs that can continue without this process do so; all others are ended and recorded.
        """
        try:
            yield
        except BaseException:
            if not self._runner.stays:
                self._give_up()
            elif self._submitted and not self._over:
                with contextlib.suppress(SierraError, OSError):
                    self._runner.leave()
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
