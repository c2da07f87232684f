"""Outputs of many executions, effective or not: the rows of tables and the bytes of files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import TYPE_CHECKING

from sierra.errors import Damaged
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.recorded_files import holding, runs_of_keys
from sierra.store.store import Snapshot
from sierra.util.hashing import sha256

if TYPE_CHECKING:
    import pyarrow as pa

OWN = ("run", "execution", "file", "filename", "file_row_number")

Key = tuple[str, str, str | None]
"""A judgement, an output and, if the execution wrote several files of it, the file."""


def rows_of(snapshot: Snapshot, executions: Iterable[str], outputs: Iterable[str]) -> dict[Key, pa.Table]:
    """Return the tables of these outputs and judgements with their rows in order."""
    tables: dict[Key, pa.Table] = {}
    executions, outputs = sorted(set(executions)), set(outputs)
    segments = holding(snapshot, executions)
    snapshot.add_table("writers", execution=executions)
    for segment in segments:
        for output, path in segment.outputs():
            if output in outputs:
                tables |= {(execution, output, file): table for execution, file, table in _tables(snapshot, path)}
    return tables


def _tables(snapshot: Snapshot, path: str) -> Iterator[tuple[str, str | None, pa.Table]]:
    """Yield the tables in one file of a segment: the execution, the file, and the rows."""
    source = read_parquet([path], rows=True)
    many = any(row[0] == "file" for row in snapshot.run(f"DESCRIBE SELECT * FROM {source}"))
    key = f"execution || '/'{' || file' if many else ''}"
    statement = f'SELECT {key} AS "# key", * FROM {source} SEMI JOIN writers USING (execution) ORDER BY 1, file_row_number'
    table = snapshot.connection.sql(statement).to_arrow_table()
    rows = table.drop_columns([column for column in ("# key", *OWN) if column in table.column_names])
    for execution, file, begin, count in runs_of_keys(table.column(0).combine_chunks()):
        yield execution, file if many else None, rows.slice(begin, count)


def objects(snapshot: Snapshot, digests: Iterable[str]) -> dict[str, bytes]:
    """Return recorded files by their SHA-256. Raises Damaged if one is missing or has changed."""
    digests = set(digests)
    snapshot.add_table("digests", sha256=digests)
    source = snapshot.views.contents(digests)
    once = "DISTINCT ON (sha256, part) sha256, content"  # two writers may have added the same file
    statement = f"SELECT {once} FROM {source} SEMI JOIN digests USING (sha256) ORDER BY sha256, part"
    parts = groupby(snapshot.each(statement, {}), lambda row: row[0])
    contents = {digest: b"".join(content for _, content in rows) for digest, rows in parts}
    for digest in digests:
        if sha256(contents.get(digest, b"")) != digest:
            raise Damaged(
                f"the recorded file {digest} {'differs from the record' if digest in contents else 'is not in the store'}"
            )
    return contents
