"""The fixed cost of commands: CPU seconds of all their processes, the least of several calls, beside what is wanted.

    bench_cost.py               small commands, in units of S
    bench_cost.py --slow        also batches, figures, large plans and packages, in seconds

S is the time of `SELECT 1` in a Python with DuckDB, measured in the same minute. What takes over 5 s is measured once.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from idle import measured, project

SIERRA = str(Path(sys.executable).with_name("sierra"))
SELECT = (sys.executable, "-c", "import duckdb; duckdb.sql('SELECT 1')")
ONCE_S = 5.0
RUN = ("run", "--runs", "1", "--no-figures")
ROWS = """import random, sys
r = random.Random(int(sys.argv[1]))
with open("out.csv", "w") as file:
    file.write("t," + ",".join(f"c{k}" for k in range(10)) + "\\n")
    for t in range(int(sys.argv[2])):
        file.write(f"{t}," + ",".join("%.6f" % r.random() for _ in range(10)) + "\\n")
"""
PACKAGE = '[package]\ntitle = "Runs"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'


def main() -> None:
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["SOURCE_DATE_EPOCH"] = "1700000000"
    with tempfile.TemporaryDirectory(prefix="sierra-bench-") as folder:
        small(Path(folder))
        if "--slow" in sys.argv:
            large(Path(folder))


def cpu(here: Path, *words: str, calls: int = 5, code: int = 0, before: Callable[[], None] = lambda: None) -> float:
    """Return the least CPU seconds of several calls; of one call if it takes long. `@` in a word is a new number each time."""
    least = float("inf")
    for _ in range(calls):
        before()
        number = str(next(NUMBERS))
        least = min(least, measured(here, *(word.replace("@", number) for word in words), code=code)[1])
        if least > ONCE_S:
            break
    return least


NUMBERS = itertools.count(1000)


def say(name: str, now: float, wanted: float, unit: float = 1.0) -> None:
    """Print a line of the table; `unit` is S if that is what is wanted."""
    kind = "S" if unit != 1.0 else "s"
    print(
        f"{name:60} now {now / unit:6.2f} {kind}   wanted {wanted:5.2f} {kind}   ratio {now / unit / wanted:5.2f}", flush=True
    )


def small(folder: Path) -> None:
    here = project(folder / "small")
    commit(here)
    measured(here, SIERRA, *RUN, "population_size=1")
    s = cpu(here, *SELECT, calls=9)
    print(f"S = {s:.3f} s")
    calls: dict[str, tuple[tuple[str, ...], float]] = {
        "--version": (("--version",), 0.5),
        "--help": (("--help",), 0.8),
        "sql": (("sql", "SELECT count(*) FROM runs"), 1.4),
        "status": (("status",), 1.4),
        "ls": (("ls",), 1.5),
        "one new run, no figures": ((*RUN, "population_size=@"), 4.0),
        "empty re-run": ((*RUN, "population_size=1"), 2.2),
        "run -n": (("run", "-n", "population_size=@"), 2.2),
        "try": (("try",), 5.0),
    }
    for name, (words, wanted) in calls.items():
        say(name, cpu(here, SIERRA, *words), wanted, s)
    drawn = project(folder / "drawn", command=f"{sys.executable} {{project}}/rows.py {{seed}} 20 {{input}}")
    (drawn / "rows.py").write_text(ROWS)
    commit(drawn)
    measured(drawn, SIERRA, "run", "population_size=1,2", "--runs", "2")
    say("4 runs with default figures", cpu(drawn, SIERRA, "run", "population_size=@,1@", "--runs", "2"), 3.0)
    measured(drawn, SIERRA, "run", "population_size=1,2", "--runs", "3", "--no-figures")
    batches = [batch["batch"][:10] for batch in (listed(drawn)[0], listed(drawn)[-1])]
    say("report", cpu(drawn, SIERRA, "report", batches[0], "--to", str(folder / "report.html")), 2.5)
    compare = ("compare", f"a={batches[0]}", f"b={batches[1]}", "--column", "c0", "--no-figure")
    say("compare", cpu(drawn, SIERRA, *compare), 3.0, s)
    say("figures --check, nothing changed", cpu(drawn, SIERRA, "figures", batches[0], "--check"), 3.0, s)


def large(folder: Path) -> None:
    here = project(folder / "large")
    say("dry run of 100,000 runs", cpu(here, SIERRA, "run", "-n", "population_size=1,2,3,4", "--runs", "25000"), 3.0)
    lights = "".join(f'  <light id="l{n}" x="{n}.5" y="0.25"/>\n' for n in range(2300))
    (here / "template.xml").write_text(f'<experiment seed="1"><swarm count="3"/>\n{lights}</experiment>\n')
    sizes = ",".join(map(str, range(1, 401)))
    say("dry run of 400 cells of a template of 90 kB", cpu(here, SIERRA, "run", "-n", f"population_size={sizes}"), 1.2)
    rows = project(folder / "rows", command=f"{sys.executable} {{project}}/rows.py {{seed}} 100000 {{input}}")
    (rows / "rows.py").write_text(ROWS)
    measured(rows, SIERRA, "run", "population_size=1", "--runs", "10", "--no-figures")
    again = cpu(rows, SIERRA, "figures", "--format", "png", calls=1, before=lambda: shutil.rmtree(rows / "figures", True))
    say("default figures of 10 x 100,000 rows x 10 columns, one format", again, 5.0)
    packed = project(folder / "packed", PACKAGE, command=f"{sys.executable} {{project}}/rows.py {{seed}} 20 {{input}}")
    (packed / "rows.py").write_text(ROWS)
    measured(packed, SIERRA, "run", "population_size=1,2,3,4", "--runs", "40", "--no-figures")
    file, [batch] = folder / "package.zip", listed(packed)
    pack = ("package", str(batch["batch"]), "-o", str(file), "--no-report", "--yes")
    both = cpu(packed, SIERRA, *pack, before=lambda: file.unlink(missing_ok=True)) + cpu(packed, SIERRA, "open", str(file))
    say("pack and open a package of 160 runs", both, 6.0)
    broken = folder / "broken.zip"
    broken.write_bytes(file.read_bytes()[:-100])
    say("refuse a package", cpu(packed, SIERRA, "open", str(broken), code=1), 0.5)


def commit(here: Path) -> None:
    for words in (("init", "-q"), ("add", "-A"), ("-c", "user.name=a", "-c", "user.email=a@example.org", "commit", "-qm", "a")):
        subprocess.run(["git", *words], cwd=here, check=True)


def listed(here: Path) -> list[dict[str, str]]:
    done = subprocess.run([SIERRA, "ls", "--json"], cwd=here, check=True, capture_output=True)
    found: list[dict[str, str]] = json.loads(done.stdout)
    return found


if __name__ == "__main__":
    main()
