"""The files of one table as one relation, in which a column of numbers stays numeric.

A column that a file does not have is NULL there. A column that holds numbers in some files, and texts, flags or dates in
others, becomes two columns. The first has the original name and holds the numbers. The second has the suffix `_text` and
holds the cells of the other files unchanged. A text that reads as a number is in both. A similar split applies to whole
numbers and decimals that DOUBLE cannot hold exactly, if other files have fractions or larger numbers: the first column has
the nearest DOUBLE, the second has all digits. If a file has both, its texts are recorded beside its numbers (see
`text_beside`), and are the second column. Beside such whole numbers, files with nothing but nan and whole numbers that their
type can hold are no reason for a split: the column stays whole, and nan is missing.

DuckDB's own union would turn all numbers into texts, true into 1, whole numbers into dates, and decimals into whole numbers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import reduce
from operator import or_
from typing import NamedTuple

from sierra.store.duckdb_file_io import parquet_schema, read_parquet, steady
from sierra.store.sql_names import column_names, identifier
from sierra.store.sql_result import RawRow
from sierra.store.type_inference import (
    EMPTY,
    EXACT_TEXT,
    INEXACT,
    NUMBERS,
    as_stored,
    bit,
    is_beyond,
    is_inexact,
    is_number,
    is_whole,
    narrowest,
    reads_as,
    text_beside,
    widest,
)
from sierra.store.verified_files import verify
from sierra.util.lazy_definitions import dataclass, field

Fetch = Callable[[str], list[RawRow]]
"""A function that executes a statement and returns its rows."""


class IndexedRows(NamedTuple):
    """Rows that are not in a file of their own: those of several segments in an index, with the same columns."""

    sql: str
    """The expression to put after FROM."""
    columns: Mapping[str, str]
    """The types of the columns."""
    first: str
    """The name of the first segment, for the position among files."""


RowSource = str | IndexedRows
"""The path of a file, or rows of an index."""
Answers = Callable[[Sequence[str], str], Mapping[str, int]]
"""A function that returns, for some of these files, the value of an SQL expression over all of its rows; 0 without rows.

The value for several files is the bitwise OR of theirs. It must leave out files with rows that do not count.
"""
PLACES = ("filename", "file_row_number")
"""Columns that identify a row's origin; they come after all other columns."""
TEXT = "_text"


@dataclass(frozen=True, slots=True)
class Relation:
    """The rows of several files; `sql` is the expression to put after FROM."""

    sql: str
    types: Mapping[str, str]
    """The type of each column, without the columns of `PLACES`."""
    texts: Mapping[str, str] = field(default_factory=dict)
    """The `_text` column that belongs to each split numeric column."""
    rounded: frozenset[str] = frozenset()
    """The split columns that hold only numbers, some of them with more digits than DOUBLE can hold."""
    spellings: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """The names of the columns that became one because they differ only in upper and lower case, by its name."""
    nans: frozenset[str] = frozenset()
    """The columns of whole numbers in which nan of some files is missing."""


