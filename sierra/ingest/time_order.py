"""A check that the time of each file's rows does not go back, as it does when a simulator resumes from a checkpoint.

A run whose time goes back has rows of a part that was abandoned; its last value, and each curve, would mix both parts. The rows
of several robots may follow each other in one file: then each robot has a time of its own. A robot's column is any column of
whole numbers or texts within whose values the time goes ahead and never back, if most values have two rows or more.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from sierra.store.connections import Database
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.sql_names import identifier, stored_name
from sierra.store.sql_result import INTEGER, NUMBER
from sierra.store.time_axis import names_time
from sierra.store.type_inference import BESIDE


class WentBack(NamedTuple):
    """The first row of a file whose time is before that of an earlier row."""

    execution: str
    file: str | None
    """The name of the file, if a run writes several."""
    row: int
    """The number of the row in its file, from 1 on."""
    before: object
    time: object

    @property
    def message(self) -> str:
        return f"time goes back from {_number(self.before)} to {_number(self.time)} in row {self.row}"


def time_of(declared: str | None, names: Sequence[str], types: Sequence[str]) -> str | None:
    """Return the time among the columns of a table: the `declared` one, or the first if its name is that of a time."""
    if declared:
        called = stored_name(declared, names)
        found = called if called in names else None
    else:
        found = names[0] if names and names_time(names[0]) else None
    return found if found is not None and re.fullmatch(NUMBER, types[names.index(found)]) else None


def gone_back(connection: Database, target: Path, declared: str | None, hidden: Sequence[str]) -> Iterator[WentBack]:
    """Yield the files in a Parquet file whose time goes back. `hidden`: columns that are not in the files themselves."""
    data = read_parquet([str(target)], rows=True)
    described = connection.execute(f"DESCRIBE SELECT * FROM {data}").fetchall()
    kinds = {name: kind for name, kind, *_ in described}
    own = [name for name in kinds if name not in (*hidden, "filename", "file_row_number") and not name.startswith(BESIDE)]
    time = time_of(declared, own, [kinds[name] for name in own])
    if time is None:
        return
    file = "file" if "file" in kinds and "file" in hidden else "NULL::VARCHAR"
    rows = ROWS.format(t=identifier(time), file=file, data=data)
    if not connection.execute(ANY.format(rows=rows)).fetchall():
        return
    back = [WentBack(*row) for row in connection.execute(FIRST.format(rows=rows)).fetchall()]
    for one in back:
        robots = [name for name in own if name != time and re.fullmatch(rf"VARCHAR|{INTEGER}", kinds[name])]
        if not any(_of_each(connection, rows, one, name) for name in robots):
            yield one


def _of_each(connection: Database, rows: str, one: WentBack, column: str) -> bool:
    """Return whether the time goes ahead and never back within the rows of each value of a column."""
    statement = WITHIN.format(rows=rows, column=identifier(column))
    return bool(connection.execute(statement, {"e": one.execution, "f": one.file}).fetchone() == (True,))


def _number(value: object) -> str:
    return f"{value:.15g}" if isinstance(value, float) else str(value)


ROWS = """
SELECT execution, {file} AS "# file", file_row_number AS "# row", CASE WHEN isfinite({t}::DOUBLE) THEN {t} END AS "# t", *
FROM {data}
"""
ANY = """
SELECT 1 FROM (
    SELECT "# t" < lag("# t") OVER () AND execution = lag(execution) OVER ()
        AND "# file" IS NOT DISTINCT FROM lag("# file") OVER () AS back
    FROM ({rows}) WHERE "# t" IS NOT NULL
) WHERE back LIMIT 1
"""
"""Finds any row with an earlier time than the row above it. Rows of one file follow each other, so nothing is sorted."""
FIRST = """
WITH placed AS (
    SELECT execution, "# file", "# t", row_number() OVER w AS place, lag("# t" IGNORE NULLS) OVER w AS before
    FROM ({rows}) WINDOW w AS (PARTITION BY execution, "# file" ORDER BY "# row")
)
SELECT execution, "# file", min(place), arg_min(before, place), arg_min("# t", place)
FROM placed WHERE "# t" < before GROUP BY execution, "# file" ORDER BY ALL
"""
WITHIN = """
SELECT bool_and(NOT back AND (rows = 1 OR ahead)) AND 2 * count(*) FILTER (rows > 1) > count(*) FROM (
    SELECT
        count(*) AS rows,
        coalesce(bool_or("# t" < before), false) AS back,
        coalesce(bool_or("# t" > before), false) AS ahead
    FROM (
        SELECT {column} AS value, "# t", lag("# t") OVER (PARTITION BY {column} ORDER BY "# row") AS before
        FROM ({rows}) WHERE execution = $e AND "# file" IS NOT DISTINCT FROM $f AND "# t" IS NOT NULL
    ) GROUP BY value
)
"""
