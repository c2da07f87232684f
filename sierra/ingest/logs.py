"""The recorded parts of an execution's logs."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from sierra.store.layout import RUN_STDERR, RUN_STDOUT

LOG_KEPT = 1 << 20
"""The number of bytes that are kept of each log: a quarter from its beginning, three quarters from its end."""
LOG_SHOWN = 2000


def kept_of(path: str) -> tuple[bytes, int]:
    """Return the kept part of a log and the log's size in bytes. A link that a run put in its place is not followed."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return b"", 0
    with os.fdopen(descriptor, "rb") as file:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or Path(path).parent.is_symlink():
            return b"", 0
        size = found.st_size
        if size <= LOG_KEPT:
            return file.read(), size
        head = file.read(LOG_KEPT // 4)
        file.seek(-3 * LOG_KEPT // 4, 2)
        return head + b"\n[... %d bytes left out ...]\n" % (size - LOG_KEPT) + file.read(), size


def last_words(folder: str) -> str | None:
    for name in (RUN_STDERR, RUN_STDOUT):
        content, _ = kept_of(f"{folder}/{name}")
        if content.strip():
            return content[-LOG_SHOWN:].decode("utf-8", "replace").strip()
    return None
