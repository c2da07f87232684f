"""Costs of commands in small and in large stores: CPU seconds of all their processes, the least of several measurements.

    bench_growth.py             commands in a store of 10 batches and in one of 1,000
    bench_growth.py --slow      commands in stores of 100,000 and of 1,000,000 runs; and in a store of 300 batches that were
                                executed, compared with one of copies

An index names all segments, if nothing else is said. S is the time of `SELECT 1` in a Python with DuckDB, measured in the same
minute. Limits in seconds were set on a machine where it is 0.28 s; they are printed as multiples of it.
"""

from __future__ import annotations

import os
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from idle import measured

import sierra
from sierra.store import index_builder
from sierra.store.layout import StorePaths

sys.path.append(str(Path(__file__).resolve().parents[2]))
from tests import large_stores, projects

SIERRA = str(Path(sys.executable).with_name("sierra"))
SELECT = (sys.executable, "-c", "import duckdb; duckdb.sql('SELECT 1')")
SELECT_S = 0.28
"""The CPU seconds of SELECT on the machine where the limits were set."""
ROUNDS = 3
FEW, MANY = 10, 1000
"""The numbers of batches."""
RATIO = 1.15
"""The most that a command may take in a large store, compared with a small one."""
EXECUTED, LIKE = 300, 1.2
"""The number of batches that are executed, and the ratio that commands may take in a store of copies."""
LIMITS = {"mean over an output": 0.9, "why": 2.5}
"""The CPU seconds that other commands may take in a large store."""
MEMORY = 400e6
"""The largest memory, in bytes, of a command in a store of 1,000,000 runs."""
QUERY = "population_size=1,2"
RUN = ("run", "--no-figures", "--runs", "1", "-j1")
COUNT = ("sql", "SELECT count(*) FROM runs")
MEAN = ("sql", "SELECT count(*), avg(coverage) FROM swarm")
ONE_ROW = projects.SIMULATOR.replace("range(5)", "range(1)")

DIFFERENT = {"diff": 1}
"""The exit codes of commands that report by them what they find."""


def main() -> None:
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory(prefix="sierra-bench-") as folder:
        for name in ("cache", "state"):
            os.environ[f"XDG_{name.upper()}_HOME"] = str(Path(folder, name))
        if "--slow" in sys.argv:
            large(Path(folder))
        else:
            growth(Path(folder))


def growth(folder: Path) -> None:
    """Measure commands in a store of few batches and in one of many; then some with segments that are in no index."""
    few, many = folder / "few", folder / "many"
    batch = batch_of(few, runs=1)
    large_stores.multiply(few, batch, FEW - 2)
    other = sierra.open(few).batches[-1].batch
    shutil.copytree(few, many)
    large_stores.multiply(many, batch, MANY - FEW, first=FEW)
    print(f"{'CPU seconds, least of 3':44} {f'{FEW} batches':>10} {f'{MANY:,}':>7} {'ratio':>6} {'S':>5}", flush=True)
    index(few, many)
    for name, words in commands(batch, other).items():
        compare(name, words, few, many)
    index(few, many)
    added, copies = 0, MANY
    for segments in (10, 29):
        for root in (few, many):
            large_stores.multiply(root, batch, segments, first=copies, segments=segments - added)
        added, copies = segments, copies + segments
        for name in ("ls", "count of runs", "show"):
            compare(f"{name}, {segments} segments in no index", commands(batch, other)[name], few, many)


def commands(batch: str, other: str) -> Mapping[str, Sequence[str]]:
    """Return the commands by what they do; `{size}` is another number in each call."""
    return {
        "ls": ("ls",),
        "count of runs": COUNT,
        "status": ("status",),
        "mean over an output": MEAN,
        "show": ("show", batch),
        "files": ("files", batch),
        "diff of two batches": ("diff", batch, other),
        "why": ("why", batch),
        "run, nothing to execute": (*RUN, QUERY),
        "run -n": (*RUN, "population_size=3", "-n"),
        "run, one new run": (*RUN, "population_size={size}"),
        "figures of one batch": ("figures", batch),
        "compare in one batch": ("compare", batch, "--by", "population_size", "--column", "coverage"),
        "report of one batch": ("report", batch, "--to", "report.html"),
    }


def batch_of(root: Path, *, runs: int, simulator: str = projects.SIMULATOR) -> str:
    """Make a project, and execute a batch of two experiments with so many runs; return its id.

    It is the second: with the first batch, a store keeps what it needs only once, such as the source.
    """
    projects.make(root, simulator=simulator)
    for query, count in (("population_size=9", 1), (QUERY, runs)):
        measured(root, SIERRA, "run", "--no-figures", "--runs", str(count), "-j2", query)
    return sierra.open(root).batches[-1].batch


def index(*roots: Path) -> None:
    for root in roots:
        index_builder.build(StorePaths(root / ".sierra"))


