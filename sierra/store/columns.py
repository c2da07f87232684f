"""The files of one table as one relation: what is a number in some of them stays one, and what is none is told apart.

A column that a file does not have is NULL there. One that holds numbers in some files, and texts, flags or dates in others,
becomes two: the numbers under its name, and beside them, with `_text` behind the name, the cells of the other files as they
are. A text that reads as a number is in both. Whole numbers and decimals that DOUBLE cannot hold are told apart in the same
way where other files have fractions: the nearest number under the name, all digits beside it.

DuckDB's own union would make texts of all numbers, 1 of true, dates of whole numbers, and whole numbers of decimals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sierra.store.names import column_names, identifier
from sierra.store.reading.kinds import EMPTY, HUGE, bit, is_inexact, is_number, is_whole, narrowest, reads_as
from sierra.store.scans import parquet_schema, read_parquet, steady

Fetch = Callable[[str], Sequence[Sequence[Any]]]
"""Executes a statement; its rows."""
PLACES = ("filename", "file_row_number")
"""Columns that say where a row is from; they stand behind all others."""
TEXT = "_text"


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
    union = len(described) > 1
    types: dict[str, dict[str, list[str]]] = {}
    names: dict[str, str] = {}
    for some, columns in described:
        for name, kind in columns.items():
            names.setdefault(name.lower(), name)
            types.setdefault(name.lower(), {}).setdefault(kind, []).extend(some)
    mixed = {name: _mixed(fetch, identifier(names[name]), kinds, where) for name, kinds in types.items() if len(kinds) > 1}
    if not mixed:
        return Relation(read_parquet(files, union=union, rows=rows), {names[name]: next(iter(types[name])) for name in names})
    beside = dict(zip(mixed, column_names([names[name] + TEXT for name in mixed], taken=names.values()), strict=True))
    parts: dict[tuple[str | None, ...], list[str]] = {}
    for some, columns in described:
        theirs = {name.lower(): kind for name, kind in columns.items()}
        parts.setdefault(tuple(theirs.get(name) for name in mixed), []).extend(some)
    scans = []
    for signature, some in parts.items():
        cells, texts = [], []
        for (name, one), its in zip(mixed.items(), signature, strict=True):
            if its is not None:
                cells.append(f"{one.cell(its)} AS {identifier(names[name])}")
                texts += [f"{text} AS {identifier(beside[name])}"] if (text := one.text(its)) else []
        replaced = f" REPLACE ({', '.join(cells)})" if cells else ""
        scans.append(f"SELECT {', '.join([f'*{replaced}', *texts])} FROM {read_parquet(some, union=True, rows=rows)}")
    kept: dict[str, str] = {}
    for name, own in names.items():
        kept[own] = mixed[name].type if name in mixed else next(iter(types[name]))
        kept |= {beside[name]: "VARCHAR"} if name in mixed and mixed[name].beside else {}
    listed = ", ".join(map(identifier, [*kept, *(PLACES if rows else ())]))
    return Relation(
        f"(SELECT {listed} FROM ({' UNION ALL BY NAME '.join(scans)}))",
        kept,
        {names[name]: beside[name] for name, one in mixed.items() if one.beside},
        frozenset(names[name] for name, one in mixed.items() if one.beside and not one.other),
    )


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
    """A column that has several types, as an identifier."""

    column: str
    type: str
    """That it becomes; empty where DuckDB's own is right."""
    empty: frozenset[str]
    """Types of files in which it has no value."""
    other: bool = False
    """Whether numbers are among other things."""
    rounded: bool = False
    """Whether there are numbers that DOUBLE does not hold."""

    @property
    def beside(self) -> bool:
        """Whether what is no number stands in a column beside it."""
        return self.other or self.rounded

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
        if not self.beside or kind in self.empty:
            return None
        if not is_number(kind):
            return f"CAST({self.column} AS VARCHAR)"
        return f"CASE WHEN {is_inexact(self.column, kind)} THEN CAST({self.column} AS VARCHAR) END" if self.rounded else None


def _mixed(fetch: Fetch, column: str, kinds: Mapping[str, Sequence[str]], where: str) -> _Mixed:
    """How a column is read that has these types, each in some files."""

    def seen(kind: str, what: str) -> Any:
        [(found,)] = fetch(f"SELECT {what} FROM {read_parquet(kinds[kind], union=True)} WHERE {where}")
        return found

    numbers = [kind for kind in kinds if is_number(kind)]
    texts = (seen("VARCHAR", f"bit_or({bit(column)})") or 0) if "VARCHAR" in kinds else 0
    filled = [kind for kind in kinds if kind not in (*numbers, EMPTY, "VARCHAR") and seen(kind, f"count({column}) > 0")]
    others = [*filled, *(["VARCHAR"] if texts else [])]
    empty = frozenset(kinds) - {*numbers, *others}
    if not numbers:
        alike = len(others) < 2 or all(map(_is_time, others)) or not any(map(_is_plain, others))
        return _Mixed(column, ("" if len(others) > 1 else next(iter(others), "BOOLEAN")) if alike else "VARCHAR", empty)
    kind = _widest([*numbers, *([narrowest(texts & 14) or "BIGINT"] if texts & 14 else [])])
    exact = [one for one in numbers if one not in ("DOUBLE", "FLOAT")] if kind == "DOUBLE" else []
    rounded = any(seen(one, f"count_if({is_inexact(column, one)}) > 0") for one in exact)
    return _Mixed(column, kind, empty, bool(others), rounded)


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
