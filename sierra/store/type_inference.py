"""Types of columns: inferred from the texts of cells, and combined from known types."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from sierra.store.sql_names import quote

WHOLE = r" *([+]?[0-9]+|-0*[1-9][0-9]*) *"
"""The pattern of a whole number. -0 does not match: it is a number, but BIGINT has no negative zero."""
POINTED = r" *[-+]?0*[1-9][0-9]{15,}[.]0* *"
"""The pattern of a whole number of at least 16 digits that is written with a decimal point."""
LOGICAL = r" *(?i:true|false) *"
VISUAL_C = r"([-+]?)1\.#(?i:(inf)|ind|qnan|snan)0*([eE][-+]?[0-9]+)?"
"""Infinity and nan as older C libraries of Windows print them: `1.#INF`, `-1.#IND`, `1.#QNAN0`."""
MINUTE, SECOND = r"[0-9]{4}-[0-9]{2}-[0-9]{2}[T ](?:[01][0-9]|2[0-3]):[0-5][0-9]", r":[0-5][0-9]"
DAY_AND_TIME = rf"{MINUTE}(?:{SECOND}(?:[.,][0-9]{{1,9}})?)?"
"""The pattern of a date with a time as ISO 8601 has it. Leap seconds do not match: DuckDB has none."""
ZONE = r"(?:Z|[-+](?:[01][0-9]|2[0-3])(?::?[0-5][0-9])?)"
NANOSECONDS = r"[.,][0-9]{7}"
"""The pattern of a fraction of a second that microseconds cannot hold."""
LOCAL_TIME, LOCAL_TIME_NS = "TIMESTAMP", "TIMESTAMP_NS"
INSTANT, INSTANT_NS = "TIMESTAMP WITH TIME ZONE", "TIMESTAMPTZ_NS"
TIME_KINDS = {LOCAL_TIME: LOCAL_TIME, LOCAL_TIME_NS: LOCAL_TIME, INSTANT: INSTANT, INSTANT_NS: INSTANT}
"""The types of times, each with that of less digits: programs may leave out zeros at the end of fractions."""
HUGE = "DECIMAL(38,0)"
EMPTY = '"NULL"'
"""DuckDB's name for the type of a Parquet column that is declared to have no values."""
AS_TEXT = " as text"
EXACT_TEXT = "DOUBLE with exact text"
"""The type of numbers in one file, some of them fractions, and others whole numbers that DOUBLE cannot hold.

They are recorded as DOUBLE, with each number as it is written in a column beside it: see `text_beside`.
"""
DURATION = "duration"
"""The kind of durations, which are recorded as nanoseconds."""
BESIDE = "# text of "
"""The beginning of the recorded names of such columns; real columns are unlikely to have such a name."""
NAN, INEXACT = 32, 64
"""The bits of `bit` for nan, and (with the bit of its type) for a whole number that DOUBLE cannot hold."""
LOCAL, ZONED, FINE, FAR = 128, 256, 512, 1024
"""The bits of `bit` for times without and with a zone, with nanoseconds, and too far from 1970 for nanoseconds."""
NUMBERS = 2 | 4 | 8 | NAN
"""The bits of `bit` for texts that are numbers."""


def own_kind(kind: str) -> str:
    """Return the kind of values that a file has in a column, without the mark that they are stored as text."""
    return kind.removesuffix(AS_TEXT)


def right_kind(kinds: Mapping[str, int]) -> str:
    """Return the kind that sibling files are expected to have in a column, from the number of files per kind.

    This is the kind that at least half of the files have; in a tie, numbers win. Otherwise it is text, which can hold
    everything. It is also text if some have times and others have texts: `never` instead of a time is a value.
    """
    counts: Counter[str] = Counter()
    for kind, number in kinds.items():
        if kind != "empty":
            counts[own_kind(kind)] += number
    if counts["text"] and any(kind in TIME_KINDS for kind in counts):
        return "text"
    most = max(counts, key=lambda kind: (counts[kind], kind == "number"), default="empty")
    return most if 2 * counts[most] >= counts.total() or not counts.keys() <= {"number", "flag", "text"} else "text"


def kind_of(kind: str) -> str:
    """Return number, text, flag, empty, or the type itself."""
    if is_number(kind):
        return "number"
    return {"VARCHAR": "text", "BOOLEAN": "flag", EMPTY: "empty"}.get(kind, kind)


