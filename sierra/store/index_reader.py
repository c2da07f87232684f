"""Reading an index that is attached to a connection: see `sierra.store.index_builder` for what its tables hold."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from collections.abc import Set as AbstractSet
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from sierra.store.duckdb_file_io import steady
from sierra.store.index_files import IndexFile
from sierra.store.listing import Facts, Listing
from sierra.store.schema import RECORDED
from sierra.store.sql_names import identifier, quote
from sierra.store.sql_result import RawRow
from sierra.store.union_files import IndexedRows

DATABASE = f"index_{os.urandom(8).hex()}"
"""The name of the index on a connection, which nobody else's statement can guess: they see its rows only through views."""
EXPERIMENTS = "experiments"
"""The beginning of the names of the tables of experiments: one for each set of axes, because axes of one name may differ."""
OWN = identifier("own segment")
"""The column of these tables with the number of a row's segment. No axis has such a name."""
STORED = "stored_"
"""The beginning of the names of tables of results: `stored_effective` and others."""
FIRST_FILES = "SELECT output, min(s.name || '/' || file) FROM {outputs} GROUP BY ALL"
EQUAL = (
    *("blobs", "environments", "files_read", "images", "ingest_rules", "isolations", "listings", "programs", "shared_files"),
    *("sources", "specs"),
)
"""Tables of which many segments have equal files. The index has the rows of such a file once."""
IN_SEGMENTS = ("objects",)
"""Tables whose contents stay in the segments; the index knows only where they are."""

Fetch = Callable[[str], list[RawRow]]
_facts: dict[Path, Facts] = {}
"""The facts about the last index of each store that this process has read."""


def attach(index: IndexFile) -> str:
    """Return the statement that attaches an index to a connection. It names the index, because descriptors are used again."""
    return f"ATTACH {quote(steady(index.readable))} AS {DATABASE} (TYPE duckdb, READ_ONLY)  -- {index.path.name}"


def facts_of(index: IndexFile, fetch: Fetch) -> Facts:
    """Return the segments that an attached index names. Raises duckdb.Error."""
    found = _facts.get(index.path)
    if found is None:
        found = read_facts(fetch)
        for old in [path for path in list(_facts) if path.parent == index.path.parent]:
            _facts.pop(old, None)
        _facts[index.path] = found
    return found


