"""Measure the overhead of SIERRA as ratios to other programs: `make bench`.

Every figure is the median of several measurements. SIERRA and the compared program alternate, so that a
busy machine affects both equally. Nothing is asserted; each ratio is printed with its target.

    make bench                 all but the slow benchmarks
    .venv/bin/python tests/bench/run.py runs recording     some of them
    .venv/bin/python tests/bench/run.py --slow             also the slow ones
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import json
import os
import random
import resource
import shlex
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from idle import project

HERE = Path(__file__).resolve().parent
SIERRA = str(Path(sys.executable).with_name("sierra"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("which", nargs="*", help=f"some of: {', '.join(BENCHES)}")
    parser.add_argument("--slow", action="store_true", help="also the slow benchmarks, such as 100,000 runs")
    arguments = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    for name, bench in BENCHES.items():
        if name in arguments.which or (not arguments.which and (arguments.slow or name not in SLOW)):
            with tempfile.TemporaryDirectory(prefix="sierra-bench-") as folder:
                bench(Path(folder))


def say(what: str, ours: float, theirs: float, promise: str) -> None:
    """Print one line: the time of SIERRA, the other time, the ratio, and the target."""
    print(f"{what:58} {ours:8.2f} s  {theirs:8.2f} s  ratio {ours / theirs:5.2f}  ({promise})", flush=True)


def in_turn(times: int, ours: Callable[[], None], theirs: Callable[[], None]) -> tuple[float, float]:
    """Return the medians of two measurements that alternate."""
    measured: tuple[list[float], list[float]] = ([], [])
    for _ in range(times):
        for place, what in enumerate((ours, theirs)):
            began = time.perf_counter()
            what()
            measured[place].append(time.perf_counter() - began)
    return statistics.median(measured[0]), statistics.median(measured[1])


def quietly(*argv: str, cwd: Path | None = None, code: int = 0) -> None:
    """Run a command, check its exit code, and discard its output."""
    done = subprocess.run(argv, cwd=cwd, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False)
    if done.returncode != code:
        sys.exit(f"{' '.join(argv)}: exit status {done.returncode}: {done.stderr.decode()}")


def xargs(folder: Path, count: int) -> None:
    """Run the same processes without SIERRA, each in a folder with two files."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    script = f"seq {count} | xargs -P2 -I@ sh -c 'mkdir @ && cd @ && /bin/true @ >stdout 2>stderr'"
    quietly("sh", "-c", script, cwd=folder)


def runs(folder: Path) -> None:
    """Measure 1,000 recorded runs of a program that does nothing."""
    here = project(folder / "project")

    def ours() -> None:
        shutil.rmtree(here / ".sierra", ignore_errors=True)
        quietly(SIERRA, "run", "population_size=1,2,3,4", "--runs", "250", "-j2", "--no-figures", cwd=here)

    say("1,000 runs of true, recorded / xargs -P2", *in_turn(5, ours, lambda: xargs(folder / "x", 1000)), "at most 2")


PLAN = """
import time
import sierra
began = time.perf_counter()
sierra.Project(".").plan("population_size=1,2,3,4", runs=250)
print(time.perf_counter() - began)
"""


def planning(folder: Path) -> None:
    """Measure the plan of a batch of 1,000 runs: source, programs, environment and inputs; without and with its caches."""
    here = project(folder / "project")
    quietly("git", "init", "-q", str(here))
    began = time.perf_counter()
    quietly(SIERRA, "run", "population_size=1,2,3,4", "--runs", "250", "-j2", "--no-figures", cwd=here)
    wall = time.perf_counter() - began
    for command in ("/bin/true {input}", "{python} sim.py {input}"):
        project(here, command=command)
        (here / "sim.py").write_text("")
        for state in ("cold", "warm"):
            cache = folder / "cache" if state == "warm" else folder / "no cache"
            shutil.rmtree(folder / "no cache", ignore_errors=True)
            took = statistics.median(plan_seconds(here, cache) for _ in range(5 if state == "warm" else 1))
            program = command.split()[0].strip("{}")
            say(f"plan of 1,000 runs of {program}, {state} / the runs of true", took, wall, "at most 0.1")


