"""Runs on three robots of this machine: how far apart programs start, how fast all stop, and what a run costs. For root.

Also how long after the common start programs begin, on the robots themselves and in containers.

Python, sshd and the programs of all robots share the cores of this machine, so that a real fleet is faster.
"""

from __future__ import annotations

import os
import shutil
import statistics
import sys
import tempfile
import time
from functools import partial
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from sierra.links.base import LinkOptions  # noqa: E402 - tests are found by the line above
from sierra.links.fabric import Fabric  # noqa: E402
from tests import containers, projects  # noqa: E402
from tests.support.robot_fleet import PROGRAMS, Fleet  # noqa: E402
from tests.support.robot_runs import Runs, job  # noqa: E402

TRIALS = 20
PROJECT = """
template = "arena.xml"
command = "sh begin.sh"
seed = "//random/@seed"
[variables]
population_size = "//swarm/@count"
[robots]
count = "population_size"
[outputs.begun]
file = "begun.csv"
[container]
image = "host.tar"
[runners.robots]
fleet = {{ {fleet} }}
link_options = {{ ssh_config = "{config}" }}
disk_min = 1000000
stop = []
"""
BEGIN = "now=$(date +%s%N); echo ns > begun.csv; echo $now >> begun.csv\n"
DELAYS = """
SELECT (ns - (epoch_us(started) * 1000 - start_skew_ns)) / 1e6 AS delay
FROM begun b JOIN robots r ON r.execution = b.execution AND r.place = b.robot
"""
PLACES = ("1", "2", "3")


def main() -> None:
    if os.geteuid() != 0 or not all(shutil.which(one, path=os.environ["PATH"] + ":/usr/sbin:/sbin") for one in PROGRAMS):
        print(f"robots: not measured, because this needs root and {', '.join(PROGRAMS)}")
        return
    with Fleet() as fleet, tempfile.TemporaryDirectory() as folder:
        options = LinkOptions(ssh_config=str(fleet.ssh_config))
        homes = {name: robot.home for name, robot in fleet.robots.items()}
        stop = ["sh", "-c", "date +%s.%N >> ~/stops"]
        own = {"disk_min": 1_000_000, "grace": 2.0, "stop": stop}
        make = partial(Runs, Path(folder), homes, lambda name, _: Fabric(name, options), **own)
        trials(make())
        for name in fleet.names:
            fleet.enter(name, "rm", "-f", "/home/robot/stops")
        stops(make(), "sleep")
        stops(make(), "deaf")
        for engine in ("none", "podman", "apptainer"):
            if engine == "none" or shutil.which(engine):
                begins(fleet, Path(folder) / engine, engine)
            else:
                print(f"start in containers of {engine}: not measured, because it is not installed")


def trials(runs: Runs) -> None:
    """Measure how far apart programs of 1 s start, and what is added to each run."""
    words = [word for place in PLACES for word in (place, "1s")]
    results = runs.run(*(job(number, *words) for number in range(TRIALS)))
    assert all(one.error is None for one in results), results
    rows = [row for table, row in runs.rows if table == "robots"]
    skews = sorted(max(each) - min(each) for each in zip(*[iter(row["start_skew_ns"] / 1e6 for row in rows)] * 3, strict=True))
    starts = [one.started for one in results]
    added = [after - before - 1.0 for before, after in pairwise(starts)]
    show("start of a run: between the first and the last robot", statistics.median(skews), "ms", "20")
    show("  the slowest of all", skews[-1], "ms", "20")
    show("a run of 1 s: added", statistics.median(added), "s", "1")


def stops(runs: Runs, action: str) -> None:
    """Measure the time from the key until the stop command is executed on all robots, and until all programs are gone."""
    words = [word for place in PLACES for word in (place, action)]
    runner = runs.submit(job(1, *words))
    runs.all_begun()
    pressed = time.time()
    runner.stop()
    runs.follow(runner)
    told = [float((home / "stops").read_text().split()[0]) - pressed for home in runs.homes.values()]
    ended = [row["ended"].timestamp() - pressed for row in runs.rows_by_place.values()]
    for home in runs.homes.values():
        (home / "stops").unlink()
    show(f"stop of programs that {'end' if action == 'sleep' else 'ignore SIGTERM'}: told to all", max(told) * 1e3, "ms", "100")
    show("  all are gone", max(ended), "s", "grace: 2")


def begins(fleet: Fleet, root: Path, engine: str) -> None:
    """Measure the time from the common start until the programs of three robots begin, by their own clocks."""
    members = ", ".join(f'{name} = {{ host = "{name}" }}' for name in fleet.names)
    projects.make(root, PROJECT.format(fleet=members, config=fleet.ssh_config))
    (root / "begin.sh").write_text(BEGIN)
    containers.host(root, Path("/bin/sh"), Path("/bin/date"))
    query = ("run", "population_size=3", "--runs", str(TRIALS), "--on", "robots", "--engine", engine, "--no-figures")
    for words in (("image", "pin"), query):
        done = projects.quick(root, *words)
        assert done.returncode in (0, 1), done.stderr  # on a busy machine, single runs fail
    found = sorted(row["delay"] for row in projects.sql(root, DELAYS))
    show(f"common start until programs begin, {engine}: median", statistics.median(found), "ms", "20")
    show("  the slowest of all", found[-1], "ms", "-")


def show(what: str, value: float, unit: str, limit: str) -> None:
    print(f"{what:58} {value:8.2f} {unit:2} (at most {limit})", flush=True)


if __name__ == "__main__":
    main()
