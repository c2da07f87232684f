"""What runs wrote becomes tables: many files at once, each checked, none averaged away.

All files of one output are read by one statement where they are as they should be. Where one is not, those at fault
are found by halving, and the fault is said with its line. A file is at fault if

- its columns are not those that most of its siblings have,
- a line has too few or too many fields, or its last line is cut short,
- there is text where at least half of its siblings have nothing but numbers,
- it cannot be read at all.

Whole numbers are BIGINT (DECIMAL(38,0) where they are too great), other numbers DOUBLE, `true`/`false` BOOLEAN, all else
VARCHAR; an empty field is NULL, and a column without any value BOOLEAN, which every other type can hold. A type is taken
from a few files, but checked in all: DuckDB would round 1.5 to be a BIGINT and call 1 true. JSON's lists and objects are
kept as JSON. A column called as one of ours, or as another but for case, gets a trailing underscore.
"""

from __future__ import annotations

import csv
import io
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from sierra.errors import Missing
from sierra.store.tables import BESIDE_OUTPUTS

DELIMITERS = (",", "\t", ";", "|")
FILE = "# file"
"""What DuckDB calls the file that a row is from: no name that a column is likely to have."""
HEAD_BYTES = 4096
"""So much of a first line a worker tells."""
WHOLE = r" *([+]?[0-9]+|-0*[1-9][0-9]*) *"
"""-0 is a number, but no whole one: a BIGINT has no such zero."""
LOGICAL = r" *(?i:true|false) *"
IN_ONE_GO = 4 << 20
"""Larger JSON files are read in pieces, which several threads would put in any order."""
AT_ONCE = 50
"""Columns that one statement looks at: what DuckDB needs to plan it grows with their square."""
HUGE = "DECIMAL(38,0)"
NUMBERS = ("BIGINT", HUGE, "DOUBLE")


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
    """How the files of one output are to be read: as declared, and as earlier files were found to be."""

    format: Literal["csv", "parquet", "jsonl"]
    delimiter: str = ""
    header: bool = True
    names: tuple[str, ...] = ()
    """Column names, where known already."""
    many: bool = False
    """Whether a run writes several such files; the table then has the column `file`."""
    types: Mapping[str, str] | None = None
    """Types that earlier files had."""
    files: int = 0
    """How many files were read before; they have a vote on what is right."""
    ended: int = 0
    """How many of them had a line feed at their end."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What came of it: rows by execution and file, faults by execution, and the shape that was found."""

    rows: Mapping[tuple[str, str], int]
    faults: Mapping[str, str]
    shape: Shape


def read(connection: Any, files: Sequence[Written], shape: Shape, target: Path) -> Reading:
    """Read all files into one Parquet file, without those of executions that are at fault.

    Raises Missing where what is sound cannot be written.
    """
    connection.execute("SET disabled_optimizers = 'join_order,build_side_probe_side'")  # rows keep their order
    readers: Mapping[str, type[_Reader]] = {"csv": _Csv, "parquet": _Parquet, "jsonl": _Jsonl}
    return readers[shape.format](connection, shape, target).read(files)


def kinds(shape: Shape) -> dict[str, str]:
    """What each column of a table holds, in a word: what must be the same for all siblings."""
    types = shape.types or {}
    return {name: kind_of(types.get(name, "BOOLEAN")) for name in shape.names}


def kind_of(kind: str) -> str:
    """number, text, flag, or the type itself."""
    if is_number(kind):
        return "number"
    return {"VARCHAR": "text", "BOOLEAN": "flag"}.get(kind, kind)


def is_number(kind: str) -> bool:
    return kind.startswith(("DECIMAL", "DOUBLE", "FLOAT")) or kind.rstrip("0123456789").removeprefix("U").endswith("INT")