def plan_seconds(here: Path, cache: Path) -> float:
    """Return the seconds that a plan takes in a separate process, without the start of Python."""
    around = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    done = subprocess.run((sys.executable, "-c", PLAN), cwd=here, env=around, capture_output=True, text=True, check=True)
    return float(done.stdout)


def linear(folder: Path) -> None:
    """Measure 10,000 runs, and the repetition of their query."""
    here = project(folder / "project")
    ask = (SIERRA, "run", "population_size=1,2,3,4", "--runs", "2500", "-j2", "--no-figures")
    say(
        "10,000 runs of true, recorded / xargs -P2",
        *in_turn(1, lambda: quietly(*ask, cwd=here), lambda: xargs(folder / "x", 10_000)),
        "linear: as with 1,000",
    )
    nothing = (sys.executable, "-c", "import typer, pydantic, lxml, duckdb, pyarrow")
    say(
        "asking again, nothing to do / importing the libraries",
        *in_turn(5, lambda: quietly(*ask, cwd=here), lambda: quietly(*nothing)),
        "under 1 s",
    )
    files = sum(len(names) for _, _, names in os.walk(here / ".sierra"))
    print(f"{'files left per recorded run':58} {files / 10_000:8.4f}  (under 0.05)")


def many(folder: Path) -> None:
    """Measure the memory of SIERRA for 100,000 runs."""
    here = project(folder / "project")
    began = time.perf_counter()
    quietly(SIERRA, "run", "population_size=1,2,3,4", "--runs", "25000", "-j2", "--no-figures", cwd=here)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"{'100,000 runs: peak memory of SIERRA':58} {peak:8.0f} MB, {time.perf_counter() - began:.0f} s  (under 300 MB)")


def recording(folder: Path) -> None:
    """Measure the recording of 1,000 CSV files of 1,000 rows and 5 columns."""
    import duckdb
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    from sierra.ingest.model import Shape, Written
    from sierra.ingest.read import read
    from sierra.store.connections import connect

    files = []
    for number in range(1000):
        numbers = random.Random(number)
        path = folder / f"{number}.csv"
        rows = (f"{t},{numbers.random()},{numbers.random()},{numbers.randint(0, 9)},{numbers.random()}\n" for t in range(1000))
        path.write_text("clock,a,b,c,d\n" + "".join(rows))
        counts = {"lines": 1001, "ended": True, "bytes": path.stat().st_size, "quotes": 0, "blank": 0, "alike": True}
        files.append(Written(str(path), f"r{number}", f"e{number}", path.name, "clock,a,b,c,d", **counts))  # as a worker counts
    paths = [file.path for file in files]

    def ours() -> None:
        connection = connect()
        found = read(connection, files, Shape("csv"), folder / "ours.parquet")
        connection.close()
        assert len(found.rows) == 1000
        assert not found.faults

    def duckdb_alone() -> None:
        connection = duckdb.connect()
        target = folder / "theirs.parquet"
        connection.execute(f"COPY (SELECT * FROM read_csv($f)) TO '{target}' (COMPRESSION zstd)", {"f": paths})
        connection.close()

    def pyarrow_alone() -> None:
        tables = [pyarrow.csv.read_csv(path) for path in paths]
        pyarrow.parquet.write_table(pa.concat_tables(tables), folder / "arrow.parquet", compression="zstd")

    say("1,000 CSVs read, checked, written / DuckDB", *in_turn(5, ours, duckdb_alone), "at most 2 of the faster")
    say("1,000 CSVs read, checked, written / pyarrow", *in_turn(3, ours, pyarrow_alone), "at most 2 of the faster")


