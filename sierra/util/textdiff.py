"""A line-by-line comparison of two files, as the patch that `diff -u` writes."""

from __future__ import annotations

import difflib

from sierra.util.lazy_definitions import dataclass

MAX_SIZE = 4 << 20
"""The size in bytes beyond which files are not compared by lines."""


@dataclass(frozen=True, slots=True)
class Patch:
    """The changes that turn one text into another."""

    added: int | None
    """The number of added lines; None if one of the files is not text or is too long."""
    removed: int | None
    lines: tuple[str, ...]


def patch(before: bytes, after: bytes, name: str) -> Patch:
    """Return the patch from one content of a file to another. Bytes that are not UTF-8 appear as U+FFFD."""
    if not (is_text(before) and is_text(after)) or max(len(before), len(after)) > MAX_SIZE:
        return Patch(None, None, ())
    old, new = (content.decode("utf-8", "replace").split("\n") for content in (before, after))
    lines = tuple(difflib.unified_diff(old, new, f"a/{name}", f"b/{name}", lineterm=""))
    changes = lines[2:]
    return Patch(sum(line[0] == "+" for line in changes), sum(line[0] == "-" for line in changes), lines)


def is_text(content: bytes) -> bool:
    """Return whether content is text by git's rule: no zero byte in the first 8000 bytes."""
    return b"\0" not in content[:8000]
