"""Redaction: rewriting the records of a store, so that they no longer show who executed runs, where and when.

The decision about each column is beside the column, in `sierra.store.row_types`; a column without one stops the command. Ids of
batches, experiments, runs, executions and sessions, hashes of outputs and of programs, and all rows and files that runs wrote
stay as they are. The table `redactions` names the sessions whose records were rewritten. Texts that are kept may contain names
all the same: see `sierra.packages.anonymity.content_search`.

Each segment is written again, under the new name that its new hashes give. Files without a column to rewrite stay as they are.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from sierra.errors import Damaged
from sierra.maintenance.extract import link_or_copy
from sierra.packages.anonymity.redact_rows import HIDDEN, RowRedactor
from sierra.store.compaction import write_whole_file
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.row_types import Redaction, RedactionRow
from sierra.store.schema import RECORDED, arrow_schema
from sierra.store.segments import OUTPUT, Segment, Writer, disk_errors
from sierra.store.sql_names import quote
from sierra.store.store import Snapshot, Store
from sierra.store.verified_files import verify

VERSION = "sierra redaction 1"
"""The version of the rules, which the table `redactions` names."""
RULES: Mapping[str, Mapping[str, Redaction | None]] = {
    name: {column.name: column.redaction for column in table.columns} for name, table in RECORDED.items()
}
"""The decision about each column, by table. Texts in columns that are kept are searched for names."""
ROWS = 65_536
MARKS = "redactions"
MARKED = {
    **dict.fromkeys(("executions", "sessions", "builds", "attempts", "captures", MARKS), "session"),
    "replays": "replay",
    "registered_claims": "session",
}
"""The column with the session, by table."""
BATCHLESS = ("registered_claims",)
"""The marked tables whose records belong to no batch."""


def rewrite(store: Store, folder: Path, date: str) -> None:
    """Rewrite all records of a store that nobody else uses, in place. `folder`: a folder for temporary files.

    `date`: the date (ISO 8601) of the last record afterwards. Raises Damaged for a column without a decision.
    """
    writers = []
    with store.snapshot() as snapshot:
        redactor = _Redactor(snapshot, date)
        for number, segment in enumerate(snapshot.segments):
            writers.append(store.writer(folder / str(number), segment.batch))
            redactor.write(segment, writers[-1])
        names = [segment.name for segment in snapshot.segments]
    with disk_errors(store.paths.segments):
        for name in names:
            shutil.rmtree(store.paths.segments / name)
    for writer in writers:
        store.publish(writer)


def rule(table: str, column: str) -> Redaction:
    """Return the decision about a column. Raises Damaged if there is none."""
    decision = RULES.get(table, {}).get(column)
    if decision is None:
        raise Damaged(f"the table {table} has a column {column!r} that this SIERRA cannot make anonymous")
    return decision


class _Redactor:
    def __init__(self, snapshot: Snapshot, date: str) -> None:
        self._snapshot = snapshot
        snapshot.views.make(tuple(RULES))
        self._rows = RowRedactor(snapshot)
        self._shift = _shift(snapshot, date)
        self._changes: dict[Redaction, Callable[[str], str]] = {
            Redaction.HOST: self._rows.host,
            Redaction.ROBOT: self._rows.robot,
            Redaction.PACKAGE: self._rows.package,
            Redaction.HIDDEN: lambda text: HIDDEN,
            Redaction.ATTEMPT: self._rows.attempt,
            Redaction.PLACE: self._rows.place,
            Redaction.ENVIRONMENT: self._rows.environment,
            Redaction.SOURCE: self._rows.source,
            Redaction.ISOLATION: self._rows.isolation,
        }

    def write(self, segment: Segment, writer: Writer) -> None:
        """Write a segment again. Raises Damaged if a file is not the recorded one."""
        verify(segment.files.values())
        for name, path in segment.files.items():
            if name == MARKS:
                continue
            with disk_errors(writer.folder):
                if name.startswith(OUTPUT) or not _is_rewritten(name, path):
                    write_whole_file(writer.path(name), name, path, link_or_copy)
                else:
                    _write(writer.path(name), name, self._tables(name, path))
        writer.records(self._marks(segment))

    def _tables(self, name: str, path: str) -> Iterator[pa.Table]:
        with pq.ParquetFile(path) as file:
            for batch in file.iter_batches(ROWS):
                yield self._rewritten(name, pa.Table.from_batches([batch]).replace_schema_metadata(None))

    def _rewritten(self, name: str, table: pa.Table) -> pa.Table:
        change = self._rows.by_table.get(name)
        if change is not None:
            return pa.Table.from_pylist([row for record in table.to_pylist() if (row := change(record))], schema=table.schema)
        columns = [self._column(rule(name, column), table.column(column)) for column in table.column_names]
        return pa.table(columns, names=table.column_names)

    def _column(self, decision: Redaction, column: pa.ChunkedArray) -> pa.ChunkedArray:
        match decision:
            case Redaction.KEEP:
                return column
            case Redaction.NOTHING:
                return pa.chunked_array([pa.nulls(len(column), column.type)])
            case Redaction.TIME:
                return pc.add(column, pa.scalar(self._shift, pa.duration("us")))
            case _:
                return _mapped(column, self._changes[decision])

    def _marks(self, segment: Segment) -> list[RedactionRow]:
        """Return a mark for each session in a segment."""
        named = [
            f"SELECT {key}, {quote('') if table in BATCHLESS else 'batch'} "  # noqa: S608 - our own names
            f"FROM {read_parquet([segment.files[table]])}"
            for table, key in MARKED.items()
            if table in segment.files
        ]
        pairs = {(str(session), str(batch)) for statement in named for session, batch in self._snapshot.run(statement)}
        return [RedactionRow(session, batch, VERSION) for session, batch in sorted(pairs)]


def _shift(snapshot: Snapshot, date: str) -> timedelta:
    """Return the duration by which times are moved, so that the last one is at the date."""
    times = [
        f"SELECT epoch_us(max({name})) FROM {table}"  # noqa: S608 - our own names
        for table, columns in RULES.items()
        for name, decision in columns.items()
        if decision is Redaction.TIME
    ]
    last = max((time for statement in times for (time,) in snapshot.run(statement) if time is not None), default=0)
    moment = datetime.fromisoformat(date)
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return moment - (datetime.fromtimestamp(0, UTC) + timedelta(microseconds=last))


def _is_rewritten(name: str, path: str) -> bool:
    columns = pq.read_schema(path).names
    own = columns[: len(RECORDED[name].columns)] if name == "experiments" else columns
    return any(rule(name, column) is not Redaction.KEEP for column in own)


def _write(target: Path, name: str, tables: Iterator[pa.Table]) -> None:
    """Write tables of records; an older file lacks the last columns."""
    writer = None
    try:
        for table in tables:
            if table.num_rows:
                schema = pa.schema(list(arrow_schema(name))[: table.num_columns])
                writer = writer or pq.ParquetWriter(target, schema, compression="zstd")
                writer.write_table(table.cast(schema))
    finally:
        if writer is not None:
            writer.close()


def _mapped(column: pa.ChunkedArray, change: Callable[[str], str]) -> pa.ChunkedArray:
    """Return a column of texts in which each different text is changed once."""
    chunks = [_mapped_chunk(chunk, change) for chunk in column.chunks]
    return pa.chunked_array(chunks, column.type)


def _mapped_chunk(chunk: Any, change: Callable[[str], str]) -> pa.Array:
    if pa.types.is_list(chunk.type):
        return pa.array([None if row is None else [change(text) for text in row] for row in chunk.to_pylist()], chunk.type)
    encoded = chunk.dictionary_encode()
    values = pa.array([change(text) for text in encoded.dictionary.to_pylist()], chunk.type)
    return values.take(encoded.indices)
