"""Statistics: `sierra.stats` compared with DuckDB's bare aggregates on 10 million rows.

    python tests/bench/bench_statistics.py [experiments] [runs] [rows]          default: 100 100 1000

It prints the CPU seconds of each, the fastest of several, because other processes do not change them much. A bare `avg` depends
on the order of rows; to sort the values of each group is the least that a result costs which does not.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import duckdb

from sierra.stats import aggregate as stats
from sierra.stats.selection import Selection

REPEATS = 3
AVERAGE = "SELECT experiment, t, count(value), avg(value), stddev_samp(value) FROM samples GROUP BY ALL ORDER BY experiment, t"
SORTED = "SELECT experiment, t, list_sort(list(value)) FROM samples GROUP BY ALL ORDER BY experiment, t"


class Frame:
    """Samples in memory."""

    def __init__(self, experiments: int, runs: int, rows: int) -> None:
        self.connection = duckdb.connect()
        self.connection.execute(
            "CREATE TABLE samples AS SELECT (i // ($runs * $rows))::INTEGER AS experiment, 'r' || (i // $rows) AS run, "
            "((i // $rows) % $runs)::INTEGER AS number, (i % $rows)::DOUBLE AS t, sin(i * 0.7) + (i % $rows) AS value "
            "FROM range($all) one(i)",
            {"runs": runs, "rows": rows, "all": experiments * runs * rows},
        )

    def sql(self, text: str, /, **params: Any) -> Any:
        return self.connection.sql(text, params=params).to_arrow_table()


def fastest(what: Callable[[], object]) -> float:
    """Return the CPU seconds of the fastest of several calls."""
    found = []
    for _ in range(REPEATS):
        began = time.process_time()
        what()
        found.append(time.process_time() - began)
    return min(found)


def main(experiments: int = 100, runs: int = 100, rows: int = 1000) -> None:
    """Measure and print."""
    frame = Frame(experiments, runs, rows)
    samples = stats.ColumnStatistics(frame, stats.coverage(frame))
    least = fastest(lambda: frame.sql(SORTED))
    for what, cost in (
        ("DuckDB: avg and stddev, in the order of rows", fastest(lambda: frame.sql(AVERAGE))),
        ("DuckDB: sorted values", least),
        ("times and numbers of rows", fastest(lambda: stats.coverage(frame))),
        ("mean with its interval, over time", fastest(lambda: samples.by_time(["interval"]))),
        ("median with quartiles, over time", fastest(lambda: samples.by_time(["median", "quartiles"]))),
        ("q90 with its interval, over time", fastest(lambda: samples.by_time(Selection.of(["q90"], {})))),
        ("mean with its interval, of last values", fastest(lambda: samples.by_experiment("final", ["interval"]))),
    ):
        print(f"{what:46} {cost:6.2f} s CPU, {cost / least:5.2f} × sorted values", flush=True)
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:4]))