def tick_files(folder: Path) -> None:
    """Measure the CPU time to record one table from 12,000 files: one for each of 300 ticks of 40 runs, with 10 rows each.

    DuckDB alone reads them with the same types, in one thread too, but checks no row counts. Most of SIERRA's time is the one
    statement that reads and writes the rows. DuckDB 2.0 takes about 0.2 ms of CPU time for each file. Its buffer sizes,
    `parallel`, `new_line`, `union_by_name` and the column with the file's name change this by less than the noise. It takes a
    quarter less without `columns`, because it then guesses the columns from the first file. SIERRA guesses nothing.
    """
    import duckdb

    from sierra.ingest.model import Shape, Written
    from sierra.ingest.read import read
    from sierra.store.connections import connect

    files = []
    for run in range(40):
        numbers = random.Random(run)
        (folder / str(run)).mkdir()
        for tick in range(300):
            path = folder / str(run) / f"floor-{tick}.csv"
            text = "x,y,v\n" + "".join(f"{x},{numbers.randint(0, 99)},{numbers.random()}\n" for x in range(10))
            path.write_text(text)
            counts = (11, True, len(text), 0, 0, True)
            files.append(Written(str(path), f"r{run}", f"e{run}", path.name, "x,y,v", *counts, (tick,)))
    paths = [file.path for file in files]
    typed = "columns = {x: 'BIGINT', y: 'BIGINT', v: 'DOUBLE'}, auto_detect = false, header = true, filename = true"

    def ours() -> None:
        connection = connect()
        found = read(connection, files, Shape("csv", many=True, ticks=("tick",)), folder / "ours.parquet")
        connection.close()
        assert len(found.rows) == len(files)
        assert not found.faults

    def duckdb_alone() -> None:
        connection = duckdb.connect(config={"threads": 1})
        target = folder / "theirs.parquet"
        connection.execute(f"COPY (SELECT * FROM read_csv($f, {typed})) TO '{target}' (COMPRESSION zstd)", {"f": paths})
        connection.close()

    measured: tuple[list[float], list[float]] = ([], [])
    for _ in range(3):
        for place, what in enumerate((ours, duckdb_alone)):
            before = time.process_time()
            what()
            measured[place].append(time.process_time() - before)
    say("12,000 CSVs, one per tick: CPU time / DuckDB", *map(statistics.median, measured), "at most 1.5")


LARGE = 16_500
"""Number of lights in a template of about 1 MB."""


def inputs(folder: Path) -> None:
    """Measure the inputs of 400 experiments of 10 runs, made from a template of 1 MB, in CPU time and memory."""
    lights = range(LARGE)
    xml = "".join(f'  <light id="l{n}" x="{n}.5" y="0.25"><power>{n}</power></light>\n' for n in lights)
    data = [{"id": f"l{n}", "x": n + 0.5, "y": 0.25, "power": n} for n in lights]
    flow = "".join(f"  - {{id: l{n}, x: {n}.5, y: 0.25, power: {n}}}\n" for n in lights)
    templates = {
        "xml": f'<world>\n  <seed>1</seed>\n  <robots count="4"/>\n{xml}</world>\n',
        "json": json.dumps({"seed": 1, "robots": {"count": 4}, "lights": data}),
        "yaml": f"seed: 1\nrobots: {{count: 4}}\nlights:\n{flow}",
    }
    for format, text in templates.items():
        (folder / format).write_text(text)
        made = subprocess.run(
            (sys.executable, "-c", INPUTS, format, folder / format), stdout=subprocess.PIPE, text=True, check=True
        )
        ours, theirs, before, after = map(float, made.stdout.split())
        say(f"4,000 inputs of 1 MB of {format} / their SHA-256, CPU", ours, theirs, "at most 2.5")
        print(f"{'memory before and after the inputs':58} {before:8.0f} MB {after:8.0f} MB  (the same)")


INPUTS = """
import hashlib, resource, sys, time
from pathlib import Path
from sierra.model import Set
from sierra.templates.base import read
format, path = sys.argv[1], Path(sys.argv[2])
def memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
ours, theirs = -time.process_time(), 0.0
template = read(path, format=format)
count, seed = ("/world/robots/@count", "/world/seed") if format == "xml" else ("/robots/count", "/seed")
for experiment in range(400):
    render = template.changed([Set(count, str(10 + experiment))], {}).per_run([Set(seed, "{seed}")])
    for run in range(10):
        content = render({"seed": 10 * experiment + run})
        began = time.process_time()
        hashlib.sha256(content).digest()
        theirs += time.process_time() - began
    if experiment == 1:
        before = memory()
print(ours + time.process_time() - theirs, theirs, before, memory())
"""


