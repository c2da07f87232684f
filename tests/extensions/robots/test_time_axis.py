"""One time axis for stamps of robots whose clocks differ, drift and are slewed, by the documented formula in SQL."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support import robot_project
from tests.support.robot_fleet import OTHER_CLOCK, Fleet

pytestmark = [pytest.mark.integration, pytest.mark.nightly]
DRIFT, SLEWED = 0.01, 0.04
STAMPS = """
import os, select, time
with open("swarm.csv", "w") as file:
    file.write("t,before,stamp,later\\n")
    for t in range(60):
        file.write(f"{t},{time.monotonic_ns()},{time.time_ns()},{time.monotonic_ns()}\\n")
        file.flush()
        select.select([], [], [], 0.05)
"""
"""Stamps of the wall clock, each between two of the monotonic clock, which all robots and this process share."""
COMMON = """
SELECT r.robot, t.before, t.later, t.stamp - offset_ns - round(drift * (t.stamp - clock_ns))::BIGINT AS common,
       c.drift, c.uncertainty_ns
FROM swarm t JOIN robot_clocks c ON c.execution = t.execution AND c.place = t.robot
JOIN robots r ON r.execution = t.execution AND r.place = t.robot
"""
Ahead = Callable[[float], float]


@contextlib.contextmanager
def clock_of(fleet: Fleet, name: str, ahead: Ahead) -> Iterator[list[float]]:
    """Let the clock of a robot be ahead by what `ahead` returns for a time of the monotonic clock; yield its steps in seconds.

    It moves in small steps, which are larger on a busy machine. An agent does not see what it was between two looks.
    """
    ended = threading.Event()
    steps: list[float] = []

    def move() -> None:
        last = first
        while not ended.wait(0.002):
            now = ahead(time.monotonic())
            fleet.set_clock(name, now)
            steps.append(ahead(time.monotonic()) - last)  # the longest time for which the last one was in force
            last = now

    first = ahead(time.monotonic())
    fleet.set_clock(name, first)
    thread = threading.Thread(target=move)
    thread.start()
    try:
        yield steps
    finally:
        ended.set()
        thread.join()


@pytest.mark.parametrize("slewed", [False, True], ids=["drift", "slew"])
def test_the_common_time_of_all_robots_is_as_exact_as_its_uncertainty(fleet: Fleet, tmp_path: Path, slewed: bool) -> None:
    root = robot_project.make(fleet, tmp_path / "p")
    (root / "swarm.py").write_text(STAMPS)
    config = root / "sierra.toml"
    text = config.read_text().replace("disk_min", "clock_error = 1.0\ndisk_min")
    variables = ", ".join(f"{name} = {value!r}" for name, value in OTHER_CLOCK.items())
    config.write_text(text.replace('host = "rb2"', f'host = "rb2"\nvariables = {{ {variables} }}'))
    began, begun = time.monotonic(), threading.Event()
    since: list[float] = []

    def drifting(now: float) -> float:
        return 137 + DRIFT * (now - began)

    def slewing(now: float) -> float:
        if not begun.is_set():
            return 137.0
        since.append(now)
        return 137.0 + SLEWED * min(1.0, (now - since[0]) / 0.5)

    with clock_of(fleet, "rb2", slewing if slewed else drifting) as steps:
        process = robot_project.drive(root, (*robot_project.RUN, "--runs", "1"))
        robot_project.all_busy(fleet, process)
        begun.set()
        _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    here = max(time.time_ns() - time.monotonic_ns() for _ in range(100))  # another process may execute in between
    rows = robot_project.rows_of(root, COMMON)
    assert {row[0] for row in rows} == set(fleet.names)
    for robot, before, later, common, drift, uncertainty in rows:
        error = uncertainty + (max(steps) * 1e9 if robot == "rb2" else 0)
        assert before + here - error <= common <= later + here + error, (robot, drift, uncertainty, max(steps))
    [(drift, uncertainty)] = {row[4:] for row in rows if row[0] == "rb2"}
    if slewed:
        assert uncertainty >= SLEWED * 1e9 * 0.99, "nothing excludes that stamps are wrong by so much"
    else:
        assert drift == pytest.approx(DRIFT / (1 + DRIFT), rel=0.2)
