"""A project whose runs are executed on the hosts of a fleet, and drivers of it: `sierra run --on lab` as processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from sierra import Project
from tests.support.robot_fleet import Fleet
from tests.waiting import PATIENCE_S

EXECUTED = "/home/robot/executed"
"""The file on each host to which each run adds its seed and its speed when it begins."""
SIMULATOR = f"""
import sys, time
text = open(sys.argv[1]).read()
seed = text.split('seed="')[1].split('"')[0]
with open("{EXECUTED}", "a") as file:
    file.write(seed + "-" + text.split('speed value="')[1].split('"')[0] + chr(10))
time.sleep(SECONDS)
with open("swarm.csv", "w") as file:
    file.write("t,x" + chr(10) + "0," + str(int(seed) % 1000) + chr(10))
"""
TABLES = """
template = "experiment.xml"
command = ["/usr/bin/python3", "sim.py", "{input}"]
seed = "//@seed"
observe = "none"
[variables.speed]
set = "//speed/@value"
[outputs.swarm]
file = "swarm.csv"
time = "t"
"""
QUERY = ("run", "speed=1,2", "--on", "lab", "--no-figures", "--runs")


def make(fleet: Fleet, folder: Path, seconds: float = 0.2, lab: str = "", hosts: str | None = None) -> Path:
    """Write a project whose runs take so long; return its folder. `lab` are more lines of the lab's table."""
    folder.mkdir(exist_ok=True)
    (folder / "sim.py").write_text(SIMULATOR.replace("SECONDS", str(seconds)))
    (folder / "experiment.xml").write_text('<e seed="0"><speed value="1"/></e>')
    listed = hosts or f"hosts = {json.dumps([f'{name}:2' for name in fleet.names])}"
    links = f'[links.openssh]\nssh_config = "{fleet.ssh_config}"\nconnect = 3.0\n'
    (folder / "sierra.toml").write_text(f"{TABLES}{links}[runners.lab]\n{listed}\n{lab}\n")
    return folder


def drive(project: Path, *words: str) -> subprocess.Popen[str]:
    """Start a driver."""
    return subprocess.Popen(
        [str(Path(sys.executable).with_name("sierra")), *words],
        cwd=project,
        env=os.environ,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Return the exit code and the standard error of a driver when it has ended."""
    _, errors = process.communicate(timeout=PATIENCE_S)
    return process.returncode, errors


def executed(fleet: Fleet, name: str | None = None) -> Counter[str]:
    """Return how often each run was begun, on one host or on all."""
    homes = [robot.home for robot in fleet.robots.values() if name in (None, robot.name)]
    files = [home / "executed" for home in homes]
    return Counter(line for file in files if file.exists() for line in file.read_text().split())


def sessions(fleet: Fleet, name: str) -> list[Path]:
    """Return the folders of sessions on a host."""
    return sorted((fleet.robots[name].home / ".cache/sierra-lab/sessions").glob("*/*"))


def rows_of(project: Path, statement: str) -> list[tuple[Any, ...]]:
    """Return the rows of a statement on the store."""
    return [tuple(row.values()) for row in Project(project).sql(statement).to_pylist()]