def relation(
    fetch: Fetch,
    files: Sequence[RowSource],
    where: str = "true",
    *,
    rows: bool = False,
    known: Mapping[str, Mapping[str, str]] | None = None,
    answers: Answers | None = None,
) -> Relation:
    """Return the rows of these files. Rows that do not meet the condition `where` do not influence the types.

    `rows`: include the columns of `PLACES`; then all rows must be in files. `known`: the types of the columns of some files.
    `answers` spares a look into some files. Raises Damaged if one of the files is not the recorded one.
    """

    def ask(sources: Sequence[RowSource], what: str) -> int:
        answered = answers([source for source in sources if isinstance(source, str)], what) if answers else {}
        unknown = [source for source in sources if not (isinstance(source, str) and source in answered)]
        [(value,)] = fetch(f"SELECT {what} FROM {_rows(unknown)} WHERE {where}") if unknown else [(0,)]
        return reduce(or_, answered.values(), int(value or 0))  # NULL if there are no rows

    verify(file for file in files if isinstance(file, str))
    described = _described(fetch, files, known or {})
    names = _names(described)
    types = _by_type(described)
    first = {own: next(iter(types[name])) for name, own in names.items()}
    several = [name for name in names if len(types[name]) > 1 or EXACT_TEXT in types[name]]
    if not several:
        source = _rows(files, union=len(described) > 1, rows=rows)
        if not all(isinstance(file, str) for file in files):  # the columns of an index come after those of files
            source = f"(SELECT {', '.join(f'{identifier(name)} AS {identifier(name)}' for name in first)} FROM {source})"
        return Relation(source, first, spellings=_spellings(described))
    called = column_names([names[name] + TEXT for name in several], taken=names.values())
    mixed = {name: _mixed(ask, names[name], beside, types[name]) for name, beside in zip(several, called, strict=True)}
    kept: dict[str, str] = {}
    for name, own in names.items():
        kept |= mixed[name].types() if name in mixed else {own: first[own]}
    columns = ", ".join(f"{identifier(name)} AS {identifier(name)}" for name in [*kept, *(PLACES if rows else ())])
    scans = " UNION ALL BY NAME ".join(
        _scan(mixed.values(), kinds, some, rows=rows) for kinds, some in _parts(described, several).items()
    )
    apart = [column for column in mixed.values() if column.apart]
    return Relation(
        f"(SELECT {columns} FROM ({scans}))",
        kept,
        {column.name: column.beside for column in apart},
        frozenset(column.name for column in apart if not column.other),
        _spellings(described),
        frozenset(column.name for column in mixed.values() if column.nan),
    )


def _rows(sources: Sequence[RowSource], *, union: bool = True, rows: bool = False) -> str:
    """Return the relation of the rows of files and of an index."""
    files = [source for source in sources if isinstance(source, str)]
    parts = [read_parquet(files, union=union, rows=rows, check=False)] if files else []
    parts += [source.sql for source in sources if isinstance(source, IndexedRows)]
    return parts[0] if len(parts) == 1 else f"({' UNION ALL BY NAME '.join(f'SELECT * FROM {part}' for part in parts)})"


Described = Sequence[tuple[Sequence[RowSource], Mapping[str, str]]]
"""Groups of files that have the same columns, each with the types of these columns."""


def _names(described: Described) -> dict[str, str]:
    """Return the columns of all files in order: their names in lower case, each with the spelling of the first file."""
    found: dict[str, str] = {}
    for _, columns in described:
        for name in columns:
            found.setdefault(name.lower(), name)
    return found


def _spellings(described: Described) -> dict[str, list[str]]:
    """Return the names of columns that differ only in upper and lower case, by the first of them."""
    found: dict[str, dict[str, None]] = {}
    for _, columns in described:
        for name in columns:
            found.setdefault(name.lower(), {})[name] = None
    return {next(iter(names)): list(names) for names in found.values() if len(names) > 1}


def _by_type(described: Described) -> dict[str, dict[str, list[RowSource]]]:
    """Return the files by column (in lower case) and type."""
    found: dict[str, dict[str, list[RowSource]]] = {}
    for files, columns in described:
        for name, kind in columns.items():
            found.setdefault(name.lower(), {}).setdefault(kind, []).extend(files)
    return found


def _parts(described: Described, several: Sequence[str]) -> dict[tuple[str | None, ...], list[RowSource]]:
    """Return the files by the types that they have in these columns."""
    found: dict[tuple[str | None, ...], list[RowSource]] = {}
    for files, columns in described:
        theirs = {name.lower(): kind for name, kind in columns.items()}
        found.setdefault(tuple(map(theirs.get, several)), []).extend(files)
    return found


def _scan(mixed: Iterable[_Mixed], kinds: Iterable[str | None], files: Sequence[RowSource], *, rows: bool) -> str:
    """Return the query for the rows of files that have types `kinds` in the columns `mixed`."""
    those = [(one, kind) for one, kind in zip(mixed, kinds, strict=True) if kind is not None]
    cells = ", ".join(f"{one.cell(kind)} AS {identifier(one.name)}" for one, kind in those)
    texts = "".join(f", {text} AS {identifier(one.beside)}" for one, kind in those if (text := one.text(kind)))
    scan = _rows(files, rows=rows)
    return f"SELECT *{f' REPLACE ({cells})' if cells else ''}{texts} FROM {scan}"


