"""What runs wrote becomes tables: many files at once, each checked, none averaged away.

All files of one output are read by one statement where they are as they should be. Where one is not, each is
looked at alone, and the fault is said with its line. A file is at fault if

- its columns are not those that most of its siblings have,
- a line has too few or too many fields, or its last line is cut short,
- there is text where its siblings have numbers,
- it cannot be read at all.

Whole numbers are BIGINT, other numbers DOUBLE, `true`/`false` BOOLEAN, all else VARCHAR; an empty field is
NULL. A column called as one of ours gets a trailing underscore.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sierra.store.tables import BESIDE_OUTPUTS

DELIMITERS = (",", "\t", ";", "|")


@dataclass(frozen=True, slots=True)
class Written:
    """One file that an execution wrote, and that belongs to a table."""

    path: str
    run: str
    execution: str
    name: str
    """Its path in the output folder."""
    head: str
    lines: int
    ended: bool
    bytes: int


@dataclass(frozen=True, slots=True)
class Shape:
    """How the files of one output are to be read: as declared, or as the first files were found to be."""

    format: Literal["csv", "parquet", "jsonl"]
    delimiter: str = ""
    header: bool = True
    names: tuple[str, ...] = ()
    """Column names, where known already."""
    many: bool = False
    """Whether a run writes several such files; the table then has the column `file`."""
    types: Mapping[str, str] | None = None
    """Types that earlier files had."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What came of it: rows by execution and file, faults by execution, and the shape that further files must have."""

    rows: Mapping[tuple[str, str], int]
    faults: Mapping[str, str]
    shape: Shape


def read(connection: Any, files: Sequence[Written], shape: Shape, target: Path) -> Reading:
    """Read all files into one Parquet file, without those of executions that are at fault."""
    match shape.format:
        case "csv":
            return _Csv(connection, shape).read(files, target)
        case "parquet":
            return _Typed(connection, shape, "read_parquet").read(files, target)
        case "jsonl":
            return _Typed(connection, shape, "read_json").read(files, target)


def delimiter_of(head: str) -> str:
    """The delimiter that occurs most often in a header line; a comma where none does."""
    return max(DELIMITERS, key=lambda d: (head.count(d), d == ","))


def quote(text: str) -> str:
    """A text as an SQL literal."""
    return "'" + text.replace("'", "''") + "'"


def identifier(name: str) -> str:
    """A name as an SQL identifier."""
    return '"' + name.replace('"', '""') + '"'


def column_name(name: str) -> str:
    """The name that a column of a run's output has in the store."""
    return name + "_" if name.lower() in BESIDE_OUTPUTS else name


class _Reader:
    """What all formats have in common: writing what is sound, counting it, and noting what is not."""

    def __init__(self, connection: Any, shape: Shape) -> None:
        self.sql = connection
        self.shape = shape
        self.faults: dict[str, str] = {}

    def fault(self, file: Written, what: str) -> None:
        self.faults.setdefault(file.execution, f"{file.name}: {what}")

    def sound(self, files: Iterable[Written]) -> list[Written]:
        return [file for file in files if file.execution not in self.faults]

    def write(self, files: Sequence[Written], source: str, columns: Sequence[str], target: Path) -> None:
        """Copy the rows that `source` (a table function on $files) gives, with whose they are."""
        import pyarrow as pa

        owners = pa.table(
            {
                "path": [file.path for file in files],
                "run": [file.run for file in files],
                "execution": [file.execution for file in files],
                "name": [file.name for file in files],
            }
        )
        named = ", ".join(f"t.{identifier(column)} AS {identifier(column_name(column))}" for column in columns)
        name = "o.name AS file, " if self.shape.many else ""
        self.sql.register("owners", owners)
        try:
            self.sql.execute(
                f"COPY (SELECT o.run, o.execution, {name}{named} FROM {source} t JOIN owners o ON t.filename = o.path) "
                f"TO {quote(str(target))} (FORMAT parquet, COMPRESSION zstd)",
                {"files": [file.path for file in files]},
            )
        finally:
            self.sql.unregister("owners")

    def count(self, files: Sequence[Written], target: Path) -> dict[tuple[str, str], int]:
        """Rows by execution and file, as they were written."""
        rows = {(file.execution, file.name): 0 for file in files}
        name = "file" if self.shape.many else "NULL"
        only = {file.execution: file.name for file in files}
        statement = f"SELECT execution, {name}, count(*) FROM read_parquet({quote(str(target))}) GROUP BY ALL"
        for execution, file, count in self.sql.execute(statement).fetchall():
            rows[execution, only[execution] if file is None else file] = count
        return rows


