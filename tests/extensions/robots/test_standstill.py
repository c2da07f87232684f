"""Robots stand still, however a run ends: motors that obey their last command for ever, and controllers that leave them on."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from sierra.extensions.robots.agent import records
from tests import projects
from tests.support import robot_project
from tests.support.robot_fleet import Fleet
from tests.support.robot_project import BROKEN, QUERY, RUN, all_move, all_stand, drive, over_openssh, rows_of
from tests.tiers import at_night

pytestmark = pytest.mark.integration

Process = subprocess.Popen[str]
ONE = (*RUN, "--runs", "1")
FOR_EVER = 6000
"""Ticks of a program that does not end by itself."""
LONGEST_S = 120.0
"""Limit on the seconds that a driver takes to end."""
AGENT = f"^python3 .*worker.pyz {records.AGENT}"
SETTLED_S = 1.0
"""Seconds in which no robot moves again."""
DEAF = "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
FORKS = """
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        while True:
            drive()
            time.sleep(0.05)
"""
CRASHES = 'if place == 2:\n    drive()\n    time.sleep(1)\n    sys.exit("no more battery")\n'
WRITES = "with open('much.bin', 'wb') as file:\n    while True:\n        drive()\n        file.write(bytes(1 << 20))\n"


@dataclass(frozen=True)
class Case:
    """A way in which a run ends, with the exit code of the driver."""

    code: int
    happen: Callable[[Fleet, Process], object] = lambda fleet, process: None
    program: str = ""
    """Code of the controller, before it drives."""
    ticks: int = FOR_EVER
    query: tuple[str, ...] = ONE
    options: str = ""
    """A line of [runners.robots]."""
    tables: str = ""
    said: str = ""
    mend: Callable[[Fleet], object] = lambda fleet: None


def on_all(fleet: Fleet, *argv: str) -> None:
    for name in fleet.names:
        fleet.enter(name, *argv)


def kill(command: str) -> tuple[str, ...]:
    """Return a command that kills the oldest process whose command line matches."""
    return ("pkill", "-KILL", "-o", "-f", command)


def wait_for_the_lease(fleet: Fleet, process: Process) -> None:
    """Stop the driver, until all robots have stopped by themselves."""
    process.send_signal(signal.SIGSTOP)
    began = time.monotonic()
    all_stand(fleet, began)
    process.send_signal(signal.SIGCONT)


def lose_the_agent_out_of_reach(fleet: Fleet, _: Process) -> None:
    fleet.radio("rb2", up=False)
    fleet.enter("rb2", *kill(AGENT))
    all_stand(fleet, time.monotonic())
    fleet.radio("rb2", up=True)


def use_up_inodes(fleet: Fleet, process: Process) -> None:
    home = fleet.robots["rb2"].folder / "home"
    fleet.robots["rb2"].changed = True
    used = os.statvfs(home).f_files - os.statvfs(home).f_ffree
    subprocess.run(["mount", "-o", f"remount,nr_inodes={used}", home], check=True)
    process.send_signal(signal.SIGINT)


def lose_a_robot_and_interrupt(fleet: Fleet, process: Process) -> None:
    fleet.radio("rb2", up=False)
    process.send_signal(signal.SIGINT)


def fill_the_disk(fleet: Fleet, process: Process) -> None:
    fleet.robots["rb2"].changed = True
    fleet.enter("rb2", "sh", "-c", "cat /dev/zero > /home/more; true")
    process.send_signal(signal.SIGINT)


def break_and_interrupt(fleet: Fleet, process: Process) -> None:
    on_all(fleet, "touch", BROKEN)
    process.send_signal(signal.SIGINT)


def heal_stops(fleet: Fleet) -> None:
    on_all(fleet, "rm", BROKEN)


SLOW_TO_END = "slow to end, Ctrl-C"
CASES = {
    SLOW_TO_END: Case(130, lambda _, process: process.send_signal(signal.SIGINT)),
    "lease": Case(1, wait_for_the_lease),
    "stop fails": Case(
        1,
        lambda fleet, _: on_all(fleet, "touch", BROKEN),
        ticks=30,
        query=QUERY,
        said="sierra: rb1 may be moving: the stop command ended with status 1; rb2 may be moving: ",
        mend=heal_stops,
    ),
    "stop fails, Ctrl-C": Case(1, break_and_interrupt, said="sierra: rb1 may be moving: ", mend=heal_stops),
    "wall": Case(1, program=DEAF, tables="[limits]\nwall = 3.0\n"),
    "hang-up": Case(130, lambda _, process: process.send_signal(signal.SIGHUP)),
    "driver killed": Case(-9, lambda _, process: process.kill()),
    "radio down": Case(
        1,
        lambda fleet, _: fleet.radio("rb2", up=False),
        mend=lambda fleet: fleet.radio("rb2", up=True),
    ),
    "agent killed": Case(1, lambda fleet, _: fleet.enter("rb2", *kill(AGENT))),
    "agent killed out of reach": Case(1, lose_the_agent_out_of_reach),
    "worker killed": Case(1, lambda fleet, _: fleet.enter("rb2", *kill(".*robot_agent worker"))),
    "restart": Case(1, lambda fleet, _: fleet.reboot("rb2")),
    "program crashes": Case(1, program=CRASHES),
    "program ends": Case(0, ticks=20),
    "orphans": Case(0, program=FORKS, ticks=20),
    "orphans, Ctrl-C": Case(130, lambda _, process: process.send_signal(signal.SIGINT), program=FORKS),
    "deaf, Ctrl-C": Case(130, lambda _, process: process.send_signal(signal.SIGINT), program=DEAF, options="grace = 1.0"),
    "memory": Case(1, program="much = bytearray(200 << 20)\n", tables='[limits]\nmemory = "100 MB"\n'),
    "no inode": Case(130, use_up_inodes, mend=Fleet.heal),
    "no space": Case(130, fill_the_disk, mend=Fleet.heal),
    "disk filled by the program": Case(1, program=WRITES, said="its disk is full|No space left", mend=Fleet.heal),
    "two at once": Case(130, lose_a_robot_and_interrupt, mend=lambda fleet: fleet.radio("rb2", up=True), options="lease = 1.0"),
}
IN_CI = (SLOW_TO_END, "lease", "stop fails", "wall")


@pytest.mark.each_case
@pytest.mark.parametrize("link", ["fabric", pytest.param("openssh", marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", [*IN_CI, *at_night([name for name in CASES if name not in IN_CI])])
def test_robots_stand_still_however_a_run_ends(fleet: Fleet, tmp_path: Path, name: str, link: str) -> None:
    case, project = CASES[name], robot_project.make(fleet, tmp_path / "project")
    adapt(project, case, link)
    process = drive(project, case.query)
    all_move(fleet, process)
    since = time.monotonic()
    case.happen(fleet, process)
    _, errors = process.communicate(timeout=LONGEST_S)
    assert process.returncode == case.code, errors
    assert any(part in errors for part in case.said.split("|")), errors
    if case.mend is heal_stops:
        assert all(motor.speed for motor in fleet.motors.values())
        recorded = [] if "Ctrl-C" in name else [("failed",)]
        assert rows_of(project, "SELECT status FROM executions") == recorded, "no further run starts"
        assert errors.splitlines()[-1].startswith(case.said)
        refused = projects.quick(project, *ONE)
        assert (refused.returncode, "may be moving: the stop command ended with status 1" in refused.stderr) == (3, True)
    else:
        all_stand(fleet, since)
        time.sleep(SETTLED_S)
        all_stand(fleet, since)
    case.mend(fleet)
    robot_project.move(project, 3)
    done = projects.quick(project, *ONE)
    assert done.returncode == 0, done.stderr
    all_stand(fleet, since)


def adapt(project: Path, case: Case, link: str) -> None:
    """Give a project what a case declares."""
    config = project / "sierra.toml"
    text = config.read_text()
    if "=" in case.options:
        key = case.options.partition("=")[0]
        text = "".join(line for line in text.splitlines(keepends=True) if not line.startswith(key))
        text = text.replace("disk_min =", f"{case.options}\ndisk_min =")
    config.write_text(text + case.tables)
    if link == "openssh":
        over_openssh(project)
    robot_project.move(project, case.ticks)
    adapt_program(project, case.program)


def adapt_program(project: Path, program: str) -> None:
    path = project / "swarm.py"
    mark = 'with open("swarm.csv"'
    path.write_text(path.read_text().replace(mark, f"{program}{mark}"))
