"""The part of a log that is kept: all of it, or its beginning and its end."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Sequence
from pathlib import Path

from sierra.util.lazy_definitions import regex

KEPT = 1 << 20
"""The number of bytes that are kept of each log: a quarter from its beginning, three quarters from its end."""
FATAL = regex(r"^.*\bFATAL\b.*$|^fatal( error)?: .*$", re.MULTILINE)
"""The lines that programs call fatal, as ARGoS, ROS and Gazebo do."""


def kept_of(path: str, most: int = KEPT) -> tuple[bytes, int]:
    """Return the kept part of a log and the log's size in bytes. A link that a run put in its place is not followed."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return b"", 0
    with os.fdopen(descriptor, "rb") as file:
        state = os.fstat(descriptor)
        if not stat.S_ISREG(state.st_mode) or Path(path).parent.is_symlink():
            return b"", 0
        size = state.st_size
        if size <= most:
            return file.read(), size
        head = file.read(most // 4)
        file.seek(size - (most - len(head)))
        return head + b"\n[... %d bytes left out ...]\n" % (size - most) + file.read(most), size


def shares(sizes: Sequence[int], most: int) -> list[int]:
    """Return how many bytes of each of several logs fit into `most` bytes: long ones share equally what short ones leave."""
    found, left = [0] * len(sizes), most
    for done, place in enumerate(sorted(range(len(sizes)), key=sizes.__getitem__)):
        found[place] = min(sizes[place], left // (len(sizes) - done))
        left -= found[place]
    return found


def with_cause(text: str, most: int) -> str:
    """Return the last `most` characters of a log; the first line that is called fatal stays, although many follow it."""
    cause, rest = _fatal(text), text[-most:].strip()
    return rest if not cause or cause in rest else f"{cause}\n[...]\n{rest}"


def last_lines(text: str, most: int) -> list[str]:
    """Return the last lines of a log, and before them the first one that is called fatal."""
    cause, lines = _fatal(text), text.splitlines()
    return lines[-most:] if not cause or cause in lines[-most:] else [cause, *lines[1 - most :]]


def _fatal(text: str) -> str | None:
    found = FATAL.search(text)
    return found[0].strip() if found else None
