"""A limit on the time of an answer, which also ends it when the user stops it.

A statement of SQL is interrupted. Work in Python, such as a test or a drawing, ends by an exception that is raised within it:
NumPy, SciPy and matplotlib have no other way, and another process would have to read the data again.
"""

from __future__ import annotations

import contextlib
import ctypes
import threading
from collections.abc import Callable

from sierra.errors import SierraError

AGAIN_S = 0.1
PATIENCE_S = 1.0
"""The time that a statement has to end, in s, before the exception is raised; then it is raised again after each such time."""


class Ended(BaseException):
    """The exception that ends work in Python: no error, so that nothing takes it for a problem of its own."""


class Limit:
    """A context manager that ends what is within once its time is over or `stop` was called.

    Raises SierraError with the reason then, whatever error the interruption became, and even if what is within has just
    finished: it may lack what was interrupted.
    """

    def __init__(self, interrupt: Callable[[], None], wall: float) -> None:
        """`interrupt` ends the statement that is executed now, if there is one. `wall`: time limit, in s."""
        self._interrupt = interrupt
        self._wall = wall
        self._due, self._ended = threading.Event(), threading.Event()
        self._reason = ""
        """Why what is within was interrupted; "" if it was not."""
        self._within = threading.current_thread()
        self._watch = threading.Thread(target=self._wait, daemon=True)

    def __enter__(self) -> Limit:
        self._within = threading.current_thread()
        self._watch.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        while not self._is_over():  # it may be ended, too, as long as the other thread watches
            continue
        if self._reason and (error is None or isinstance(error, Exception | Ended)):
            raise SierraError(self._reason) from error

    def stop(self, reason: str) -> None:
        self._reason = self._reason or reason
        self._due.set()

    def _is_over(self) -> bool:
        """End the watch, and return whether no exception can come any more."""
        with contextlib.suppress(Ended):
            self._ended.set()
            self._due.set()
            self._watch.join()
            _raise_in(self._within, None)
            return True
        return False

    def _wait(self) -> None:
        if not self._due.wait(self._wall):
            self.stop(f"no answer within {self._wall:g} s; ask for less, or use sierra sql, which has no time limit")
        waited = 0.0
        while not self._ended.is_set() and self._within.is_alive():
            self._interrupt()
            if waited >= PATIENCE_S:
                _raise_in(self._within, Ended)
                waited = 0.0
            self._ended.wait(AGAIN_S)
            waited += AGAIN_S


def _raise_in(thread: threading.Thread, kind: type[BaseException] | None) -> None:
    """Raise an exception in a thread as soon as it executes Python; None takes back one that was not raised yet."""
    raised = None if kind is None else ctypes.py_object(kind)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident or 0), raised)
