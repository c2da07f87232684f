"""Many things in one line: the first few of them, and how many more there are."""

from __future__ import annotations

from collections.abc import Sequence


def few(things: Sequence[str], most: int) -> str:
    """At most so many of them by name, and the others by number: `a, b and 3 more`."""
    more = f" and {len(things) - most} more" if len(things) > most else ""
    return ", ".join(things[:most]) + more


def counted(count: int, noun: str) -> str:
    """So many of them: `1 element`, `2 elements`."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
