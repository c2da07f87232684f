"""The answer to one SQL statement: as Python rows for few rows, or as an Arrow table.

Rows need neither pyarrow nor numpy, which take longer to load than most queries take. Values of types that DuckDB's own
conversion would change (nanoseconds, for example) come through Arrow.
"""

from __future__ import annotations

import itertools
import re
from datetime import UTC, date, datetime, time, timedelta
from decimal import Decimal
from typing import TYPE_CHECKING, Any, TypeAlias

from sierra.util.lazy_definitions import regex

if TYPE_CHECKING:
    import duckdb
    import pyarrow as pa

SqlValue: TypeAlias = (
    bool
    | int
    | float
    | str
    | bytes
    | Decimal
    | datetime
    | date
    | time
    | timedelta
    | list["SqlValue"]
    | dict[str, "SqlValue"]
    | None
)
"""One value of a result."""
RawRow: TypeAlias = tuple[Any, ...]
"""A row of one of SIERRA's own statements as DuckDB returns it; the statement is next to the code that unpacks the row."""

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
INSTANT = "TIMESTAMP WITH TIME ZONE"
INTEGER = r"U?(TINY|SMALL|BIG|HUGE)INT|U?INTEGER"
NUMBER = rf"{INTEGER}|DOUBLE|FLOAT|DECIMAL\(\d+,\d+\)"
"""The types of whole numbers, and of all numbers, as regular expressions."""
SIMPLE = regex(rf"(VARCHAR|BOOLEAN|{NUMBER}|DATE|TIMESTAMP|BLOB|JSON)(\[\])*")
"""The types of values that are the same as Python objects from DuckDB and from Arrow; `HUGEINT` is more exact."""
TIMES = regex(r"DATE|TIME|BIT|INTERVAL")
"""A pattern in the names of types with values that Python cannot hold: infinity, years before 1 and after 9999, for example."""
HELD = {
    "DATE": "#{0} BETWEEN DATE '0001-01-01' AND DATE '9999-12-31'",
    "TIMESTAMP": "#{0} BETWEEN TIMESTAMP '0001-01-01' AND TIMESTAMP '9999-12-31 23:59:59.999999'",
    INSTANT: "#{0} BETWEEN TIMESTAMPTZ '0001-01-01 00:00:00+00' AND TIMESTAMPTZ '9999-12-31 23:59:59.999999+00'",
    "TIME": "#{0} < TIME '24:00:00'",
    "TIME WITH TIME ZONE": "false",
    "BIT": "false",
}
"""Conditions that a value of a type can be a Python object, by the type; those of TIMESTAMP_S and _MS are TIMESTAMP's."""
NEVER_HELD = regex(r"_NS\b|INTERVAL")
"""A pattern in the names of types with values that Python never holds: nanoseconds and intervals."""
NESTED_HELD = r"NOT regexp_matches(#{0}::VARCHAR, 'infinity|\(BC\)|\d{{5,}}-\d\d-\d\d|24:00:00')"
"""The condition for values of other types, such as lists of dates; also false if they have a text like such a time."""
TEXTS = {
    INSTANT: "(#{0} AT TIME ZONE 'UTC')::VARCHAR || CASE WHEN isfinite(#{0}) THEN '+00' ELSE '' END",
    "TIMESTAMPTZ_NS": "(#{0} AT TIME ZONE 'UTC')::VARCHAR || '+00'",
}
"""The texts of values that cannot be Python objects, by the type, if they are not DuckDB's own."""


class Answer:
    """A statement's result. Each method executes the statement, so it is used once, while its snapshot is open."""

    def __init__(self, relation: duckdb.DuckDBPyRelation, notes: str = "") -> None:
        """`relation` is DuckDB's; `notes` are about columns of the result."""
        self._relation = relation
        self.types = [str(one) for one in relation.types]
        self.columns = unique(relation.columns)
        self.notes = notes

    @property
    def numeric(self) -> list[str]:
        """Return the names of the columns of numbers."""
        return [name for name, kind in zip(self.columns, self.types, strict=True) if re.fullmatch(NUMBER, kind)]

    def first(self, count: int) -> Answer:
        """Return the first rows of this answer, of which no others are computed if possible."""
        return Answer(self._relation.limit(count), self.notes)

    def rows(self) -> list[tuple[SqlValue, ...]]:
        """Return all rows as Python objects; times are in UTC. What Python cannot hold, such as nanoseconds, is text."""
        times = [place for place, kind in enumerate(self.types) if TIMES.search(kind)]
        simple = all(kind == INSTANT or SIMPLE.fullmatch(kind) for kind in self.types)
        relation = self._held(times, simple=simple) if times else self._relation
        rows: list[tuple[SqlValue, ...]] = relation.fetchall() if simple else _through_arrow(relation)
        return [_with_times(row, times, len(self.types)) for row in rows] if times else rows

    def arrow(self) -> pa.Table:
        """Return the result as an Arrow table."""
        return self._relation.to_arrow_table().rename_columns(self.columns)

    def _held(self, times: list[int], *, simple: bool) -> duckdb.DuckDBPyRelation:
        """Return the relation with NULL for times that Python cannot hold, followed by columns with the texts of these.

        If all columns are simple, instants are microseconds since 1970: DuckDB needs a further library to convert them.
        """
        columns = [f"#{index}" for index in range(1, len(self.types) + 1)]
        texts = []
        for index in times:
            kind, value = self.types[index], columns[index]
            held = HELD.get(re.sub("_M?S$", "", kind), "false" if NEVER_HELD.search(kind) else NESTED_HELD).format(index + 1)
            text = TEXTS.get(kind, "#{0}::VARCHAR").format(index + 1)
            exact = f"epoch_us({value})" if simple and kind == INSTANT else value
            columns[index] = f"CASE WHEN {held} THEN {exact} END"
            texts.append(f"CASE WHEN NOT ({held}) THEN {text} END")
        return self._relation.project(", ".join((*columns, *texts)))


def few_rows(relation: duckdb.DuckDBPyRelation) -> pa.Table:
    """Return rows of which Python objects will be made; another process that executes the statement limits their number."""
    found: pa.Table = getattr(relation, "to_few_rows", relation.to_arrow_table)()
    return found


def _through_arrow(relation: duckdb.DuckDBPyRelation) -> list[tuple[SqlValue, ...]]:
    table = few_rows(relation)
    return [tuple(row.values()) for row in table.rename_columns(list(map(str, range(table.num_columns)))).to_pylist()]


def _with_times(row: tuple[SqlValue, ...], times: list[int], count: int) -> tuple[SqlValue, ...]:
    """Return the first `count` values of a row, with the texts after them in place of times that Python cannot hold."""
    values = list(row[:count])
    for place, text in zip(times, row[count:], strict=True):
        if text is not None:
            values[place] = text
        elif isinstance(value := values[place], int):
            values[place] = EPOCH + timedelta(microseconds=value)
    return tuple(values)


def unique(columns: list[str]) -> list[str]:
    """Return unique column names: repeated ones (`SELECT * FROM runs JOIN executions …`) become run, run_1."""
    names: list[str] = []
    for name in columns:
        others = (f"{name}_{number}" for number in itertools.count(1))
        names.append(name if name not in names else next(other for other in others if other not in (*names, *columns)))
    return names
