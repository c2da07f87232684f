"""Files that people name are read through here: a named pipe, a socket or a device is refused instead of waited for.

Opening a pipe waits for a writer, and a device such as /dev/zero has no end.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

KINDS = ((stat.S_ISFIFO, "a named pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISCHR, "a device"), (stat.S_ISBLK, "a device"))

NOT_REGULAR = (errno.EISDIR, errno.EOPNOTSUPP)
"""The system's errors for a folder, and for what is refused here."""


def open_regular(path: Path | str | bytes, buffering: int = -1) -> BinaryIO:
    """Open a regular file, or a link to one, for reading. Raises OSError at once for everything else."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if error.errno == errno.ENXIO:  # a socket cannot be opened
            _check(os.stat(path).st_mode, path)  # noqa: PTH116 - a path may be bytes
        raise
    try:
        _check(os.fstat(descriptor).st_mode, path)
    except OSError:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb", buffering)


def read_regular(path: Path | str) -> bytes:
    """Return the content of a regular file, or of a link to one. Raises OSError."""
    with open_regular(path) as file:
        return file.read()


def read_regular_text(path: Path | str) -> str:
    """Return the text in UTF-8 of a regular file, or of a link to one. Raises OSError, UnicodeDecodeError."""
    with open_regular(path) as file:
        return file.read().decode().replace("\r\n", "\n").replace("\r", "\n")


def _check(mode: int, path: Path | str | bytes) -> None:
    """Raise OSError for a file of this type unless it is a regular one."""
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    if not stat.S_ISREG(mode):
        kind = next((name for is_kind, name in KINDS if is_kind(mode)), "something else")
        raise OSError(errno.EOPNOTSUPP, f"this is {kind}, and not a regular file", os.fspath(path))
