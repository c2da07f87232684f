"""Copies of recorded output rows, written under a new judgement that reads the same files in the same way."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from sierra.errors import Damaged
from sierra.store.connections import connect, keep_order
from sierra.store.duckdb_file_io import copy, read_parquet
from sierra.store.duckdb_messages import check_shortage, disk_error, first_line
from sierra.store.segments import OUTPUT, Writer, is_first_part
from sierra.store.store import Snapshot

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

ROWS = "SELECT o.* REPLACE (m.made AS execution) FROM {files} o JOIN made m ON o.execution = m.known"
HOLDING = "SELECT DISTINCT o.filename FROM {files} o SEMI JOIN made m ON o.execution = m.known"


def write_again(
    snapshot: Snapshot, writer: Writer, outputs: Iterable[str], new_judgements: Mapping[str, str]
) -> dict[str, int]:
    """Write the rows of these outputs again, in their order, under new judgements.

    `outputs` are names in lower case. `new_judgements` maps each known judgement to the new judgement.
    Return the number of rows per output. Raises Missing if the disk is full, Damaged if the store cannot be read.
    """
    import duckdb
    import pyarrow as pa

    connection = connect()
    try:
        connection.register(
            "made", pa.table({"known": pa.array(list(new_judgements), pa.string()), "made": list(new_judgements.values())})
        )
        keep_order(connection)
        return {name: _output(connection, snapshot, writer, name) for name in sorted(set(outputs))}
    except duckdb.IOException as error:
        raise disk_error(writer.folder, error) from error
    except duckdb.Error as error:
        check_shortage(error)
        raise Damaged(f"the store cannot be read: {first_line(error)}; see sierra fsck") from error
    finally:
        connection.close()


def _output(connection: DuckDBPyConnection, snapshot: Snapshot, writer: Writer, name: str) -> int:
    """Write the rows of one output and return their number. Files with the same columns become one file."""
    import pyarrow.parquet as pq

    called = {path: called for segment in snapshot.segments for called, path in segment.outputs() if called.lower() == name}
    if not called:
        return 0
    holding = connection.execute(HOLDING.format(files=read_parquet(list(called), filename=True))).fetchall()
    alike: dict[str, list[str]] = {}
    for (path,) in sorted(holding, key=lambda row: (not is_first_part(row[0]), row[0])):
        alike.setdefault(str(pq.read_schema(path).remove_metadata()), []).append(path)
    written = 0
    for index, files in enumerate(alike.values(), 1):
        target = writer.path(OUTPUT + called[files[0]] + (f"~{index}" if index > 1 else ""))
        connection.execute(copy(ROWS.format(files=read_parquet(files)), target, called[files[0]]))
        written += pq.read_metadata(target).num_rows
    return written
