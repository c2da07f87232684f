"""Reading an index that is attached to a connection: see `sierra.store.index_builder` for what its tables hold."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from collections.abc import Set as AbstractSet
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from sierra.store.index_files import IndexFile
from sierra.store.listing import Facts, Listing
from sierra.store.schema import RECORDED
from sierra.store.sql_names import identifier, quote
from sierra.store.sql_result import RawRow
from sierra.store.union_files import Held

DATABASE = f"index_{os.urandom(8).hex()}"
"""The name of the index on a connection, which nobody else's statement can guess: they see its rows only through views."""
EXPERIMENTS = "experiments"
"""The beginning of the names of the tables of experiments: one for each set of axes, because axes of one name may differ."""
STORED = "stored_"
"""The beginning of the names of tables of results: `stored_effective` and others."""
CONTENT = ("objects",)
"""Tables whose contents stay in the segments; the index knows only where they are."""

Fetch = Callable[[str], list[RawRow]]
_facts: dict[Path, Facts] = {}
"""The facts about the indexes that this process has read."""


def attach(index: IndexFile) -> str:
    """Return the statement that attaches an index to a connection. It names the index, because descriptors are used again."""
    return f"ATTACH {quote(index.readable)} AS {DATABASE} (TYPE duckdb, READ_ONLY)  -- {index.path.name}"


def facts_of(index: IndexFile, fetch: Fetch) -> Facts:
    """Return the segments that an attached index names. Raises duckdb.Error."""
    found = _facts.get(index.path)
    if found is None:
        found = _facts[index.path] = read_facts(fetch)
    return found


def read_facts(fetch: Fetch) -> Facts:
    """Return the segments that the index on a connection names."""
    segments = fetch(f"SELECT name, seg, ignored, replaces, after FROM {DATABASE}.segments ORDER BY name")
    filled = f"SELECT table_name FROM duckdb_tables() WHERE database_name = '{DATABASE}' AND estimated_size > 0"
    held = fetch(filled)
    tables = {"experiments" if name.startswith(EXPERIMENTS) else name for (name,) in held}
    return Facts(
        {name: seg for name, seg, *_ in segments},
        frozenset(name for name, _, ignored, *_ in segments if ignored),
        frozenset(name for name, _, ignored, replaces, _ in segments if replaces and not ignored),
        frozenset(row[0] for row in fetch(f"SELECT name FROM {DATABASE}.replaced")),
        frozenset(after for *_, ignored, _, after in segments if after is not None and not ignored),
        frozenset(tables & RECORDED.keys()),
        frozenset(name for name in tables if name.startswith(STORED)),
    )


class OutputFile(NamedTuple):
    """A file of an output in a segment that the index names."""

    segment: str
    path: str
    columns: Mapping[str, str]
    """The types of its columns."""


