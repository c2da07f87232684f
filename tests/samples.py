"""Samples in memory, as statistics get them from the store."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

import duckdb
import pyarrow as pa

from sierra.stats import aggregate as stats


@cache
def database(threads: int) -> duckdb.DuckDBPyConnection:
    """Return an empty database in memory, made once, because opening one takes long. A cursor sees its own tables only."""
    return duckdb.connect(config={"threads": threads})


class Memory:
    """A frame in memory: rows of (experiment, number of the run, t, value)."""

    def __init__(self, rows: Iterable[tuple[int, int, float, float | None]], threads: int = 2) -> None:
        rows = list(rows)
        columns: list[Any] = list(zip(*rows, strict=True)) or [()] * 4
        table = pa.table(
            {
                "experiment": pa.array(columns[0], pa.int32()),
                "run": pa.array([f"{e}-{n}" for e, n, *_ in rows], pa.string()),
                "number": pa.array(columns[1], pa.int32()),
                "t": pa.array(columns[2], pa.float64()),
                "shared_t": pa.array(columns[2], pa.float64()),
                "value": pa.array(columns[3], pa.float64(), from_pandas=False),
                "file": pa.nulls(len(rows), pa.string()),
                "place": pa.nulls(len(rows), pa.int64()),
            }
        )
        self.connection = database(threads).cursor()
        self.connection.register("given", table)
        self.connection.execute("CREATE TEMP TABLE samples AS SELECT * FROM given")

    def sql(self, text: str, /, **params: Any) -> pa.Table:
        return self.connection.sql(text, params=params).to_arrow_table()


def samples(column: stats.Column, *, rate: bool = False) -> stats.ColumnStatistics:
    return stats.ColumnStatistics(column, stats.coverage(column), rate)