def delimiter_of(head: str) -> str:
    """The delimiter that occurs most often in a header line, outside quotes; a comma where none does."""
    bare = re.sub(r'"[^"]*"', "", head)
    return max(DELIMITERS, key=lambda d: (bare.count(d), d == ","))


def quote(text: str) -> str:
    """A text as an SQL literal."""
    return "'" + text.replace("'", "''") + "'"


def identifier(name: str) -> str:
    """A name as an SQL identifier."""
    return '"' + name.replace('"', '""') + '"'


def column_names(names: Sequence[str], taken: Iterable[str] = BESIDE_OUTPUTS) -> tuple[str, ...]:
    """The names that the columns of a run's output have in the store, where case makes no difference."""
    seen = {name.lower() for name in taken}
    kept = []
    for number, name in enumerate(names):
        free = name or f"column{number}"
        while free.lower() in seen:
            free += "_"
        seen.add(free.lower())
        kept.append(free)
    return tuple(kept)


class _Reader:
    """What all formats have in common: writing what is sound, counting it, and noting what is not."""

    def __init__(self, connection: Any, shape: Shape, target: Path) -> None:
        import duckdb

        self.sql = connection
        self.shape = shape
        self.target = target
        self.faults: dict[str, str] = {}
        self.error: type[Exception] = duckdb.Error

    def read(self, files: Sequence[Written]) -> Reading:
        raise NotImplementedError

    def fault(self, file: Written, what: str) -> None:
        self.faults.setdefault(file.execution, f"{shown(file.name)}: {what}")

    def sound(self, files: Iterable[Written]) -> list[Written]:
        return [file for file in files if file.execution not in self.faults]

    def done(self, files: Sequence[Written], names: Sequence[str], types: Mapping[str, str], **found: Any) -> Reading:
        """What was read: `files`, with `names` and `types`."""
        shape = replace(
            self.shape,
            names=tuple(names),
            types=dict(types),
            files=self.shape.files + len(files),
            ended=self.shape.ended + sum(file.ended for file in files),
            **found,
        )
        return Reading(self.count(files), self.faults, shape)

    def halve(self, files: Sequence[Written], attempt: Callable[[Sequence[Written]], Any], explain: Callable[..., str]) -> None:
        """Find the files with which `attempt` fails; they are at fault."""
        try:
            if files:
                attempt(files)
        except self.error as error:
            if len(files) == 1:
                self.fault(files[0], explain(files[0], error))
            else:
                for half in (files[: len(files) // 2], files[len(files) // 2 :]):
                    self.halve(half, attempt, explain)

    def write(self, files: Sequence[Written], source: str, columns: Mapping[str, str]) -> None:
        """Copy the rows that `source` (a relation on $files) gives, with whose they are; expressions by name."""
        import pyarrow as pa

        owners = pa.table(
            {
                "path": [file.path for file in files],
                "run": [file.run for file in files],
                "execution": [file.execution for file in files],
                "name": [shown(file.name) for file in files],
            }
        )
        named = ", ".join(
            f"{expression} AS {identifier(name)}"
            for name, expression in zip(column_names(list(columns)), columns.values(), strict=True)
        )
        name = "o.name AS file, " if self.shape.many else ""
        self.sql.register("owners", owners)
        try:
            self.sql.execute(
                f"COPY (SELECT o.run, o.execution, {name}{named} FROM {source} t "
                f"JOIN owners o ON t.{identifier(FILE)} = o.path) "
                f"TO {quote(str(self.target))} (FORMAT parquet, COMPRESSION zstd)",
                _these(files),
            )
        except self.error:
            self.target.unlink(missing_ok=True)
            raise
        finally:
            self.sql.unregister("owners")

    def count(self, files: Sequence[Written]) -> dict[tuple[str, str], int]:
        """Rows by execution and file, as they were written."""
        rows = {(file.execution, file.name): 0 for file in files}
        if self.target.exists():
            name = "file" if self.shape.many else "NULL"
            only = {(file.execution, shown(file.name) if self.shape.many else None): file.name for file in files}
            statement = f"SELECT execution, {name}, count(*) FROM read_parquet({quote(str(self.target))}) GROUP BY ALL"
            for execution, file, count in self.sql.execute(statement).fetchall():
                rows[execution, only[execution, file]] = count
        return rows

    def fetch(self, statement: str, files: Sequence[Written]) -> list[tuple[Any, ...]]:
        rows: list[tuple[Any, ...]] = self.sql.execute(statement, _these(files)).fetchall() if files else []
        return rows

    def unwritten(self, error: Exception) -> Missing:
        return Missing(f"cannot write to {self.target.parent}: {first_line(error)}")

    def likely(self, candidates: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
        """The columns that most files have, those read earlier included; of two that as many have, the more."""
        counts = Counter(candidates)
        if self.shape.files and self.shape.names:
            counts[self.shape.names] += self.shape.files
        return max(counts, key=lambda names: (counts[names], len(names)))


class _Text(_Reader):
    """Formats whose fields are texts: what the texts of a column look like decides its type."""

    def relation(self, names: Sequence[str], types: Mapping[str, str]) -> str:
        """A relation on $files with the columns c0, c1, … and the file; those that may be VARCHAR or as in `types`."""
        raise NotImplementedError

    def text(self, cell: str) -> str:
        """The text that a cell holds, where its column is a column of texts."""
        return cell

    def first_fault(self, file: Written, names: Sequence[str], types: Mapping[str, str]) -> str | None:
        """The first line of a file that is not as it should be, found the slow way."""
        raise NotImplementedError

    def table(self, files: Sequence[Written], names: Sequence[str], **found: Any) -> Reading:
        """Read files that have these columns."""
        try:
            types = self._types(files, names)
            files = self.sound(files)
            self._write(files, names, types)
        except self.error:
            texts = dict.fromkeys(names, "VARCHAR")

            def explain(file: Written, error: Exception) -> str:
                return self.first_fault(file, names, texts) or first_line(error)

            self.halve(files, lambda some: self._try(some, names), explain)
            types = self._agreed(self.sound(files), names)
            files = self.sound(files)
            try:
                self._write(files, names, types)
            except self.error as error:
                raise self.unwritten(error) from error
        if not files:
            return Reading({}, self.faults, self.shape)
        return self.done(files, names, types, **found)

    def _write(self, files: Sequence[Written], names: Sequence[str], types: Mapping[str, str]) -> None:
        if not files:
            return
        columns = {name: self._typed(f"t.c{place}", types[name]) for place, name in enumerate(names)}
        self.write(files, self.relation(names, types), columns)

    def _typed(self, cell: str, kind: str) -> str:
        """A cell as a value of its column's type; what does not fit is an error, never rounded."""
        match kind:
            case "VARCHAR":
                return self.text(cell)
            case "DOUBLE":
                return f"CAST({cell} AS DOUBLE)"
            case "BOOLEAN":
                sound = f"regexp_full_match({cell}, {quote(LOGICAL)})"
                value = f"CAST(trim({cell}) AS BOOLEAN)"
            case _:
                sound = f"regexp_full_match({cell}, {quote(WHOLE)})"
                value = f"CAST({cell} AS {kind})"
        return f"CASE WHEN {cell} IS NULL THEN NULL WHEN {sound} THEN {value} ELSE error('not {kind}') END"

    def _try(self, files: Sequence[Written], names: Sequence[str]) -> None:
        relation = self.relation(names, dict.fromkeys(names, "VARCHAR"))
        self.fetch(f"SELECT count(COLUMNS(*)) FROM {relation}", files)

    def _types(self, files: Sequence[Written], names: Sequence[str]) -> dict[str, str]:
        """Each column's type, as a sample of the files has it; where that leaves a doubt, as all have it."""
        sample = [files[place] for place in sorted({0, len(files) // 2, len(files) - 1})]
        found = self._seen(sample, names)
        known = self.shape.types or {}
        doubtful = []
        for name in names:
            seen = {kind for kind in found[name].values() if kind}
            sure = seen and "VARCHAR" not in seen
            other = known.get(name) == "VARCHAR"
            if other or not sure:
                doubtful.append(name)
        if doubtful and len(sample) < len(files):
            found |= self._seen(files, names, doubtful)
        return self._decided(names, found, self._at_fault(files, names, found))

    def _agreed(self, files: Sequence[Written], names: Sequence[str]) -> dict[str, str]:
        """Each column's type, as all of the files have it; those that have something else are at fault."""
        found = self._seen(files, names)
        return self._decided(names, found, self._at_fault(files, names, found))

    def _decided(self, names: Sequence[str], found: Mapping[str, Mapping[str, str | None]], bad: set[str]) -> dict[str, str]:
        types = {}
        for name in names:
            kinds = {kind for path, kind in found[name].items() if kind and path not in bad}
            types[name] = _common(kinds, (self.shape.types or {}).get(name))
        return types

    def _at_fault(
        self, files: Sequence[Written], names: Sequence[str], found: Mapping[str, Mapping[str, str | None]]
    ) -> set[str]:
        """The files with text where at least half have nothing but numbers; they are noted."""
        bad: set[str] = set()
        by_path = {file.path: file for file in files}
        numeric = dict.fromkeys(names, "VARCHAR")
        for name in names:
            seen = {path: kind for path, kind in found[name].items() if kind}
            numbers = sum(kind in NUMBERS for kind in seen.values())
            others = len(seen) - numbers
            known = (self.shape.types or {}).get(name)
            numbers += self.shape.files if known in NUMBERS else 0
            others += self.shape.files if known == "VARCHAR" else 0
            if numbers and numbers >= others:
                numeric[name] = "DOUBLE"
                bad |= {path for path, kind in seen.items() if kind not in NUMBERS}
        for path in sorted(bad):
            what = self.first_fault(by_path[path], names, numeric)
            self.fault(by_path[path], what or "has text where its siblings have numbers")
        return bad

    def _seen(
        self, files: Sequence[Written], names: Sequence[str], wanted: Sequence[str] | None = None
    ) -> dict[str, dict[str, str | None]]:
        """The narrowest type that holds all of a column, by column and file; None where it has no value."""
        wanted = names if wanted is None else wanted
        relation = self.relation(names, dict.fromkeys(names, "VARCHAR"))
        found: dict[str, dict[str, str | None]] = {name: {} for name in wanted}
        for at in range(0, len(wanted), AT_ONCE):
            some = wanted[at : at + AT_ONCE]
            columns = ", ".join(f"bit_or({_bit(f'c{names.index(name)}')})" for name in some)
            for path, *seen in self.fetch(f"SELECT {identifier(FILE)}, {columns} FROM {relation} GROUP BY 1", files):
                for name, bits in zip(some, seen, strict=True):
                    found[name][path] = _narrowest(bits or 0)
        return found


def _bit(cell: str) -> str:
    """Which kind of text a cell holds: one bit each; none where it is empty."""
    whole = f"regexp_full_match({cell}, {quote(WHOLE)})"
    return (
        f"CASE WHEN {cell} IS NULL THEN 0 WHEN {whole} AND TRY_CAST({cell} AS BIGINT) IS NOT NULL THEN 2 "
        f"WHEN {whole} AND TRY_CAST({cell} AS {HUGE}) IS NOT NULL THEN 4 WHEN TRY_CAST({cell} AS DOUBLE) IS NOT NULL THEN 8 "
        f"WHEN regexp_full_match({cell}, {quote(LOGICAL)}) THEN 1 ELSE 16 END"
    )


def _narrowest(bits: int) -> str | None:
    """The narrowest type that holds all of these kinds."""
    if bits in (0, 1):
        return "BOOLEAN" if bits else None
    if bits & 17:
        return "VARCHAR"
    return "DOUBLE" if bits & 8 else HUGE if bits & 4 else "BIGINT"


def _common(kinds: set[str], known: str | None) -> str:
    """The narrowest type that holds all of these."""
    if not kinds:
        return known or "BOOLEAN"
    if len(kinds) == 1:
        [kind] = kinds
        return "VARCHAR" if known == "VARCHAR" else kind
    if not kinds <= set(NUMBERS) or known == "VARCHAR":
        return "VARCHAR"
    return "DOUBLE" if "DOUBLE" in kinds else HUGE


class _Csv(_Text):
    """Delimited text."""

    def __init__(self, connection: Any, shape: Shape, target: Path) -> None:
        super().__init__(connection, shape, target)
        self._delimiter = shape.delimiter
        self._longest = 0

    def read(self, files: Sequence[Written]) -> Reading:
        files = [file for file in files if self._whole(file)]
        if not files:
            return Reading({}, self.faults, self.shape)
        names = self._columns(files)
        self._cut(files)
        files = self.sound(files)
        if not files:
            return Reading({}, self.faults, self.shape)
        if any(file.bytes >= 2_000_000 for file in files):
            self._longest = max(_longest_line(file) for file in files if file.bytes >= 2_000_000)
        return self.table(files, names, delimiter=self._delimiter)

    def relation(self, names: Sequence[str], types: Mapping[str, str]) -> str:
        columns = ", ".join(
            f"c{place}: {quote('DOUBLE' if types[name] == 'DOUBLE' else 'VARCHAR')}" for place, name in enumerate(names)
        )
        longest = f", max_line_size = {self._longest + 1}" if self._longest >= 2_000_000 else ""
        return (
            f"read_csv($files, columns = {{{columns}}}, auto_detect = false, header = {str(self.shape.header).lower()}, "
            f"delim = {quote(self._delimiter)}, quote = '\"', escape = '\"', nullstr = '', filename = {quote(FILE)}, "
            f"strict_mode = true{longest})"
        )

    def _whole(self, file: Written) -> bool:
        if file.bytes == 0 and self.shape.header:
            self.fault(file, "is empty; not even a header")
            return False
        return True

    def _columns(self, files: Sequence[Written]) -> tuple[str, ...]:
        """The columns that most files have; files with others are at fault."""
        heads = {file.path: _first_record(file) for file in files}
        if not self._delimiter:
            self._delimiter = delimiter_of(Counter(heads.values()).most_common(1)[0][0])
        if not self.shape.header:
            widths = Counter(len(split(head, self._delimiter)) for head in heads.values() if head)
            width = max(widths, key=lambda width: (widths[width], width), default=1)
            return self.shape.names or tuple(f"column{number}" for number in range(width))
        has = {head: split(head, self._delimiter) for head in set(heads.values())}
        names = self.likely(has[heads[file.path]] for file in files)
        if names and all(_is_number(name) for name in names):
            for file in files:
                self.fault(file, "line 1: numbers, no names of columns (if it has no header: header = false in [outputs.…])")
            return names
        doubled = [name for name, count in Counter(names).items() if count > 1 and name]
        for file in files:
            own = has[heads[file.path]]
            if own != names:
                self.fault(file, "line 1: " + difference(own, names))
            elif doubled:
                self.fault(file, f"line 1: the column {doubled[0]!r} is there twice")
        return names

    def _cut(self, files: Sequence[Written]) -> None:
        """A last line without its line feed is suspicious where at least half of the siblings have one."""
        cut = [file for file in files if not file.ended]
        ended = len(files) - len(cut) + self.shape.ended
        if ended >= len(cut) + self.shape.files - self.shape.ended:
            for file in cut:
                self.fault(file, f"line {file.lines + 1}: its last line is cut short (no line feed at its end)")

    def first_fault(self, file: Written, names: Sequence[str], types: Mapping[str, str]) -> str | None:
        ends = set()
        for line, record, end in _records(file, self._delimiter):
            if isinstance(record, str):
                return f"line {line}: {record}"
            if not record or (line == 1 and self.shape.header):
                continue
            text = self._delimiter.join(record)
            if any("\udc80" <= character <= "\udcff" for character in text):
                return f"line {line}: is not UTF-8: {shown(text)[:80]!r}"
            if len(record) != len(names) and not (len(record) == len(names) + 1 and not record[-1]):
                few = "too few" if len(record) < len(names) else "too many"
                return f"line {line}: {few} fields ({len(record)}, not {len(names)}): {text[:80]!r}"
            for name, field in zip(names, record, strict=False):
                if types[name] == "DOUBLE" and field and not _is_number(field):
                    return f"line {line}: text where numbers are in column {name!r}: {field[:80]!r}"
            ends.add(end)
        return "some lines end in CR LF, and some in LF" if len(ends) > 1 else None


class _Jsonl(_Text):
    """JSON lines: an object each."""

    def read(self, files: Sequence[Written]) -> Reading:
        if any(file.bytes >= IN_ONE_GO for file in files):
            self.sql.execute("SET threads = 1")
        try:
            return self._read(files)
        finally:
            self.sql.execute("RESET threads")

    def _read(self, files: Sequence[Written]) -> Reading:
        try:
            found = self._keys(files)
        except self.error:
            self.halve(files, self._keys, lambda file, error: self.first_fault(file, (), {}) or first_line(error))
            files = self.sound(files)
            found = self._keys(files) if files else {}
        candidates = [tuple(found[file.path]) for file in files if file.path in found]
        if not candidates:
            return Reading({(file.execution, file.name): 0 for file in files}, self.faults, self.shape)
        first = {frozenset(names): names for names in reversed(candidates)}
        names = self.likely(first[frozenset(names)] for names in candidates)
        for file in files:
            has = tuple(found.get(file.path, names))
            if set(has) != set(names):
                self.fault(file, difference(has, names))
        files = self.sound(files)
        return self.table(files, names) if files else Reading({}, self.faults, self.shape)

    def _keys(self, files: Sequence[Written]) -> dict[str, dict[str, None]]:
        """The keys that a file's objects have, by file."""
        rows = self.fetch(
            f"SELECT DISTINCT {identifier(FILE)}, CASE WHEN json_type(json) <> 'OBJECT' THEN error('not an object') "
            "WHEN len(json_keys(json)) <> len(list_distinct(json_keys(json))) THEN error('a key is there twice') "
            f"ELSE json_keys(json) END FROM {self._objects()}",
            files,
        )
        found: dict[str, dict[str, None]] = {}
        for path, keys in sorted(rows, key=lambda row: -len(row[1])):
            found.setdefault(path, {}).update(dict.fromkeys(keys))
        return found

    def _objects(self) -> str:
        return f"read_ndjson_objects($files, filename = {quote(FILE)})"

    def relation(self, names: Sequence[str], types: Mapping[str, str]) -> str:
        pointers = ("/" + name.replace("~", "~0").replace("/", "~1") for name in names)
        cells = ", ".join(
            f"nullif(json_extract(json, {quote(pointer)})::VARCHAR, 'null') AS c{place}"
            for place, pointer in enumerate(pointers)
        )
        return f"(SELECT {cells}, {identifier(FILE)} FROM {self._objects()})"

    def text(self, cell: str) -> str:
        return f"CASE WHEN starts_with({cell}, '\"') THEN json_extract_string({cell}, '$') ELSE {cell} END"

    def first_fault(self, file: Written, names: Sequence[str], types: Mapping[str, str]) -> str | None:
        import json

        with Path(file.path).open(encoding="utf-8", errors="surrogateescape") as lines:
            for line, text in enumerate(lines, 1):
                if not text.strip():
                    continue
                try:
                    pairs = json.loads(text, object_pairs_hook=_Pairs)
                except ValueError:
                    return f"line {line}: is cut short, or no JSON: {shown(text.strip())[:80]!r}"
                if not isinstance(pairs, _Pairs):
                    return f"line {line}: is not an object: {text.strip()[:80]!r}"
                doubled = [key for key, count in Counter(key for key, _ in pairs).items() if count > 1]
                if doubled:
                    return f"line {line}: the key {doubled[0]!r} is there twice"
                for key, value in pairs:
                    number = value is None or (isinstance(value, int | float) and not isinstance(value, bool))
                    if types.get(key) == "DOUBLE" and not number:
                        return f"line {line}: text where numbers are in column {key!r}: {str(value)[:80]!r}"
        return None


class _Pairs(list[tuple[str, Any]]):
    """A JSON object as it is written."""


class _Parquet(_Reader):
    """Parquet knows its types."""

    def read(self, files: Sequence[Written]) -> Reading:
        try:
            found = self._schemas(files)
        except self.error:
            files = self._readable(files)
            found = self._schemas(files) if files else {}
        if not files:
            return Reading({}, self.faults, self.shape)
        names = self.likely(tuple(found[file.path]) for file in files)
        types = {name: self._type(name, [found[file.path] for file in files]) for name in names}
        for file in files:
            self._compare(file, found[file.path], names, types)
        files = self.sound(files)
        if not files:
            return Reading({}, self.faults, self.shape)
        try:
            self._write(files, names, types)
        except self.error:
            files = self._readable(files)
            if not files:
                return Reading({}, self.faults, self.shape)
            try:
                self._write(files, names, types)
            except self.error as error:
                raise self.unwritten(error) from error
        return self.done(files, names, types)

    def _write(self, files: Sequence[Written], names: Sequence[str], types: Mapping[str, str]) -> None:
        self.write(files, self._source(), {name: f"CAST(t.{identifier(name)} AS {types[name]})" for name in names})

    def _source(self) -> str:
        return f"read_parquet($files, filename = {quote(FILE)}, union_by_name = true)"

    def _readable(self, files: Sequence[Written]) -> list[Written]:
        whole = f"SELECT count(COLUMNS(*)) FROM {self._source()}"
        self.halve(files, lambda some: self.fetch(whole, some), lambda file, error: first_line(error))
        return self.sound(files)

    def _schemas(self, files: Sequence[Written]) -> dict[str, dict[str, str]]:
        """Names and types of each file's columns; files that say the same are asked once."""
        rows = self.fetch(
            "SELECT file_name, list((name, type, type_length, num_children, converted_type, scale, precision, logical_type)"
            "::VARCHAR) FROM parquet_schema($files) GROUP BY file_name",
            files,
        )
        by_path = {file.path: file for file in files}
        described: dict[tuple[str, ...], dict[str, str]] = {}
        found = {}
        for path, schema in rows:
            key = tuple(schema)
            if key not in described:
                columns = self.fetch(f"DESCRIBE SELECT * FROM {self._source()}", [by_path[path]])
                described[key] = {row[0]: row[1] for row in columns if row[0] != FILE}
            found[path] = described[key]
        return found

    def _type(self, name: str, found: Sequence[Mapping[str, str]]) -> str:
        counts = Counter(columns[name] for columns in found if name in columns)
        numbers = {kind for kind in counts if is_number(kind)}
        if len(numbers) > 1 and 2 * sum(counts[kind] for kind in numbers) >= sum(counts.values()):
            whole = all("INT" in kind for kind in numbers)
            return HUGE if whole and "UBIGINT" in numbers else "BIGINT" if whole else "DOUBLE"
        return max(counts, key=lambda kind: (counts[kind], is_number(kind)))

    def _compare(self, file: Written, has: Mapping[str, str], names: Sequence[str], types: Mapping[str, str]) -> None:
        if set(has) != set(names):
            self.fault(file, difference(tuple(has), tuple(names)))
            return
        for name, kind in has.items():
            if kind != types[name] and not (is_number(kind) and is_number(types[name])):
                self.fault(file, f"column {name!r} is {kind} where its siblings have {types[name]}")


def _these(files: Sequence[Written]) -> dict[str, list[str]]:
    return {"files": [file.path for file in files]}


def _first_record(file: Written) -> str:
    """The first line of a CSV, whole: a worker tells its beginning only, and a quoted name may hold a line feed."""
    head = file.head
    if len(head.encode()) < HEAD_BYTES - 4 and head.count('"') % 2 == 0:
        return head.removeprefix("\ufeff").partition("\r")[0]
    with Path(file.path).open(encoding="utf-8-sig", errors="replace", newline="") as text:
        line = next(text, "")
        while line.count('"') % 2 and (more := next(text, "")):
            line += more
    return line.rstrip("\r\n")


def _longest_line(file: Written) -> int:
    with Path(file.path).open("rb") as lines:
        return max(map(len, lines), default=0)


def _records(file: Written, delimiter: str) -> Iterator[tuple[int, list[str] | str, str]]:
    """The records of a CSV with the lines they begin in and how those end; at last what cannot be read, as a sentence."""
    before = csv.field_size_limit(sys.maxsize)
    ends: list[str] = []

    def lines(text: Iterable[str]) -> Iterator[str]:
        for line in text:
            ends.append("\r\n" if line.endswith("\r\n") else line[-1])
            yield line

    line = 1
    try:
        with Path(file.path).open(encoding="utf-8-sig", errors="surrogateescape", newline="") as text:
            if len(delimiter) != 1:
                for place, whole in enumerate(text, 1):
                    yield place, whole.rstrip("\r\n").split(delimiter), "\n"
                return
            reader = csv.reader(lines(text), delimiter=delimiter, strict=True)
            try:
                for record in reader:
                    yield line, record, "\n" if reader.line_num > line and not file.ended else _end(ends)
                    line = reader.line_num + 1
            except csv.Error as error:
                yield line, f"quotes are not closed, or not as CSV has them ({error})", ""
    finally:
        csv.field_size_limit(before)


def _end(ends: list[str]) -> str:
    """How the last line that was read ended; a last line without an end is like its forerunners."""
    end = ends[-1]
    return end if end in ("\n", "\r", "\r\n") else (ends[-2] if len(ends) > 1 else "\n")


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def split(head: str, delimiter: str) -> tuple[str, ...]:
    """The fields of a header line."""
    if len(delimiter) != 1:
        return tuple(field.strip() for field in head.split(delimiter))
    reader = csv.reader(io.StringIO(head, newline=""), delimiter=delimiter, skipinitialspace=True)
    return tuple(field.strip() for field in next(reader, []))


def difference(has: tuple[str, ...], names: tuple[str, ...]) -> str:
    """What is wrong with a file's columns, seen from its siblings'."""
    missing = [name for name in names if name not in has]
    extra = [name for name in has if name not in names]
    doubled = [name for name, count in Counter(has).items() if count > names.count(name) > 0]
    parts = []
    if missing:
        parts.append(f"lacks the column {', '.join(map(repr, missing))}")
    if extra:
        parts.append(f"has the further column {', '.join(map(repr, extra))}")
    if doubled:
        parts.append(f"has the column {doubled[0]!r} twice")
    return (" and ".join(parts) or "has its columns in another order") + " (its siblings have " + ", ".join(names) + ")"


def shown(path: str) -> str:
    """A file's name as text: bytes of it that are no UTF-8 as escapes."""
    return path.encode("utf-8", "backslashreplace").decode()


def first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:200]