def compare(name: str, words: Sequence[str], few: Path, many: Path, ratio: float = RATIO) -> None:
    """Print what a command takes in two stores, beside SELECT; the three alternate."""
    for root in (few, many):
        cost(root, words)  # fills the caches
    taken: dict[Path | None, list[float]] = {None: [], few: [], many: []}
    for call in range(1, ROUNDS + 1):
        taken[None].append(measured(few, *SELECT)[1])
        for root in (few, many):
            taken[root].append(cost(root, words, call))
    select, small, large = (min(taken[one]) for one in (None, few, many))
    limit = f"at most {LIMITS[name] / SELECT_S:.1f} S" if name in LIMITS else f"ratio at most {ratio}"
    kept = large <= LIMITS[name] / SELECT_S * select if name in LIMITS else large <= ratio * small
    figures = f"{small:10.2f} {large:7.2f} {large / small:6.2f} {select:5.2f}"
    print(f"{name:44} {figures}  ({limit}: {'ok' if kept else 'over'})", flush=True)


def cost(root: Path, words: Sequence[str], call: int = 0) -> float:
    """Return the CPU seconds of a call of a command."""
    called = [word.format(size=10 + call) for word in words]
    return measured(root, SIERRA, *called, code=DIFFERENT.get(words[0], 0))[1]


def large(folder: Path) -> None:
    """Measure commands in stores of 10,000 batches and of 1,000,000 runs, and in copies."""
    print(f"{'CPU seconds, least of 3':44} {'it takes':>10} {'S':>5} {'memory':>10}", flush=True)
    many = folder / "many"
    grown(many, 10_000, runs=5)
    alone("ls, 10,000 batches of 10 runs", many, ("ls",), 1.2)
    alone("count of runs, 10,000 batches of 10 runs", many, COUNT, 1.5)
    shutil.rmtree(many)
    million = folder / "million"
    grown(million, 1000, runs=500, simulator=ONE_ROW)
    alone("count of runs, 1,000,000 runs", million, COUNT, 1.5, MEMORY)
    alone("mean over an output, 1,000,000 runs", million, MEAN, 1.5, MEMORY)
    executed_or_copied(folder)


def executed_or_copied(folder: Path) -> None:
    """Compare commands in a store of batches that were executed and in one of copies."""
    executed, copied = folder / "executed", folder / "copied"
    batch = batch_of(executed, runs=1)
    shutil.copytree(executed, copied)
    large_stores.multiply(copied, batch, EXECUTED)
    for number in range(EXECUTED):
        measured(executed, SIERRA, *RUN, f"population_size={1000 + number},{2000 + number}")
    index(executed, copied)
    print(f"{'CPU seconds, least of 3':44} {'executed':>10} {'copied':>7} {'ratio':>6} {'S':>5}", flush=True)
    for name, words in commands(batch, batch).items():
        if name in ("ls", "count of runs", "show", "why", "run, nothing to execute"):
            compare(name, words, executed, copied, LIKE)


def grown(root: Path, batches: int, *, runs: int, simulator: str = projects.SIMULATOR) -> None:
    """Make a project with so many batches, and print what that takes."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:  # what a process starts may seem to have its memory
        batch = batch_of(root, runs=runs, simulator=simulator)
        measured(root, SIERRA, "gc", "--yes")  # or the number of segments depends on the time that this batch took
        for what, make in (
            ("made", pool.submit(taken, large_stores.multiply, root, batch, batches - 2)),
            ("indexed", pool.submit(taken, index, root)),
        ):
            cpu, seconds, memory = make.result()
            figures = f"{cpu:10.2f} {'':5} {memory / 1e6:7.0f} MB"
            print(f"{f'{batches:,} batches {what}':44} {figures}  ({seconds:.0f} s)", flush=True)


def taken(what: Callable[..., None], *arguments: object) -> tuple[float, float, int]:
    """Return the CPU seconds, the seconds and the largest memory of this process, in bytes, after a call."""
    began = time.process_time(), time.perf_counter()
    what(*arguments)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return time.process_time() - began[0], time.perf_counter() - began[1], memory


def alone(name: str, root: Path, words: Sequence[str], limit: float, memory: float | None = None) -> None:
    """Print what a command takes in a store, beside SELECT."""
    measured(root, SIERRA, *words)  # fills the caches
    rounds = [(measured(root, *SELECT), measured(root, SIERRA, *words)) for _ in range(ROUNDS)]
    select, took, peak = (min(values) for values in zip(*((one[1], two[1], two[2]) for one, two in rounds), strict=True))
    kept = took <= limit / SELECT_S * select and (memory is None or peak <= memory)
    wanted = f"at most {limit / SELECT_S:.1f} S" + (f" and {memory / 1e6:.0f} MB" if memory else "")
    print(f"{name:44} {took:10.2f} {select:5.2f} {peak / 1e6:7.0f} MB  ({wanted}: {'ok' if kept else 'over'})", flush=True)


if __name__ == "__main__":
    main()
