"""Comparing an index with the segments that it names, for `sierra fsck`: it reads both, and trusts neither."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import duckdb

from sierra.store.connections import connect
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.index_files import IndexFile
from sierra.store.index_reader import DATABASE, EQUAL, EXPERIMENTS, OWN, STORED, Fetch, Index, attach, facts_of
from sierra.store.listing import Listing
from sierra.store.schema import RECORDED
from sierra.store.segments import Segment
from sierra.store.sql_names import identifier
from sierra.store.sql_result import RawRow
from sierra.store.union_files import read_columns
from sierra.store.views import Views, records

SUM = "SELECT count(*), sum(hash(t)::HUGEINT)::VARCHAR FROM ({rows}) t"


def different(index: IndexFile, segments: Mapping[str, Segment]) -> list[str]:
    """Return the tables whose rows in an index do not follow from these segments, by name; all of them if it cannot be read.

    Segments that are not among these are not compared. Results are only if none is missing.
    """
    connection = connect()

    def fetch(statement: str) -> list[RawRow]:
        return connection.execute(statement).fetchall()

    try:
        connection.execute(attach(index))
        facts = facts_of(index, fetch)
        current = {number: name for name, number in facts.numbers.items() if name not in facts.ignored}
        named = {number: segments[name] for number, name in current.items() if name in segments}
        tables = [table for table in RECORDED if _differs(connection, table, named)]
        if len(named) == len(current) and not tables:
            listing = Listing([index.path.parent.parent / "segments"], segments=list(named.values()))
            tables = [*_other_results(connection, listing), *_other_outputs(fetch, Index(fetch, listing, facts), listing)]
        return tables
    except duckdb.Error:
        return list(RECORDED)
    finally:
        connection.close()


def _other_results(connection: duckdb.DuckDBPyConnection, listing: Listing) -> Iterator[str]:
    """Yield the names of the results that do not follow from these segments."""
    for name, query in Views(lambda: connection, listing).results():
        if _sum(connection, f"FROM {DATABASE}.{STORED}{name}") != _sum(connection, query):
            yield name


def _other_outputs(fetch: Fetch, index: Index, listing: Listing) -> Iterator[str]:
    """Yield the names of the outputs of which the index has other files or columns, or other values of expressions."""
    files: dict[str, list[str]] = {}
    for segment in listing.rest:
        for name, path in segment.outputs():
            files.setdefault(name.lower(), []).append(path)
    for name in sorted({name.lower() for name in index.spellings()} | files.keys()):
        columns = {path: types for some, types in read_columns(fetch, files.get(name, [])) for path in some}
        same = {file.path: file.columns for file in index.outputs(name)} == columns
        if not same or any(_other_answers(fetch, index, name, question, columns) for question in index.questions(name)):
            yield name


def _other_answers(fetch: Fetch, index: Index, output: str, question: str, columns: Mapping[str, Mapping[str, str]]) -> bool:
    """Compare the values of an expression over files; those with other columns apart, because DuckDB cannot unite all types."""
    groups: dict[tuple[tuple[str, str], ...], dict[str, int]] = {}
    for file, value in index.answers(output, question).items():
        groups.setdefault(tuple(columns[file].items()), {})[file] = value
    sources = ((read_parquet(list(known), filename=True, check=False), known) for known in groups.values())
    asked = f"SELECT filename, coalesce({question}, 0)::INTEGER FROM"
    return any(dict(fetch(f"{asked} {source} GROUP BY filename")) != known for source, known in sources)


def _differs(connection: duckdb.DuckDBPyConnection, table: str, segments: Mapping[int, Segment]) -> bool:
    """Compare the rows of a table of these segments, which have numbers in the index."""
    columns = [column.name for column in RECORDED[table].columns if column.type != "BLOB"]
    shown = ", ".join(map(identifier, columns))
    sources = [f"{DATABASE}.{table}"]
    if table == EXPERIMENTS:  # the ids of experiments follow from the values of the axes
        sets = connection.execute(f"SELECT number FROM {DATABASE}.experiment_sets").fetchall()
        sources = [f"{DATABASE}.{EXPERIMENTS}_{number}" for (number,) in sets]
    theirs = f"WHERE {OWN if table == EXPERIMENTS else 'seg'} IN ({', '.join(map(str, segments)) or 'NULL'})"
    distinct = "DISTINCT " * (table in EQUAL)
    if table in EQUAL:
        theirs = f"WHERE file_number IN (SELECT file_number FROM {DATABASE}.equal_file_of {theirs})"
    held = " UNION ALL ".join(f"SELECT {distinct}{shown} FROM {source} {theirs}" for source in sources)
    return _sum(connection, held) != _sum(connection, _written(table, f"{distinct}{shown}", list(segments.values())))


def _sum(connection: duckdb.DuckDBPyConnection, rows: str) -> object:
    return connection.execute(SUM.format(rows=rows)).fetchall()[0] if rows else (0, None)


def _written(table: str, columns: str, segments: Sequence[Segment]) -> str:
    """Return the query for the rows of a table in the files of these segments; nothing if there is none."""
    files = [segment.files[table] for segment in segments if table in segment.files]
    return f"SELECT {columns} FROM {records(table, files, check=False)}" if files else ""
