"""Figures: `sierra.deliverables.figures` compared with a script that draws the same aggregates in three formats.

    python tests/bench/bench_figures.py [experiments] [times] [figures]

Both draw a time series with bands and a summary with intervals for each of several columns, each in separate
processes, which print their CPU seconds with imports and those of drawing. The target is a ratio of at most 1.3.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

REPEATS = 5


def aggregates(experiments: int, times: int) -> tuple[Any, Any]:
    """Return a table over time and a table over the axis, as statistics in SQL compute them."""
    import numpy as np
    import pyarrow as pa

    rng = np.random.default_rng(1)
    t = np.tile(np.arange(times, dtype=float), experiments)
    ordinal = np.repeat(np.arange(experiments), times)
    mean = (ordinal + 1) * 20 * (1 - np.exp(-3 * t / times)) + np.convolve(rng.normal(0, 0.5, t.size), np.ones(9) / 9, "same")
    half = 2 + rng.random(t.size)
    series = {"experiment": ordinal, "t": t, "n": np.full(t.size, 10), "mean": mean}
    series |= {"mean_low": mean - half, "mean_high": mean + half}
    last = {name: values[times - 1 :: times] for name, values in series.items() if name != "t"}
    return pa.table(series), pa.table({**last, "never": np.zeros(experiments, dtype=int)})


def ours(experiments: int, times: int, figures: int, folder: Path) -> float:
    """Return the CPU seconds of SIERRA."""
    from sierra.config.deliverable_tables import Figure
    from sierra.deliverables.figures.drawing import Drawing, draw
    from sierra.model import Axis

    series, last = aggregates(experiments, times)
    axis = Axis("population_size", tuple(2**k for k in range(experiments)))
    cells = {k: {axis.name: value} for k, value in enumerate(axis.values)}
    began = time.process_time()
    for k in range(figures):
        for kind, table in (("timeseries", series), ("summary", last)):
            figure = Figure.model_validate({"kind": kind, "column": "energy"})
            draw(Drawing(f"{kind}{k}", figure, (axis,), cells, {"energy": table}, note="mean, 95 % CI, n = 10"), folder)
    return time.process_time() - began


def by_hand(experiments: int, times: int, figures: int, folder: Path) -> float:
    """Return the CPU seconds of a typical script written by hand."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    series, last = aggregates(experiments, times)
    began = time.process_time()
    plt.rcParams.update({"font.size": 8, "pdf.fonttype": 42, "svg.fonttype": "none"})
    names = [2**k for k in range(experiments)]
    for k in range(figures):
        figure, plot = plt.subplots(figsize=(3.5, 2.4), layout="constrained")
        for ordinal, name in enumerate(names):
            rows = np.flatnonzero(series["experiment"].to_numpy() == ordinal)
            t, mean, low, high = (series[c].to_numpy()[rows] for c in ("t", "mean", "mean_low", "mean_high"))
            plot.plot(t, mean, label=str(name), linewidth=1.2)
            plot.fill_between(t, low, high, alpha=0.2, linewidth=0)
        _finish(figure, plot, "time", folder / f"timeseries{k}")
        figure, plot = plt.subplots(figsize=(3.5, 2.4), layout="constrained")
        mean, low, high = (last[c].to_numpy() for c in ("mean", "mean_low", "mean_high"))
        plot.errorbar(names, mean, [mean - low, high - mean], marker="o", capsize=2, label="mean")
        plot.set_xscale("log", base=2)
        plot.set_xticks(names, [str(name) for name in names])
        _finish(figure, plot, "population size", folder / f"summary{k}")
    return time.process_time() - began


def _finish(figure: Any, plot: Any, xlabel: str, path: Path) -> None:
    import matplotlib.pyplot as plt

    plot.set_xlabel(xlabel)
    plot.set_ylabel("energy")
    plot.grid(visible=True)
    plot.legend(title="population size")
    for ending in ("png", "pdf", "svg"):
        figure.savefig(path.with_suffix(f".{ending}"), dpi=300)
    plt.close(figure)


def main(experiments: int = 8, times: int = 500, figures: int = 5) -> None:
    """Run both alternately, several times; compare the fastest of each, which other processes disturbed least."""
    best: dict[str, tuple[float, float]] = {}
    for _ in range(REPEATS):
        for name in ("ours", "by_hand"):
            argv = [sys.executable, __file__, name, str(experiments), str(times), str(figures)]
            drawing, whole = json.loads(subprocess.run(argv, check=True, capture_output=True, text=True).stdout)
            before = best.get(name, (drawing, whole))
            best[name] = (min(before[0], drawing), min(before[1], whole))
    for name, (drawing, whole) in best.items():
        print(f"{name:8} {drawing:6.2f} s CPU for {2 * figures} figures in 3 formats, {whole:6.2f} s with imports")
    print(f"ratio    {best['ours'][0] / best['by_hand'][0]:6.2f}, with imports {best['ours'][1] / best['by_hand'][1]:.2f}")


if __name__ == "__main__":
    if sys.argv[1:2] in (["ours"], ["by_hand"]):
        with tempfile.TemporaryDirectory() as scratch:
            experiments, times, figures = map(int, sys.argv[2:5])
            taken = {"ours": ours, "by_hand": by_hand}[sys.argv[1]](experiments, times, figures, Path(scratch))
        print(json.dumps([taken, time.process_time()]))
    else:
        main(*map(int, sys.argv[1:4]))