def read_facts(fetch: Fetch) -> Facts:
    """Return the segments that the index on a connection names."""
    segments = fetch(f"SELECT name, seg, ignored, replaces, after FROM {DATABASE}.segments ORDER BY name")
    filled = f"SELECT table_name, estimated_size FROM duckdb_tables() WHERE database_name = '{DATABASE}' AND estimated_size > 0"
    tables = {EXPERIMENTS if name.startswith(EXPERIMENTS) else name: rows for name, rows in fetch(filled)}
    return Facts(
        {name: seg for name, seg, *_ in segments},
        frozenset(name for name, _, ignored, *_ in segments if ignored),
        frozenset(name for name, _, ignored, replaces, _ in segments if replaces and not ignored),
        frozenset(row[0] for row in fetch(f"SELECT name FROM {DATABASE}.replaced")),
        frozenset(after for *_, ignored, _, after in segments if after is not None and not ignored),
        {name: rows for name, rows in tables.items() if name in RECORDED},
        frozenset(name for name in tables if name.startswith(STORED)),
        dict(fetch(FIRST_FILES.format(outputs=f"{DATABASE}.outputs JOIN {DATABASE}.segments s USING (seg)"))),
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
        self._held: dict[str, bool] = {}

    def stored(self, name: str) -> str:
        """Return the relation of a result of all rows; "" if the index has none, or if not all of these rows are current."""
        return f"{DATABASE}.{STORED}{name}" if STORED + name in self._facts.stored and not self._without else ""

    def count(self, table: str) -> int:
        """Return the number of rows of a table of records, current or not."""
        return self._facts.tables.get(table, 0)

    def holds(self, table: str) -> bool:
        """Check whether the index has any current row of a table of records."""
        if table not in self._facts.tables or not self._without:
            return table in self._facts.tables
        if table not in self._held:
            rows = self.experiments() if table == EXPERIMENTS else self._fetch(f"SELECT 1 FROM {self.rows(table)} LIMIT 1")
            self._held[table] = bool(rows)
        return self._held[table]

    def rows(self, table: str) -> str:
        """Return the relation of the indexed rows of a table, with all of its columns in order.

        Of `objects`, only rows whose contents exist still: a lost file can be stored again, unless it is believed to be there.
        """
        columns = ", ".join(identifier(column.name) for column in RECORDED[table].columns if column.type != "BLOB")
        current = self._current_by("seg", self._lost(table)) if table in IN_SEGMENTS else self._current
        if table in EQUAL and current:
            current = f" WHERE file_number IN (SELECT file_number FROM {DATABASE}.equal_file_of{current})"
        return f"(SELECT {columns} FROM {DATABASE}.{table}{current})"

    @cached_property
    def _current(self) -> str:
        """The condition for the rows of current segments."""
        return self._current_by("seg")

    def _current_by(self, column: str, lost: AbstractSet[int] = frozenset()) -> str:
        without = self._without | lost
        return f" WHERE {column} NOT IN ({', '.join(map(str, sorted(without)))})" if without else ""

    def _lost(self, table: str) -> AbstractSet[int]:
        """Return the numbers of segments in which a file has been lost."""
        of = self._of_segments(f"(SELECT DISTINCT seg FROM {DATABASE}.{table})")
        segments = self._fetch(f"SELECT seg, s.name FROM {of}")
        return {seg for seg, name in segments if not os.path.exists(f"{self._folder}/{name}/{table}.parquet")}  # noqa: PTH110

    def _of_segments(self, rows: str) -> str:
        """Return the relation of current rows, each beside its segment s."""
        return f"{rows} JOIN {DATABASE}.segments s USING (seg){self._current}"

    def experiments(self, batch: str | None = None) -> list[IndexedRows]:
        """Return the indexed experiments, those with the same axes together; of one batch only, if one is named."""
        theirs = "" if batch is None else f" {'AND' if self._without else 'WHERE'} batch = {quote(batch)}"
        indexed = []
        for number, columns in self._fetch(f"SELECT number, columns FROM {DATABASE}.experiment_sets ORDER BY number"):
            current = self._current_by(OWN)
            source = f"(SELECT * EXCLUDE {OWN} FROM {DATABASE}.{EXPERIMENTS}_{number}{current}{theirs})"
            of = f"{DATABASE}.{EXPERIMENTS}_{number} JOIN {DATABASE}.segments s ON s.seg = {OWN}{current}{theirs}"
            [(first,)] = self._fetch(f"SELECT min(s.name) FROM {of}")
            if first is not None:
                indexed.append(IndexedRows(source, dict(json.loads(columns)), first))
        return indexed

    def spellings(self) -> Mapping[str, str]:
        """Return the indexed tables that runs wrote, each with the names of the first segment that has it and of the file."""
        if not self._without:
            return self._facts.spellings
        return dict(self._fetch(FIRST_FILES.format(outputs=self._of_segments(f"{DATABASE}.outputs"))))

    def outputs(self, name: str) -> list[OutputFile]:
        """Return the indexed files of an output, whatever the case of its name, in the order of their segments."""
        described = {number: dict(json.loads(columns)) for number, columns in self._fetch(f"FROM {DATABASE}.column_sets")}
        of = self._of_segments(f"{DATABASE}.outputs")
        return [
            OutputFile(segment, f"{self._folder}/{segment}/{file}", described[columns])
            for segment, output, file, columns in self._fetch(
                f"SELECT s.name, output, file, columns FROM {of} ORDER BY s.name, file"
            )
            if output.lower() == name.lower()
        ]

    def judgements(self) -> str:
        """Return the query for the indexed first and later judgements, each with the name of its segment."""
        first, later = (
            f"SELECT s.name AS segment, {column} AS judgement FROM {DATABASE}.{table} JOIN {DATABASE}.segments s USING (seg)"
            for table, column in (("executions", "execution"), ("judgements", "judgement"))
        )
        return f"{first}{self._current} UNION ALL {later}{self._current}"

    def questions(self, output: str) -> list[str]:
        """Return the SQL expressions whose values over files of an output are stored; its name is in lower case."""
        return [
            row[0] for row in self._fetch(f"SELECT DISTINCT question FROM {DATABASE}.answers WHERE output = {quote(output)}")
        ]

    def answers(self, output: str, question: str) -> dict[str, int]:
        """Return the stored values of an SQL expression over files of an output, whose name is in lower case.

        All rows of these files are of judgements of their own segments.
        """
        asked = f"(FROM {DATABASE}.answers WHERE output = {quote(output)} AND question = {quote(question)})"
        rows = self._fetch(f"SELECT s.name, file, value FROM {self._of_segments(asked)}")
        return {f"{self._folder}/{segment}/{file}": value for segment, file, value in rows}

    def highest(self, tables: Iterable[str], column: str) -> int:
        """Return the highest value of a column of whole numbers in the current rows of these tables."""
        each = " UNION ALL ".join(f"SELECT max({column}) AS value FROM {DATABASE}.{table}{self._current}" for table in tables)
        [(highest,)] = self._fetch(f"SELECT coalesce(max(value), 0) FROM ({each})")
        return int(highest)

    def files(self, table: str) -> list[str]:
        """Return the paths of the files of a table whose contents stay in the segments, also those of lost ones."""
        of = self._of_segments(f"{DATABASE}.{table}")
        return [f"{self._folder}/{segment}/{table}.parquet" for (segment,) in self._fetch(f"SELECT DISTINCT s.name FROM {of}")]

    def recording(self, judgements: str) -> list[str]:
        """Return the names of the indexed segments that contain first or later judgements, for which this is a query."""
        found: set[str] = set()
        for table, column in (("executions", "execution"), ("judgements", "judgement")):
            rows = f"(FROM {DATABASE}.{table} WHERE {column} IN ({judgements}))"
            of = self._of_segments(rows)
            found |= {name for (name,) in self._fetch(f"SELECT DISTINCT s.name FROM {of}")}
        return sorted(found)

    def holding(self, digests: Iterable[str], *, first: bool = False) -> list[str]:
        """Return the names of the indexed segments that hold contents with these SHA-256s; `first`: one for each part."""
        wanted = ", ".join(map(quote, digests)) or "NULL"
        of = self._of_segments(f"(FROM {DATABASE}.objects WHERE sha256 IN ({wanted}))")
        found = f"SELECT min(s.name) AS name FROM {of} GROUP BY sha256, part" if first else f"SELECT s.name FROM {of}"
        return [name for (name,) in self._fetch(f"SELECT DISTINCT name FROM ({found}) ORDER BY ALL")]
