"""What columns hold, by the texts of their cells and by the types that are known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

from sierra.store.names import quote

WHOLE = r" *([+]?[0-9]+|-0*[1-9][0-9]*) *"
"""-0 is a number, but no whole one: a BIGINT has no such zero."""
LOGICAL = r" *(?i:true|false) *"
HUGE = "DECIMAL(38,0)"
EMPTY = '"NULL"'
"""What DuckDB calls the type of a Parquet column that says itself that it has no values."""
AS_TEXT = " as text"


def own_kind(kind: str) -> str:
    """What a file has in a column, however it is kept."""
    return kind.removesuffix(AS_TEXT)


def right_kind(kinds: Mapping[str, int]) -> str:
    """What siblings ought to have in a column, by how many of them have what: what at least half of them have (of two that
    as many have: numbers), else text, which holds all."""
    counts: Counter[str] = Counter()
    for kind, number in kinds.items():
        if kind != "empty":
            counts[own_kind(kind)] += number
    most = max(counts, key=lambda kind: (counts[kind], kind == "number"), default="empty")
    return most if 2 * counts[most] >= counts.total() or not counts.keys() <= {"number", "flag", "text"} else "text"


def kind_of(kind: str) -> str:
    """number, text, flag, empty, or the type itself."""
    if is_number(kind):
        return "number"
    return {"VARCHAR": "text", "BOOLEAN": "flag", EMPTY: "empty"}.get(kind, kind)


def is_number(kind: str) -> bool:
    return kind.startswith(("DECIMAL", "DOUBLE", "FLOAT")) or kind.rstrip("0123456789").endswith(("INT", "INTEGER"))


def is_whole(kind: str) -> bool:
    return "INT" in kind or kind == HUGE


def is_inexact(column: str, kind: str) -> str:
    """The condition that a number of some type is not the same as DOUBLE."""
    return f"{column} IS NOT NULL AND TRY_CAST(CAST({column} AS DOUBLE) AS {kind}) IS DISTINCT FROM {column}"


def bit(cell: str) -> str:
    """Which kind of text a cell holds: one bit each; none where it is empty."""
    whole = f"regexp_full_match({cell}, {quote(WHOLE)})"
    return (
        f"CASE WHEN {cell} IS NULL THEN 0 WHEN {whole} AND TRY_CAST({cell} AS BIGINT) IS NOT NULL THEN 2 "
        f"WHEN {whole} AND TRY_CAST({cell} AS {HUGE}) IS NOT NULL THEN 4 "
        f"WHEN TRY_CAST({no_nan(cell)} AS DOUBLE) IS NOT NULL AND NOT {odd(cell)} THEN 8 "
        f"WHEN regexp_full_match({cell}, {quote(LOGICAL)}) THEN 1 ELSE 16 END"
    )


def no_nan(cell: str) -> str:
    """The same text, but for the -nan that C prints, as DuckDB knows it."""
    return f"CASE WHEN regexp_full_match({cell}, ' *[-+](?i:nan) *') THEN 'nan' ELSE {cell} END"


def odd(cell: str) -> str:
    """Whether DuckDB takes a text for a number that it is not: 12_34 for 1234, 1e400 for infinity."""
    return f"(contains({cell}, '_') OR (isinf(TRY_CAST({cell} AS DOUBLE)) AND regexp_matches({cell}, '[0-9]')))"


def reads_as(cell: str, kind: str) -> str:
    """The number that a text is, as a type of numbers; NULL where it is none."""
    return f"CASE WHEN NOT {odd(cell)} THEN TRY_CAST({no_nan(cell)} AS {kind}) END"


def narrowest(bits: int) -> str | None:
    """The narrowest type that holds all of these kinds."""
    if bits in (0, 1):
        return "BOOLEAN" if bits else None
    if bits & 17:
        return "VARCHAR"
    return "DOUBLE" if bits & 8 else HUGE if bits & 4 else "BIGINT"


def common(kinds: Iterable[str | None]) -> str:
    """The narrowest type that holds all of these."""
    some = {kind for kind in kinds if kind}
    if len(some) < 2:
        return some.pop() if some else "BOOLEAN"
    if not all(map(is_number, some)):
        return "VARCHAR"
    return "DOUBLE" if "DOUBLE" in some else HUGE