def start(folder: Path) -> None:
    """Measure the start time of the command line."""
    small = folder / "small.py"
    small.write_text(
        "import typer\napp = typer.Typer()\n\n@app.command()\ndef one(x: int = 1) -> None: ...\n\n"
        "@app.command()\ndef two(x: int = 1) -> None: ...\n\napp()\n"
    )
    say(
        "sierra --help / --help of two typer commands",
        *in_turn(9, lambda: quietly(SIERRA, "--help"), lambda: quietly(sys.executable, str(small), "--help")),
        "at most 1.5",
    )


FORKS = "i=0; while [ $i -lt 200 ]; do /bin/true; i=$((i+1)); done"
IMPORTS = (
    "import asyncio, concurrent.futures, ctypes, curses, dbm, decimal, difflib, email.mime.text, fractions, http.server, "
    "imaplib, json, logging.handlers, multiprocessing.pool, pydoc, smtplib, sqlite3, statistics, tarfile, unittest, "
    "urllib.request, venv, wsgiref.simple_server, xml.etree.ElementTree, xml.dom.minidom, xml.sax, xmlrpc.server, zipfile"
)
"""About 300 modules."""
STRACE = ("strace", "-f", "--seccomp-bpf", "-e", "trace=%file", "-o", "/dev/null")
OBSERVED = 10


def observation(folder: Path) -> None:
    """Measure runs whose files are observed, compared with bare strace; and a batch as it is by default."""
    commands: dict[str, tuple[str, ...]] = {
        "true": ("/bin/true",),
        "a shell with 200 forks": ("sh", "-c", FORKS),
        "a Python with 300 imports": (sys.executable, "-c", IMPORTS),
    }
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        importlib.metadata.version("mujoco")
        quietly(SIERRA, "init", "--example", "swarm", str(folder / "example"))
        example = folder / "example"
        commands["the example (MuJoCo)"] = (sys.executable, str(example / "swarm.py"), str(example / "template.xml"), ".")
    for name, words in commands.items():
        here, plain = (observed(folder / f"{name} {observe}", observe, words) for observe in ("all", "none"))
        run_anew(here)  # fills the caches
        more, less = in_turn(3, *(partial(run_anew, where, str(OBSERVED)) for where in (here, plain)))
        with tempfile.TemporaryDirectory() as place:
            traced, bare = (partial(quietly, *prefix, *words, cwd=Path(place)) for prefix in (STRACE, ()))
            theirs, alone = in_turn(5, traced, bare)
        say(f"one run of {name}, observed / bare strace", (more - less) / OBSERVED + alone, theirs, f"plain {alone:.3f} s")
    batch_of_short_runs(folder)


AROUND = {
    "before and after": 'before = "true"\nafter = "true"\n',
    "a service": '[services.it]\ncommand = ["sh", "-c", "echo ready; exec sleep 99"]\nready = { output = "ready" }\n',
}
CONDUCTED = 50


def around(folder: Path) -> None:
    """Measure what services and commands around a run cost, compared with the start of a Python."""

    def batch(name: str, tables: str) -> Callable[[], None]:
        here = project(folder / name)
        config = here / "sierra.toml"
        own, table = ("", tables) if tables.startswith("[") else (tables, "")
        config.write_text(f'observe = "none"\n{own}{config.read_text()}{table}')
        return partial(run_anew, here, str(CONDUCTED))

    plain = batch("plain", "")
    python = partial(quietly, sys.executable, "-I", "-S", "-c", "pass")
    for name, tables in AROUND.items():
        ours = batch(name, tables)
        ours()  # fills the caches
        rounds = [tuple(map(cpu_seconds, (ours, plain, python))) for _ in range(3)]
        more, less, theirs = (statistics.median(taken) for taken in zip(*rounds, strict=True))
        took = (more - less) / CONDUCTED
        say(f"a run with {name} ({took * 1000:.0f} ms CPU) / the start of a Python", took, theirs, "at most 5")


