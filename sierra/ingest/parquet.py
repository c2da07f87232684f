"""The reader of Parquet, and the reader for formats of other packages, whose tables become Parquet files first."""

from __future__ import annotations

import tempfile
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from sierra.errors import Damaged
from sierra.ingest import base
from sierra.ingest.base import Columns, OutputReader, UnreadableError
from sierra.ingest.missing_values import MissingValues
from sierra.ingest.model import AtFaultError, Part, Reading, Shape, Siblings, Written
from sierra.ingest.shipped_reader_base import FILE, TableReader
from sierra.ingest.text_table_reader import alike
from sierra.store.connections import Database
from sierra.store.duckdb_file_io import arrow_schemas, parquet_given, parquet_schema
from sierra.store.duckdb_messages import check_shortage, first_line
from sierra.store.parquet_footer import rows_in
from sierra.store.segments import disk_errors
from sierra.store.sql_names import differing_by_case, identifier
from sierra.store.type_inference import DURATION, EMPTY, is_inexact, is_number, kind_of, widest
from sierra.util.lazy_definitions import regex
from sierra.util.shortage import PASSING, lacking

if TYPE_CHECKING:
    import pyarrow as pa

NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""The nanoseconds in the units of Arrow's durations."""
NESTED = "write them as numbers, or as a column of durations"
DIGITS = 38
"""The maximum number of digits of a DuckDB DECIMAL. DuckDB silently reads longer decimals as DOUBLE."""

RENAMED = regex(r"_\d+$")
"""The end of the names that DuckDB gives to columns whose names differ only in upper and lower case."""


