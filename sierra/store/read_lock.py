"""The lock of a store's readers: readers share it, and a process that removes replaced segments takes it exclusively.

Nobody waits long for readers: if the exclusive lock is not available soon, the removal is postponed. On a file system that
has no locks or is read-only, nothing is locked.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

PATIENCE_S = 2.0


class Shared:
    """The shared lock, held until it is closed."""

    def __init__(self, path: Path) -> None:
        self._descriptor = _open(path)
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                fcntl.flock(self._descriptor, fcntl.LOCK_SH)

    def close(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


@contextlib.contextmanager
def alone(path: Path, patience: float = PATIENCE_S) -> Iterator[bool]:
    """Take the lock exclusively, within `patience` seconds. Yield True if nobody reads, or if locks do not work; else False."""
    descriptor = _open(path)
    try:
        yield descriptor is None or _locked(descriptor, time.monotonic() + patience)
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _open(path: Path) -> int | None:
    for flags in (os.O_RDWR, os.O_RDONLY):
        with contextlib.suppress(OSError):
            return os.open(path, flags | os.O_CLOEXEC)
    return None


def _locked(descriptor: int, give_up: float) -> bool:
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > give_up:
                return False
            time.sleep(0.02)
        except OSError as error:
            return error.errno != errno.EBADF  # NFS locks only what may be written, and others may hold the lock
        else:
            return True