class _Csv(_Reader):
    """Delimited text."""

    def read(self, files: Sequence[Written], target: Path) -> Reading:
        files = [file for file in files if self._whole(file)]
        names, delimiter = self._columns(files)
        files = self.sound(files)
        shape = Shape("csv", delimiter, self.shape.header, names, self.shape.many, self.shape.types)
        if not files or not names:
            return Reading({}, self.faults, shape)
        types = dict(self.shape.types or self._types(files, names, delimiter))
        while True:
            try:
                self.write(files, self._source(types, delimiter), names, target)
                break
            except self._error() as error:
                types = self._diagnose(files, types, delimiter, error)
                files = self.sound(files)
                if not files:
                    return Reading({}, self.faults, shape)
        shape = Shape("csv", delimiter, self.shape.header, names, self.shape.many, types)
        rows = self.count(files, target)
        self._cross_check(files, rows)
        if not self.sound(files) or len(self.sound(files)) < len(files):
            files = self.sound(files)
            if not files:
                target.unlink()
                return Reading({}, self.faults, shape)
            self.write(files, self._source(types, delimiter), names, target)
            rows = self.count(files, target)
        return Reading(rows, self.faults, shape)

    def _whole(self, file: Written) -> bool:
        if file.bytes == 0 and self.shape.header:
            self.fault(file, "is empty; not even a header")
            return False
        return True

    def _columns(self, files: Sequence[Written]) -> tuple[tuple[str, ...], str]:
        """The columns that most files have (of the known ones, where they are known); the others are at fault."""
        if not files:
            return self.shape.names, self.shape.delimiter
        heads = Counter(file.head.rstrip("\r").removeprefix("\ufeff") for file in files)
        if not self.shape.header:
            delimiter = self.shape.delimiter or delimiter_of(heads.most_common(1)[0][0])
            width = max(len(split(head, delimiter)) for head in heads)
            names = self.shape.names or tuple(f"column{number}" for number in range(width))
            return names, delimiter
        likely = max(heads, key=lambda head: (heads[head], len(head)))
        delimiter = self.shape.delimiter or delimiter_of(likely)
        names = self.shape.names or split(likely, delimiter)
        for file in files:
            has = split(file.head.rstrip("\r").removeprefix("\ufeff"), delimiter)
            if has != names:
                self.fault(file, "line 1: " + difference(has, names))
        doubled = [name for name, count in Counter(map(column_name, map(str.lower, names))).items() if count > 1]
        for file in files if doubled else ():
            self.fault(file, f"line 1: the column {doubled[0]!r} is there twice")
        return names, delimiter

    def _types(self, files: Sequence[Written], names: Sequence[str], delimiter: str) -> Mapping[str, str]:
        """Each column's type, as a sample of the files has it; a text column is looked at in all of them."""
        sample = [files[place] for place in sorted({0, len(files) // 2, len(files) - 1})]
        types = self._narrowest([file.path for file in sample], names, delimiter)
        return self._majority(files, names, delimiter, types)

    def _majority(
        self, files: Sequence[Written], names: Sequence[str], delimiter: str, types: Mapping[str, str]
    ) -> Mapping[str, str]:
        """For columns with text somewhere: numbers, if most files have nothing but numbers there."""
        texts = [name for name in names if types[name] == "VARCHAR"]
        if not texts:
            return types
        checks = ", ".join(
            f"count({identifier(n)}) = count(TRY_CAST({identifier(n)} AS DOUBLE)) AND count({identifier(n)}) > 0" for n in texts
        )
        source = self._source(dict.fromkeys(names, "VARCHAR"), delimiter, tolerant=True)
        rows = self.sql.execute(
            f"SELECT {checks} FROM {source} GROUP BY filename", {"files": [file.path for file in files]}
        ).fetchall()
        result = dict(types)
        for place, name in enumerate(texts):
            numeric = sum(bool(row[place]) for row in rows)
            if numeric * 2 > len(rows):
                result[name] = "DOUBLE"
        return result

    def _narrowest(self, paths: Sequence[str], names: Sequence[str], delimiter: str) -> dict[str, str]:
        """The narrowest type that holds all of each column, in the given files."""
        source = self._source(dict.fromkeys(names, "VARCHAR"), delimiter, tolerant=True)
        columns = ", ".join(
            f"count({c}), count(*) FILTER (lower({c}) IN ('true', 'false')), "
            f"count(*) FILTER (regexp_full_match({c}, '[+-]?[0-9]{{1,18}}')), count(TRY_CAST({c} AS DOUBLE))"
            for c in map(identifier, names)
        )
        [row] = self.sql.execute(f"SELECT {columns} FROM {source}", {"files": list(paths)}).fetchall()
        types = {}
        for place, name in enumerate(names):
            present, logical, whole, number = row[4 * place : 4 * place + 4]
            fits = {"BOOLEAN": logical, "BIGINT": whole, "DOUBLE": number}
            types[name] = next((kind for kind, count in fits.items() if count == present > 0), "VARCHAR")
            if present == 0:
                types[name] = "DOUBLE"
        return types

    def _source(self, types: Mapping[str, str], delimiter: str, *, tolerant: bool = False) -> str:
        columns = ", ".join(f"{quote(name)}: {quote(kind)}" for name, kind in types.items())
        extra = ", null_padding = true, ignore_errors = true" if tolerant else ""
        return (
            f"read_csv($files, columns = {{{columns}}}, auto_detect = false, header = {str(self.shape.header).lower()}, "
            f"delim = {quote(delimiter)}, quote = '\"', escape = '\"', nullstr = '', filename = true, "
            f"strict_mode = true{extra})"
        )

    def _diagnose(
        self, files: Sequence[Written], types: dict[str, str], delimiter: str, error: Exception
    ) -> dict[str, str]:
        """Find the files at fault, or the whole numbers that elsewhere have a fraction; the types to go on with."""
        self.sql.execute("DROP TABLE IF EXISTS reject_errors; DROP TABLE IF EXISTS reject_scans")
        paths = {file.path: file for file in files}
        source = self._source(types, delimiter)[:-1] + ", store_rejects = true)"
        try:
            self.sql.execute(f"SELECT count(*) FROM (SELECT * FROM {source})", {"files": list(paths)}).fetchall()
            self.sql.execute(
                f"CREATE OR REPLACE TEMP TABLE tried AS SELECT * FROM {source}", {"files": list(paths)}
            )
            rejects = self.sql.execute(
                "SELECT s.file_path, e.line, e.column_name, e.error_type::VARCHAR, e.csv_line, e.error_message "
                "FROM reject_errors e JOIN reject_scans s USING (scan_id, file_id) ORDER BY ALL"
            ).fetchall()
        except self._error():
            rejects = []
        finally:
            for table in ("tried", "reject_errors", "reject_scans"):
                self.sql.execute(f"DROP TABLE IF EXISTS {table}")
        widened = self._widened(rejects, types, files, delimiter)
        if widened != types:
            return widened
        before = len(self.faults)
        for path, line, column, kind, text, message in rejects:
            self.fault(paths[path], f"line {line}: " + complaint(column, kind, text, message, types))
        if len(self.faults) == before:
            self._one_by_one(files, types, delimiter, error)
        return types

    def _widened(
        self, rejects: Sequence[tuple[Any, ...]], types: dict[str, str], files: Sequence[Written], delimiter: str
    ) -> dict[str, str]:
        """Types with BIGINT made DOUBLE (BOOLEAN made VARCHAR) where all that was refused fits that."""
        result = dict(types)
        for column in {reject[2] for reject in rejects if reject[3] == "CAST"}:
            if types.get(column) not in ("BIGINT", "BOOLEAN"):
                continue
            source = self._source(dict.fromkeys(types, "VARCHAR"), delimiter, tolerant=True)
            c = identifier(column)
            good = self.sql.execute(
                f"SELECT count({c}) = count(TRY_CAST({c} AS DOUBLE)) FROM {source} GROUP BY filename",
                {"files": [file.path for file in files]},
            ).fetchall()
            if sum(bool(row[0]) for row in good) * 2 > len(good):
                result[column] = "DOUBLE"
            elif types[column] == "BOOLEAN":
                result[column] = "VARCHAR"
        return result

    def _one_by_one(self, files: Sequence[Written], types: Mapping[str, str], delimiter: str, error: Exception) -> None:
        """The last resort: whoever cannot be read alone is at fault; if all can, the statement's error is."""
        before = len(self.faults)
        for file in files:
            try:
                self.sql.execute(
                    f"SELECT count(COLUMNS(*)) FROM {self._source(types, delimiter)}", {"files": [file.path]}
                ).fetchall()
            except self._error() as alone:
                self.fault(file, first_line(alone))
        if len(self.faults) == before:
            raise error

    def _cross_check(self, files: Sequence[Written], rows: Mapping[tuple[str, str], int]) -> None:
        """A last line without its line feed is suspicious where siblings have one."""
        cut = [file for file in files if not file.ended]
        if cut and len(cut) * 2 < len(files):
            for file in cut:
                self.fault(file, f"line {file.lines + 1}: its last line is cut short (no line feed at its end)")

    def _error(self) -> type[Exception]:
        import duckdb

        error: type[Exception] = duckdb.Error
        return error


class _Typed(_Reader):
    """Formats that know their types: Parquet, JSON lines."""

    def __init__(self, connection: Any, shape: Shape, function: str) -> None:
        super().__init__(connection, shape)
        self._function = function

    def read(self, files: Sequence[Written], target: Path) -> Reading:
        import duckdb

        shapes: dict[str, tuple[tuple[str, str], ...]] = {}
        for file in files:
            try:
                shapes[file.path] = self._describe(file)
            except duckdb.Error as error:
                self.fault(file, first_line(error))
        files = self.sound(files)
        if not files:
            return Reading({}, self.faults, self.shape)
        names = self.shape.names or self._likely([tuple(n for n, _ in shapes[file.path]) for file in files])
        kinds = self.shape.types or self._kinds(names, [dict(shapes[file.path]) for file in files])
        for file in files:
            self._compare(file, shapes[file.path], names, kinds)
        files = self.sound(files)
        shape = Shape(self.shape.format, names=tuple(names), many=self.shape.many, types=kinds)
        if not files:
            return Reading({}, self.faults, shape)
        casts = ", ".join(f"CAST({identifier(n)} AS {kinds[n]}) AS {identifier(n)}" for n in names)
        self.write(files, f"(SELECT {casts}, filename FROM {self._source()})", names, target)
        return Reading(self.count(files, target), self.faults, shape)

    def _source(self) -> str:
        extra = ", format = 'newline_delimited'" if self._function == "read_json" else ""
        return f"{self._function}($files, filename = true, union_by_name = true{extra})"

    def _describe(self, file: Written) -> tuple[tuple[str, str], ...]:
        rows = self.sql.execute(f"DESCRIBE SELECT * FROM {self._source()}", {"files": [file.path]}).fetchall()
        self.sql.execute(f"SELECT count(COLUMNS(*)) FROM {self._source()}", {"files": [file.path]}).fetchall()
        return tuple((row[0], row[1]) for row in rows if row[0] != "filename")

    def _likely(self, candidates: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
        counts = Counter(candidates)
        return max(counts, key=lambda names: (counts[names], len(names)))

    def _kinds(self, names: Sequence[str], found: Sequence[Mapping[str, str]]) -> dict[str, str]:
        kinds = {}
        for name in names:
            counts = Counter(shape[name] for shape in found if name in shape)
            numeric = {kind for kind in counts if is_number(kind)}
            kinds[name] = "DOUBLE" if len(numeric) > 1 and sum(counts[k] for k in numeric) * 2 > len(found) else (
                counts.most_common(1)[0][0]
            )
        return kinds

    def _compare(self, file: Written, shape: Sequence[tuple[str, str]], names: Sequence[str], kinds: Mapping[str, str]) -> None:
        has = tuple(name for name, _ in shape)
        if set(has) != set(names):
            self.fault(file, difference(has, tuple(names)))
            return
        for name, kind in shape:
            if kind != kinds[name] and not (is_number(kind) and is_number(kinds[name])):
                self.fault(file, f"column {name!r} is {kind} where its siblings have {kinds[name]}")


def is_number(kind: str) -> bool:
    return kind.startswith(("DECIMAL", "BIGINT", "INT", "DOUBLE", "FLOAT", "UBIGINT", "UINT", "HUGEINT", "SMALLINT", "TINYINT"))


def split(head: str, delimiter: str) -> tuple[str, ...]:
    """The fields of a header line."""
    import csv

    return tuple(field.strip() for field in next(csv.reader([head], delimiter=delimiter), []))


def difference(has: tuple[str, ...], names: tuple[str, ...]) -> str:
    """What is wrong with a file's columns, seen from its siblings'."""
    missing = [name for name in names if name not in has]
    extra = [name for name in has if name not in names]
    parts = []
    if missing:
        parts.append(f"lacks the column {', '.join(map(repr, missing))}")
    if extra:
        parts.append(f"has the further column {', '.join(map(repr, extra))}")
    return (" and ".join(parts) or "has its columns in another order") + " (its siblings have " + ", ".join(names) + ")"


def complaint(column: str | None, kind: str, text: str | None, message: str, types: Mapping[str, str]) -> str:
    """One refused line, in words."""
    match kind:
        case "CAST":
            return f"text where numbers are in column {column!r}: {(text or '').strip()[:80]!r}"
        case "MISSING COLUMNS":
            return f"too few fields: {(text or '').strip()[:80]!r}"
        case "TOO MANY COLUMNS":
            return f"too many fields: {(text or '').strip()[:80]!r}"
        case _:
            return message.splitlines()[0][:160]


def first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:200]
