"""Runs on three robots of this machine: how far apart programs start, how fast all stop, and what a run costs. For root.

Also how long after the common start programs begin, on the robots themselves and in containers. Stops are measured from the
key that a person presses in a terminal, and leases with their default.

Python, sshd and the programs of all robots share the cores of this machine, so that a real fleet is faster.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from sierra.extensions.hosts.fabric import Fabric  # noqa: E402
from sierra.runners.links.base import LinkOptions  # noqa: E402 - tests are found by the line above
from tests import containers, projects  # noqa: E402
from tests.support.robot_fleet import PROGRAMS, UID, Fleet  # noqa: E402
from tests.support.robot_runs import Runs, job  # noqa: E402
from tests.terminals import Terminal  # noqa: E402
from tests.waiting import until  # noqa: E402

TRIALS, BEGINS, KEYS, SILENCES = 100, 20, 20, 3
MANY, MANY_RUNS = 12, 20
DRIVE = 'import time; time.sleep(1.1); open("way.csv", "w").write("t,x\\n0,1\\n")'
PROJECT = """
template = "arena.xml"
command = {command}
seed = "//random/@seed"
[variables]
population_size = "//swarm/@count"
[robots]
count = "population_size"
[runners.robots]
fleet = {{ {fleet} }}
link_options = {{ ssh_config = "{config}" }}
disk_min = 1000000
stop = {stop}
"""
BEGUN = """
[outputs.begun]
file = "begun.csv"
[container]
image = "host.tar"
"""
SUPERVISED = """
[trials]
supervised = true
countdown = 0
"""
STOP = ["sh", "-c", "date +%s.%N >> /home/robot/stops"]
TOLD = """
import signal, sys, time

def note(number, frame):
    with open("/home/robot/signals", "a") as file:
        print(time.time(), file=file)
    if sys.argv[1] == "ends":
        sys.exit()

signal.signal(signal.SIGTERM, note)
open("/home/robot/begun", "w").close()
while True:
    time.sleep(60)
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
    many()
    with Fleet() as fleet, tempfile.TemporaryDirectory() as folder:
        options = LinkOptions(ssh_config=str(fleet.ssh_config))
        homes = {name: robot.home for name, robot in fleet.robots.items()}
        own = {"disk_min": 1_000_000, "grace": 2.0, "stop": STOP}
        make = partial(Runs, Path(folder), homes, lambda name, _: Fabric(name, options), **own)
        trials(make())
        short_silences(fleet, make)
        long_silences(fleet, make)
        keys(fleet, Path(folder) / "ends", "ends", KEYS)
        keys(fleet, Path(folder) / "deaf", "ignores SIGTERM", 3)
        for engine in ("none", "podman", "apptainer"):
            if engine == "none" or shutil.which(engine):
                begins(fleet, Path(folder) / engine, engine)
            else:
                print(f"start in containers of {engine}: not measured, because it is not installed")


def many() -> None:
    """Measure what is added to runs of 1.1 s on twelve robots, and what plain SSH over open connections adds."""
    with Fleet(MANY) as fleet, tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "many"
        projects.make(root, configured(fleet, ["python3", "{project}/drive.py"], STOP).replace("lease", "#"))
        (root / "drive.py").write_text(DRIVE)
        query = ("run", f"population_size={MANY}", "--runs", str(MANY_RUNS), "--on", "robots", "--no-figures")
        done = projects.quick(root, *query)
        assert done.returncode == 0, done.stderr
        starts = [row["started"] for row in projects.sql(root, "SELECT epoch(started) AS started FROM executions ORDER BY 1")]
        own = statistics.mean(after - before for before, after in pairwise(starts))
        plain = statistics.mean(over_ssh(fleet, Path(folder), number) for number in range(MANY_RUNS))
        show(f"{MANY} robots, {MANY_RUNS} runs of 1.1 s: time of a run", own, "s", "2 x plain SSH")
        show("  plain SSH over open connections", plain, "s", "-")
        show("  ratio", own / plain, "", "2")