class Parquet(TableReader):
    """The reader of Parquet, which has types of its own."""

    def __init__(self, connection: Database, shape: Shape, target: Path, siblings: Siblings) -> None:
        super().__init__(connection, shape, target, siblings)
        self._found: dict[str, dict[str, str]] = {}
        self._wide: dict[str, str] = {}
        """By path, a column with decimals that DuckDB would turn into DOUBLE."""
        self._missing = MissingValues(shape.form.na)
        self._called: dict[str, Mapping[str, str]] = {}
        """By path, DuckDB's names of the columns: it changes those that differ from others only in upper and lower case."""

    def sort(self, files: Sequence[Written]) -> Mapping[str, Part | None]:
        try:
            self._found = self._schemas(files)
        except self.error:
            self._found = self._schemas(self._readable(files))
        self._find_durations(self.sound(files))
        for file in self.sound(files):
            if name := self._wide.get(file.path):
                self.fault(
                    file, f"the column {name!r} has decimals of more than {DIGITS} digits, which is the maximum of a table"
                )
        return {path: Part(tuple(columns)) for path, columns in self._found.items()}

    def key(self, part: Part) -> Hashable:
        """Return the key that files of one part share: DuckDB's names depend on the order of names that are alike to it."""
        return part.names if differing_by_case(part.names) else super().key(part)

    def read_part(self, files: Sequence[Written]) -> None:
        try:
            written = self._write(files)
        except self.error:
            try:
                written = self._write(self._readable(files))
            except self.error as error:
                raise self.unwritten(error) from error
        for target, some in written:
            kinds = {file.path: {name: _kind(self._found[file.path][name]) for name in self.part.names} for file in some}
            self.done(target, some, kinds)

    def count(self, file: Written, read: int) -> int | str:
        try:
            return rows_in(file.path)
        except Damaged as error:
            return str(error)

    def _write(self, files: Sequence[Written]) -> list[tuple[Path, list[Written]]]:
        """Write the files, with one Parquet file for each combination of column kinds. Return each target with its files."""
        kinds = {
            name: {file.path: None if (kind := self._found[file.path][name]) == EMPTY else kind for file in files}
            for name in self.part.names
        }
        written = list(zip(self.targets(), alike(files, kinds, self._inexact(files)), strict=False))
        try:
            for target, some in written:
                types = {name: self._type(name, some) for name in self.part.names}
                called = self._called[some[0].path]
                columns = {n: self._valued(some, n, f"t.{identifier(called[n])}", types[n]) for n in self.part.names}
                self.write(target, some, self._source(), columns)
        except (self.error, AtFaultError):
            for target, _ in written:
                target.unlink(missing_ok=True)
            raise
        return written

    def _valued(self, files: Sequence[Written], name: str, column: str, kind: str) -> str:
        """Return the SQL expression for a column in its type, in which values that stand for missing ones are NULL."""
        value = _cast(column, kind)
        if not self._missing or kind.startswith(DURATION) or name in self.shape.places:
            return value
        own = {self._found[file.path][name] for file in files} - {EMPTY}
        missing = self._missing.condition(column, next(iter(own)) if len(own) == 1 else kind) if own else ""
        return f"CASE WHEN {missing} THEN NULL ELSE {value} END" if missing else value

    def _inexact(self, files: Sequence[Written]) -> set[str]:
        """Return the columns that would become DOUBLE, of which some have numbers that DOUBLE cannot hold."""
        inexact = set()
        for name in self.part.names:
            by_kind: dict[str, list[Written]] = {}
            for file in files:
                if is_number(kind := self._found[file.path][name]):
                    by_kind.setdefault(kind, []).append(file)
            exact = by_kind.keys() - {"DOUBLE", "FLOAT"}
            mixed = len(by_kind) > 1 and widest(by_kind) == "DOUBLE"
            if mixed and any(self._any_inexact(name, kind, by_kind[kind]) for kind in exact):
                inexact.add(name)
        return inexact

    def _any_inexact(self, name: str, kind: str, files: Sequence[Written]) -> bool:
        inexact = is_inexact(f"CAST({identifier(self._called[files[0].path][name])} AS {kind})", kind)
        return bool(self.fetch(f"SELECT 1 FROM {self._source()} WHERE {inexact} LIMIT 1", files))

    def _source(self) -> str:
        return parquet_given(FILE)

    def _readable(self, files: Sequence[Written]) -> list[Written]:
        whole = f"SELECT count(COLUMNS(*)) FROM {self._source()}"
        self.halve(files, lambda some: self.fetch(whole, some), lambda file, error: first_line(error))
        return self.sound(files)

    def _schemas(self, files: Sequence[Written]) -> dict[str, dict[str, str]]:
        """Return the names and types of each file's columns, with one query for all files of the same schema."""
        rows = self.fetch(
            "SELECT file_name, list((name, type, type_length, num_children, converted_type, scale, precision, logical_type)"
            f"::VARCHAR), min(name) FILTER (precision > {DIGITS}) FROM {parquet_schema()} GROUP BY file_name",
            files,
        )
        self._wide |= {path: name for path, _, name in rows if name}
        by_path = {file.path: file for file in files}
        described: dict[tuple[str, ...], tuple[dict[str, str], dict[str, str]]] = {}
        schemas = {}
        for path, schema, _ in rows:
            key = tuple(schema)
            if key not in described:
                columns = self.fetch(f"DESCRIBE SELECT * FROM {self._source()}", [by_path[path]])
                names = [row[0] for row in columns if row[0] != FILE]
                called = dict(zip(_own_names(path, names), names, strict=True))
                kinds = {row[0]: row[1] for row in columns}
                described[key] = {own: kinds[name] for own, name in called.items()}, called
            schemas[path], self._called[path] = described[key]
        return schemas

    def _find_durations(self, files: Sequence[Written]) -> None:
        """Find the columns of durations, whose units only the Arrow schema of a file has; note faults."""
        texts: dict[str, bytes] = dict(self.fetch(f"SELECT file_name, value FROM {arrow_schemas()}", files))
        units = {text: durations_in(text) for text in set(texts.values())}
        limited: dict[tuple[str, str], list[Written]] = {}
        for file in files:
            for name, unit in units[texts[file.path]].items() if file.path in texts else ():
                if name not in self._found[file.path]:
                    continue
                if unit not in NANOSECONDS:
                    self.fault(file, f"the column {name!r} has durations within lists or structures: {NESTED}")
                self._found[file.path] = {**self._found[file.path], name: f"{DURATION} in {unit}"}
                limited.setdefault((name, unit), []).append(file)
        for (name, unit), some in limited.items():
            limit = (2**63 - 1) // NANOSECONDS.get(unit, 1)
            called = identifier(self._called[some[0].path][name])
            beyond = f"SELECT DISTINCT {identifier(FILE)} FROM {self._source()} WHERE abs({called}::HUGEINT) > {limit}"
            paths = {path for (path,) in self.fetch(beyond, self.sound(some))}
            for file in (file for file in some if file.path in paths):
                self.fault(file, f"the column {name!r} has a duration of more than 292 years, which nanoseconds cannot hold")

    def _type(self, name: str, files: Sequence[Written]) -> str:
        """Return the type of a column in files that have one kind in it; of several number types, the widest."""
        return widest({self._found[file.path][name] for file in files} - {EMPTY} or {EMPTY})