def _described(
    fetch: Fetch, files: Sequence[RowSource], known: Mapping[str, Mapping[str, str]]
) -> list[tuple[list[RowSource], dict[str, str]]]:
    """Return the files grouped by equal columns, with the columns' types, in the order of the files."""
    unknown = [file for file in files if isinstance(file, str) and file not in known]
    columns = {file: theirs for some, theirs in read_columns(fetch, unknown) for file in some}
    groups: dict[tuple[tuple[str, str], ...], list[RowSource]] = {}
    for source in files:
        theirs = source.columns if isinstance(source, IndexedRows) else known.get(source) or columns[source]
        groups.setdefault(tuple(theirs.items()), []).append(source)
    return [(some, _with_texts(dict(theirs))) for theirs, some in groups.items()]


def read_columns(fetch: Fetch, files: Sequence[str]) -> Iterator[tuple[list[str], dict[str, str]]]:
    """Yield the files with equal columns, and the types of these columns, from the footers of the files."""
    groups = [list(files)] if files else []
    if len(files) > 1:
        own = {steady(file): file for file in files}
        alike = (
            f"SELECT list(file_name) FROM (SELECT file_name, list((name, duckdb_type, num_children)) AS columns "
            f"FROM {parquet_schema(files)} GROUP BY file_name) GROUP BY columns"
        )
        groups = [[own[file] for file in some] for (some,) in fetch(alike)]
    for some in groups:
        rows = fetch(f"DESCRIBE SELECT * FROM {read_parquet(some[:1], check=False)}")
        yield some, {row[0]: row[1] for row in rows}


def _with_texts(columns: Mapping[str, str]) -> dict[str, str]:
    """Return the columns of a file, of which those with recorded texts beside them have the type `EXACT_TEXT`."""
    beside = {text: name for name in columns if (text := text_beside(name)) in columns}
    return {name: EXACT_TEXT if name in beside.values() else kind for name, kind in columns.items() if name not in beside}


@dataclass(frozen=True, slots=True)
class _Mixed:
    """A column that has different types in different files."""

    name: str
    beside: str
    """The name of the `_text` column."""
    type: str
    """The resulting type; empty if DuckDB's own union gives the right type."""
    empty: frozenset[str]
    """The types of the files in which the column has no values."""
    other: bool = False
    """True if some files hold numbers and others hold other values."""
    rounded: bool = False
    """True if DOUBLE cannot hold some of the numbers exactly."""
    no_nan: bool = False
    """True if files have nan, or whole numbers that `type` can hold, as DOUBLE, and others those that DOUBLE cannot hold."""
    nan: bool = False
    """True if some of these files do have nan."""

    @property
    def apart(self) -> bool:
        """True if the column needs a `_text` column."""
        return self.other or self.rounded

    @property
    def column(self) -> str:
        return identifier(self.name)

    def types(self) -> dict[str, str]:
        """Return the resulting columns with their types."""
        return {self.name: self.type, **({self.beside: "VARCHAR"} if self.apart else {})}

    def cell(self, kind: str) -> str:
        """Return the SQL expression for the column's value in files where it has type `kind`."""
        if kind in self.empty:
            return f"NULL::{self.type or kind}"
        if not self.type:
            return self.column
        if is_number(self.type) and not is_number(kind):
            return reads_as(self.column, self.type) if kind == "VARCHAR" else f"NULL::{self.type}"
        if self.no_nan and kind == "DOUBLE":
            return f"CASE WHEN NOT isnan({self.column}) THEN TRY_CAST({self.column} AS {self.type}) END"
        if self.type == "VARCHAR" and _is_instant(kind):
            return f"CAST({self.column} AT TIME ZONE 'UTC' AS VARCHAR) || '+00'"
        return f"CAST({self.column} AS {self.type})"

    def text(self, kind: str) -> str | None:
        """Return the SQL expression for the value of the `_text` column; None if there is none."""
        if not self.apart or kind in self.empty:
            return None
        if not is_number(kind):
            return f"CAST({self.column} AS VARCHAR)"
        if kind == EXACT_TEXT:
            return identifier(text_beside(self.name))
        return f"CASE WHEN {is_inexact(self.column, kind)} THEN CAST({self.column} AS VARCHAR) END" if self.rounded else None


