"""Figures of many runs: computing time and memory of `sierra figures`, and of a statistic beside DuckDB's bare aggregate.

    python tests/bench/bench_drawing.py [experiments] [runs] [rows] [columns]

The runs are written by awk. The targets are those of 10 experiments, 100 runs, 1,000 rows and 9 columns: 6 CPU seconds and
300 MB for all default figures, and a statement that takes at most twice as long as the bare aggregate of the same column. Those
of 100 experiments, 100 runs, 1,000 rows and one column are 5 seconds and 1 GB for one time series with its band.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from idle import measured, project

import sierra
from sierra.stats import aggregate
from sierra.store.batch_data import BatchData, RecordedColumn
from sierra.store.store import Store

REPEATS = 3
SIERRA = str(Path(sys.executable).with_name("sierra"))
BARE = "SELECT experiment, t, avg(value), stddev(value), count(value) FROM samples GROUP BY experiment, t ORDER BY ALL"
SIMULATOR = """
awk -v rows={rows} -v columns={columns} -v seed="$(sed 's/.*experiment seed="\\([0-9]*\\)".*/\\1/' "$1")" 'BEGIN {{
  srand(seed); printf "tick"; for (c = 0; c < columns; c++) printf ",c%d", c; print ""
  for (t = 0; t < rows; t++) {{ printf "%d", t; for (c = 0; c < columns; c++) printf ",%.6f", t * c + rand(); print "" }}
}}' > out.csv
"""
FIGURES = (
    ("default figures", (), "at most 6 s CPU, 300 MB for 9 million values"),
    ("one time series", ("out_c0_timeseries",), "at most 5 s, 1 GB for 10 million values"),
)


def main(experiments: int = 10, runs: int = 100, rows: int = 1000, columns: int = 9) -> None:
    with tempfile.TemporaryDirectory(prefix="sierra-bench-") as folder:
        here = project(Path(folder), command="sh sim.sh {input}")
        (here / "sim.sh").write_text(SIMULATOR.format(rows=rows, columns=columns))
        query = (f"population_size=1:{experiments}:{experiments}", "--runs", str(runs), "--no-figures", "--yes")
        subprocess.run([SIERRA, "run", *query], cwd=here, check=True, stdout=subprocess.DEVNULL)
        for what, names, target in FIGURES:
            measured = [figures(here, *names) for _ in range(REPEATS)]
            seconds, cpu_seconds, memory = (min(values) for values in zip(*measured, strict=True))
            print(f"{what:40} {cpu_seconds:6.2f} s CPU  {seconds:6.2f} s  {memory / 1e6:6.0f} MB  ({target})")
        ours, bare = statements(here)
        ratio = ours / bare
        print(f"{'mean and interval over time / bare':40} {ours:6.2f} s CPU  {bare:6.2f} s  ratio {ratio:5.2f}  (at most 2)")


def figures(here: Path, *names: str) -> tuple[float, float, int]:
    """Draw the default figures, or the named one; return the seconds, the CPU seconds, and the largest memory in bytes."""
    return measured(here, SIERRA, "figures", str(sierra.open(here).batches[-1].batch), *names)


def statements(here: Path) -> tuple[float, float]:
    """Return the CPU seconds of the statistics of a line with its band, and of the bare aggregate, in one thread each."""
    with BatchData(Store(here / ".sierra"), str(sierra.open(here).batches[-1].batch)) as frame:
        column = RecordedColumn(frame, "out", "c0", "tick")
        samples = aggregate.ColumnStatistics(column, aggregate.coverage(column))
        frame._snapshot.run("SET threads = 1")
        times = [(cpu(lambda: samples.by_time(("mean", "interval"))), cpu(lambda: column.sql(BARE))) for _ in range(REPEATS)]
    ours, bare = (min(values) for values in zip(*times, strict=True))
    return ours, bare


def cpu(call: Callable[[], Any]) -> float:
    """Return the CPU seconds of a call."""
    began = time.process_time()
    call()
    return time.process_time() - began


if __name__ == "__main__":
    main(*map(int, sys.argv[1:5]))
