"""Faults around whole runs on robots, by `sierra run --on robots` as a process.

After each fault, every robot has stopped, everything is recorded once, and the same query executes what is missing.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import projects
from tests.support import robot_project
from tests.support.robot_fleet import Fleet, Proxy
from tests.support.robot_project import LEASE_S, RUN, all_busy, all_idle, answered, drive, rows_of
from tests.tiers import at_night
from tests.waiting import until

BIG = """
import os, sys
for _ in range(200 if os.environ["SIERRA_ROBOT"] == "2" else 0):
    sys.stdout.write(("y" * 1023 + "\\n") * 1024)
open("swarm.csv", "w").write("t,x\\n0,0\\n")
"""


@pytest.fixture
def project(fleet: Fleet, tmp_path: Path) -> Iterator[Path]:
    yield robot_project.make(fleet, tmp_path / "project", 5)
    all_idle(fleet)


def stopped_at(project: Path, step: str) -> subprocess.Popen[str]:
    """Start a driver, and return it when it has stopped at a step. It must go on within the time of the lease."""
    process = drive(project, step=("SIGSTOP", step))
    _, status = os.waitpid(process.pid, os.WUNTRACED)
    assert os.WIFSTOPPED(status), process.communicate()
    return process


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Let a driver go on, and return its exit code and its standard error when it has ended."""
    process.send_signal(signal.SIGCONT)
    _, errors = process.communicate(timeout=120)
    assert "fault in" not in errors
    return process.returncode, errors


def test_outputs_are_pulled_from_disks_that_take_nothing_more(project: Path, fleet: Fleet) -> None:
    process = stopped_at(project, "pull 1")
    fleet.fill_disk("rb2")
    fleet.read_only("rb3")
    code, errors = ended(process)
    assert code == 3
    [line] = [line for line in errors.splitlines() if line.startswith("sierra: ")]
    assert line.startswith(("sierra: rb2: its disk has ", "sierra: rb3: /home/robot/"))
    assert rows_of(project, "SELECT status FROM executions") == [("ok",)]
    assert rows_of(project, "SELECT count(*), count(DISTINCT robot) FROM swarm") == [(15, 3)]
    fleet.heal()
    answered(project, ticks=5)


@pytest.mark.parametrize(("step", "free"), [("journal 3", 20_000), *at_night([("pull 1", 0), ("journal 1", 20_000)])])
def test_a_full_disk_of_this_machine_loses_no_record(
    project: Path, fleet: Fleet, disk: Callable[[Path, str], Path], step: str, free: int
) -> None:
    store = disk(project / ".sierra", "64m")
    process = stopped_at(project, step)
    with (store / "full").open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, shutil.disk_usage(store).free - free)
    code, errors = ended(process)
    assert code == 3
    [line] = [line for line in errors.splitlines() if line.startswith("sierra: ")]
    assert line.startswith(f"sierra: cannot write to {store}/work/")
    assert line.endswith(": No space left on device")
    all_idle(fleet)
    os.truncate(store / "full", (store / "full").stat().st_size - 500_000)
    refused = projects.quick(project, *RUN)
    assert refused.returncode == 3
    assert refused.stderr.splitlines()[-1].startswith(f"sierra: this machine: the disk of {store}/work/")
    (store / "full").unlink()
    answered(project, ticks=5)
    assert projects.quick(project, "fsck").returncode == 0


@pytest.mark.nightly
def test_a_locked_store_and_two_sessions_of_sshd_are_enough(project: Path, fleet: Fleet) -> None:
    for name in fleet.names:
        fleet.configure(name, "MaxSessions 2")
    process = stopped_at(project, "journal 1")
    with (project / ".sierra/work/lock").open() as work, (project / ".sierra/format").open() as readers:
        for lock in (work, readers):
            fcntl.flock(lock, fcntl.LOCK_EX)
        process.send_signal(signal.SIGCONT)
        time.sleep(LEASE_S + 1)
        assert process.poll() is None
    assert ended(process)[0] == 0
    robot_project.is_recorded(project, ticks=5)
    assert rows_of(project, "SELECT count(*) FROM executions") == [(2,)]


@pytest.mark.nightly
def test_200_mb_on_standard_output_are_kept_in_part(project: Path, fleet: Fleet) -> None:
    robot = fleet.robots["rb2"]
    robot.changed = True
    subprocess.run(["mount", "-o", "remount,size=300m", robot.folder / "home"], check=True)
    (project / "swarm.py").write_text(BIG)
    process, peak, began = drive(project, (*RUN, "--runs", "1")), 0, time.monotonic()
    while process.poll() is None:
        peak = max(peak, peak_of(process))
        time.sleep(0.1)
    assert ended(process)[0] == 0
    assert time.monotonic() - began < 60
    assert peak < 400 << 20
    assert rows_of(project, "SELECT status, log_tail FROM executions") == [("ok", None)]


def peak_of(process: subprocess.Popen[str]) -> int:
    """Return the most memory that a process has had, in bytes."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM:")), 0)


@pytest.mark.nightly
def test_a_slow_link_that_stalls_is_used_and_one_that_is_cut_stops_all(fleet: Fleet, tmp_path: Path) -> None:
    with Proxy(fleet.robots["rb2"].address, delay=0.1) as proxy:
        project = robot_project.make(fleet, tmp_path / "project", 30, {"rb2": fleet.through("rb2", proxy.port)})
        config = project / "sierra.toml"
        config.write_text(config.read_text().replace("grace =", "clock_error = 1.0\ngrace ="))
        process = drive(project)
        all_busy(fleet, process)
        proxy.stall()
        time.sleep(LEASE_S / 2)
        proxy.stall(stalled=False)
        until(lambda: rows_of(project, "SELECT status FROM executions"), "the first run is recorded", 60)
        all_busy(fleet, process)
        proxy.cut()
        all_idle(fleet)
        code, _ = ended(process)
        assert code == 1
        found = rows_of(project, "SELECT status, reason LIKE 'rb2 was lost: %' FROM executions ORDER BY started")
        assert found == [("ok", None), ("failed", True)]
        answered(project)
