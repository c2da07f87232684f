"""Times that are no numbers, as a time axis: seconds since midnight of the day on which a run's first row was written.

A clock is `00:00:10`, also with days before it as SUMO writes them (`1:00:00:00`). A moment is a date with a time as ISO 8601
has it, with or without a zone, or a time of CSV or Parquet. The day of a text is that of its own zone; other days are those of
UTC. A clock without days is not continued after midnight: its time goes back then, which is an error elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import Any

from sierra.store.sql_names import identifier, quote
from sierra.util.lazy_definitions import regex

DAY = 86_400
CLOCK = r"(?:(0|[1-9][0-9]{0,6}):(?:[01]?[0-9]|2[0-3])|[0-9]{1,5}):[0-5][0-9]:(?:[0-5][0-9]|60)(?:[.,][0-9]+)?"
"""Days are written without zeros before them, unlike the hours of films (`00:00:10:24`), whose last number counts frames."""
CLOCK_PARTS = r"(?:([0-9]+):)?([0-9]+):([0-9]{2}):([0-9]{2})(?:[.,]([0-9]+))?"
MOMENT = (
    r"([0-9]{4}-[0-9]{2}-[0-9]{2})(?:[Tt ]([0-9]{2}:[0-9]{2})(?::([0-9]{2})(?:[.,]([0-9]+))?)?)?"
    r" ?(?:[Zz]|UTC|([-+])([0-9]{2}):?([0-9]{2})?)?"
)
ZONE = r"(?:[Zz]|UTC|:[0-9.,]+ ?[-+][0-9:]+)$"
"""The zone at the end of a moment."""
STAMP = regex(r"DATE|TIMESTAMP\w*( WITH TIME ZONE)?")
"""DuckDB's types of moments."""
UNIT = "s"
SECONDS = "# seconds of "
"""The beginning of the name of a column with the seconds of another, in tables for statistics."""
NOTE = "the time {time!r} of output {table!r} is read as seconds since midnight of the day of each run's first row"


class TimeKind(StrEnum):
    """The form of times that are no numbers."""

    CLOCK = "clock"
    MOMENT = "moment"
    STAMP = "stamp"
    NANOSTAMP = "nanostamp"
    TIME = "time"


WITHOUT_DAYS = (TimeKind.CLOCK, TimeKind.TIME)
DAYS = "; if its clock passes midnight, let the run write the day, too: 1:00:00:05, or a date"


def kind_of(run: Callable[[str], Sequence[Sequence[Any]]], relation: str, column: str, kind: str) -> TimeKind | None:
    """Return the form of the times in a column of this type; None if they are numbers, or no times.

    `run` executes a statement.
    """
    if STAMP.fullmatch(kind) or kind == "TIME":
        return TimeKind.TIME if kind == "TIME" else TimeKind.NANOSTAMP if kind.endswith("_NS") else TimeKind.STAMP
    if kind != "VARCHAR":
        return None
    cell = f"trim({identifier(column)})"
    parsed = f"TRY_CAST({_minute(cell)} AS TIMESTAMP) IS NOT NULL"
    [(cells, clocks, moments, zoned)] = run(
        f"SELECT count({cell}), count(*) FILTER (regexp_full_match({cell}, {quote(CLOCK)})), "
        f"count(*) FILTER (regexp_full_match({cell}, {quote(MOMENT)}) AND {parsed}), "
        f"count(*) FILTER (regexp_matches({cell}, {quote(ZONE)})) FROM {relation}"
    )
    if cells and cells == moments and zoned in (0, cells):
        return TimeKind.MOMENT
    return TimeKind.CLOCK if 0 < cells == clocks else None


def _minute(cell: str) -> str:
    """Return the SQL expression for the date and the minute of a moment, as a text."""
    date, clock = (f"regexp_extract({cell}, {quote(MOMENT)}, {number})" for number in (1, 2))
    return f"({date} || ' ' || coalesce(nullif({clock}, ''), '00:00') || ':00')"


def _midnight(moment: str, day: int) -> str:
    """Return the SQL expression for the midnight before a moment, also before 1970."""
    return f"({moment} - ({moment} % {day} + {day}) % {day})"


def seconds(column: str, kind: TimeKind, keys: str) -> str:
    """Return the SQL expression for the seconds of a row; `keys` are the columns that rows of one run share."""
    cell, over = f"trim({identifier(column)})", f"OVER (PARTITION BY {keys})"

    def part(pattern: str, number: int) -> str:
        return f"nullif(regexp_extract({cell}, {quote(pattern)}, {number}), '')"

    def fraction(pattern: str, number: int) -> str:
        return f"coalesce(('0.' || {part(pattern, number)})::DOUBLE, 0)"

    match kind:
        case TimeKind.CLOCK:
            days, hours, minutes, whole = (f"coalesce({part(CLOCK_PARTS, number)}::BIGINT, 0)" for number in (1, 2, 3, 4))
            total = f"{days} * {DAY} + {hours} * 3600 + {minutes} * 60 + {whole}"
            return f"CASE WHEN {identifier(column)} IS NOT NULL THEN ({total})::DOUBLE + {fraction(CLOCK_PARTS, 5)} END"
        case TimeKind.MOMENT:
            sign = f"CASE WHEN {part(MOMENT, 5)} = '-' THEN -1 ELSE 1 END"
            hours, minutes = (f"coalesce({part(MOMENT, number)}::BIGINT, 0)" for number in (6, 7))
            zone = f"{sign} * ({hours} * 3600 + {minutes} * 60)"
            moment = f"epoch(CAST({_minute(cell)} AS TIMESTAMP))::BIGINT"
            local = f"({moment} + coalesce({part(MOMENT, 3)}::BIGINT, 0))"
            first = f"arg_min({_midnight(local, DAY)} - {zone}, {local} - {zone}) {over}"
            return f"({local} - {zone} - {first})::DOUBLE + {fraction(MOMENT, 4)}"
        case TimeKind.STAMP:
            moment = f"epoch_us({identifier(column)})"
            return f"({moment} - {_midnight(f'(min({moment}) {over})', DAY * 10**6)}) / 1e6"
        case TimeKind.NANOSTAMP:
            moment = f"epoch_ns({identifier(column)})"
            return f"({moment} - {_midnight(f'(min({moment}) {over})', DAY * 10**9)}) / 1e9"
        case TimeKind.TIME:
            return f"epoch({identifier(column)})::DOUBLE"
