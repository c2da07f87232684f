"""Executing jobs: a runner is followed to its end, and what it says is recorded."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from sierra.errors import Missing, SierraError
from sierra.execution import recover
from sierra.execution.sessions import Session
from sierra.ingest.recorder import Recorder
from sierra.model import Status
from sierra.runners.base import Look, Runner, Work
from sierra.store.store import Store

POLL_S = 0.05
MANY = 100
"""Results of one look, of which there are so many that the next look is at once."""


@dataclass(frozen=True, slots=True)
class Observer:
    """Who hears of what happens: of each run as it ends (and again if recording finds fault with it), of how many are running,
    how many elements wait and why, of what the user should know at once.
    """

    took: Callable[[str, Status], None]
    tell: Callable[[int, int, str], None]
    say: Callable[[str], None] = lambda text: None


class Following:
    """One runner and the recorder that takes what it says."""

    def __init__(
        self,
        runner: Runner,
        recorder: Recorder,
        store: Store,
        session: Session,
        observer: Observer,
        *,
        leave: Callable[[], bool] = lambda: True,
    ) -> None:
        """`leave`: asked when the user wants to end, where what runs lives on without this process: whether it is to."""
        self._runner = runner
        self._recorder = recorder
        self._store = store
        self._session = session
        self._observer = observer
        self._leave = leave
        self.left = False
        """Whether what runs was left to itself."""
        self._submitted = self._over = False

    def execute(self, work: Work, signals: Sequence[int], *, enough: Callable[[], bool] = lambda: False) -> None:
        """Execute all jobs, until `signals` has something in it, or `enough` is true: what runs is ended then, or left.

        Whatever goes wrong, what had finished is recorded, or left for whoever asks next.
        """
        with self._giving_up():
            self._runner.submit(work, self._session.paths)
            self._submitted = True
            self._follow(signals, enough)

    def go_on(self, signals: Sequence[int]) -> None:
        """The same with what another process has submitted."""
        self._submitted = True
        with self._giving_up():
            rows = self._store.rows("SELECT execution, attempt FROM executions WHERE session = $s", s=self._session.id)
            self._runner.resume(self._session.paths, {row["execution"]: row["attempt"] for row in rows})
            self._follow(signals, lambda: False)

    def _follow(self, signals: Sequence[int], enough: Callable[[], bool]) -> None:
        alive, told = True, 0
        while alive:
            look = self._look()
            self._take(look)
            if self._recorder.due():
                self._flush()
            self._observer.tell(look.running, look.queued, look.waits)
            self._session.beat()
            if len(signals) > told or (enough() and not told):
                if self._runner.stays and len(signals) > told and self._leave():
                    self._runner.leave()
                    look = self._look()
                    self._take(look)
                    while look.results:
                        look = self._look()
                        self._take(look)
                    self.left = look.alive
                    break
                told = max(len(signals), 1)
                self._runner.stop()
            alive = look.alive
            if alive and len(look.results) < MANY:
                time.sleep(POLL_S)
        self._flush()
        if self.left:
            self._session.leave()
        self._observer.tell(0, 0, "")

    def _look(self) -> Look:
        """What has happened; where the runner can't go on, what it had told is recorded first."""
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
                self._observer.took(result.run, status)
        self._recorder.beside(look.rows, look.copies)
        for text in look.notes:
            self._observer.say(text)

    def _flush(self) -> None:
        for run, status, _ in self._recorder.flush():
            self._observer.took(run, status)

    @contextlib.contextmanager
    def _giving_up(self) -> Iterator[None]:
        """Whatever goes wrong meanwhile: what lives on without this process does, and all else is ended and recorded."""
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
