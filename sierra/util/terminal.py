"""The terminal of this process, of which one program at a time may ask the user something."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

_asking = threading.RLock()
_interruptions = 0


class Interrupted(Exception):
    """A question that may not be asked any more, because the user has pressed Ctrl-C."""


@contextlib.contextmanager
def reserved(since: int) -> Iterator[None]:
    """Reserve the terminal for a question: others wait with theirs, and what is drawn repeatedly pauses.

    Two programs that ask at once restore each other's mode, so that a password is shown while it is typed. `since`: what
    `interruptions` returned when the work began that needs an answer. Raises Interrupted if there were more meanwhile.
    """
    with _asking:
        if _interruptions != since:
            raise Interrupted
        yield


def interruptions() -> int:
    """Return how often the user has interrupted this process, or a program that asked something."""
    return _interruptions


def interrupt() -> None:
    """Note that the user has interrupted this process, or a program that asked something."""
    global _interruptions
    _interruptions += 1


def is_free() -> bool:
    """Return whether no other thread has reserved the terminal."""
    if not _asking.acquire(blocking=False):
        return False
    _asking.release()
    return True
