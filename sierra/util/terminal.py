"""The terminal of this process, of which one program at a time may ask the user something."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

_asking = threading.RLock()


@contextlib.contextmanager
def reserved() -> Iterator[None]:
    """Reserve the terminal for a question: others wait with theirs, and what is drawn repeatedly pauses.

    Two programs that ask at once restore each other's mode, so that a password is shown while it is typed.
    """
    with _asking:
        yield


def is_free() -> bool:
    """Return whether no other thread has reserved the terminal."""
    if not _asking.acquire(blocking=False):
        return False
    _asking.release()
    return True
