"""A project whose runs on two robots are supervised trials that leave tables and bags, and the same in a simulator."""

from __future__ import annotations

import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Any

import sierra
from tests import projects
from tests.extensions.ros import bags
from tests.support.robot_fleet import Fleet

CONFIG = """\
template = "arena.xml"
command = "python3 sim.py {{input}}"
seed = "//random/@seed"
runs = 1
target = "sim"
[variables]
noise = "//noise"
[outputs.swarm]
file = "swarm.csv"
time = "tick"
[outputs.odom]
file = "run.bag"
format = "bag"
topics = ["/{{model}}/odom"]
mismatch = "ragged"
volatile = ["received_ns"]
[package]
title = "Robots"
license = "MIT"
authors = [{{ name = "Ada Lovelace" }}]
[targets.sim]
[targets.robots]
runner = "robots"
[targets.robots.robots]
count = 2
command = "python3 robot.py {{input}} {{robot}}"
[targets.robots.trials]
supervised = true
countdown = 0
reasons = ["fell over", "lost"]
[runners.robots]
fleet = {{ {fleet} }}
link_options = {{ ssh_config = "{ssh_config}" }}
disk_min = 1000000
lease = 2
grace = 0.5
stop = []
"""
PROGRAM = """\
import pathlib, shutil, sys, time
text = open(sys.argv[1]).read()
seed = int(text.split('<random seed="')[1].split('"')[0])
noise = float(text.split("<noise>")[1].split("<")[0])
slope = {slope}
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    for tick in range(5):
        print(tick, tick * slope + noise * (seed % 100), sep=",", file=file)
shutil.copy(pathlib.Path(__file__).with_name({bag}), "run.bag")
if any(pathlib.Path("/home").glob("*/wait")):
    time.sleep(600)
"""
"""The mean of robots 1 and 2 is the simulator's value."""
TICKS, MESSAGES = 5, {1: 3, 2: 6}
"""The rows of a robot's table, and the messages in the bags of robots 1 and 2."""
TABLES = (
    *("trials", "all_trials", "robots", "robot_clocks", "executions", "effective", "swarm", "odom", "artifacts"),
    *("environments", "batch_runs"),
)


def make(fleet: Fleet, folder: Path) -> Path:
    """Write the project into a new folder; return the folder."""
    members = ", ".join(f'{name} = {{ host = "{name}" }}' for name in fleet.names[:2])
    simulator = PROGRAM.format(slope="1.5", bag='"robot1.bag"')
    root = projects.make(folder, CONFIG.format(fleet=members, ssh_config=fleet.ssh_config), simulator=simulator)
    (root / "robot.py").write_text(PROGRAM.format(slope="int(sys.argv[2])", bag='f"robot{sys.argv[2]}.bag"'))
    for place in (1, 2):
        bag = bags.record(folder.with_name("bags") / str(place), "bag", bags.odometry(place, 3))
        shutil.copy(bag, root / f"robot{place}.bag")
    return root


def copy_without_store(root: Path, folder: Path) -> Path:
    return shutil.copytree(root, folder, ignore=shutil.ignore_patterns(".sierra"))


def wait(fleet: Fleet, *, waiting: bool = True) -> None:
    """Let the programs on the robots wait after they have written their files, or end."""
    for robot in fleet.robots.values():
        (robot.home / "wait").touch() if waiting else (robot.home / "wait").unlink(missing_ok=True)


def have_written(fleet: Fleet) -> bool:
    """Check if a run has written all of its files on both robots."""
    return all(list(fleet.robots[name].home.glob(".cache/*/runs/*/1/output/run.bag")) for name in fleet.names[:2])


def leftovers(fleet: Fleet) -> list[str]:
    """Return the processes of runs and the folders of runs on all robots."""
    folders = [str(path) for robot in fleet.robots.values() for path in robot.home.glob(".cache/*/runs/*")]
    return [*folders, *(line for name in fleet.names for line in fleet.commands(name))]


def rows(root: Path, without: Collection[str] = ("row",)) -> dict[str, list[str]]:
    """Return all rows of the tables about trials and robots, in one order.

    `row` is the number of a row in its segment, and `gc` merges segments.
    """

    def shown(row: dict[str, Any]) -> str:
        return repr({name: value for name, value in row.items() if name not in without})

    store = sierra.open(root)
    return {table: sorted(map(shown, store.sql(f"SELECT * FROM {table}").to_pylist())) for table in TABLES}