def _mixed(
    ask: Callable[[Sequence[RowSource], str], int], name: str, beside: str, kinds: Mapping[str, Sequence[RowSource]]
) -> _Mixed:
    """Decide how to read a column that has these types, each in some files."""
    column = identifier(name)

    def seen(kind: str, what: str) -> int:
        return ask(kinds[kind], what)

    def has_values(kind: str) -> bool:
        return kind != EMPTY and bool(seen(kind, f"count({column}) > 0"))

    others = [kind for kind in kinds if not is_number(kind) and has_values(kind)]
    numbers = [kind for kind in kinds if is_number(kind) and (not others or has_values(kind))]
    empty = frozenset(kinds) - {*numbers, *others}
    if not numbers:
        return _Mixed(name, beside, _of_times(others, seen, column) or _common(others), empty)
    texts = seen("VARCHAR", f"bit_or({bit(column)})") & NUMBERS if "VARCHAR" in others else 0
    kind = widest([*map(as_stored, numbers), *([as_stored(narrowest(texts) or "")] if texts else [])])
    exact = [number for number in numbers if number not in ("DOUBLE", "FLOAT", EXACT_TEXT)] if kind == "DOUBLE" else []
    rounded = any(seen(number, f"count_if({is_inexact(column, number)}) > 0") for number in exact)
    whole = rounded and not texts and all(map(is_whole, exact)) and {*exact, "DOUBLE"} == {*numbers}
    if whole and not seen("DOUBLE", f"count_if({is_beyond(column, widest(exact))}) > 0"):
        nan = bool(seen("DOUBLE", f"count_if(isnan({column})) > 0"))
        return _Mixed(name, beside, widest(exact), empty, bool(others), no_nan=True, nan=nan)
    if EXACT_TEXT in numbers:
        rounded |= bool(seen(EXACT_TEXT, f"bit_or({bit(identifier(text_beside(name)))})") & INEXACT)
    return _Mixed(name, beside, kind, empty, bool(others), rounded)


def _common(kinds: Sequence[str]) -> str:
    """Return the type that holds these types that are not numbers; empty if DuckDB's own union gives the right type."""
    if len(kinds) < 2:
        return next(iter(kinds), "BOOLEAN")
    return "" if _are_times(kinds) or _are_nested_alike(kinds) else "VARCHAR"


def _of_times(kinds: Sequence[str], seen: Callable[[str, str], int], column: str) -> str:
    """Return VARCHAR for times with nanoseconds and others that these cannot hold, before 1677 or after 2262; else nothing."""
    exact = next((kind for kind in kinds if kind.endswith("_NS")), "")
    if not exact or not _are_times(kinds):
        return ""
    beyond = f"count_if({column} IS NOT NULL AND TRY_CAST({column} AS {exact}) IS NULL) > 0"
    return "VARCHAR" if any(seen(kind, beyond) for kind in kinds if kind != exact) else ""


def _are_nested_alike(kinds: Sequence[str]) -> bool:
    """Return whether DuckDB can unite these types: only lists whose items it can unite, only structures, or only maps."""
    if not all(kind.endswith("]") for kind in kinds):
        return any(all(kind.startswith(word) and kind.endswith(")") for kind in kinds) for word in ("STRUCT", "MAP", "UNION"))
    items = sorted({kind[: kind.rindex("[")] for kind in kinds})
    same = len(items) == 1 or all(map(is_number, items)) or "VARCHAR" in items
    return same or _are_times(items) or _are_nested_alike(items)


def _are_times(kinds: Sequence[str]) -> bool:
    """Return whether these are dates and times, all with a time zone, or all without one."""
    times = all(re.fullmatch(r"DATE|TIMESTAMP\w*( WITH TIME ZONE)?", kind) for kind in kinds)
    return times and len(set(map(_is_instant, kinds))) == 1


def _is_instant(kind: str) -> bool:
    """Return whether this is a type of times with a time zone."""
    return kind.startswith("TIMESTAMP") and ("TIME ZONE" in kind or "TZ" in kind)
