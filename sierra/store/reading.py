"""What runs wrote becomes tables: many files at once, each checked, none averaged away.

All files of one output that have the same columns make a *part*, which is one Parquet file: columns may differ between
experiments, and whether they may differ between two runs is not for here to say (see `sierra.record.find_odd`). A part
is read by one statement where all is as it should be. Where it is not, the files at fault are found by halving, and the
fault is said with its line. A file is at fault if a line has too few or too many fields, if its last line is cut short, or
if it cannot be read at all.

What a column holds (numbers, flags, texts) is no fault here, since it would depend on which files are read together: files
that hold other things go into Parquet files of their own, and `sierra.record.find_odd` judges. Where most of a file's
siblings have text, its numbers are kept as the texts that they are: 007 and 1e5 are other texts as numbers.

Whole numbers are BIGINT (DECIMAL(38,0) where they are too great), other numbers DOUBLE, `true`/`false` BOOLEAN, all else
VARCHAR; an empty field is NULL, and a column without any value BOOLEAN, which every other type can hold. A type is taken
from a few files, but checked in all: DuckDB would round 1.5 to be a BIGINT and call 1 true. JSON's lists and objects are
kept as JSON. A column called as one of ours, or as another but for case, gets a trailing underscore.
"""

from __future__ import annotations

import csv
import io
import math
import re
import sys
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from sierra.errors import Missing
from sierra.store.complaints import first_line
from sierra.store.tables import BESIDE_OUTPUTS
from sierra.wording import few

DELIMITERS = (",", "\t", ";", "|")
FILE = "# file"
"""What DuckDB calls the file that a row is from: no name that a column is likely to have."""
HEAD_BYTES = 4096
"""So much of a first line a worker tells."""
WHOLE = r" *([+]?[0-9]+|-0*[1-9][0-9]*) *"
"""-0 is a number, but no whole one: a BIGINT has no such zero."""
LOGICAL = r" *(?i:true|false) *"
CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f]")
"""Characters that no column's name has."""
FEW = 10
"""Names of columns that one line shows."""
AT_ONCE = 50
"""Columns that a statement looks at side by side: what DuckDB needs to plan it grows with their square."""
PARTS = 1000
"""Sets of columns that one output may have: each is a file in each segment, and files are not to multiply with runs."""
HUGE = "DECIMAL(38,0)"
EMPTY = '"NULL"'
"""What DuckDB calls the type of a Parquet column that says itself that it has no values."""
AS_TEXT = " as text"


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
class Part:
    """Those files of an output that have the same columns."""

    names: tuple[str, ...]
    delimiter: str = ""


@dataclass(frozen=True, slots=True)
class Shape:
    """How the files of one output are to be read: as declared, and as earlier files were found to be."""

    format: Literal["csv", "parquet", "jsonl"]
    delimiter: str = ""
    """Of a CSV; found out, for each part, where it is empty."""
    header: bool = True
    names: tuple[str, ...] = ()
    """The columns of a CSV without header, where they are declared."""
    many: bool = False
    """Whether a run writes several such files; the table then has the column `file`."""
    parts: tuple[Part, ...] = ()
    files: int = 0
    """How many files were read before."""
    ended: int = 0
    """How many of them had a line feed at their end."""


Group = Hashable
"""An experiment, as a key."""


def _nobody(runs: Sequence[str]) -> tuple[Mapping[str, Group], Mapping[tuple[Group, str], Mapping[str, int]]]:
    return {}, {}