SHORT = "import json, xml.etree.ElementTree; sum(i * i for i in range(700_000))"
"""A Python that computes for about 0.1 s."""


def batch_of_short_runs(folder: Path) -> None:
    """Measure batches of 100 runs of 0.1 s with the default settings, compared with runs that are not observed.

    The least CPU seconds of several batches are compared, because other work on the machine only adds to them.
    """
    both = [observed(folder / f"short {observe}", observe, (sys.executable, "-c", SHORT)) for observe in ("first", "none")]
    for experiments, runs in ((1, 100), (100, 1), (10, 10)):
        batches = [partial(run_anew, here, str(runs), experiments) for here in both]
        batches[0]()  # fills the caches
        ours, theirs = (min(times) for times in zip(*(map(cpu_seconds, batches) for _ in range(3)), strict=True))
        say(f"{experiments} x {runs} runs of 0.1 s, CPU, by default / none observed", ours, theirs, "at most 1.10")


def observed(folder: Path, observe: str, words: Sequence[str]) -> Path:
    """Make a project whose runs execute a command in their working directory."""
    here = project(folder, command="sh {project}/run.sh {input}")
    (here / "run.sh").write_text(f"exec {shlex.join(words)}\n")
    config = here / "sierra.toml"
    config.write_text(f'observe = "{observe}"\n{config.read_text()}')
    return here


def run_anew(here: Path, runs: str = "1", experiments: int = 1) -> None:
    shutil.rmtree(here / ".sierra", ignore_errors=True)
    values = ",".join(map(str, range(1, experiments + 1)))
    quietly(SIERRA, "run", f"population_size={values}", "--runs", runs, "-j2", "--no-figures", cwd=here)


