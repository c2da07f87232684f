"""Supervised trials on robots with real sshd: signs of life of each robot, a key stops all, and the trial is repeated."""

from __future__ import annotations

import hashlib
import json
import re
import time
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
stop = ["sh", "-c", "! ls ~/.cache/sierra-robot/runs/*/1/output/* || echo 64 > ~/battery"]
battery = "/home/robot/battery"
firmware = ["cat", "/home/robot/firmware"]
calibration = "~/calibration.yaml"
"""
BATTERIES = {"rb1": 81, "rb2": 79}
"""The charges of the robots in percent; the stop command after a run makes them 64."""
RUN = ("run", "population_size=1", "--on", "robots", "--operator", "Ann", "--no-figures")
ROBOT = """\
import pathlib, sys, time
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    print(0, sys.argv[2], sep=",", file=file)
if not any(pathlib.Path("/home").glob("*/again")):
    time.sleep(600)
"""


def is_armed(fleet: Fleet, name: str) -> bool:
    """Check whether a worker waits with a run on a robot."""
    return any(path.stat().st_size for path in fleet.robots[name].home.glob(".cache/*/runs/*/journal.jsonl"))


def is_moving(fleet: Fleet, name: str) -> bool:
    """Check whether a program of the project executes on a robot."""
    return any("/sources/" in line for line in fleet.commands(name))


def has_written(fleet: Fleet, name: str) -> bool:
    """Check whether a program of the project has written its table on a robot."""
    return any(path.read_text().count("\n") == 2 for path in fleet.robots[name].home.rglob("output/swarm.csv"))


def project(fleet: Fleet, folder: Path) -> Path:
    members = ", ".join(f'{name} = {{ host = "{name}" }}' for name in fleet.names[:2])
    root = projects.make(folder / "project", CONFIG.format(fleet=members, config=fleet.ssh_config))
    (root / "robot.py").write_text(ROBOT)
    for name, charge in BATTERIES.items():
        facts = {"battery": f"{charge}\n", "firmware": f"1.4 of {name}\n", "calibration.yaml": f"radius: {charge}\n"}
        for file, text in facts.items():
            (fleet.robots[name].home / file).write_text(text)
        (fleet.robots[name].home / "battery").chmod(0o666)
    return root


def test_a_key_stops_all_robots_and_the_trial_is_repeated(fleet: Fleet, tmp_path: Path) -> None:
    root = project(fleet, tmp_path)
    with Terminal(root, str(projects.SIERRA), *RUN) as terminal:
        assert "\nrobots: 1 (rb1), 2 (rb2)\r\n" in terminal.expect("a: abort > ")
        for name in fleet.names[:2]:
            until(partial(is_armed, fleet, name), "it is armed while the person places it")
            assert not is_moving(fleet, name)
        terminal.type("\n")
        terminal.expect("\rgo")
        said = time.time()
        terminal.expect("any key: stop  rb1 ")
        terminal.expect(" s 81 %  rb2 ")
        terminal.expect(" s 79 %")
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
    facts = "SELECT robot, battery_start, battery_end, firmware, calibration_sha256 FROM robots JOIN trials USING (execution)"
    assert [tuple(row.values()) for row in projects.sql(root, f"{facts} ORDER BY position, robot")] == [
        (name, start, 64, f"1.4 of {name}", hashlib.sha256(f"radius: {charge}\n".encode()).hexdigest())
        for again in (False, True)
        for name, charge in BATTERIES.items()
        for start in (64 if again else charge,)
    ]
    [first] = projects.sql(root, "SELECT min(epoch(started)) AS at FROM robots")
    assert first["at"] - said < 60.0, "0.4 s on a machine without other work"
    assert projects.sql(root, "SELECT robot, coverage FROM swarm ORDER BY robot") == [
        {"robot": 1, "coverage": 1},
        {"robot": 2, "coverage": 2},
    ]
    assert projects.sql(root, "SELECT count(*) AS n FROM artifacts WHERE path LIKE '%swarm.csv'") == [{"n": 4}]
    [batch] = projects.sql(root, "SELECT batch FROM batches")
    shown = json.loads(projects.quick(root, "show", batch["batch"], "--json").stdout)
    assert [(one["robot"], one["place"], one["firmware"], one["runs"]) for one in shown["robots"]] == [
        (name, place, f"1.4 of {name}", 1) for place, name in enumerate(BATTERIES, 1)
    ]


def test_keys_do_not_stop_a_trial_that_has_lost_a_robot_but_answer_the_prompts(fleet: Fleet, tmp_path: Path) -> None:
    root, (first, second) = project(fleet, tmp_path), fleet.names[:2]
    placed = "countdown = 0\n[trials.draw_poses]\ncount = 2\nx = [0, 4]\ny = [0, 3]\n"
    config = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text(config.replace("countdown = 0\n", placed) + "lease = 2\ngrace = 1\n")
    with Terminal(root, str(projects.SIERRA), *RUN) as terminal:
        shown = terminal.answer("a: abort > ")
        assert re.search(rf"\n  1 \({first}\): x .*\n  2 \({second}\): x ", shown)
        terminal.expect(f"any key: stop  {first} ")
        for name in (first, second):
            until(partial(has_written, fleet, name))
        fleet.radio(second, up=False)
        terminal.expect(f"\nnote: {second} does not answer; ")
        terminal.expect("collecting files, 0 s  ")
        terminal.type("\ni\n2\n")
        fleet.radio(second, up=True)
        ended = terminal.expect("repeat it > i\r\n")
        assert "any key" not in ended
        assert re.search(rf"\nended after [0-9.]+ s; failed: {second} was lost: ", ended)
        terminal.expect("or text) > 2\r\n")
        terminal.answer("none) > ")
        terminal.answer("a: abort > ", "a")
        terminal.end()
    verdicts = projects.sql(root, "SELECT valid, t.reason, stopped FROM trials t")
    assert verdicts == [{"valid": False, "reason": "hardware failure", "stopped": False}]


def test_robots_that_wait_are_disarmed_if_the_trial_is_skipped(fleet: Fleet, tmp_path: Path) -> None:
    root, names = project(fleet, tmp_path), fleet.names[:2]
    with Terminal(root, str(projects.SIERRA), *RUN) as terminal:
        terminal.expect("a: abort > ")
        until(lambda: all(is_armed(fleet, name) for name in names), "all are armed")
        terminal.type("s\n")
        terminal.end()
    assert not any(is_armed(fleet, name) or list(fleet.robots[name].home.glob(".cache/*/runs/*")) for name in names)
    assert projects.sql(root, "SELECT count(*) AS n FROM executions") == [{"n": 0}]
