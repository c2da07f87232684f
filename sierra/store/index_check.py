"""Comparing an index with the segments that it names, for `sierra fsck`: it reads both, and trusts neither."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import duckdb

from sierra.store.connections import connect
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.index_files import IndexFile
from sierra.store.index_reader import DATABASE, EXPERIMENTS, attach, facts_of
from sierra.store.schema import LATER, RECORDED
from sierra.store.segments import Segment
from sierra.store.sql_names import identifier

SUM = "SELECT count(*), sum(hash(t)::HUGEINT)::VARCHAR FROM ({rows}) t"


def different(index: IndexFile, segments: Mapping[str, Segment]) -> list[str]:
    """Return the tables whose rows in an index are not those of these segments, by name; all of them if it cannot be read.

    Segments that are not among these are not compared.
    """
    connection = connect()
    try:
        connection.execute(attach(index))
        facts = facts_of(index, lambda statement: connection.execute(statement).fetchall())
        named = {
            number: segments[name] for name, number in facts.numbers.items() if name in segments and name not in facts.ignored
        }
        return [table for table in RECORDED if _differs(connection, table, named)]
    except duckdb.Error:
        return list(RECORDED)
    finally:
        connection.close()


def _differs(connection: duckdb.DuckDBPyConnection, table: str, segments: Mapping[int, Segment]) -> bool:
    """Compare the rows of a table of these segments, which have numbers in the index."""
    columns = [column.name for column in RECORDED[table].columns if column.type != "BLOB"]
    shown = ", ".join(map(identifier, columns))
    sources = [f"{DATABASE}.{table}"]
    if table == EXPERIMENTS:  # the ids of experiments follow from the values of the axes
        sets = connection.execute(f"SELECT number FROM {DATABASE}.experiment_sets").fetchall()
        sources = [f"{DATABASE}.{EXPERIMENTS}_{number}" for (number,) in sets]
    theirs = f"WHERE seg IN ({', '.join(map(str, segments)) or 'NULL'})"
    held = " UNION ALL ".join(f"SELECT {shown} FROM {source} {theirs}" for source in sources)
    return _sum(connection, held) != _sum(connection, _written(table, shown, list(segments.values())))


def _sum(connection: duckdb.DuckDBPyConnection, rows: str) -> object:
    return connection.execute(SUM.format(rows=rows)).fetchall()[0] if rows else (0, None)


def _written(table: str, columns: str, segments: Sequence[Segment]) -> str:
    """Return the query for the rows of a table in the files of these segments; nothing if there is none."""
    files = [segment.files[table] for segment in segments if table in segment.files]
    schema = {column.name: column.type for column in RECORDED[table].columns} if table in LATER else None
    source = read_parquet(files, union=table == EXPERIMENTS, schema=schema, check=False) if files else ""
    return f"SELECT {columns} FROM {source}" if files else ""