def _own_names(path: str, called: Sequence[str]) -> Sequence[str]:
    """Return the names of a file's columns. DuckDB calls them so, unless two differ only in upper and lower case."""
    import pyarrow.parquet as pq

    if not any(RENAMED.search(name) for name in called):
        return called
    names: list[str] = pq.read_schema(path).names
    return names if len(names) == len(called) and len(set(names)) == len(names) else called


class Converted(Parquet):
    """A reader that converts each file by a reader of another package."""

    def __init__(self, connection: Database, shape: Shape, target: Path, siblings: Siblings) -> None:
        super().__init__(connection, shape, target, siblings)
        self._reader: OutputReader = base.make(shape.format, shape.reader)

    def read(self, files: Sequence[Written]) -> Reading:
        with tempfile.TemporaryDirectory(prefix="sierra-") as folder, disk_errors(Path(folder)):
            return super().read(list(self._converted(files, Path(folder))))

    def _converted(self, files: Sequence[Written], folder: Path) -> Iterator[Written]:
        """Yield the files as Parquet files; note the faults of others."""
        for number, file in enumerate(files):
            target = folder / f"{number}.parquet"
            try:
                with target.open("wb") as stream:
                    write_parquet(self._present(self._reader.read(Path(file.path))), stream)
            except UnreadableError as error:
                if lacking(error) in PASSING:
                    check_shortage(error)
                self.fault(file, _one_line(str(error) or "cannot be read"))
            except OSError:
                raise
            except Exception as error:
                message = f"the reader {self.shape.format!r} failed: {type(error).__name__}: {error}"
                self.fault(file, _one_line(message))
            else:
                yield replace(file, path=str(target))

    def _present(self, columns: Columns) -> Columns:
        """Return the columns without the values that stand for missing ones, which may be of another type than the others."""
        if not self._missing:
            return columns
        has = self._missing.has_value
        return {
            name: [None if has(value) else value for value in values] if isinstance(values, list) else values
            for name, values in columns.items()
        }


def write_parquet(columns: Columns | pa.Table, target: BinaryIO) -> None:
    """Write a table as Parquet. A column without any value is BOOLEAN, which every other type can hold."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = columns if isinstance(columns, pa.Table) else pa.table(dict(columns))
    for index, field in enumerate(table.schema):
        if pa.types.is_null(field.type):
            empty = pa.nulls(len(table), pa.bool_())
            table = table.set_column(index, field.name, empty)
    pq.write_table(table, target)


def durations_in(schema: bytes) -> dict[str, str]:
    """Return the columns of durations in an Arrow schema in base64, with their units; "" if they are within other values."""
    import base64

    import pyarrow as pa

    try:
        fields = pa.ipc.read_schema(pa.py_buffer(base64.b64decode(schema)))
    except (pa.ArrowException, OSError, ValueError):
        return {}
    units = {field.name: _unit(field.type) for field in fields}
    return {name: unit for name, unit in units.items() if unit is not None}


def _unit(kind: pa.DataType) -> str | None:
    """Return the unit of a type of durations, "" if a part of the type is one, and None otherwise."""
    import pyarrow as pa

    if pa.types.is_duration(kind):
        return str(kind.unit)
    if pa.types.is_dictionary(kind) or pa.types.is_run_end_encoded(kind):
        return _unit(kind.value_type)
    parts = [kind.field(place).type for place in range(kind.num_fields)] if pa.types.is_nested(kind) else []
    return "" if any(_unit(part) is not None for part in parts) else None


def _kind(kind: str) -> str:
    return DURATION if kind.startswith(DURATION) else kind_of(kind)


def _cast(column: str, kind: str) -> str:
    """Return the SQL expression for a column in its type; durations become nanoseconds."""
    if kind.startswith(DURATION):
        return f"CAST({column}::HUGEINT * {NANOSECONDS[kind.rpartition(' ')[2]]} AS BIGINT)"
    return f"CAST({column} AS {kind})"


def _one_line(text: str) -> str:
    return " ".join(text.split())
