"""The explorer: the times of its answers over 1 million rows, beside DuckDB alone, and its lists of 10,000 batches.

    python tests/bench/bench_explorer.py [experiments] [runs] [rows] [batches]      default: 10 100 1000 10000

The page's questions are asked over HTTP, as the page does. The targets: the first chart in 2 s after the server has started;
each later query at most 50 ms above DuckDB's own time for the same statement over the same files. CPU seconds are those of the
server: other processes do not change them much.
"""

from __future__ import annotations

import http.client
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import duckdb
from bench_drawing import SIMULATOR
from idle import project

from sierra.store.store import Store

SIERRA = str(Path(sys.executable).with_name("sierra"))
REPEATS = 15
STATEMENTS = {
    "SELECT 1": "SELECT 1",
    "the mean of 1 million rows": "SELECT avg(c0) FROM out",
    "a mean for each time": "SELECT tick, avg(c0) AS mean, count(*) AS n FROM out GROUP BY tick ORDER BY tick",
    "the first 1,000 rows": "SELECT * FROM out LIMIT 1000",
}


class Page:
    """The explorer's page: it asks questions over one connection."""

    def __init__(self, url: str, pid: int) -> None:
        self._times = Path(f"/proc/{pid}/stat")
        address, _, token = url.partition("#")
        self._connection = http.client.HTTPConnection(address.removeprefix("http://").rstrip("/"), timeout=120)
        self._headers = {"X-Sierra-Token": token, "Content-Type": "application/json"}

    def ask(self, question: str, /, **content: Any) -> Any:
        self._connection.request("POST", f"/ask/{question}", json.dumps(content), self._headers)
        answer = self._connection.getresponse()
        found = json.loads(answer.read())
        assert answer.status == 200, found
        return found

    def cpu(self) -> float:
        """Return the CPU seconds of the server so far."""
        fields = self._times.read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def explorer(here: Path) -> Iterator[Page]:
    """Start `sierra explore` in a project; yield its page as soon as the address is printed, and end it."""
    words = [SIERRA, "explore", "--no-browser"]
    with subprocess.Popen(words, cwd=here, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout
        try:
            yield Page(process.stdout.readline().strip(), process.pid)
        finally:
            process.terminate()


def main(experiments: int = 10, runs: int = 100, rows: int = 1000, batches: int = 10_000) -> None:
    with tempfile.TemporaryDirectory(prefix="sierra-bench-") as folder:
        here = project(Path(folder, "rows"), command="sh sim.sh {input}")
        (here / "sim.sh").write_text(SIMULATOR.format(rows=rows, columns=2))
        query = (f"population_size=1:{experiments}:{experiments}", "--runs", str(runs), "--no-figures", "--yes")
        subprocess.run([SIERRA, "run", *query], cwd=here, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        charts(here)
        queries(here)
        lists(Path(folder, "batches"), batches)


def charts(here: Path) -> None:
    """Print the time of the first chart, from the page's first question on, and of later ones."""
    times: dict[str, list[float]] = {"first": [], "cpu": [], "again": [], "box": []}
    for _ in range(3):
        with explorer(here) as page:
            began, before = time.perf_counter(), page.cpu()
            chart = first_chart(page)
            times["first"].append(time.perf_counter() - began)
            times["cpu"].append(page.cpu() - before)
            box = {**chart, "name": "box", "keys": {"table": "out", "column": "c0", "kind": "box"}}
            for what, asked in (("again", chart), ("box", box)):
                times[what] += [seconds(partial(page.ask, "chart", **asked)) for _ in range(3)]
    cpu = statistics.median(times["cpu"])
    say("first chart over 1 million rows", statistics.median(times["first"]), f"at most 2 s; {cpu:.2f} s CPU")
    say("the same chart again", statistics.median(times["again"]))
    say("a kind without an interactive chart", statistics.median(times["box"]))


def first_chart(page: Page) -> dict[str, Any]:
    """Ask what the page asks until the first chart is there; return the question for it."""
    page.ask("overview")
    batch = page.ask("batches", again=True)["batches"][0]["batch"]
    figures = page.ask("batch", batch=batch)["figures"]
    page.ask("tables", batch=batch)
    name, keys = next(iter(figures.items()))
    page.ask("chart", batch=batch, name=name, keys=keys)
    return {"batch": batch, "name": name, "keys": keys}


def queries(here: Path) -> None:
    """Print the time of statements in the explorer, beside DuckDB alone on the same files."""
    files = [path for segment in Store(here / ".sierra").segments() for name, path in segment.outputs() if name == "out"]
    bare = duckdb.connect()
    bare.execute(f"CREATE VIEW out AS FROM read_parquet({files!r})")
    with explorer(here) as page:
        batch = first_chart(page)["batch"]
        for what, statement in STATEMENTS.items():
            ask = partial(page.ask, "query", statement=statement, batch=batch)
            ask()
            pairs = [(seconds(ask), seconds(partial(fetched, bare, statement))) for _ in range(REPEATS)]
            for name, pick in (("median", statistics.median), ("fastest", min)):
                ours, theirs = (1000 * pick(one) for one in zip(*pairs, strict=True))
                added = f"DuckDB {theirs:6.1f} ms  added {ours - theirs:6.1f} ms  (at most 50)"
                print(f"{what:34} {name:7} {ours:7.1f} ms  {added}", flush=True)


def fetched(bare: duckdb.DuckDBPyConnection, statement: str) -> None:
    from sierra.extensions.explorer.answers import ROWS

    bare.execute(statement).fetchmany(ROWS + 1)


def lists(here: Path, batches: int) -> None:
    """Print the time of the list of many batches, of a filter, and of its last part."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    from tests.support import many_batches

    many_batches.make(project(here), batches)
    with explorer(here) as page:
        say(f"the list of {batches:,} batches", seconds(partial(page.ask, "batches", again=True)))
        say("a filter in it", seconds(partial(page.ask, "batches", words="size=77")))
        say("its last part", seconds(partial(page.ask, "batches", first=batches - 100)))


def seconds(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def say(what: str, took: float, target: str = "") -> None:
    print(f"{what:42} {took:7.2f} s  {f'({target})' if target else ''}", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:5]))
