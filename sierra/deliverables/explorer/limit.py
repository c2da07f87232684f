"""A limit on the time of an answer, which also ends it when the user stops it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from sierra.errors import SierraError

AGAIN_S = 0.1


class Limit:
    """A context manager that interrupts what is within, again and again, once its time is over or `stop` was called.

    Raises SierraError with the reason, if that caused an error within.
    """

    def __init__(self, interrupts: Sequence[Callable[[], None]], wall: float) -> None:
        """`wall`: time limit, in s."""
        self._interrupts = interrupts
        self._wall = wall
        self._due, self._ended = threading.Event(), threading.Event()
        self.reason = ""
        """Why what is within was interrupted; "" if it was not."""
        self._watch = threading.Thread(target=self._wait, daemon=True)

    def __enter__(self) -> Limit:
        self._watch.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        self._ended.set()
        self._due.set()
        self._watch.join()
        if self.reason and isinstance(error, SierraError):
            raise SierraError(self.reason) from error

    def stop(self, reason: str) -> None:
        self.reason = self.reason or reason
        self._due.set()

    def check(self) -> None:
        """Raise SierraError if the time is over: for work that nothing interrupts."""
        if self.reason:
            raise SierraError(self.reason)

    def _wait(self) -> None:
        if not self._due.wait(self._wall):
            self.stop(f"no answer within {self._wall:g} s; ask for less, or use sierra sql, which has no time limit")
        while not self._ended.is_set():
            for interrupt in self._interrupts:
                interrupt()
            self._ended.wait(AGAIN_S)
