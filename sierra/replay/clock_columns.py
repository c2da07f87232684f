"""Recognition of columns that hold the time of a clock, such as wall-clock times and durations, and not a simulated quantity.

This decides nothing. It is only for the proposal of what to declare as volatile: a person knows the columns, SIERRA does not.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

from sierra.util.arrow_columns import values_of
from sierra.util.lazy_definitions import regex

if TYPE_CHECKING:
    import pyarrow as pa

WORDS = regex(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")
"""The words of a name such as `wall_time`, `cpuSeconds` or `RTF`."""
CLOCKS = frozenset(
    [
        "wall",
        "wallclock",
        "walltime",
        "cpu",
        "elapsed",
        "runtime",
        "timestamp",
        "timestamps",
        "datetime",
        "date",
        "created",
        "modified",
        "written",
        "began",
        "begun",
        "host",
        "rtf",
        "fps",
        "realtime",
    ]
)
"""Words that name a clock, or a speed that is measured by one."""
PERHAPS = frozenset(
    ["duration", "durations", "took", "seconds", "secs", "sec", "ms", "us", "ns", "millis", "latency", "time", "times", "real"]
)
"""Words that name a clock or a simulated time."""
EPOCH = (1e9, 4.2e9)
"""Seconds since 1970, from 2001 to 2103."""
SCALES = (1.0, 1e3, 1e6, 1e9)
DATE = regex(r"\d{4}-\d\d-\d\d|\d\d:\d\d:\d\d|[A-Z][a-z]{2} [A-Z][a-z]{2} +\d+ ")


class Clock(StrEnum):
    """The probability that a column that differs holds the time of a clock."""

    NO = ""
    PERHAPS = "perhaps a clock"
    """It has the name of a duration; this may be a simulated one."""
    YES = "a clock"


def clock_of(name: str, recorded: pa.ChunkedArray, found: pa.ChunkedArray, first: int) -> Clock:
    """Return whether a column that differs probably is a clock, by its name, its type, and the first row that differs."""
    words = {word.lower() for word in WORDS.findall(name)}
    if words & CLOCKS or _is_moment(recorded, found, first):
        return Clock.YES
    return Clock.PERHAPS if words & PERHAPS else Clock.NO


def _is_moment(recorded: pa.ChunkedArray, replayed: pa.ChunkedArray, row: int) -> bool:
    """Check if the values are dates that became later, or seconds since 1970."""
    import datetime

    was, now = (values_of(column.slice(row, 1))[0] for column in (recorded, replayed))
    match was, now:
        case (bool(), _) | (_, bool()):
            return False
        case (int() | float(), int() | float()):
            return was < now and any(all(EPOCH[0] <= value / scale <= EPOCH[1] for value in (was, now)) for scale in SCALES)
        case (str(), str()):
            return DATE.search(was) is not None and DATE.search(now) is not None
        case (datetime.datetime(), datetime.datetime()) | (datetime.time(), datetime.time()):
            return True
        case (datetime.date(), datetime.date()):
            return bool(was < now)
    return False
