"""Signals that ask this process to end: Ctrl-C, a signal from another process, or the loss of its terminal."""

from __future__ import annotations

import contextlib
import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn

from sierra.util import terminal

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_at_quit: list[Callable[[], None]] = []
"""The functions that end the processes that this one has started, when SIGQUIT ends it."""
_before_raising: list[Callable[[BaseException], None]] = []
"""The functions that are called before the handler of a signal raises an exception."""


def at_quit(end: Callable[[], None]) -> Callable[[], None]:
    """Call `end` before SIGQUIT ends this process. Return a function that takes it back; it may be called again."""
    _at_quit.append(end)
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGQUIT) is signal.SIG_DFL:
        signal.signal(signal.SIGQUIT, _quit)

    def forget() -> None:
        if end in _at_quit:
            _at_quit.remove(end)

    return forget


def _quit(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_DFL)
    for end in _at_quit:
        with contextlib.suppress(Exception):
            end()
    os.kill(os.getpid(), number)


def before_raising(end: Callable[[BaseException], None]) -> None:
    """Call `end` in the main thread, wherever it is, before the handler of a signal raises an exception there."""
    _before_raising.append(end)


def raise_in_handler(error: BaseException) -> NoReturn:
    """Raise an exception in the handler of a signal."""
    for end in _before_raising:
        end(error)
    raise error


def handle() -> None:
    """Make each of these signals end this process as Ctrl-C does, except signals that are already ignored (nohup)."""
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, interrupt)


def ignore() -> None:
    """Ignore these signals from now on: the process ends already, and a second one must not change its exit status."""
    if threading.current_thread() is threading.main_thread():
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)


@contextlib.contextmanager
def noted(already: bool = False) -> Iterator[list[int]]:
    """Collect the signals to end that arrive inside the `with` block, so that they do not interrupt it.

    Yields the list of their numbers. In other threads than the main thread the list stays as it begins. `already`: begin with
    one signal, as if it had arrived.
    """
    noted: list[int] = [signal.SIGINT] if already else []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return

    def note(number: int, frame: object) -> None:
        terminal.interrupt()
        _hang_up(number)
        noted.append(number)

    before = {number: signal.getsignal(number) for number in ENDING}
    heeded = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in heeded:
        signal.signal(number, note)
    try:
        yield noted
    finally:
        for number, handler in heeded.items():
            signal.signal(number, handler)


def interrupt(number: int, frame: object) -> NoReturn:
    """Handle a signal: end this process as Ctrl-C does."""
    terminal.interrupt()
    _hang_up(number)
    raise_in_handler(KeyboardInterrupt())


def _hang_up(number: int) -> None:
    """Redirect the terminal's descriptors to the null device after SIGHUP, because reading and writing would fail."""
    if number != signal.SIGHUP:
        return
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode):
                os.dup2(nothing, descriptor)
    os.close(nothing)
