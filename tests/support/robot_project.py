"""A project whose runs move three robots of a fleet, and drivers of it: `sierra run --on robots` as processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from sierra import Project
from tests.support.robot_fleet import MOTOR, REPOSITORY, Fleet
from tests.waiting import PATIENCE_S, until

LEASE_S = 3.0
SWARM = f"""
import os, signal, sys, time
place = int(os.environ["SIERRA_ROBOT"])

def drive():
    with open("{MOTOR}", "w") as motor:
        motor.write("0.2\\n")

def end(*_):  # as a launcher of ROS, whose nodes send commands until they have ended
    give_up = time.monotonic() + 0.5
    while time.monotonic() < give_up:
        drive()
        time.sleep(0.05)
    os._exit(0)

signal.signal(signal.SIGTERM, end)
with open("swarm.csv", "w") as file:
    file.write("t,x\\n")
    for t in range(TICKS):
        drive()
        file.write(f"{{t}},{{t * place}}\\n")
        file.flush()
        time.sleep(0.1)
"""
"""A program that leaves the motor on."""
BROKEN = "/run/robot/broken"
"""A file on a robot with which its stop command fails."""
STOP = ["sh", "-c", f"test ! -e {BROKEN} && echo 0 > {MOTOR}"]
TABLES = f"""
template = "experiment.xml"
command = ["python3", "{{project}}/swarm.py", "{{seed}}"]
[variables.speed]
set = "//speed/@value"
[outputs.swarm]
file = "swarm.csv"
time = "t"
[robots]
count = 3
[runners.robots]
stop = {json.dumps(STOP)}
disk_min = 1000000
lease = {LEASE_S}
grace = 3.0
[links.fabric]
"""
RUN = ("run", "speed=1", "--on", "robots", "--no-figures")
QUERY = (*RUN, "--runs", "2")


def make(fleet: Fleet, folder: Path, ticks: int = 30, hosts: Mapping[str, str] | None = None) -> Path:
    """Write a project whose robots move for `ticks` tenths of a second; return its folder.

    `hosts` are other names of robots in the configuration of OpenSSH.
    """
    folder.mkdir(exist_ok=True)
    move(folder, ticks)
    (folder / "experiment.xml").write_text('<e><speed value="1"/></e>')
    known = hosts or {}
    robots = "".join(f'[runners.robots.fleet.{name}]\nhost = "{known.get(name, name)}"\n' for name in fleet.names)
    (folder / "sierra.toml").write_text(f'{TABLES}ssh_config = "{fleet.ssh_config}"\n{robots}')
    return folder


def move(project: Path, ticks: int) -> None:
    """Let the robots of a project move for `ticks` tenths of a second."""
    (project / "swarm.py").write_text(SWARM.replace("TICKS", str(ticks)))


def drive(project: Path, words: tuple[str, ...] = QUERY, step: tuple[str, str] | None = None) -> subprocess.Popen[str]:
    """Start a driver; `step` are a signal that it sends itself, and when (see `tests.support.killed_driver`)."""
    argv = [str(Path(sys.executable).with_name("sierra"))]
    if step is not None:
        argv = [sys.executable, "-m", "tests.support.killed_driver", *step]
    return subprocess.Popen(
        [*argv, *words],
        cwd=project,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def is_idle(fleet: Fleet, name: str) -> bool:
    return not [line for line in fleet.commands(name) if "swarm.py" in line]


def all_idle(fleet: Fleet, seconds: float = PATIENCE_S) -> None:
    """Wait until no robot that is switched on executes a program of the project."""
    on = [name for name, robot in fleet.robots.items() if robot.process is not None]
    until(lambda: all(is_idle(fleet, name) for name in on), "all robots have stopped", seconds)


def all_stand(fleet: Fleet, since: float | None = None) -> None:
    """Wait until no robot that is switched on executes a program of the project or moves; print how long that took.

    `since` is the time of a fault by the monotonic clock.
    """
    on = [name for name, robot in fleet.robots.items() if robot.process is not None]
    until(lambda: all(is_idle(fleet, name) and not fleet.motors[name].speed for name in on), "all robots stand still")
    for motor, name in [(fleet.motors[name], name) for name in on if since is not None]:
        first, last = motor.stopped_after(since), motor.stood_after(since)
        print(f"{name}: told to stop {first:.2f} s after the fault, stood still after {last:.2f} s")


def all_move(fleet: Fleet, process: subprocess.Popen[str]) -> None:
    """Wait until all robots move."""

    def move() -> bool:
        assert process.poll() is None, process.communicate()
        return all(motor.speed for motor in fleet.motors.values())

    until(move, "all robots move")


def over_openssh(project: Path, options: str = "") -> None:
    """Let the runs of a project use the link `openssh`."""
    config = project / "sierra.toml"
    config.write_text(
        config.read_text()
        .replace("grace =", 'link = "openssh"\ngrace =')
        .replace("[links.fabric]", f"[links.openssh]\nlost = 4\n{options}")
    )


def all_busy(fleet: Fleet, process: subprocess.Popen[str]) -> None:
    """Wait until a driver's run executes on all robots."""

    def busy() -> bool:
        assert process.poll() is None, process.communicate()
        return all(list(robot.home.rglob("swarm.csv")) for robot in fleet.robots.values())

    until(busy, "all robots have begun")


def answered(project: Path, ticks: int = 30) -> None:
    """Ask again, and check that each run has one successful execution, with all ticks of all robots in its table."""
    process = drive(project)
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, output + errors
    is_recorded(project, ticks)


def is_recorded(project: Path, ticks: int) -> None:
    """Check that both runs of QUERY have one successful execution, with all ticks of all robots in its table."""
    rows = partial(rows_of, project)
    assert rows("SELECT count(*), count(DISTINCT run) FROM executions WHERE status = 'ok'") == [(2, 2)]
    swarm = "swarm JOIN executions USING (execution)"
    counts = rows(f"SELECT robot, count(*) FROM {swarm} WHERE status = 'ok' GROUP BY robot ORDER BY robot")
    assert counts == [(robot, 2 * ticks) for robot in (1, 2, 3)]
    assert set(rows("SELECT count(DISTINCT place) FROM robots GROUP BY execution")) == {(3,)}


def rows_of(project: Path, statement: str) -> list[tuple[object, ...]]:
    return [tuple(row.values()) for row in Project(project).sql(statement).to_pylist()]