def cpu_seconds(what: Callable[[], None]) -> float:
    """Return the CPU seconds, in user and kernel mode, of the processes that a function starts and waits for."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    what()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def cost(folder: Path, *more: str) -> None:
    """Measure the fixed cost of commands, beside what is wanted."""
    del folder
    subprocess.run([sys.executable, str(HERE / "bench_cost.py"), *more], check=True)


def large_cost(folder: Path) -> None:
    """Measure batches, figures, plans and packages, beside what is wanted."""
    cost(folder, "--slow")


def imports(folder: Path) -> None:
    """Count the modules that commands import, beside the limits of `make check`."""
    import tomllib

    import ratchet

    del folder
    limits = tomllib.loads(ratchet.LIMITS.read_text())["imported modules"]
    for name, count in ratchet.imported().items():
        print(f"{f'modules imported by {name}':58} {count:5d}  (at most {limits[name]})", flush=True)


def growth(folder: Path, *more: str) -> None:
    """Compare commands in stores of 10 and of 1,000 batches, in a separate process."""
    del folder
    subprocess.run([sys.executable, str(HERE / "bench_growth.py"), *more], check=True)


def large_growth(folder: Path) -> None:
    """Measure commands in stores of 100,000 and of 1,000,000 runs."""
    growth(folder, "--slow")


def snapshot(folder: Path) -> None:
    """Measure snapshots of a repository with 50,000 files, compared with git alone."""
    from sierra.provenance import source

    here = folder / "repository"
    for number in range(50_000):
        inside = here / f"{number // 100}"
        inside.mkdir(parents=True, exist_ok=True)
        (inside / f"{number}.py").write_text(f"number = {number}\n" * 20)
    index = {**os.environ, "GIT_INDEX_FILE": str(folder / "index")}

    def begin(committed: bool) -> None:
        shutil.rmtree(here / ".git", ignore_errors=True)
        (folder / "index").unlink(missing_ok=True)
        quietly("git", "init", cwd=here)
        if committed:
            quietly("git", "add", "--all", cwd=here)
            quietly("git", "-c", "user.name=a", "-c", "user.email=a@b", "-c", "gc.auto=0", "commit", "-m", "all", cwd=here)

    def git() -> None:
        for command in (("add", "--all"), ("write-tree",)):
            subprocess.run(["git", *command], cwd=here, env=index, check=True, capture_output=True)

    def ours() -> None:
        source.capture(here, paths=(), without=("sierra.toml", ".sierra"))

    def outside() -> None:
        source.capture(here, paths=(), without=(), memory=folder / "memory")

    for committed in (False, True):
        state = "committed" if committed else "untracked"
        first = median_of(3, lambda: begin(committed), ours), median_of(1, lambda: begin(committed), git)  # noqa: B023
        say(f"50,000 files, all {state}: first snapshot / git add", *first, "under 3 s")
        ours()
        again = in_turn(7, ours, git)
        say(f"50,000 files, all {state}: snapshot again / git add", *again, "under 0.5 s")
    shutil.rmtree(here / ".git")
    outside_first = median_of(3, lambda: (folder / "memory").unlink(missing_ok=True), outside)
    say("50,000 files outside git: first snapshot / git add", outside_first, first[1], "under 3 s")
    say("50,000 files outside git: snapshot again / git add", median_of(7, lambda: None, outside), again[1], "under 1 s")


def median_of(times: int, prepare: Callable[[], object], what: Callable[[], None]) -> float:
    """Return the median time of a function, each time after a preparation that is not measured."""
    measured = []
    for _ in range(times):
        prepare()
        began = time.perf_counter()
        what()
        measured.append(time.perf_counter() - began)
    return statistics.median(measured)


def fsck(folder: Path) -> None:
    """Measure fsck for a store with 400 MB of recorded files, and for one with many small runs."""
    here = project(folder / "large")
    toml = (here / "sierra.toml").read_text()
    (here / "sierra.toml").write_text(toml.replace("/bin/true {input}", "dd if=/dev/urandom of=noise bs=1M count=10"))
    quietly(SIERRA, "run", "population_size=1,2,3,4", "--runs", "10", "-j2", "--no-figures", cwd=here)
    small = project(folder / "small")
    quietly(SIERRA, "run", "population_size=1,2,3,4", "--runs", "250", "-j2", "--no-figures", cwd=small)
    for what, where, promise in (("40 files of 10 MB", here, "at most 4"), ("1,000 runs of true", small, "under 3 s")):
        hashing = f"find {where / '.sierra' / 'segments'} -type f -print0 | xargs -0 sha256sum"
        check, hash_all = partial(quietly, SIERRA, "fsck", cwd=where), partial(quietly, "sh", "-c", hashing)
        say(f"sierra fsck, {what} / sha256sum", *in_turn(3, check, hash_all), promise)


def packages(folder: Path) -> None:
    """Measure writing and verifying a package of 1,000 runs, beside writing a zip of the store and hashing its files."""
    package = '[package]\ntitle = "Runs"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
    here = project(folder / "project", package, command="sh {project}/write.sh {input}")
    rows = 'print "tick,value"; srand(s); for (i = 0; i < 300; i++) print i "," rand()'
    (here / "write.sh").write_text(f"awk -v s=$SIERRA_SEED 'BEGIN {{{rows}}}' > rows.csv\n")
    quietly(SIERRA, "run", "population_size=1,2,3,4", "--runs", "250", "-j2", "--no-figures", cwd=here)
    listed = subprocess.run([SIERRA, "ls", "--json"], cwd=here, check=True, capture_output=True).stdout
    packed, zipped, extracted = folder / "package.zip", folder / "store.zip", folder / "extracted"
    store = str(here / ".sierra" / "segments")

    def write() -> None:
        packed.unlink(missing_ok=True)
        quietly(SIERRA, "package", json.loads(listed)[-1]["batch"], "-o", str(packed), "--no-report", "--yes", cwd=here)

    write_zip = partial(quietly, sys.executable, "-m", "zipfile", "-c", str(zipped), store)
    say("sierra package, 1,000 runs / python -m zipfile of its store", *in_turn(3, write, write_zip), "under 5 s")
    quietly(sys.executable, "-m", "zipfile", "-e", str(packed), str(extracted))
    verify = partial(quietly, sys.executable, str(extracted / "reproduce.py"), str(packed))
    hash_all = partial(quietly, "sha256sum", "-c", "manifest-sha256.txt", cwd=extracted)
    say("reproduce.py, 1,000 runs / sha256sum", *in_turn(3, verify, hash_all), "under 2 s")
    stored = sum(path.stat().st_size for path in Path(store).rglob("*") if path.is_file())
    print(
        f"size of the package / size of the store's segments: {packed.stat().st_size / stored:.2f}  (at most 1.3)", flush=True
    )


def figures(folder: Path) -> None:
    """Measure figures in three formats, by SIERRA and by a script written by hand."""
    del folder
    subprocess.run([sys.executable, str(HERE / "bench_figures.py")], check=True)


def drawing(folder: Path) -> None:
    """Measure the default figures of 1,000 runs, and a statistic beside the bare aggregate."""
    del folder
    subprocess.run([sys.executable, str(HERE / "bench_drawing.py")], check=True)


def videos(folder: Path) -> None:
    """Measure videos of 1,000 and of 3,000 frames."""
    del folder
    subprocess.run([sys.executable, str(HERE / "bench_videos.py")], check=True)


def reports(folder: Path) -> None:
    """Measure reports of the example and of 10,000 batches."""
    del folder
    subprocess.run([sys.executable, str(HERE / "bench_reports.py")], check=True)


def explorer(folder: Path) -> None:
    """Measure the explorer over 1 million rows and over 10,000 batches, in a separate process."""
    del folder
    subprocess.run([sys.executable, str(HERE / "bench_explorer.py")], check=True)


def large_drawing(folder: Path) -> None:
    """Measure figures of 10,000 runs with 10 million rows."""
    del folder
    subprocess.run([sys.executable, str(HERE / "bench_drawing.py"), "100", "100", "1000", "1"], check=True)


def containers(folder: Path) -> None:
    """Compare runs in containers with the bare engine, and shared containers with none, in a separate process."""
    subprocess.run([sys.executable, str(HERE / "bench_containers.py")], check=True)


def bags(folder: Path) -> None:
    """Measure bags of ROS, in a separate process."""
    del folder
    subprocess.run([sys.executable, str(HERE / "bench_bags.py")], check=True)


def clusters(folder: Path, *more: str) -> None:
    """Compare batches on a separate SLURM with jobs written by hand, in a separate process."""
    del folder
    subprocess.run([sys.executable, str(HERE / "bench_clusters.py"), *more], check=True)


def links(folder: Path) -> None:
    """Measure commands on hosts and robots, copies from them, and batches in a lab, over SSH."""
    subprocess.run([sys.executable, str(HERE / "bench_links.py")], check=True)
    subprocess.run([sys.executable, str(HERE / "bench_robots.py")], check=True)
    subprocess.run([sys.executable, str(HERE / "bench_lab.py")], check=True)


def large_clusters(folder: Path) -> None:
    """Run the slow benchmarks of clusters: an array without packing, and 100,000 runs."""
    clusters(folder, "--slow")


BENCHES: dict[str, Callable[[Path], None]] = {
    "start": start,
    "runs": runs,
    "planning": planning,
    "cost": cost,
    "imports": imports,
    "observation": observation,
    "around": around,
    "linear": linear,
    "inputs": inputs,
    "recording": recording,
    "tick_files": tick_files,
    "bags": bags,
    "growth": growth,
    "snapshot": snapshot,
    "fsck": fsck,
    "packages": packages,
    "figures": figures,
    "drawing": drawing,
    "explorer": explorer,
    "videos": videos,
    "reports": reports,
    "large_drawing": large_drawing,
    "containers": containers,
    "clusters": clusters,
    "links": links,
    "many": many,
    "large_clusters": large_clusters,
    "large_growth": large_growth,
    "large_cost": large_cost,
}
SLOW = ("large_cost", "many", "large_clusters", "large_drawing", "large_growth")

if __name__ == "__main__":
    main()
