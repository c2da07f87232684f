"""The files of one table as one relation: what is a number in some of them stays one, and what is none is told apart.

A column that a file does not have is NULL there. One that holds numbers in some files, and texts, flags or dates in others,
becomes two: the numbers under its name, and beside them, with `_text` behind the name, the cells of the other files as they
are. A text that reads as a number is in both. Whole numbers and decimals that DOUBLE cannot hold are told apart in the same
way where other files have fractions: the nearest number under the name, all digits beside it.

DuckDB's own union would make texts of all numbers, 1 of true, dates of whole numbers, and whole numbers of decimals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sierra.store.column_types import EMPTY, HUGE, bit, is_inexact, is_number, is_whole, narrowest, reads_as
from sierra.store.names import column_names, identifier
from sierra.store.scans import parquet_schema, read_parquet, steady

Fetch = Callable[[str], Sequence[Sequence[Any]]]
"""Executes a statement; its rows."""
PLACES = ("filename", "file_row_number")
"""Columns that say where a row is from; they stand behind all others."""
TEXT = "_text"
NUMBERS = 2 | 4 | 8
"""What `bit` says of texts that are numbers."""


@dataclass(frozen=True, slots=True)
class Relation:
    """Rows of several files: `sql` is what stands behind FROM."""

    sql: str
    types: Mapping[str, str]
    """By column, its type, without those of `PLACES`."""
    texts: Mapping[str, str] = field(default_factory=dict)
    """By column of numbers, the one beside it for what is none there."""
    rounded: frozenset[str] = frozenset()
    """Those of them in which all are numbers, and some have more digits than DOUBLE."""


def relation(fetch: Fetch, files: Sequence[str], where: str = "true", *, rows: bool = False) -> Relation:
    """Return the rows of these files. What is only in rows that do not meet the condition `where` decides no type.

    `rows`: with the columns of `PLACES`.
    """
    described = _described(fetch, files)
    names = _names(described)
    types = _by_type(described)
    first = {own: next(iter(types[name])) for name, own in names.items()}
    several = [name for name in names if len(types[name]) > 1]
    if not several:
        return Relation(read_parquet(files, union=len(described) > 1, rows=rows), first)
    called = column_names([names[name] + TEXT for name in several], taken=names.values())
    mixed = {name: _mixed(fetch, names[name], beside, types[name], where) for name, beside in zip(several, called, strict=True)}
    kept: dict[str, str] = {}
    for name, own in names.items():
        kept |= mixed[name].types() if name in mixed else {own: first[own]}
    columns = ", ".join(map(identifier, [*kept, *(PLACES if rows else ())]))
    scans = " UNION ALL BY NAME ".join(
        _scan(mixed.values(), kinds, some, rows=rows) for kinds, some in _parts(described, several).items()
    )
    apart = [one for one in mixed.values() if one.apart]
    return Relation(
        f"(SELECT {columns} FROM ({scans}))",
        kept,
        {one.name: one.beside for one in apart},
        frozenset(one.name for one in apart if not one.other),
    )


Described = Sequence[tuple[Sequence[str], Mapping[str, str]]]
"""Files that have the same columns, and the types of these."""


def _names(described: Described) -> dict[str, str]:
    """The columns of all files in their order, as the first file calls them, by their names in lower case."""
    found: dict[str, str] = {}
    for _, columns in described:
        for name in columns:
            found.setdefault(name.lower(), name)
    return found


def _by_type(described: Described) -> dict[str, dict[str, list[str]]]:
    """The files by column, in lower case, and type."""
    found: dict[str, dict[str, list[str]]] = {}
    for files, columns in described:
        for name, kind in columns.items():
            found.setdefault(name.lower(), {}).setdefault(kind, []).extend(files)
    return found


def _parts(described: Described, several: Sequence[str]) -> dict[tuple[str | None, ...], list[str]]:
    """The files by what types they have in these columns."""
    found: dict[tuple[str | None, ...], list[str]] = {}
    for files, columns in described:
        theirs = {name.lower(): kind for name, kind in columns.items()}
        found.setdefault(tuple(map(theirs.get, several)), []).extend(files)
    return found


def _scan(mixed: Iterable[_Mixed], kinds: Iterable[str | None], files: Sequence[str], *, rows: bool) -> str:
    """The query for rows of files that have these types in columns which others have otherwise."""
    those = [(one, kind) for one, kind in zip(mixed, kinds, strict=True) if kind is not None]
    cells = ", ".join(f"{one.cell(kind)} AS {identifier(one.name)}" for one, kind in those)
    texts = "".join(f", {text} AS {identifier(one.beside)}" for one, kind in those if (text := one.text(kind)))
    return f"SELECT *{f' REPLACE ({cells})' if cells else ''}{texts} FROM {read_parquet(files, union=True, rows=rows)}"


def _described(fetch: Fetch, files: Sequence[str]) -> list[tuple[list[str], dict[str, str]]]:
    """The files that have the same columns, and these with their types; in the order of the files."""
    groups = [list(files)]
    if len(files) > 1:
        own = {steady(file): file for file in files}
        places = {file: place for place, file in enumerate(files)}
        alike = (
            f"SELECT list(file_name) FROM (SELECT file_name, list((name, duckdb_type, num_children)) AS columns "
            f"FROM {parquet_schema(files)} GROUP BY file_name) GROUP BY columns"
        )
        groups = sorted(
            (sorted((own[file] for file in some), key=places.__getitem__) for (some,) in fetch(alike)),
            key=lambda some: places[some[0]],
        )
    return [(some, {row[0]: row[1] for row in fetch(f"DESCRIBE SELECT * FROM {read_parquet(some[:1])}")}) for some in groups]


@dataclass(frozen=True, slots=True)
class _Mixed:
    """A column that has several types."""

    name: str
    beside: str
    """What a column beside it is called."""
    type: str
    """That it becomes; empty where DuckDB's own is right."""
    empty: frozenset[str]
    """Types of files in which it has no value."""
    other: bool = False
    """Whether numbers are among other things."""
    rounded: bool = False
    """Whether there are numbers that DOUBLE does not hold."""

    @property
    def apart(self) -> bool:
        """Whether something stands in a column beside it."""
        return self.other or self.rounded

    @property
    def column(self) -> str:
        return identifier(self.name)

    def types(self) -> dict[str, str]:
        """What it becomes: itself, and the column beside it."""
        return {self.name: self.type, **({self.beside: "VARCHAR"} if self.apart else {})}

    def cell(self, kind: str) -> str:
        """The expression of its value, in files where it has this type."""
        if kind in self.empty:
            return f"NULL::{self.type or kind}"
        if not self.type:
            return self.column
        if is_number(self.type) and not is_number(kind):
            return reads_as(self.column, self.type) if kind == "VARCHAR" else f"NULL::{self.type}"
        return f"CAST({self.column} AS {self.type})"

    def text(self, kind: str) -> str | None:
        """The expression of what stands beside it."""
        if not self.apart or kind in self.empty:
            return None
        if not is_number(kind):
            return f"CAST({self.column} AS VARCHAR)"
        return f"CASE WHEN {is_inexact(self.column, kind)} THEN CAST({self.column} AS VARCHAR) END" if self.rounded else None


