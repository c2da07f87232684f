"""Regular expressions for the lines of output files that are rows, whose named groups are the columns.

They are matched by RE2, which takes time in proportion to the length of a line, whatever the expression. Python's own engine,
which may take exponential time, only reads the names of the groups.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from functools import cache

from sierra.config.field_types import NAME, check_distinct

EXAMPLE = r"step=(?P<step>\d+)"
WHOLE = "sierra_whole"
"""The name of the group around a pattern, so that the place of the whole match is known."""


def columns(pattern: str) -> Sequence[str]:
    """Return the names of the groups of a checked pattern, in their order."""
    return tuple(_compiled(pattern).groupindex)


@cache
def check(pattern: str) -> None:
    """Check that a pattern makes columns, and that RE2 can match it. Raises ValueError."""
    if "\n" in pattern:
        raise ValueError(f"lines: {pattern!r} has a line feed, but is searched in single lines; give each table its own lines")
    try:
        compiled = _compiled(pattern)
    except (re.error, OverflowError, RecursionError) as error:
        named = "; write a named group as (?P<name>…)" if re.search(r"\(\?<[A-Za-z_]", pattern) else ""
        raise ValueError(f"lines: {pattern!r} is not a regular expression: {error}{named}") from error
    names = tuple(compiled.groupindex)
    if not names:
        raise ValueError(f"lines: {pattern!r} has no named group; write each column as a group, such as {EXAMPLE!r}")
    if compiled.groups > len(names):
        raise ValueError(f"lines: {pattern!r} has a group without a name; write (?P<name>…) for a column, or else (?:…)")
    if unsound := [name for name in names if not re.fullmatch(NAME, name)]:
        raise ValueError(f"lines: the group {unsound[0]!r} is no name of a column; use letters, digits and _")
    if WHOLE in names:
        raise ValueError(f"lines: SIERRA needs the name {WHOLE!r} itself; choose another one for the group")
    check_distinct(names, "lines")
    if reason := _refused(pattern):
        rather = "write it without look-around, back-references and possessive or very long repetitions"
        raise ValueError(f"lines: {pattern!r} cannot be matched in linear time ({reason}); {rather}")
    if compiled.search(""):
        raise ValueError(f"lines: {pattern!r} also matches an empty line; write + instead of * where text must be")


def _compiled(pattern: str) -> re.Pattern[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return re.compile(pattern)


def _refused(pattern: str) -> str:
    """Return why RE2 does not take a pattern; "" if it does."""
    from sierra.store.connections import refused_by_re2

    return refused_by_re2(pattern)