class Index:
    """The rows of an attached index that are current."""

    def __init__(self, fetch: Fetch, listing: Listing, facts: Facts) -> None:
        self._fetch = fetch
        self._facts = facts
        self._folder = listing.folders[0]
        self._without = listing.without
        self._rest = {name for segment in listing.rest for name in segment.files}

    def stored(self, name: str, needs: AbstractSet[str]) -> str:
        """Return the relation of a result that the index holds; "" if segments that it does not name have one of these tables.

        `needs`: the tables of records from which the result follows.
        """
        is_valid = STORED + name in self._facts.stored and not self._without and self._rest.isdisjoint(needs)
        return f"{DATABASE}.{STORED}{name}" if is_valid else ""

    def holds(self, table: str) -> bool:
        """Check whether the index has any row of a table of records."""
        return table in self._facts.tables

    def rows(self, table: str) -> str:
        """Return the relation of the indexed rows of a table, with all of its columns in order."""
        columns = ", ".join(identifier(column.name) for column in RECORDED[table].columns if column.type != "BLOB")
        return f"(SELECT {columns} FROM {DATABASE}.{table}{self._current})"

    @cached_property
    def _current(self) -> str:
        """The condition for the rows of current segments."""
        return f" WHERE seg NOT IN ({', '.join(map(str, sorted(self._without)))})" if self._without else ""

    def experiments(self, batch: str | None = None) -> list[Held]:
        """Return the indexed experiments, those with the same axes together; of one batch only, if one is named."""
        theirs = "" if batch is None else f" {'AND' if self._without else 'WHERE'} batch = {quote(batch)}"
        found = []
        for number, columns in self._fetch(f"SELECT number, columns FROM {DATABASE}.experiment_sets ORDER BY number"):
            source = f"(SELECT * EXCLUDE seg FROM {DATABASE}.{EXPERIMENTS}_{number}{self._current}{theirs})"
            of = f"{DATABASE}.{EXPERIMENTS}_{number} JOIN {DATABASE}.segments s USING (seg){self._current}{theirs}"
            [(first,)] = self._fetch(f"SELECT min(s.name) FROM {of}")
            if first is not None:
                found.append(Held(source, dict(json.loads(columns)), first))
        return found

    def spellings(self) -> dict[str, str]:
        """Return the indexed tables that runs wrote, each with the name of the first segment that has it."""
        of = f"{DATABASE}.outputs JOIN {DATABASE}.segments s USING (seg){self._current}"
        return dict(self._fetch(f"SELECT output, min(s.name) FROM {of} GROUP BY ALL"))

    def outputs(self, name: str) -> list[OutputFile]:
        """Return the indexed files of an output, whatever the case of its name, in the order of their segments."""
        described = {number: dict(json.loads(columns)) for number, columns in self._fetch(f"FROM {DATABASE}.column_sets")}
        of = f"{DATABASE}.outputs o JOIN {DATABASE}.segments s USING (seg){self._current}"
        return [
            OutputFile(segment, f"{self._folder}/{segment}/{file}", described[columns])
            for segment, output, file, columns in self._fetch(
                f"SELECT s.name, output, file, columns FROM {of} ORDER BY s.name, file"
            )
            if output.lower() == name.lower()
        ]

    def highest(self, tables: Iterable[str], column: str) -> int:
        """Return the highest value of a column of whole numbers in the current rows of these tables."""
        each = " UNION ALL ".join(f"SELECT max({column}) AS value FROM {DATABASE}.{table}{self._current}" for table in tables)
        [(highest,)] = self._fetch(f"SELECT coalesce(max(value), 0) FROM ({each})")
        return int(highest)

    def files(self, table: str) -> list[str]:
        """Return the paths of the files of a table whose contents stay in the segments."""
        of = f"{DATABASE}.{table} JOIN {DATABASE}.segments s USING (seg){self._current}"
        return [f"{self._folder}/{segment}/{table}.parquet" for (segment,) in self._fetch(f"SELECT DISTINCT s.name FROM {of}")]

    def recording(self, judgements: str) -> list[str]:
        """Return the names of the indexed segments that contain first or later judgements, for which this is a query."""
        found: set[str] = set()
        for table, column in (("executions", "execution"), ("judgements", "judgement")):
            rows = f"(FROM {DATABASE}.{table} WHERE {column} IN ({judgements}))"
            of = f"{rows} JOIN {DATABASE}.segments s USING (seg){self._current}"
            found |= {name for (name,) in self._fetch(f"SELECT DISTINCT s.name FROM {of}")}
        return sorted(found)

    def holding(self, digests: Iterable[str]) -> list[str]:
        """Return the names of the indexed segments that hold contents with these SHA-256s."""
        wanted = ", ".join(map(quote, digests)) or "NULL"
        of = f"(FROM {DATABASE}.objects WHERE sha256 IN ({wanted})) JOIN {DATABASE}.segments s USING (seg){self._current}"
        return [name for (name,) in self._fetch(f"SELECT DISTINCT s.name FROM {of} ORDER BY ALL")]