def _mixed(fetch: Fetch, name: str, beside: str, kinds: Mapping[str, Sequence[str]], where: str) -> _Mixed:
    """How a column is read that has these types, each in some files."""
    column = identifier(name)

    def seen(kind: str, what: str) -> Any:
        [(found,)] = fetch(f"SELECT {what} FROM {read_parquet(kinds[kind], union=True)} WHERE {where}")
        return found

    def has_values(kind: str) -> bool:
        return kind != EMPTY and bool(seen(kind, f"count({column}) > 0"))

    others = [kind for kind in kinds if not is_number(kind) and has_values(kind)]
    numbers = [kind for kind in kinds if is_number(kind) and (not others or has_values(kind))]
    empty = frozenset(kinds) - {*numbers, *others}
    if not numbers:
        return _Mixed(name, beside, _common(others), empty)
    texts = seen("VARCHAR", f"bit_or({bit(column)})") & NUMBERS if "VARCHAR" in others else 0
    kind = _widest([*numbers, *([narrowest(texts) or ""] if texts else [])])
    exact = [one for one in numbers if one not in ("DOUBLE", "FLOAT")] if kind == "DOUBLE" else []
    rounded = any(seen(one, f"count_if({is_inexact(column, one)}) > 0") for one in exact)
    return _Mixed(name, beside, kind, empty, bool(others), rounded)


def _common(kinds: Sequence[str]) -> str:
    """The type that holds what are no numbers; empty where DuckDB's own does."""
    if len(kinds) < 2:
        return next(iter(kinds), "BOOLEAN")
    return "" if all(map(_is_time, kinds)) or not any(map(_is_plain, kinds)) else "VARCHAR"


def _widest(kinds: Sequence[str]) -> str:
    """The type that holds all of these numbers: whole ones exactly, others as DOUBLE."""
    if len(set(kinds)) == 1:
        return kinds[0]
    if all(map(is_whole, kinds)):
        return HUGE if {HUGE, "UBIGINT", "HUGEINT", "UHUGEINT"} & set(kinds) else "BIGINT"
    return "DOUBLE"


def _is_time(kind: str) -> bool:
    return kind.startswith(("DATE", "TIMESTAMP"))


def _is_plain(kind: str) -> bool:
    return not kind.startswith(("STRUCT", "MAP", "UNION")) and not kind.endswith("]")