def is_number(kind: str) -> bool:
    return kind.startswith(("DECIMAL", "DOUBLE", "FLOAT")) or kind.rstrip("0123456789").endswith(("INT", "INTEGER"))


def is_whole(kind: str) -> bool:
    return "INT" in kind or kind == HUGE


def is_inexact(column: str, kind: str) -> str:
    """Return the SQL condition that a number of type `kind` changes when it is converted to DOUBLE."""
    return f"{column} IS NOT NULL AND TRY_CAST(CAST({column} AS DOUBLE) AS {kind}) IS DISTINCT FROM {column}"


def is_beyond(column: str, kind: str) -> str:
    """Return the SQL condition that a DOUBLE is neither nan nor a number that the whole type `kind` can hold."""
    return f"{column} IS NOT NULL AND NOT isnan({column}) AND TRY_CAST({column} AS {kind})::DOUBLE IS DISTINCT FROM {column}"


def text_beside(column: str) -> str:
    """Return the recorded name of the column with the numbers of `column` as they are written."""
    return BESIDE + column


def bit(cell: str, *, as_written: bool = True, times: bool = False) -> str:
    """Return the SQL expression that classifies the text of a cell: one bit for each kind, 0 for an empty cell.

    A whole number that DOUBLE cannot hold has the bit `INEXACT` too, also if it is written as 9007199254740993.0.

    `as_written`: the text is that of a file; otherwise a parser made it from a DOUBLE, so that digits before .0 mean nothing.
    `times`: dates with a time are no texts.
    """
    whole = f"regexp_full_match({cell}, {quote(WHOLE)})"
    rounded = f"(TRY_CAST(TRY_CAST({cell} AS DOUBLE) AS HUGEINT) = TRY_CAST({cell} AS HUGEINT)) IS NOT TRUE"
    pointed = f"strpos({cell}, '.') > 16 AND regexp_full_match({cell}, {quote(POINTED)}) AND {rounded}"
    inexact = f"CASE WHEN length({cell}) > 15 AND {rounded} THEN {INEXACT} ELSE 0 END"
    return (
        f"CASE WHEN {cell} IS NULL THEN 0 WHEN {whole} AND TRY_CAST({cell} AS BIGINT) IS NOT NULL THEN 2 + {inexact} "
        f"WHEN {whole} AND TRY_CAST({cell} AS {HUGE}) IS NOT NULL THEN 4 + {inexact} "
        f"WHEN TRY_CAST({as_read(cell)} AS DOUBLE) IS NOT NULL AND NOT {odd(cell)} THEN "
        f"CASE WHEN length({cell}) > 38 AND {whole} THEN {8 + INEXACT} "
        f"{f'WHEN {pointed} THEN {8 + INEXACT} ' if as_written else ''}"
        f"WHEN regexp_matches({cell}, '[nN] *$|#(?i:ind|qnan|snan)') THEN {NAN} ELSE 8 END "
        f"WHEN regexp_full_match({cell}, {quote(LOGICAL)}) THEN 1 ELSE {_time_bit(cell) if times else 16} END"
    )


def _time_bit(cell: str) -> str:
    """Return the SQL expression for the bits of a date with a time; 16 for another text, and for a day that does not exist."""
    local, zoned = (is_time(cell, kind) for kind in (LOCAL_TIME_NS, INSTANT_NS))
    fine = f"CASE WHEN regexp_matches({cell}, {quote(NANOSECONDS)}) THEN {FINE} ELSE 0 END"
    far = f"CASE WHEN TRY_CAST({time_text(cell)} AS {{}}) IS NULL THEN {FAR} ELSE 0 END"
    exists = f"TRY_CAST({time_text(cell)} AS {{}}) IS NOT NULL AND NOT starts_with(trim({cell}), '0000')"
    return (
        f"CASE WHEN length({cell}) < 16 THEN 16 "
        f"WHEN {local} AND {exists.format(LOCAL_TIME)} THEN {LOCAL} + {fine} + {far.format(LOCAL_TIME_NS)} "
        f"WHEN {zoned} AND {exists.format(INSTANT)} THEN {ZONED} + {fine} + {far.format(INSTANT_NS)} ELSE 16 END"
    )


def is_time(cell: str, kind: str) -> str:
    """Return the SQL condition that a text has the form of a time of a type, which can hold all its digits."""
    form = DAY_AND_TIME if kind.endswith("_NS") else DAY_AND_TIME.replace("{1,9}", "{1,6}")
    zone = ZONE if TIME_KINDS[kind] == INSTANT else ""
    return f"regexp_full_match({cell}, {quote(f' *{form}{zone} *')})"


