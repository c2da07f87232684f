"""Records written to Parquet files by DuckDB, which needs neither pyarrow nor numpy for it: these take long to load."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.store.connections import connect
from sierra.store.duckdb_file_io import copy
from sierra.store.duckdb_messages import disk_error, first_line
from sierra.store.sql_names import unnested

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

AT_A_TIME = 4096
"""The number of rows that DuckDB gets at a time."""
PYTHON_TYPES: Mapping[str, tuple[type, ...]] = {
    "VARCHAR": (str,),
    "BIGINT": (int,),
    "DOUBLE": (float, int),
    "BOOLEAN": (bool,),
    "TIMESTAMP WITH TIME ZONE": (datetime,),
    "VARCHAR[]": (list, tuple),
    "BLOB": (bytes,),
}
"""The types of the values of a column by its SQL type. DuckDB itself would convert others: 1.5 to 2 for BIGINT."""

_connections: dict[int, DuckDBPyConnection] = {}
"""The connection of this process, by process id: a forked process does not inherit DuckDB's threads."""


def write(target: Path, columns: Mapping[str, str], rows: Iterable[Sequence[object]]) -> None:
    """Write rows to a Parquet file; write none if there are no rows.

    `columns`: the SQL type of each column by name, in the order of the values in a row.
    Raises Missing if the disk is full or read-only, TypeError or ValueError for a value that is not of its column's type.
    """
    import duckdb

    rows = iter(rows)
    part = list(itertools.islice(rows, AT_A_TIME))
    if not part:
        return
    select = unnested(columns)
    connection = _connection()
    try:
        if len(part) < AT_A_TIME:
            connection.execute(copy(select, target), _values(columns, part))
            return
        connection.execute(f"CREATE OR REPLACE TEMP TABLE written AS {select}", _values(columns, part))
        while part := list(itertools.islice(rows, AT_A_TIME)):
            connection.execute(f"INSERT INTO written {select}", _values(columns, part))
        connection.execute(copy("FROM written", target))
        connection.execute("DROP TABLE written")
    except duckdb.IOException as error:
        raise disk_error(target.parent, error) from error
    except duckdb.Error as error:
        raise ValueError(f"{target.name}: {first_line(error)}") from error


def _connection() -> DuckDBPyConnection:
    connection = _connections.get(os.getpid())
    if connection is None:
        connection = connect()
        connection.execute("SET threads = 1")
        connection.execute("PRAGMA disable_optimizer")  # there is nothing to optimize, and it takes half of the time
        _connections[os.getpid()] = connection
    return connection


def _values(columns: Mapping[str, str], rows: Sequence[Sequence[object]]) -> list[list[object]]:
    """Return the values of each column. Raises TypeError for a value that is not of its column's type."""
    values = [list(column) for column in zip(*rows, strict=True)]
    for (name, kind), column in zip(columns.items(), values, strict=True):
        for found in set(map(type, column)) - {type(None)}:
            if not issubclass(found, PYTHON_TYPES[kind]) or (found is bool and kind != "BOOLEAN"):
                raise TypeError(f"the column {name} of type {kind} has a value of type {found.__name__}")
        if kind == "TIMESTAMP WITH TIME ZONE" and any(isinstance(one, datetime) and one.tzinfo is None for one in column):
            raise ValueError(f"the column {name} has a time without a time zone")
    return values
