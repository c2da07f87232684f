"""Drivers of robots that are killed, stopped, or two at once: `sierra run --on robots` as a process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from sierra import Project
from tests import projects
from tests.support.killed_driver import NAMES
from tests.support.robot_fleet import REPOSITORY, Fleet
from tests.tiers import at_night
from tests.waiting import until

SWARM = """
import os, sys, time
place = int(os.environ["SIERRA_ROBOT"])
with open("swarm.csv", "w") as file:
    file.write("t,x\\n")
    for t in range(30):
        file.write(f"{t},{t * place}\\n")
        file.flush()
        time.sleep(0.1)
"""
TABLES = """
template = "experiment.xml"
command = ["python3", "{project}/swarm.py", "{seed}"]
[variables.speed]
set = "//speed/@value"
[outputs.swarm]
file = "swarm.csv"
time = "t"
[robots]
count = 3
[runners.robots]
stop = ["sh", "-c", "date >> /home/robot/stops"]
disk_min = 1000000
lease = 3.0
grace = 1.0
[links.fabric]
"""
STEPS = {f"SIGKILL {name} {number}" for name in NAMES for number in (1, 3)}
STEPS |= {f"SIGINT {name} 3" for name in NAMES} | {f"SIGKILL {step}" for step in ("arm 2", "clock 100", "journal 2", "done 4")}
"""The steps at which drivers are killed or interrupted at night; a batch of two runs on three robots reaches each of them."""
QUERY = ("run", "speed=1", "--runs", "2", "--on", "robots", "--no-figures")


@pytest.fixture
def project(fleet: Fleet, tmp_path: Path) -> Iterator[Path]:
    (tmp_path / "swarm.py").write_text(SWARM)
    (tmp_path / "experiment.xml").write_text('<e><speed value="1"/></e>')
    robots = "".join(f'[runners.robots.fleet.{name}]\nhost = "{name}"\n' for name in fleet.names)
    (tmp_path / "sierra.toml").write_text(f'{TABLES}ssh_config = "{fleet.ssh_config}"\n{robots}')
    yield tmp_path
    for name in fleet.names:
        until(partial(is_idle, fleet, name), partial(fleet.commands, name), 20)


def is_idle(fleet: Fleet, name: str) -> bool:
    return not [line for line in fleet.commands(name) if "swarm.py" in line]


def drive(project: Path) -> subprocess.Popen[str]:
    argv = [str(Path(sys.executable).with_name("sierra")), *QUERY]
    return subprocess.Popen(
        argv, cwd=project, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
    )


def all_busy(fleet: Fleet, process: subprocess.Popen[str]) -> None:
    """Wait until a driver's run executes on all robots."""

    def busy() -> bool:
        assert process.poll() is None, process.communicate()
        return all(list(robot.home.rglob("swarm.csv")) for robot in fleet.robots.values())

    until(busy, "all robots have begun", 60)


def answered(project: Path, ticks: int = 30) -> None:
    """Ask again, and check that each run has one successful execution, with all ticks of all robots in its table."""
    process = drive(project)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    store = Project(project)
    rows = partial(rows_of, store)
    assert rows("SELECT count(*), count(DISTINCT run) FROM executions WHERE status = 'ok'") == [(2, 2)]
    swarm = "swarm JOIN executions USING (execution)"
    counts = rows(f"SELECT robot, count(*) FROM {swarm} WHERE status = 'ok' GROUP BY robot ORDER BY robot")
    assert counts == [(robot, 2 * ticks) for robot in (1, 2, 3)]
    assert set(rows("SELECT count(DISTINCT place) FROM robots GROUP BY execution")) == {(3,)}


def rows_of(store: Project, statement: str) -> list[tuple[object, ...]]:
    return [tuple(row.values()) for row in store.sql(statement).to_pylist()]


def test_robots_stop_when_their_driver_is_killed(project: Path, fleet: Fleet):
    with drive(project) as process:
        all_busy(fleet, process)
        process.kill()
    until(lambda: all(is_idle(fleet, name) for name in fleet.names), "all robots have stopped", 10)
    assert all((robot.home / "stops").exists() for robot in fleet.robots.values())
    answered(project)


@pytest.mark.parametrize("step", ["SIGKILL at 2", "SIGKILL pull 2", "SIGINT arm 2", *at_night(STEPS)])
def test_a_driver_that_ends_at_a_step_leaves_nothing_that_moves(project: Path, fleet: Fleet, step: str):
    number, _, step = step.partition(" ")
    (project / "swarm.py").write_text(SWARM.replace("range(30)", "range(5)"))
    argv = [sys.executable, "-m", "tests.support.killed_driver", number, step, *QUERY]
    ended = subprocess.run(
        argv, cwd=project, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, capture_output=True, timeout=120, check=False
    )
    assert ended.returncode in ({-signal.SIGKILL} if number == "SIGKILL" else {130, 0}), ended.stderr
    assert b"fault" not in ended.stderr
    until(lambda: all(is_idle(fleet, name) for name in fleet.names), "all robots have stopped", 10)
    moved = [robot for robot in fleet.robots.values() if list(robot.home.rglob("swarm.csv"))]
    assert all((robot.home / "stops").exists() for robot in moved)
    answered(project, ticks=5)
    assert projects.quick(project, "fsck").returncode == 0


def test_robots_stop_when_their_driver_is_stopped(project: Path, fleet: Fleet):
    with drive(project) as process:
        all_busy(fleet, process)
        os.killpg(process.pid, signal.SIGSTOP)
        began = time.monotonic()
        until(lambda: all(is_idle(fleet, name) for name in fleet.names), "all robots have stopped", 10)
        assert time.monotonic() - began < 9
        time.sleep(max(0.0, 9 - (time.monotonic() - began)))  # three leases
        os.killpg(process.pid, signal.SIGCONT)
        output, errors = process.communicate(timeout=120)
        assert process.returncode == 1, errors
        assert "1 failed" in output or "lost" in output + errors
    answered(project)


def test_two_drivers_take_turns(project: Path, fleet: Fleet, tmp_path_factory: pytest.TempPathFactory):
    other = tmp_path_factory.mktemp("other")
    for name in ("swarm.py", "experiment.xml", "sierra.toml"):
        (other / name).write_text((project / name).read_text())
    (project / "swarm.py").write_text(SWARM.replace("range(30)", "range(600)"))
    with drive(project) as first:
        all_busy(fleet, first)
        second = drive(other)
        _, errors = second.communicate(timeout=60)
        assert second.returncode == 3
        [line] = [line for line in errors.splitlines() if "in use by" in line]
        assert " (session " in line
        first.send_signal(signal.SIGINT)
        assert first.wait(60) == 130
    answered(other)