def time_text(cell: str) -> str:
    """Return the SQL expression for the text of a time as DuckDB reads it."""
    return f"replace(trim({cell}), ',', '.')"


def no_nan(cell: str) -> str:
    """Return an SQL expression for the cell's text in which -nan, as C prints it, is nan, as DuckDB requires."""
    return f"CASE WHEN regexp_full_match({cell}, ' *[-+](?i:nan) *') THEN 'nan' ELSE {cell} END"


def as_read(cell: str) -> str:
    """Return an SQL expression for the cell's text in which infinity and nan are written as DuckDB requires."""
    pattern = quote(f" *{VISUAL_C} *")
    visual_c = f"CASE WHEN regexp_extract({cell}, {pattern}, 2) = '' THEN 'nan' "
    visual_c += f"ELSE regexp_extract({cell}, {pattern}, 1) || 'inf' END"
    return f"CASE WHEN contains({cell}, '#') AND regexp_full_match({cell}, {pattern}) THEN {visual_c} ELSE {no_nan(cell)} END"


def as_float(text: str) -> float | None:
    """Return the number that a text is, also infinity and nan; None if it is none."""
    if found := re.fullmatch(VISUAL_C, text.strip()):
        return math.nan if found[2] is None else math.copysign(math.inf, -1 if found[1] == "-" else 1)
    try:
        number = float(text)
    except ValueError:
        return None
    return None if "_" in text or (math.isinf(number) and any(map(str.isdigit, text))) else number


def odd(cell: str) -> str:
    """Return the SQL condition that DuckDB misreads a text as a number: 12_34 as 1234, or 1e400 as infinity."""
    infinite = f"coalesce(isinf(TRY_CAST({cell} AS DOUBLE)), false)"
    return f"(contains({cell}, '_') OR ({infinite} AND regexp_matches({cell}, '[0-9]')))"


def reads_as(cell: str, kind: str) -> str:
    """Return the SQL expression that parses a text as a number of type `kind`; NULL if it is not a number."""
    return f"CASE WHEN NOT {odd(cell)} THEN TRY_CAST({no_nan(cell)} AS {kind}) END"


def narrowest(bits: int) -> str | None:
    """Return the narrowest type that holds all kinds of text whose bits (see `bit`) are set.

    Beside whole numbers that DOUBLE cannot hold, nan is a missing value.
    """
    if bits in (0, 1):
        return "BOOLEAN" if bits else None
    if bits & (LOCAL | ZONED):
        return _narrowest_time(bits)
    if bits & 17:
        return "VARCHAR"
    if bits & 8 or (bits & NAN and not bits & INEXACT):
        return EXACT_TEXT if bits & INEXACT else "DOUBLE"
    return HUGE if bits & 4 else "BIGINT"


def _narrowest_time(bits: int) -> str:
    """Return the type of times that are all with a zone, or all without one; VARCHAR for others."""
    kinds = {LOCAL: (LOCAL_TIME, LOCAL_TIME_NS), ZONED: (INSTANT, INSTANT_NS)}.get(bits & ~(FINE | FAR))
    if kinds is None or bits & (FINE | FAR) == FINE | FAR:
        return "VARCHAR"
    return kinds[bool(bits & FINE)]


def sibling_kind(kind: str) -> str:
    """Return the kind by which a column of a text file is compared with those of siblings: that of times ignores digits."""
    return TIME_KINDS.get(kind) or kind_of(kind)


def as_stored(kind: str) -> str:
    """Return the SQL type in which numbers of a type are recorded."""
    return "DOUBLE" if kind == EXACT_TEXT else kind


def widest(kinds: Collection[str]) -> str:
    """Return the type that holds all of these numbers: whole numbers exactly, others as DOUBLE."""
    if len(set(kinds)) == 1:
        return next(iter(kinds))
    if all(map(is_whole, kinds)):
        return HUGE if {HUGE, "UBIGINT", "HUGEINT", "UHUGEINT"} & set(kinds) else "BIGINT"
    return "DOUBLE"


def common(kinds: Iterable[str | None]) -> str:
    """Return the narrowest type that holds the values of all these types."""
    some = {kind for kind in kinds if kind}
    if len(some) < 2:
        return some.pop() if some else "BOOLEAN"
    if not all(map(is_number, some)):
        return "VARCHAR"
    return "DOUBLE" if {"DOUBLE", EXACT_TEXT} & some else HUGE
