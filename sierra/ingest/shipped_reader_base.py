"""The base class of the shipped readers: it sorts files by their columns, writes valid files, and notes faults.

Also: a check that the time of each file's rows does not go back, as it does when a simulator resumes from a checkpoint.

A run whose time goes back has rows of a part that was abandoned; its last value, and each curve, would mix both parts. The rows
of several robots may follow each other in one file: then each robot has a time of its own. A robot's column is any column of
whole numbers or texts within whose values the time goes ahead and never back, if most values have two rows or more.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, NamedTuple

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.errors import Damaged, Missing
from sierra.ingest import robot_files
from sierra.ingest.messages import shown
from sierra.ingest.model import AtFaultError, Part, Reading, Shape, Siblings, Written
from sierra.store.connections import Database, reset
from sierra.store.duckdb_file_io import copy, parquet_metadata, read_parquet
from sierra.store.duckdb_messages import check_shortage, disk_error, duckdb_error
from sierra.store.parquet_footer import rows_in
from sierra.store.sql_names import column_names, identifier, stored_name, stored_names, unnested
from sierra.store.sql_result import INTEGER, NUMBER, RawRow
from sierra.store.time_axis import names_time
from sierra.store.type_inference import BESIDE
from sierra.util.shortage import PASSING, lacking


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
    for step in back:
        robots = [name for name in own if name != time and re.fullmatch(rf"VARCHAR|{INTEGER}", kinds[name])]
        if not any(_of_each(connection, rows, step, name) for name in robots):
            yield step


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


FILE = "# file"
"""DuckDB's name for the column with a row's file; real columns are unlikely to have this name."""
PARTS = 1000
"""The limit on different sets of columns in one output. Each set is a file in each segment; files must not grow with runs."""


class TableReader:
    """The base class of the shipped readers, which read many files at once.

    It sorts files by their columns, writes valid files, and notes faults.
    """

    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, connection: Database, shape: Shape, target: Path, siblings: Siblings) -> None:
        self.sql = connection
        self.shape = shape
        self.siblings = siblings
        self.parts = list(shape.parts)
        self.part = Part(())
        """The part that is being read."""
        self.target = self._first = target
        self._more = 0
        """The number of Parquet files for files whose values differ from most files of their part."""
        self.rows: dict[tuple[str, str], int] = {}
        self.counted: dict[tuple[str, str], int] = {}
        self.columns: dict[tuple[str, str], Mapping[str, str]] = {}
        self.hints: dict[tuple[str, str], dict[str, str]] = {}
        self.faults: dict[str, str] = {}
        self.error: type[Exception] = duckdb_error()
        self.nans: set[str] = set()
        """The columns of whole numbers in which nan is recorded as missing."""
        self._ticks = {name.lower() for name in shape.ticks}

    def read(self, files: Sequence[Written]) -> Reading:
        for number, members in self._by_part(files):
            sound = self.sound(members)
            if number is None:  # without rows and columns
                self._without_rows(sound)
            elif sound:
                self.part = self.parts[number]
                self.target = self._first.with_stem(f"{self._first.stem}~{number + 1}") if number else self._first
                self._read_part(sound)
        ended = sum(file.ended for file in files if (file.execution, file.name) in self.rows)
        shape = self.shape
        nans = tuple(dict.fromkeys((*shape.nans, *sorted(self.nans))))
        shape = replace(
            shape, parts=tuple(self.parts), files=shape.files + len(self.rows), ended=shape.ended + ended, nans=nans
        )
        return Reading(self.rows, self.counted, self.columns, self.hints, self.faults, shape)

    def _without_rows(self, files: Sequence[Written]) -> None:
        """Record that files have neither rows nor columns, if a count of their rows agrees."""
        self.part = Part(())
        for file, fault in self._miscounted(files, {}):
            self.fault(file, fault)
        for file in self.sound(files):
            self.rows[file.execution, file.name] = 0
            self.columns[file.execution, file.name] = {}

    def _read_part(self, files: Sequence[Written]) -> None:
        """Read the files of one part. Files that turn out to be at fault are left out."""
        while files:
            try:
                self.read_part(files)
            except AtFaultError as error:
                for file, fault in error.faults:
                    self.fault(file, fault)
                self.forget_hints(files)
                files = self.sound(files)
            else:
                return

    def forget_hints(self, files: Iterable[Written]) -> None:
        """Forget the hints about files, which are written again."""
        for file in files:
            self.hints.pop((file.execution, file.name), None)

    def _miscounted(self, files: Sequence[Written], rows: Mapping[tuple[str, str], int]) -> Iterator[tuple[Written, str]]:
        """Yield the files whose own count differs from `rows`, each with an error message."""
        for file in files:
            key = file.execution, file.name
            read = rows.get(key, 0)
            counted = self.count(file, read)
            if isinstance(counted, int):
                self.counted[key] = counted
            if counted != read:
                yield file, counted if isinstance(counted, str) else self.miscount(file, counted, read)

    def count(self, file: Written, read: int) -> int | str:
        """Return the number of rows in a file, counted without DuckDB, or why it cannot be counted.

        `read` is the number of rows that DuckDB has read. A slow count is only needed if a quick count differs from `read`.
        """
        raise NotImplementedError

    def miscount(self, file: Written, counted: int, read: int) -> str:
        """Return the message for a file with a different number of rows than were read."""
        return f"it contains {counted} rows, but {read} were read: other readers read it differently"

    def sort(self, files: Sequence[Written]) -> Mapping[str, Part | None]:
        """Return the columns (and the delimiter) of each valid file by its path; None if it has no rows and no columns."""
        raise NotImplementedError

    def read_part(self, files: Sequence[Written]) -> None:
        """Read the files of one part."""
        raise NotImplementedError

    def targets(self) -> Iterator[Path]:
        """Yield target paths for the files of one part: first for the usual kinds of values, then for others."""
        yield self.target
        while True:
            self._more += 1
            yield self._first.with_stem(f"{self._first.stem}~{PARTS + self._more}")

    def _by_part(self, files: Sequence[Written]) -> list[tuple[int | None, list[Written]]]:
        """Return the files of each part with the part's position; None for files without rows and columns."""
        part_of_file = self.sort(files)
        numbers = {self.key(part): number for number, part in enumerate(self.parts)}
        members: dict[int | None, list[Written]] = {}
        for file in self.sound(files):
            part = part_of_file[file.path]
            if part is not None and (own := self._ticks & set(map(str.lower, part.names))):
                self.fault(file, f"has a column {min(own)!r}, but {robot_files.of_name(min(own), file.name)}")
                continue
            number = None if part is None else numbers.setdefault(self.key(part), len(numbers))
            if number is not None and number >= PARTS:
                self.fault(file, f"has different columns, but a table has at most {PARTS} different sets of columns")
                continue
            if part is not None and number == len(self.parts):
                self.parts.append(part)
            members.setdefault(number, []).append(file)
        return list(members.items())

    def key(self, part: Part) -> Hashable:
        """Return the key that files of one part share. The order of columns matters only in a CSV."""
        return frozenset(part.names)

    def fault(self, file: Written, what: str) -> None:
        self.faults.setdefault(file.execution, f"{shown(file.name)}: {what.replace(file.path, shown(file.name))}")

    def sound(self, files: Iterable[Written]) -> list[Written]:
        return [file for file in files if file.execution not in self.faults]

    def done(self, target: Path, files: Sequence[Written], kinds: Mapping[str, Mapping[str, str]]) -> None:
        """Record the files that were written to `target`; `kinds` are the kinds of values in their columns, by path."""
        ticks = dict.fromkeys(self.shape.ticks, "number")
        for file in files:
            self.columns[file.execution, file.name] = {**ticks, **kinds[file.path]} if ticks else kinds[file.path]
        self.rows |= dict.fromkeys(((file.execution, file.name) for file in files), 0)
        stored = dict(zip(self.part.names, stored_names(self.part.names), strict=True))
        lacking = self._lacking(target)
        partly = [name for name in self.part.names if stored[name] in lacking]
        for key, count, filled in self._count(target, files, [stored[name] for name in partly]):
            self.rows[key] = count
            empty = {name for name, values in zip(partly, filled, strict=True) if not values}
            if empty:
                self.columns[key] = {n: "empty" if n in empty else kind for n, kind in self.columns[key].items()}
        for file in files:
            key = file.execution, file.name
            if not self.rows[key]:
                self.columns[key] = dict.fromkeys(self.columns[key], "empty")
        self._check_time(target, files)

    def _check_time(self, target: Path, files: Sequence[Written]) -> None:
        """Mark the files in `target` as faulty whose time goes back."""
        if self.shape.any_order or "# t" in self.part.names:
            return
        hidden = ("run", "execution", *(["file"] if self.shape.many else ()), *column_names(self.shape.ticks))
        only = self._names(files)
        by_key = {(file.execution, file.name): file for file in files}
        for back in gone_back(self.sql, target, self.shape.time, hidden):
            file = by_key[back.execution, only[back.execution, back.file]]
            keys = "" if self.shape.declared else f"file = {json.dumps(file.name, ensure_ascii=False)}, "
            cure = f'to take rows in the order of their times, set {keys}time_order = "any" in [outputs.{self.shape.name}]'
            self.fault(file, f"{back.message} ({cure})")

    def _lacking(self, target: Path) -> set[str]:
        """Return the columns of a Parquet file that have no value in some row."""
        rows = self.sql.execute(
            f"SELECT path_in_schema FROM {parquet_metadata(str(target))} GROUP BY 1 "
            "HAVING coalesce(max(stats_null_count), 1) > 0"
        ).fetchall()
        return {row[0].partition(", ")[0] for row in rows} | {row[0] for row in rows}

    def halve(
        self, files: Sequence[Written], attempt: Callable[[Sequence[Written]], object], explain: Callable[..., str]
    ) -> None:
        """Find the files for which `attempt` fails, by repeated halving, and mark them as faulty."""
        try:
            if files:
                attempt(files)
        except self.error as error:
            if lacking(error) in PASSING:
                check_shortage(error)
            if len(files) == 1:
                self.fault(files[0], explain(files[0], error))
            else:
                for half in (files[: len(files) // 2], files[len(files) // 2 :]):
                    self.halve(half, attempt, explain)

    def write(self, target: Path, files: Sequence[Written], source: str, columns: Mapping[str, str]) -> None:
        """Write the rows of `source` (a relation on $files) with their run and execution; `columns` are expressions by name."""
        owners = {
            "path": [file.path for file in files],
            "run": [file.run for file in files],
            "execution": [file.execution for file in files],
            "name": [shown(file.name) for file in files],
            **{f"tick{index}": [file.ticks[index] for file in files] for index in range(len(self.shape.ticks))},
        }
        named = ", ".join(
            f"{expression} AS {identifier(name)}"
            for name, expression in zip(stored_names(list(columns)), columns.values(), strict=True)
        )
        name = "o.name AS file, " if self.shape.many else ""
        name += "".join(f"o.tick{index} AS {identifier(tick)}, " for index, tick in enumerate(column_names(self.shape.ticks)))
        types = {name: "BIGINT" if name.startswith("tick") else "VARCHAR" for name in owners}
        self.sql.execute(f"CREATE OR REPLACE TEMP TABLE owners AS {unnested(types)}", list(owners.values()))
        self.sql.execute("SET threads = 1")  # several threads would write the pieces of a large file in any order
        try:
            rows = f"SELECT o.run, o.execution, {name}{named} FROM {source} t JOIN owners o ON t.{identifier(FILE)} = o.path"
            self.sql.execute(copy(rows, target, self.shape.name), these(files))
            self._check_rows(target, files)
        except (self.error, AtFaultError):
            target.unlink(missing_ok=True)
            raise
        finally:
            self.sql.execute(reset("threads"))
            self.sql.execute("DROP TABLE owners")

    def _check_rows(self, target: Path, files: Sequence[Written]) -> None:
        """Raise AtFaultError if `target` has a different number of rows of a file than the file itself."""
        written = {key: rows for key, rows, _ in self._count(target, files, ())}
        if (stated := rows_in(target)) != sum(written.values()):
            raise Damaged(f"{target}: its footer states {stated} rows, but it has {sum(written.values())}")
        if faults := list(self._miscounted(files, written)):
            raise AtFaultError(faults)

    def _names(self, files: Sequence[Written]) -> dict[tuple[str, str | None], str]:
        """Return the files' names by their keys in a Parquet file: the execution, and the file if a run writes several."""
        many = self.shape.many
        return {(file.execution, shown(file.name) if many else None): file.name for file in files}

    def _count(
        self, target: Path, files: Sequence[Written], columns: Sequence[str]
    ) -> Iterator[tuple[tuple[str, str], int, Sequence[int]]]:
        """Yield for each execution and file the number of written rows, and the number of values in these columns."""
        name = "file" if self.shape.many else "NULL"
        only = self._names(files)
        filled = "".join(f", count({identifier(column)})" for column in columns)
        statement = f"SELECT execution, {name}, count(*){filled} FROM {read_parquet([str(target)])} GROUP BY 1, 2"
        for execution, file, count, *values in self.sql.execute(statement).fetchall():
            yield (execution, only[execution, file]), count, values

    def fetch(self, statement: str, files: Sequence[Written]) -> list[RawRow]:
        return self.sql.execute(statement, these(files)).fetchall() if files else []

    def unwritten(self, error: Exception) -> Missing:
        return disk_error(self.target.parent, error)


def these(files: Sequence[Written]) -> dict[str, list[str]]:
    return {"files": [file.path for file in files]}
