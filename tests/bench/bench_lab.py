"""Runs on the hosts of a lab on this machine: the time of a batch, the rate of large results, what the driver costs. For root.

Python, sshd and the programs of all hosts share the cores of this machine, so that a real lab is faster.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tests.support import lab_project  # noqa: E402 - tests are found by the line above
from tests.support.robot_fleet import Fleet  # noqa: E402

HOSTS, SLOTS, RUNS, SECONDS = 8, 2, 1000, 1.0
LARGE = 1 << 30
WRITES = f"""
import sys
with open("large.bin", "wb") as file:
    for _ in range({LARGE >> 20}):
        file.write(bytes(1 << 20))
open("swarm.csv", "w").write("t,x" + chr(10) + "0,1" + chr(10))
"""


def bench(folder: Path) -> None:
    with Fleet(HOSTS, disk="4g") as fleet:
        many(fleet, folder)
        large(fleet, folder)


def timed(project: Path, *words: str) -> tuple[float, float]:
    """Return the seconds of a driver, and its CPU seconds with those of its clients of SSH."""
    began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    code, errors = lab_project.ended(lab_project.drive(project, *words))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert code == 0, errors
    return time.monotonic() - began, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def many(fleet: Fleet, folder: Path) -> None:
    """Print the time of many short runs, compared with the ideal."""
    hosts = f"hosts = {[f'{name}:{SLOTS}' for name in fleet.names]!r}".replace("'", '"')
    project = lab_project.make(fleet, folder / "many", SECONDS, hosts=hosts)
    seconds, cpu = timed(project, *lab_project.QUERY, str(RUNS // 2))
    ideal = RUNS * SECONDS / (HOSTS * SLOTS)
    print(f"{RUNS} runs of {SECONDS:g} s on {HOSTS} hosts: {seconds:.1f} s, ideal {ideal:.1f} s, ratio {seconds / ideal:.2f}")
    print(f"CPU of the driver: {cpu:.1f} s, {100 * cpu / (RUNS * SECONDS):.1f} % of the runs' time")
    if shutil.which("parallel"):
        seconds = with_parallel(fleet, project)
        print(f"the same with GNU parallel, which copies and records nothing: {seconds:.1f} s, ratio {seconds / ideal:.2f}")


def with_parallel(fleet: Fleet, project: Path) -> float:
    """Return the seconds for the same runs with GNU parallel, in a folder for each run on a host that has the files."""
    for robot in fleet.robots.values():
        for name in ("sim.py", "experiment.xml"):
            shutil.copy(project / name, robot.home)
    logins = project.with_name("logins")
    logins.write_text("".join(f"{SLOTS}/{name}\n" for name in fleet.names))
    run = "mkdir -p w{} && cd w{} && python3 ../sim.py ../experiment.xml"
    argv = ("parallel", "--will-cite", "--sshloginfile", str(logins), run, ":::", *map(str, range(RUNS)))
    began = time.monotonic()
    subprocess.run(argv, check=True, env=os.environ | {"PARALLEL_SSH": f"ssh -F {fleet.ssh_config}"})
    return time.monotonic() - began


def large(fleet: Fleet, folder: Path) -> None:
    """Print the rate at which one large result comes, compared with that of SSH."""
    name = fleet.names[0]
    hosts = f'hosts = ["{name}:1"]'
    project = lab_project.make(fleet, folder / "large", hosts=hosts)
    (project / "sim.py").write_text(WRITES)
    query = (*lab_project.QUERY[:1], "speed=1", *lab_project.QUERY[2:])
    code, errors = lab_project.ended(lab_project.drive(project, *query, "1", "--detach"))
    assert code == 0, errors
    while not [entry for session in lab_project.sessions(fleet, name) for entry in session.glob("ended/*")]:
        time.sleep(0.2)
    for log in project.glob(".sierra/work/*/results/*.pack"):
        log.unlink()
    process = lab_project.drive(project, "attach")
    began, first, log = 0.0, 0, None
    while log is None or not (first := log.stat().st_size):
        log = next(project.glob(".sierra/work/*/results/*.pack"), None)
        time.sleep(0.01)
        assert process.poll() is None
    began = time.monotonic()
    while log.exists() and log.stat().st_size < LARGE:
        time.sleep(0.01)
    ours = (LARGE - first) / (time.monotonic() - began)
    code, errors = lab_project.ended(process)
    assert code == 0, errors
    source = fleet.robots[name].home / "source"
    source.write_bytes(bytes(LARGE))
    began = time.monotonic()
    with (folder / "copy").open("wb") as copy:
        subprocess.run(["ssh", "-F", fleet.ssh_config, name, "cat", "source"], stdout=copy, check=True, env=os.environ)
    theirs = LARGE / (time.monotonic() - began)
    print(f"1 GiB of results: {ours / 1e6:.0f} MB/s, ssh cat: {theirs / 1e6:.0f} MB/s, ratio {ours / theirs:.2f}")


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory(prefix="sierra-bench-") as scratch:
        bench(Path(scratch))
