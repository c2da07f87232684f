"""Supervised trials on robots with real sshd: signs of life of each robot, a key stops all, and the trial is repeated."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from tests import projects
from tests.support.robot_fleet import Fleet
from tests.terminals import Terminal
from tests.waiting import until

pytestmark = pytest.mark.integration
CONFIG = """\
template = "arena.xml"
command = "python3 sim.py {{input}}"
seed = "//random/@seed"
runs = 1
[variables]
population_size = "//swarm/@count"
[robots]
count = 2
command = "python3 robot.py {{input}} {{robot}}"
[trials]
supervised = true
countdown = 0
[runners.robots]
fleet = {{ {fleet} }}
link_options = {{ ssh_config = "{config}" }}
disk_min = 1000000
stop = ["sh", "-c", "echo stopped >> ~/stops"]
"""
ROBOT = """\
import pathlib, sys, time
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    print(0, sys.argv[2], sep=",", file=file)
if not any(pathlib.Path("/home").glob("*/again")):
    time.sleep(600)
"""


def is_moving(fleet: Fleet, name: str) -> bool:
    """Check whether a program of the project executes on a robot."""
    return any("/sources/" in line for line in fleet.commands(name))


def has_written(fleet: Fleet, name: str) -> bool:
    """Check whether a program of the project has written its table on a robot."""
    return any(path.read_text().count("\n") == 2 for path in fleet.robots[name].home.rglob("output/swarm.csv"))


def test_a_key_stops_all_robots_and_the_trial_is_repeated(fleet: Fleet, tmp_path: Path) -> None:
    members = ", ".join(f'{name} = {{ host = "{name}" }}' for name in fleet.names[:2])
    root = projects.make(tmp_path / "project", CONFIG.format(fleet=members, config=fleet.ssh_config))
    (root / "robot.py").write_text(ROBOT)
    words = ("run", "population_size=1", "--on", "robots", "--operator", "Ann", "--no-figures")
    with Terminal(root, str(projects.SIERRA), *words) as terminal:
        terminal.answer("a: abort > ")
        terminal.expect("any key: stop  rb1 ")
        for name in fleet.names[:2]:
            until(partial(has_written, fleet, name))
            assert is_moving(fleet, name)
        terminal.type(" ")
        terminal.answer("repeat it > ", "i")
        terminal.answer("or text) > ", "2")
        terminal.answer("none) > ")
        assert not any(is_moving(fleet, name) for name in fleet.names[:2])
        for name in fleet.names[:2]:
            (fleet.robots[name].home / "again").touch()
        terminal.answer("a: abort > ")
        terminal.answer("i: no > ")
        terminal.answer("none) > ")
        assert terminal.end() == 0, terminal.shown
    trials = "SELECT valid, stopped, e.status FROM trials JOIN executions e USING (execution) ORDER BY position"
    assert projects.sql(root, trials) == [
        {"valid": False, "stopped": True, "status": "stopped"},
        {"valid": True, "stopped": False, "status": "ok"},
    ]
    assert projects.sql(root, "SELECT robot, coverage FROM swarm ORDER BY robot") == [
        {"robot": 1, "coverage": 1},
        {"robot": 2, "coverage": 2},
    ]
    assert projects.sql(root, "SELECT count(*) AS n FROM artifacts WHERE path LIKE '%swarm.csv'") == [{"n": 4}]
