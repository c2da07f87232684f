"""Two files, line by line: the patch between them, as `diff -u` writes it."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

LONGEST = 4 << 20
"""Bytes of a file beyond which lines are not matched."""


@dataclass(frozen=True, slots=True)
class Patch:
    """What must be done to one text to get the other."""

    added: int | None
    """Lines; None where one of the files is no text, or is too long."""
    removed: int | None
    lines: tuple[str, ...]


def patch(before: bytes, after: bytes, name: str) -> Patch:
    """How two files of one name differ. What is no UTF-8 is shown with U+FFFD in its place."""
    if not (is_text(before) and is_text(after)) or max(len(before), len(after)) > LONGEST:
        return Patch(None, None, ())
    old, new = (content.decode("utf-8", "replace").split("\n") for content in (before, after))
    lines = tuple(difflib.unified_diff(old, new, f"a/{name}", f"b/{name}", lineterm=""))
    changes = lines[2:]
    return Patch(sum(line[0] == "+" for line in changes), sum(line[0] == "-" for line in changes), lines)


def is_text(content: bytes) -> bool:
    """As git decides it: no zero byte in the first 8000."""
    return b"\0" not in content[:8000]