@dataclass(frozen=True, slots=True)
class Siblings:
    """What is known of files that were read before."""

    mixed: AbstractSet[str] = frozenset()
    """Columns in which some of them have something else than numbers."""
    ask: Callable[[Sequence[str]], tuple[Mapping[str, Group], Mapping[tuple[Group, str], Mapping[str, int]]]] = _nobody
    """Of runs: the experiment that each belongs to, and how many of its files have which kind in which column."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What came of it: rows and what columns hold, by execution and file; faults by execution; the shape that was found.

    What a column holds is number, text, flag, empty, or another type, and `number as text` where its siblings have text.
    """

    rows: Mapping[tuple[str, str], int]
    columns: Mapping[tuple[str, str], Mapping[str, str]]
    hints: Mapping[tuple[str, str], Mapping[str, str]]
    """By file and column, where text begins that most siblings read so far do not have."""
    faults: Mapping[str, str]
    shape: Shape


def read(connection: Any, files: Sequence[Written], shape: Shape, target: Path, siblings: Siblings | None = None) -> Reading:
    """Read all files, without those of executions that are at fault, into Parquet files: `target` and, where columns or
    what they hold differ, others beside it (`target~2`, …).

    Raises Missing where what is sound cannot be written.
    """
    connection.execute("SET disabled_optimizers = 'join_order,build_side_probe_side'")  # rows keep their order
    readers: Mapping[str, type[_Reader]] = {"csv": _Csv, "parquet": _Parquet, "jsonl": _Jsonl}
    return readers[shape.format](connection, shape, target, siblings or Siblings()).read(files)


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
    """What all formats have in common: sorting files by their columns, writing what is sound, noting what is not."""

    def __init__(self, connection: Any, shape: Shape, target: Path, siblings: Siblings) -> None:
        import duckdb

        self.sql = connection
        self.shape = shape
        self.siblings = siblings
        self.parts = list(shape.parts)
        self.part = Part(())
        """The one that is being read."""
        self.target = self._first = target
        self._more = 0
        """How many Parquet files hold what is not as in most files of their part."""
        self.rows: dict[tuple[str, str], int] = {}
        self.columns: dict[tuple[str, str], Mapping[str, str]] = {}
        self.hints: dict[tuple[str, str], dict[str, str]] = {}
        self.faults: dict[str, str] = {}
        self.error: type[Exception] = duckdb.Error

    def read(self, files: Sequence[Written]) -> Reading:
        for place, some in self._by_part(files):
            sound = self.sound(some)
            if place is None:  # without rows and columns
                self.rows |= dict.fromkeys(((file.execution, file.name) for file in sound), 0)
                self.columns |= {(file.execution, file.name): {} for file in sound}
            elif sound:
                self.part = self.parts[place]
                self.target = self._first.with_stem(f"{self._first.stem}~{place + 1}") if place else self._first
                self.one(sound)
        ended = sum(file.ended for file in files if (file.execution, file.name) in self.rows)
        shape = self.shape
        shape = replace(shape, parts=tuple(self.parts), files=shape.files + len(self.rows), ended=shape.ended + ended)
        return Reading(self.rows, self.columns, self.hints, self.faults, shape)

    def sort(self, files: Sequence[Written]) -> Mapping[str, Part | None]:
        """The columns (and delimiter) of each file that is not at fault, by its path; None where it has no rows nor columns."""
        raise NotImplementedError

    def one(self, files: Sequence[Written]) -> None:
        """Read the files of one part."""
        raise NotImplementedError

    def targets(self) -> Iterator[Path]:
        """Where the files of one part go: those that hold what most of them hold, then others."""
        yield self.target
        while True:
            self._more += 1
            yield self._first.with_stem(f"{self._first.stem}~{PARTS + self._more}")

    def _by_part(self, files: Sequence[Written]) -> list[tuple[int | None, list[Written]]]:
        """The files of each part, by its place."""
        found = self.sort(files)
        places = {self.key(part): place for place, part in enumerate(self.parts)}
        members: dict[int | None, list[Written]] = {}
        for file in self.sound(files):
            part = found[file.path]
            place = None if part is None else places.setdefault(self.key(part), len(places))
            if place is not None and place >= PARTS:
                self.fault(file, f"has other columns than {PARTS} other sets of columns; a table has at most so many")
                continue
            if part is not None and place == len(self.parts):
                self.parts.append(part)
            members.setdefault(place, []).append(file)
        return list(members.items())

    def key(self, part: Part) -> Any:
        """What is the same for files of one part. The order of columns matters in a CSV alone."""
        return frozenset(part.names)

    def fault(self, file: Written, what: str) -> None:
        self.faults.setdefault(file.execution, f"{shown(file.name)}: {what.replace(file.path, shown(file.name))}")

    def sound(self, files: Iterable[Written]) -> list[Written]:
        return [file for file in files if file.execution not in self.faults]

    def done(self, target: Path, files: Sequence[Written], kinds: Mapping[str, Mapping[str, str]]) -> None:
        """Note what was written to `target`: what these files have in each column, by their paths."""
        for file in files:
            self.columns[file.execution, file.name] = kinds[file.path]
        self.rows |= dict.fromkeys(((file.execution, file.name) for file in files), 0)
        stored = dict(zip(self.part.names, column_names(self.part.names), strict=True))
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

    def _lacking(self, target: Path) -> set[str]:
        """The columns of a Parquet file that have no value in some row."""
        rows = self.sql.execute(
            f"SELECT path_in_schema FROM parquet_metadata({quote(str(target))}) GROUP BY 1 "
            "HAVING coalesce(max(stats_null_count), 1) > 0"
        ).fetchall()
        return {row[0].partition(", ")[0] for row in rows} | {row[0] for row in rows}

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

    def write(self, target: Path, files: Sequence[Written], source: str, columns: Mapping[str, str]) -> None:
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
        self.sql.execute("SET threads = 1")  # several would put the pieces of a large file in any order
        try:
            self.sql.execute(
                f"COPY (SELECT o.run, o.execution, {name}{named} FROM {source} t "
                f"JOIN owners o ON t.{identifier(FILE)} = o.path) "
                f"TO {quote(str(target))} (FORMAT parquet, COMPRESSION zstd)",
                _these(files),
            )
        except self.error:
            target.unlink(missing_ok=True)
            raise
        finally:
            self.sql.execute("RESET threads")
            self.sql.unregister("owners")

    def _count(
        self, target: Path, files: Sequence[Written], columns: Sequence[str]
    ) -> Iterator[tuple[tuple[str, str], int, Sequence[int]]]:
        """Of each execution and file, the rows that were written, and how many of them have a value in these columns."""
        name = "file" if self.shape.many else "NULL"
        only = {(file.execution, shown(file.name) if self.shape.many else None): file.name for file in files}
        filled = "".join(f", count({identifier(column)})" for column in columns)
        statement = f"SELECT execution, {name}, count(*){filled} FROM read_parquet({quote(str(target))}) GROUP BY 1, 2"
        for execution, file, count, *values in self.sql.execute(statement).fetchall():
            yield (execution, only[execution, file]), count, values

    def fetch(self, statement: str, files: Sequence[Written]) -> list[tuple[Any, ...]]:
        rows: list[tuple[Any, ...]] = self.sql.execute(statement, _these(files)).fetchall() if files else []
        return rows

    def unwritten(self, error: Exception) -> Missing:
        return Missing(f"cannot write to {self.target.parent}: {first_line(error)}")


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

    def one(self, files: Sequence[Written]) -> None:
        names = self.part.names
        try:
            written = self._write(files, self._quickly_seen(files, names))
        except (self.error, _MisreadError):
            texts = dict.fromkeys(names, "VARCHAR")

            def explain(file: Written, error: Exception) -> str:
                return self.first_fault(file, names, texts) or first_line(error)

            self.halve(files, lambda some: self._try(some, names), explain)
            files = self.sound(files)
            try:
                written = self._write(files, self._seen(files, names), by_text=True) if files else []
            except self.error as error:
                raise self.unwritten(error) from error
        for target, some, kinds in written:
            self.done(target, some, kinds)

    def _write(
        self, files: Sequence[Written], found: Mapping[str, Mapping[str, str | None]], *, by_text: bool = False
    ) -> list[tuple[Path, list[Written], dict[str, dict[str, str]]]]:
        """Write what the files hold, as their types were found; with `by_text`, slower, numbers too that DuckDB does not know.

        Where it was written, what, and what it is.
        """
        names = self.part.names
        texts = dict.fromkeys(names, "VARCHAR")
        kept = self._kept(files, found)
        written: list[tuple[Path, list[Written], dict[str, dict[str, str]]]] = []
        try:
            targets = self.targets()
            usual = next(targets)
            for some in _alike(files, kept):
                # what will hardly count goes where SQL does not look for types (see `Views._holding`)
                odd = any((file.execution, file.name) in self.hints for file in some)
                target = next(targets) if odd or written else usual
                types = {name: _common(kept[name].get(file.path) for file in some) for name in names}
                columns = {name: self._typed(f"t.c{place}", types[name], by_text) for place, name in enumerate(names)}
                written.append((target, some, _kinds(some, types, found, kept)))
                self.write(target, some, self.relation(names, texts if by_text else types), columns)
                if not by_text and self._misread(target, some, names, types):
                    raise _MisreadError
        except (self.error, _MisreadError):
            for target, _, _ in written:
                target.unlink(missing_ok=True)
            raise
        return written

    def _kept(
        self, files: Sequence[Written], found: Mapping[str, Mapping[str, str | None]]
    ) -> dict[str, Mapping[str, str | None]]:
        """The type that each file's columns are kept as: text among siblings that have text."""
        doubtful = [
            name
            for name, seen in found.items()
            if name in self.siblings.mixed or len({kind_of(kind) for kind in seen.values() if kind}) > 1
        ]
        doubtful = [name for name in doubtful if any(kind not in (None, "VARCHAR") for kind in found[name].values())]
        kept = dict(found)
        if not doubtful:
            return kept
        groups, votes = self.siblings.ask([file.run for file in files])
        for name in doubtful:
            seen = found[name]
            counts: dict[Group, Counter[str]] = {}
            for file in files:
                if kind := seen.get(file.path):
                    group = groups.get(file.run)
                    counts.setdefault(group, Counter(votes.get((group, name), {})))[kind_of(kind)] += 1
            right = {group: right_kind(kinds) for group, kinds in counts.items()}
            kept[name] = {
                file.path: "VARCHAR" if kind and right[groups.get(file.run)] == "text" else kind
                for file in files
                for kind in (seen.get(file.path),)
            }
            for file in files:
                if seen.get(file.path) in ("VARCHAR", "BOOLEAN") and right[groups.get(file.run)] == "number":
                    self._hint(file, name)
        return kept

    def _hint(self, file: Written, name: str) -> None:
        """Note where a file has text, since most of its siblings have numbers."""
        types = dict.fromkeys(self.part.names, "VARCHAR") | {name: "DOUBLE"}
        if told := self.first_fault(file, self.part.names, types):
            self.hints.setdefault((file.execution, file.name), {})[name] = f"{shown(file.name)}: {told}"

    def _misread(self, target: Path, files: Sequence[Written], names: Sequence[str], types: Mapping[str, str]) -> bool:
        """Whether something that is no number was written as one: looked for only where there is a sign of it."""
        doubles = [name for name in names if types[name] == "DOUBLE"]
        if not doubles or not files:
            return False
        stored = dict(zip(names, column_names(names), strict=True))
        written = f"read_parquet({quote(str(target))})"
        if not self._any("isinf({})", (identifier(stored[name]) for name in doubles), written, {}):
            files = [file for file in files if self.has_underscores(file)]
            if not files:
                return False
        places = {name: place for place, name in enumerate(names)}
        relation = self.relation(names, dict.fromkeys(names, "VARCHAR"))
        return self._any(_odd("{}"), (f"c{places[name]}" for name in doubles), relation, _these(files))

    def _any(self, condition: str, cells: Iterable[str], relation: str, given: Mapping[str, Any]) -> bool:
        """Whether a condition holds for any of these cells of any row."""
        cells = list(cells)
        either = " OR ".join(condition.replace("{}", cell) for cell in cells)
        if len(cells) > AT_ONCE:
            relation, either = f"(SELECT unnest([{', '.join(cells)}]) AS cell FROM {relation})", condition.replace("{}", "cell")
        return bool(self.sql.execute(f"SELECT 1 FROM {relation} WHERE {either} LIMIT 1", given).fetchall())

    def has_underscores(self, file: Written) -> bool:
        """Whether there may be an underscore within a number."""
        return False

    def _typed(self, cell: str, kind: str, by_text: bool) -> str:
        """A cell as a value of its column's type; what does not fit is an error, never rounded."""
        match kind:
            case "VARCHAR":
                return self.text(cell)
            case "DOUBLE":
                return f"CAST({_no_nan(cell) if by_text else cell} AS DOUBLE)"  # and see `_misread`
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

    def _quickly_seen(self, files: Sequence[Written], names: Sequence[str]) -> dict[str, dict[str, str | None]]:
        """Each column's type in a few of the files, taken for that in all; where that leaves a doubt, as each file has it."""
        sample = [files[place] for place in sorted({0, len(files) // 2, len(files) - 1})]
        found = self._seen(sample, names)
        if len(sample) == len(files):
            return found
        doubtful = []
        alike: dict[str, dict[str, str | None]] = {}
        for name in names:
            kinds = {kind for kind in found[name].values() if kind}
            if len(set(map(kind_of, kinds))) != 1 or "VARCHAR" in kinds or name in self.siblings.mixed:
                doubtful.append(name)
            else:
                kind = _common(kinds)
                found[name] = alike.get(kind) or alike.setdefault(kind, {file.path: kind for file in files})
        return found | (self._seen(files, names, doubtful) if doubtful else {})

    def _seen(
        self, files: Sequence[Written], names: Sequence[str], wanted: Sequence[str] | None = None
    ) -> dict[str, dict[str, str | None]]:
        """The narrowest type that holds all of a column, by column and file; None where it has no value."""
        wanted = names if wanted is None else wanted
        relation = self.relation(names, dict.fromkeys(names, "VARCHAR"))
        places = {name: place for place, name in enumerate(names)}
        found: dict[str, dict[str, str | None]] = {name: {} for name in wanted}
        if len(wanted) > AT_ONCE:
            cells = ", ".join(f"c{places[name]}" for name in wanted)
            each = (
                f"(SELECT {identifier(FILE)}, unnest([{cells}]) AS cell, unnest(range({len(wanted)})) AS place FROM {relation})"
            )
            rows = self.fetch(f"SELECT {identifier(FILE)}, place, bit_or({_bit('cell')}) FROM {each} GROUP BY 1, 2", files)
            for path, place, bits in rows:
                found[wanted[place]][path] = _narrowest(bits or 0)
            return found
        columns = ", ".join(f"bit_or({_bit(f'c{places[name]}')})" for name in wanted)
        for path, *seen in self.fetch(f"SELECT {identifier(FILE)}, {columns} FROM {relation} GROUP BY 1", files):
            for name, bits in zip(wanted, seen, strict=True):
                found[name][path] = _narrowest(bits or 0)
        return found


def _bit(cell: str) -> str:
    """Which kind of text a cell holds: one bit each; none where it is empty."""
    whole = f"regexp_full_match({cell}, {quote(WHOLE)})"
    return (
        f"CASE WHEN {cell} IS NULL THEN 0 WHEN {whole} AND TRY_CAST({cell} AS BIGINT) IS NOT NULL THEN 2 "
        f"WHEN {whole} AND TRY_CAST({cell} AS {HUGE}) IS NOT NULL THEN 4 "
        f"WHEN TRY_CAST({_no_nan(cell)} AS DOUBLE) IS NOT NULL AND NOT {_odd(cell)} THEN 8 "
        f"WHEN regexp_full_match({cell}, {quote(LOGICAL)}) THEN 1 ELSE 16 END"
    )


def _no_nan(cell: str) -> str:
    """The same text, but for the -nan that C prints, as DuckDB knows it."""
    return f"CASE WHEN regexp_full_match({cell}, ' *[-+](?i:nan) *') THEN 'nan' ELSE {cell} END"


def _odd(cell: str) -> str:
    """Whether DuckDB takes a text for a number that it is not: 12_34 for 1234, 1e400 for infinity."""
    return f"(contains({cell}, '_') OR (isinf(TRY_CAST({cell} AS DOUBLE)) AND regexp_matches({cell}, '[0-9]')))"


def _narrowest(bits: int) -> str | None:
    """The narrowest type that holds all of these kinds."""
    if bits in (0, 1):
        return "BOOLEAN" if bits else None
    if bits & 17:
        return "VARCHAR"
    return "DOUBLE" if bits & 8 else HUGE if bits & 4 else "BIGINT"


def _common(kinds: Iterable[str | None]) -> str:
    """The narrowest type that holds all of these."""
    some = {kind for kind in kinds if kind}
    if len(some) < 2:
        return some.pop() if some else "BOOLEAN"
    if not all(map(is_number, some)):
        return "VARCHAR"
    return "DOUBLE" if "DOUBLE" in some else HUGE


def _alike(files: Sequence[Written], kept: Mapping[str, Mapping[str, str | None]]) -> list[list[Written]]:
    """The files sorted by what their columns are to hold; a column without values goes with those that have most."""
    kinds = {name: {path: kind_of(kind) for path, kind in seen.items() if kind} for name, seen in kept.items()}
    mixed = {name: Counter(seen.values()) for name, seen in kinds.items() if len(set(seen.values())) > 1}
    most = {name: counts.most_common(1)[0][0] for name, counts in mixed.items()}
    sorts: dict[tuple[str, ...], list[Written]] = {}
    for file in files:
        sorts.setdefault(tuple(kinds[name].get(file.path, most[name]) for name in mixed), []).append(file)
    return sorted(sorts.values(), key=lambda some: -len(some))


def _kinds(
    files: Sequence[Written],
    types: Mapping[str, str],
    found: Mapping[str, Mapping[str, str | None]],
    kept: Mapping[str, Mapping[str, str | None]],
) -> dict[str, dict[str, str]]:
    """What each file has in each column, and whether that is kept as text."""
    told = {}
    same: dict[tuple[str, ...], dict[str, str]] = {}
    for file in files:
        mine = {}
        for name in types:
            kind = found[name].get(file.path)
            as_text = kind not in (None, "VARCHAR") and kept[name].get(file.path) == "VARCHAR"
            mine[name] = kind_of(kind or EMPTY) + AS_TEXT * as_text
        told[file.path] = same.setdefault(tuple(mine.values()), mine)
    return told


class _MisreadError(Exception):
    """Something that is no number was written as one."""


class _Csv(_Text):
    """Delimited text."""

    _longest = 0
    """Bytes of the longest line of the part, where it has files of megabytes."""

    def sort(self, files: Sequence[Written]) -> Mapping[str, Part | None]:
        for file in files:
            if file.bytes == 0 and self.shape.header:
                self.fault(file, "is empty; not even a header")
        self._cut(self.sound(files))
        heads = {file.path: _first_record(file) for file in self.sound(files)}
        described = self._described(Counter(heads.values()))
        for file in self.sound(files):
            part = described[heads[file.path]]
            if isinstance(part, str):
                self.fault(file, f"line 1: {part}")
        return {path: part for path, head in heads.items() if not isinstance(part := described[head], str)}

    def key(self, part: Part) -> Any:
        return part.names, part.delimiter

    def _described(self, heads: Counter[str]) -> dict[str, Part | str | None]:
        """What the first lines say of columns; a sentence where they say nothing sensible."""
        if self.shape.header:
            return {head: self._named(head) for head in heads}
        delimiter = self.shape.delimiter or delimiter_of(heads.most_common(1)[0][0] if heads else "")
        return {head: self._numbered(head, delimiter) for head in heads}

    def _named(self, head: str) -> Part | str:
        delimiter = self.shape.delimiter or delimiter_of(head)
        names = split(head, delimiter)
        if not any(names):
            return "is empty, where the names of the columns should be"
        if "\ufffd" in head or CONTROL.search(head):
            return f"is no text in UTF-8 (is it compressed?): {head[:80]!r}"
        if head.count('"') % 2:
            return f"quotes are not closed: {head[:80]!r}"
        if all(_is_number(name) for name in names):
            return "numbers, no names of columns (if it has no header: header = false in [outputs.…])"
        names = tuple(name or f"column{place}" for place, name in enumerate(names))
        doubled = [name for name, count in Counter(names).items() if count > 1]
        if doubled:
            return f"the column {doubled[0]!r} is there twice"
        return Part(names, delimiter)

    def _numbered(self, head: str, delimiter: str) -> Part | None:
        """Columns of a file without header: as declared, or as many as its first line has fields."""
        width = len(split(head, delimiter))
        if self.shape.names or width:
            return Part(self.shape.names or tuple(f"column{number}" for number in range(width)), delimiter)
        return None

    def one(self, files: Sequence[Written]) -> None:
        large = [file for file in files if file.bytes >= 2_000_000]
        self._longest = max(map(_longest_line, large), default=0)
        super().one(files)

    def relation(self, names: Sequence[str], types: Mapping[str, str]) -> str:
        columns = ", ".join(
            f"c{place}: {quote('DOUBLE' if types[name] == 'DOUBLE' else 'VARCHAR')}" for place, name in enumerate(names)
        )
        longest = f", max_line_size = {self._longest + 1}" if self._longest >= 2_000_000 else ""
        return (
            f"read_csv($files, columns = {{{columns}}}, auto_detect = false, header = {str(self.shape.header).lower()}, "
            f"delim = {quote(self.part.delimiter)}, quote = '\"', escape = '\"', nullstr = '', filename = {quote(FILE)}, "
            f"strict_mode = true{longest})"
        )

    def has_underscores(self, file: Written) -> bool:
        with Path(file.path).open("rb") as data:
            if self.shape.header:
                data.readline()
            return any(b"_" in piece for piece in iter(lambda: data.read(1 << 20), b""))

    def _cut(self, files: Sequence[Written]) -> None:
        """A last line without its line feed is suspicious where at least half of all files have one."""
        cut = [file for file in files if not file.ended]
        ended = len(files) - len(cut) + self.shape.ended
        if ended >= len(cut) + self.shape.files - self.shape.ended:
            for file in cut:
                self.fault(file, f"line {file.lines + 1}: its last line is cut short (no line feed at its end)")

    def first_fault(self, file: Written, names: Sequence[str], types: Mapping[str, str]) -> str | None:
        ends = set()
        for line, record, end in _records(file, self.part.delimiter):
            if isinstance(record, str):
                return f"line {line}: {record}"
            if not record or (line == 1 and self.shape.header):
                continue
            text = self.part.delimiter.join(record)
            if any("\udc80" <= character <= "\udcff" for character in text):
                return f"line {line}: is not UTF-8: {shown(text)[:80]!r}"
            if len(record) != len(names) and not (len(record) == len(names) + 1 and not record[-1]):
                few = "too few" if len(record) < len(names) else "too many"
                return f"line {line}: {few} fields ({len(record)}, not {len(names)}): {text[:80]!r}"
            for name, cell in zip(names, record, strict=False):
                if types[name] == "DOUBLE" and cell and not _is_number(cell):
                    return f"line {line}: text where numbers are in column {name!r}: {cell[:80]!r}"
            ends.add(end)
        return "some lines end in CR LF, and some in LF" if len(ends) > 1 else None


class _Jsonl(_Text):
    """JSON lines: an object each."""

    def sort(self, files: Sequence[Written]) -> Mapping[str, Part | None]:
        try:
            found = self._keys(files)
        except self.error:
            self.halve(files, self._keys, lambda file, error: self.first_fault(file, (), {}) or first_line(error))
            found = self._keys(self.sound(files))
        return {file.path: Part(tuple(found[file.path])) if file.path in found else None for file in files}

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
        cells = "".join(
            f"nullif(json_extract(json, {quote(pointer)})::VARCHAR, 'null') AS c{place}, "
            for place, pointer in enumerate(pointers)
        )
        return f"(SELECT {cells}{identifier(FILE)} FROM {self._objects()})"

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

    def __init__(self, connection: Any, shape: Shape, target: Path, siblings: Siblings) -> None:
        super().__init__(connection, shape, target, siblings)
        self._found: Mapping[str, Mapping[str, str]] = {}

    def sort(self, files: Sequence[Written]) -> Mapping[str, Part | None]:
        try:
            self._found = self._schemas(files)
        except self.error:
            self._found = self._schemas(self._readable(files))
        return {path: Part(tuple(columns)) for path, columns in self._found.items()}

    def one(self, files: Sequence[Written]) -> None:
        try:
            written = self._write(files)
        except self.error:
            try:
                written = self._write(self._readable(files))
            except self.error as error:
                raise self.unwritten(error) from error
        for target, some in written:
            kinds = {file.path: {name: kind_of(self._found[file.path][name]) for name in self.part.names} for file in some}
            self.done(target, some, kinds)

    def _write(self, files: Sequence[Written]) -> list[tuple[Path, list[Written]]]:
        """Write the files, those whose columns are of one kind into one Parquet file: where, and which."""
        kinds = {
            name: {file.path: None if (kind := self._found[file.path][name]) == EMPTY else kind for file in files}
            for name in self.part.names
        }
        written = list(zip(self.targets(), _alike(files, kinds), strict=False))
        try:
            for target, some in written:
                types = {name: self._type(name, some) for name in self.part.names}
                columns = {name: f"CAST(t.{identifier(name)} AS {types[name]})" for name in self.part.names}
                self.write(target, some, self._source(), columns)
        except self.error:
            for target, _ in written:
                target.unlink(missing_ok=True)
            raise
        return written

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

    def _type(self, name: str, files: Sequence[Written]) -> str:
        """The type that files have in a column, all of one kind; the widest of numbers."""
        kinds = {self._found[file.path][name] for file in files} - {EMPTY}
        if len(kinds) < 2:
            return kinds.pop() if kinds else EMPTY
        whole = all("INT" in kind for kind in kinds)
        return HUGE if whole and "UBIGINT" in kinds else "BIGINT" if whole else "DOUBLE"


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
        number = float(field)
    except ValueError:
        return False
    return "_" not in field and not (math.isinf(number) and any(map(str.isdigit, field)))


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
    parts = []
    if missing:
        parts.append(f"lacks the column{'s' * (len(missing) > 1)} {_few(map(repr, missing))}")
    if extra:
        parts.append(f"has the further column{'s' * (len(extra) > 1)} {_few(map(repr, extra))}")
    return (" and ".join(parts) or "has its columns in another order") + f" (its siblings have {_few(names)})"


def _few(names: Iterable[str]) -> str:
    """Some names, and how many more there are; never `and 1 more`."""
    names = list(names)
    return few(names, FEW if len(names) > FEW + 1 else len(names))


def shown(path: str) -> str:
    """A file's name as text: bytes of it that are no UTF-8 as escapes."""
    return path.encode("utf-8", "backslashreplace").decode()
