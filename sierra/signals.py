"""Signals that ask this process to end."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def noted(already: bool = False) -> Iterator[list[int]]:
    """Signals to end that arrive meanwhile: noted, so that nothing is torn apart (in the main thread; others get none).

    `already`: as if one had arrived.
    """
    noted: list[int] = [signal.SIGINT] if already else []
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
