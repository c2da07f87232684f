"""Executing jobs: a runner is followed to its end, and what it says is recorded."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence

from sierra import recovery
from sierra.errors import Missing
from sierra.model import Result, Status
from sierra.record import Recorder
from sierra.runners import Runner, Work
from sierra.sessions import Session
from sierra.store import Store

POLL_S = 0.05


class Following:
    """One runner and the recorder that takes what it says.

    `took` hears of each run as it ends, and again if recording finds fault with it; `tell` how many are running.
    """

    def __init__(
        self,
        runner: Runner,
        recorder: Recorder,
        store: Store,
        session: Session,
        took: Callable[[str, Status], None],
        tell: Callable[[int], None],
    ) -> None:
        self._runner = runner
        self._recorder = recorder
        self._store = store
        self._session = session
        self._took = took
        self._tell = tell

    def execute(self, work: Work, signals: Sequence[int], *, enough: Callable[[], bool] = lambda: False) -> None:
        """Execute all jobs, until `signals` has something in it, or `enough` is true: what runs is ended then.

        Whatever goes wrong, what had finished is recorded, or left for whoever asks next.
        """
        try:
            self._runner.submit(work, self._session.paths)
            self._follow(signals, enough)
        except BaseException:
            self._give_up()
            raise

    def _follow(self, signals: Sequence[int], enough: Callable[[], bool]) -> None:
        alive, told = True, 0
        while alive:
            look = self._runner.look()
            self._take(look.results)
            if self._recorder.due():
                self._flush()
            self._tell(look.running)
            if len(signals) > told or (enough() and not told):
                told = max(len(signals), 1)
                self._runner.stop()
            alive = look.alive
            if alive:
                time.sleep(POLL_S)
        self._flush()
        self._tell(0)

    def _take(self, results: Sequence[Result]) -> None:
        for result in results:
            status = self._recorder.add(result)
            if status is not Status.INTERRUPTED:
                self._took(result.run, status)

    def _flush(self) -> None:
        for run, status, _ in self._recorder.flush():
            self._took(run, status)

    def _give_up(self) -> None:
        self._session.recorded = False
        with contextlib.suppress(Exception):
            self._runner.stop()
            while self._runner.look().alive:
                time.sleep(POLL_S)
        with contextlib.suppress(Missing, OSError):
            recovery.recover(self._store, self._session.paths)
            self._session.recorded = True


@contextlib.contextmanager
def noted() -> Iterator[list[int]]:
    """Signals to end that arrive meanwhile: noted, so that nothing is torn apart (in the main thread; others get none)."""
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    heeded = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in heeded:
        signal.signal(number, lambda got, _: noted.append(got))
    try:
        yield noted
    finally:
        for number, handler in heeded.items():
            signal.signal(number, handler)
