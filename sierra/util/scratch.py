"""Temporary folders in folders of the user. The next process that needs one there removes those of killed processes.

A folder has a file MARK with the name of the host. Its process holds a lock on it, and names it after it is locked. A folder
is removed only if it has a mark of this host on which nobody holds a lock. On a file system without locks it stays.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

MARK = ".sierra-scratch"
UNMARKED = ".unmarked"


@contextlib.contextmanager
def scratch(parent: Path, prefix: str) -> Iterator[Path]:
    """Yield a new folder in `parent` whose name begins with `prefix`, and remove it at the end.

    Folders of this prefix that killed processes left there are removed first. Raises OSError if the folder cannot be made.
    """
    remove_abandoned(parent, prefix)
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
    held: int | None = None
    try:
        held = _mark(folder)
        yield folder
    finally:
        _clear(folder)
        if held is not None:
            os.close(held)


def remove_abandoned(parent: Path, prefix: str) -> None:
    """Remove the folders of this prefix that killed processes left in `parent`."""
    for folder in parent.glob(f"{prefix}*"):
        with contextlib.suppress(OSError):  # it has no mark, its process lives, or another user has made it
            remove(folder)


def is_abandoned(folder: Path) -> bool:
    """Return whether a path is a temporary folder of a killed process on this host."""
    with contextlib.suppress(OSError), _held(folder):
        return True
    return False


def remove(folder: Path) -> None:
    """Remove a temporary folder of a killed process. Raises OSError if it has no mark, or its process lives."""
    with _held(folder):
        _clear(folder)


def _mark(folder: Path) -> int:
    """Mark a folder as one of this process; return the file that is held, whose lock ends with the process."""
    unmarked = folder / UNMARKED
    held = os.open(unmarked, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    os.write(held, _host())
    with contextlib.suppress(OSError):  # a file system without locks
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        unmarked.rename(folder / MARK)
    return held


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Hold the lock on a folder of a killed process. Raises OSError if it is no such folder."""
    if folder.is_symlink():
        raise NotADirectoryError(folder)
    held = os.open(folder / MARK, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if os.read(held, len(_host()) + 1) != _host():
            raise PermissionError(folder)
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(held)


def _clear(folder: Path) -> None:
    """Remove a folder, its mark last: if this process is killed, the next one removes the rest."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        elif path.name != MARK:
            path.unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)


def _host() -> bytes:
    return f"a temporary folder of SIERRA on {socket.gethostname()}\n".encode()
