"""Texts about files and their columns."""

from __future__ import annotations

from collections.abc import Iterable

from sierra.util.text import few

FEW = 10
"""The number of column names in one message."""


def difference(has: tuple[str, ...], names: tuple[str, ...]) -> str:
    """Return how a file's columns differ from its siblings'."""
    missing = [name for name in names if name not in has]
    extra = [name for name in has if name not in names]
    parts = []
    if missing:
        parts.append(f"lacks the column{'s' * (len(missing) > 1)} {_few(map(repr, missing))}")
    if extra:
        parts.append(f"has the additional column{'s' * (len(extra) > 1)} {_few(map(repr, extra))}")
    return (" and ".join(parts) or "has its columns in another order") + f" (other runs have {_few(names)})"


def _few(names: Iterable[str]) -> str:
    """Return some names and the number of the others; never `and 1 more`."""
    names = list(names)
    return few(names, FEW if len(names) > FEW + 1 else len(names))


def shown(path: str) -> str:
    """Return a file's name as text, with escapes for bytes that are not UTF-8."""
    return path.encode("utf-8", "backslashreplace").decode()
