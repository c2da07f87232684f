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
SIMPLE = re.compile(rf"(VARCHAR|BOOLEAN|{NUMBER}|DATE|TIMESTAMP|BLOB|JSON)(\[\])*")
"""The types of values that are the same as Python objects from DuckDB and from Arrow; `HUGEINT` is more exact."""


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
        """Return all rows as Python objects; times are in UTC."""
        if not all(kind == INSTANT or SIMPLE.fullmatch(kind) for kind in self.types):
            return [tuple(row.values()) for row in self.arrow().to_pylist()]
        instants = [place for place, kind in enumerate(self.types) if kind == INSTANT]
        if not instants:
            rows: list[tuple[SqlValue, ...]] = self._relation.fetchall()
            return rows
        return [_with_times(row, instants) for row in self._microseconds().fetchall()]

    def arrow(self) -> pa.Table:
        """Return the result as an Arrow table."""
        return self._relation.to_arrow_table().rename_columns(self.columns)

    def _microseconds(self) -> duckdb.DuckDBPyRelation:
        """Return the relation with times as microseconds since 1970: DuckDB needs a further library to convert times."""
        kinds = enumerate(self.types, start=1)
        texts = [f"epoch_us(#{place})" if kind == INSTANT else f"#{place}" for place, kind in kinds]
        return self._relation.project(", ".join(texts))


def _with_times(row: tuple[SqlValue, ...], places: list[int]) -> tuple[SqlValue, ...]:
    values = list(row)
    for place in places:
        if isinstance(value := values[place], int):
            values[place] = EPOCH + timedelta(microseconds=value)
    return tuple(values)


def unique(columns: list[str]) -> list[str]:
    """Return unique column names: repeated ones (`SELECT * FROM runs JOIN executions …`) become run, run_1."""
    names: list[str] = []
    for name in columns:
        others = (f"{name}_{number}" for number in itertools.count(1))
        names.append(name if name not in names else next(other for other in others if other not in (*names, *columns)))
    return names