def over_ssh(fleet: Fleet, folder: Path, number: int) -> float:
    """Execute the program on all robots over open connections, and copy what it has left; return the seconds that it takes."""
    client = ["ssh", "-F", str(fleet.ssh_config), "-o", "ControlMaster=auto", "-o", f"ControlPath={folder}/%h"]
    client += ["-o", "ControlPersist=60"]
    argv = {name: [*client, name, f"mkdir -p plain && cd plain && python3 -c '{DRIVE}'"] for name in fleet.names}
    began = time.monotonic()
    for one in [subprocess.Popen(argv[name], stdout=subprocess.DEVNULL) for name in fleet.names]:
        assert one.wait() == 0
    copies = [folder / f"{name}.{number}" for name in fleet.names]
    for name, copy in zip(fleet.names, copies, strict=True):
        with copy.open("wb") as file:
            subprocess.Popen([*client, name, "cat plain/way.csv"], stdout=file)
    while not all(copy.stat().st_size for copy in copies):
        time.sleep(0.005)
    return time.monotonic() - began


def trials(runs: Runs) -> None:
    """Measure how far apart programs of 1 s start, and what is added to each run."""
    words = [word for place in PLACES for word in (place, "1s")]
    results = runs.follow(runs.submit(*(job(number, *words) for number in range(TRIALS))), 1000.0)
    assert all(one.error is None for one in results), results
    rows = [row for table, row in runs.rows if table == "robots"]
    skews = [max(each) - min(each) for each in zip(*[iter(row["start_skew_ns"] / 1e6 for row in rows)] * 3, strict=True)]
    added = sorted(after.started - before.started - 1.0 for before, after in pairwise(results))
    show_all("start of a run: between the first and the last robot", skews, "ms", "20")
    show(f"{TRIALS} runs of 1 s: added to each, mean", statistics.mean(added), "s", "1")
    show("  the slowest tenth", statistics.mean(added[-len(added) // 10 :]), "s", "1")


def short_silences(fleet: Fleet, make: Callable[[], Runs]) -> None:
    """Measure how often a run fails whose robot cannot be reached for 3 s."""
    failed = 0
    for number in range(SILENCES):
        runs = make()
        runner = runs.submit(job(number, *(word for place in PLACES for word in (place, "nap"))))
        runs.all_begun()
        fleet.radio("rb2", up=False)
        time.sleep(3)
        fleet.radio("rb2", up=True)
        [result] = runs.follow(runner)
        failed += result.error is not None
        assert any("rb2 does not answer; its run goes on" in note for note in runs.notes), runs.notes
    show(f"radio down for 3 s: failed runs of {SILENCES}", failed, "", "0")


def long_silences(fleet: Fleet, make: Callable[[], Runs]) -> None:
    """Measure the time from the loss of a robot until its program is gone, by its lease, and those of the others."""
    lost, others = [], []
    for number in range(SILENCES):
        runs = make()
        runner = runs.submit(job(number, *(word for place in PLACES for word in (place, "sleep"))))
        runs.all_begun()
        running = processes("go.py")
        fleet.radio("rb2", up=False)
        ends = gone(time.time(), running)
        runs.follow(runner)
        fleet.heal()
        lost.append(ends["2"])
        others.append(max(ends["1"], ends["3"]))
    lease = f"lease of {runs.table.lease:g} s"
    show_all(f"radio down for ever: its program is gone, {lease}", lost, "s", "10")
    show_all("  the programs of all others are gone", others, "s", "10")


def keys(fleet: Fleet, root: Path, program: str, count: int) -> None:
    """Measure the time from a key in a terminal until programs and stop commands are told, and until no program is left."""
    projects.make(root, configured(fleet, ["python3", "{project}/told.py", program], STOP) + SUPERVISED)
    (root / "told.py").write_text(TOLD)
    homes = [robot.home for robot in fleet.robots.values()]
    query = ("run", "population_size=3", "--runs", "1", "--on", "robots", "--operator", "Ann", "--no-figures")
    found: dict[str, list[float]] = {"signals": [], "stops": [], "gone": []}
    with Terminal(root, str(projects.SIERRA), *query) as terminal:
        for _ in range(count):
            for home in homes:
                for name in ("signals", "stops", "begun"):
                    (home / name).unlink(missing_ok=True)
            terminal.answer("a: abort > ")
            terminal.expect("any key: stop  rb1 ")
            until(lambda: all((home / "begun").exists() for home in homes), "all have begun", 30)
            time.sleep(random.uniform(0.2, 0.4))  # at any time of the polls
            running = processes("told.py")
            pressed = time.time()
            terminal.type(" ")
            found["gone"].append(max(gone(pressed, running).values()))
            terminal.answer("repeat it > ", "i")
            for name in ("signals", "stops"):
                at = [float((home / name).read_text().split()[0]) for home in homes]
                found[name].append(1e3 * (max(at) - pressed))
            terminal.answer("or text) > ", "2")
            terminal.answer("none) > ")
        terminal.answer("a: abort > ", "a")
        terminal.end()
    show_all(f"key until a program that {program} gets SIGTERM", found["signals"], "ms", "100")
    show_all("  until the stop command executes", found["stops"], "ms", "100")
    show_all("  until no program is left", found["gone"], "s", "grace: 2")


def processes(program: str) -> dict[str, str]:
    """Return the processes of a program on all robots, each with the place of its robot."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if program in (folder / "cmdline").read_text() and folder.stat().st_uid == UID:
                variables = dict(one.partition("=")[::2] for one in (folder / "environ").read_text().split("\0"))
                found[folder.name] = variables["SIERRA_ROBOT"]
    assert set(found.values()) == set(PLACES), found
    return found


def gone(since: float, running: dict[str, str]) -> dict[str, float]:
    """Wait until no process is left; return the seconds since a time at which those of each place had ended."""
    ends: dict[str, float] = {}
    while running:
        for pid in [pid for pid in running if not Path(f"/proc/{pid}").exists()]:
            ends[running.pop(pid)] = time.time() - since
        time.sleep(0.001)
    return ends


def configured(fleet: Fleet, command: list[str], stop: list[str]) -> str:
    """Return the settings of a project whose runs execute a command on three robots."""
    members = ", ".join(f'{name} = {{ host = "{name}" }}' for name in fleet.names)
    return PROJECT.format(fleet=members, config=fleet.ssh_config, command=command, stop=stop)


def begins(fleet: Fleet, root: Path, engine: str) -> None:
    """Measure the time from the common start until the programs of three robots begin, by their own clocks."""
    projects.make(root, configured(fleet, ["sh", "begin.sh"], []) + BEGUN)
    (root / "begin.sh").write_text(BEGIN)
    containers.host(root, Path("/bin/sh"), Path("/bin/date"))
    query = ("run", "population_size=3", "--runs", str(BEGINS), "--on", "robots", "--engine", engine, "--no-figures")
    for words in (("image", "pin"), query):
        done = projects.quick(root, *words)
        assert done.returncode in (0, 1), done.stderr  # on a busy machine, single runs fail
    show_all(f"common start until programs begin, {engine}", [row["delay"] for row in projects.sql(root, DELAYS)], "ms", "20")


def show_all(what: str, values: Sequence[float], unit: str, limit: str) -> None:
    show(f"{what}, median", statistics.median(values), unit, limit)
    show("    the slowest of all", max(values), unit, limit)


def show(what: str, value: float, unit: str, limit: str) -> None:
    print(f"{what:68} {value:8.2f} {unit:2} (at most {limit})", flush=True)


if __name__ == "__main__":
    main()
