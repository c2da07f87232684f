"""The records of segments that no index names, kept in memory while a command makes one snapshot after the other.

DuckDB opens each file of a view again for each statement, even for one that reads a single row. So the rows of small files are
read once, and those of segments that come later are added: the order of the rows is that in which this process has seen them.
Users' statements could list these tables, so that a snapshot for such statements has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sierra.store.duckdb_file_io import read_parquet
from sierra.store.schema import LATER, sql_types
from sierra.store.sql_names import identifier
from sierra.store.verified_files import size_of, verify

SCHEMA = identifier("rest rows")
MOST_BYTES = 1 << 20
"""The size of the files of a table above which they are read where they are."""

Execute = Callable[[str], object]


class RestRows:
    """The tables of one connection."""

    def __init__(self) -> None:
        self._held: dict[str, tuple[set[str], int]] = {}
        """The files whose rows are held, and their size, by table."""

    def relation(self, name: str, files: Sequence[str], execute: Execute) -> str:
        """Return the relation of the rows in these files of a table of records; "" if they are too large. Raises duckdb.Error.

        Raises Damaged if a file is not the recorded one, also if it has changed since it was read.
        """
        verify(files)
        table = f"{SCHEMA}.{identifier(name)}"
        held, size = self._held.get(name, (set(), 0))
        if not held <= set(files):
            del self._held[name]
            execute(f"DROP TABLE {table}")
            held, size = set(), 0
        new = [file for file in files if file not in held]
        size += sum(map(size_of, new))
        if size > MOST_BYTES:
            return ""
        if not self._held:
            execute(f"CREATE SCHEMA IF NOT EXISTS {SCHEMA}")
        if name not in self._held:
            columns = ", ".join(f"{identifier(column)} {kind}" for column, kind in sql_types(name).items())
            execute(f"CREATE OR REPLACE TABLE {table} ({columns})")
        self._held[name] = held, size
        if new:
            execute(f"INSERT INTO {table} BY NAME SELECT * FROM {read_parquet(new, union=name in LATER, check=False)}")
            self._held[name] = held | set(new), size
        return table

    def clear(self, execute: Execute) -> None:
        """Forget all rows."""
        if self._held:
            self._held.clear()
            execute(f"DROP SCHEMA {SCHEMA} CASCADE")
