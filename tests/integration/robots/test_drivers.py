"""Drivers of robots that are killed, stopped, or two at once: `sierra run --on robots` as a process."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import projects
from tests.support import robot_project
from tests.support.killed_driver import NAMES
from tests.support.robot_fleet import Fleet
from tests.support.robot_project import all_busy, all_idle, answered, drive
from tests.tiers import at_night

STEPS = {f"SIGKILL {name} {number}" for name in NAMES for number in (1, 3)}
STEPS |= {f"SIGINT {name} 3" for name in NAMES} | {
    f"SIGKILL {step}" for step in ("arm 2", "clock 100", "journal 2", "pull 2", "done 4")
}
"""The steps at which drivers are killed or interrupted at night; a batch of two runs on three robots reaches each of them."""


@pytest.fixture
def project(fleet: Fleet, tmp_path: Path) -> Iterator[Path]:
    yield robot_project.make(fleet, tmp_path)
    all_idle(fleet, 20)


def test_robots_stop_when_their_driver_is_killed(project: Path, fleet: Fleet):
    with drive(project) as process:
        all_busy(fleet, process)
        process.kill()
    all_idle(fleet)
    assert all((robot.home / "stops").exists() for robot in fleet.robots.values())
    answered(project)


@pytest.mark.parametrize("step", ["SIGKILL at 2", "SIGINT arm 2", *at_night(STEPS)])
def test_a_driver_that_ends_at_a_step_leaves_nothing_that_moves(project: Path, fleet: Fleet, step: str):
    number, _, step = step.partition(" ")
    robot_project.move(project, 5)
    process = drive(project, step=(number, step))
    _, errors = process.communicate(timeout=120)
    assert process.returncode in ({-signal.SIGKILL} if number == "SIGKILL" else {130, 0}), errors
    assert "fault" not in errors
    all_idle(fleet)
    moved = [robot for robot in fleet.robots.values() if list(robot.home.rglob("swarm.csv"))]
    assert all((robot.home / "stops").exists() for robot in moved)
    answered(project, ticks=5)
    assert projects.quick(project, "fsck").returncode == 0


@pytest.mark.nightly
def test_robots_stop_when_their_driver_is_stopped(project: Path, fleet: Fleet):
    with drive(project) as process:
        all_busy(fleet, process)
        os.killpg(process.pid, signal.SIGSTOP)
        began = time.monotonic()
        all_idle(fleet, 9)
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
    robot_project.move(project, 600)
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
