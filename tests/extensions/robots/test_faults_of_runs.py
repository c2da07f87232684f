"""Faults around whole runs on robots, by `sierra run --on robots` as a process.

After each fault, every robot stands still, everything is recorded once, and the same query executes what is missing.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests import projects
from tests.support import robot_project
from tests.support.robot_fleet import Fleet, Proxy
from tests.support.robot_project import LEASE_S, RUN, all_busy, all_stand, answered, drive, rows_of
from tests.tiers import at_night
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.integration

BIG = """
import os, sys
for _ in range(200 if os.environ["SIERRA_ROBOT"] == "2" else 0):
    sys.stdout.write(("y" * 1023 + "\\n") * 1024)
open("swarm.csv", "w").write("t,x\\n0,0\\n")
"""


@dataclass(frozen=True)
class Fault:
    """A fault of the robot rb2, and what a driver says and records then."""

    step: str
    """The step of the driver at which it happens; empty: when all robots execute the first run."""
    happen: Callable[[Fleet], object]
    code: int
    said: str
    statement: str
    rows: list[tuple[Any, ...]]
    """The answer to the statement, which tells of the first run."""
    mend: Callable[[Fleet], object] = Fleet.heal
    options: str = ""
    """More options of the runner."""
    first: Callable[[Fleet], object] = bool
    """The state before the driver starts."""


def unusable(happen: Callable[[Fleet], object], said: str, step: str = "run 1") -> Fault:
    """Return a fault with which no run starts."""
    return Fault(step, happen, 3, f"sierra: rb2: {said}", "SELECT count(*) FROM executions", [(0,)])


def lost(happen: Callable[[Fleet], object], mend: Callable[[Fleet], object], code: int = 3) -> Fault:
    """Return a fault by which the robot is lost in the middle of a run, which ends on the others."""
    first = "(SELECT execution FROM executions ORDER BY started LIMIT 1)"
    return Fault(
        "",
        happen,
        code,
        "",
        f"SELECT e.status, e.reason LIKE 'rb2 was lost: %', place, r.status FROM executions e JOIN robots r USING (execution) "
        f"WHERE execution = {first} ORDER BY place",
        [("failed", True, 1, "stopped"), ("failed", True, 2, "lost"), ("failed", True, 3, "stopped")],
        mend,
    )


def survived(happen: Callable[[Fleet], object], said: str, statement: str, rows: list[tuple[Any, ...]], **more: Any) -> Fault:
    """Return a fault with which both runs succeed."""
    return Fault(more.pop("step", ""), happen, 0, said, statement, rows, **more)


def silence(fleet: Fleet) -> None:
    fleet.radio("rb2", up=False)
    time.sleep(3)
    fleet.radio("rb2", up=True)


FAULTS = {
    "changed host key": unusable(lambda fleet: fleet.new_host_key("rb2"), "its host key differs"),
    "refused login": unusable(lambda fleet: fleet.refuse_logins("rb2"), "it refuses the login"),
    "unknown host key": unusable(lambda fleet: fleet.forget_host_key("rb2"), "the host key of .* is not known"),
    "one session": unusable(lambda fleet: fleet.configure("rb2", "MaxSessions 1"), ".* a run needs two sessions at once"),
    "power cut before arming": unusable(lambda fleet: fleet.power_cut("rb2"), "", "arm 1"),
    "power cut before the start": unusable(lambda fleet: fleet.power_cut("rb2"), "", "at 1"),
    "power cut": lost(lambda fleet: fleet.power_cut("rb2"), lambda fleet: fleet.boot("rb2")),
    "restart": lost(lambda fleet: fleet.reboot("rb2"), bool, code=1),
    "radio down": lost(lambda fleet: fleet.radio("rb2", up=False), lambda fleet: fleet.radio("rb2", up=True)),
    "radio down for 3 s": survived(
        silence,
        "rb2 does not answer; its run goes on for 5 s at most, its lease",
        "SELECT DISTINCT status FROM robots",
        [("ok",)],
        options="lease = 5",
    ),
    "clock 137 s ahead": survived(
        lambda fleet: fleet.set_clock("rb2", 137),
        "",
        "SELECT place, count(*) FROM robots WHERE abs(offset_start_ns) > 100e9 GROUP BY place",
        [(2, 2)],
        step="run 1",
    ),
    "clock that steps": survived(
        lambda fleet: fleet.set_clock("rb2", -20),
        "rb2: its wall clock has moved by -25",
        "SELECT place, c.drift FROM robots JOIN robot_clocks c USING (execution, place) WHERE clock_remark IS NOT NULL",
        [(2, None)],
        first=lambda fleet: fleet.set_clock("rb2", 5),
    ),
    "1 Mbit/s": survived(
        lambda fleet: fleet.slow("rb2"),
        "",
        "SELECT count(*) FROM executions",
        [(2,)],
        step="run 1",
        options="lease = 5\nclock_error = 1",
    ),
}
FAST = ("refused login",)


@pytest.fixture
def project(fleet: Fleet, tmp_path: Path) -> Iterator[Path]:
    yield robot_project.make(fleet, tmp_path / "project", 5)
    all_stand(fleet)


def stopped_at(project: Path, step: str) -> subprocess.Popen[str]:
    """Start a driver, and return it when it has stopped at a step. It must go on within the time of the lease."""
    process = drive(project, step=("SIGSTOP", step))
    _, status = os.waitpid(process.pid, os.WUNTRACED)
    assert os.WIFSTOPPED(status), process.communicate()
    return process


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Let a driver go on, and return its exit code and its standard error when it has ended."""
    process.send_signal(signal.SIGCONT)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert "fault in" not in errors
    return process.returncode, errors


@pytest.mark.each_case
@pytest.mark.parametrize("name", [pytest.param(name, marks=[] if name in FAST else pytest.mark.nightly) for name in FAULTS])
def test_after_a_fault_all_stop_and_the_same_query_does_what_is_missing(fleet: Fleet, tmp_path: Path, name: str) -> None:
    fault, ticks = FAULTS[name], 5 if FAULTS[name].step else 50
    project = robot_project.make(fleet, tmp_path / "project", ticks)
    config = project / "sierra.toml"
    replaced = "lease = 3.0\n" if "lease" in fault.options else ""
    config.write_text(config.read_text().replace(replaced, "").replace("grace =", f"{fault.options}\ngrace ="))
    fault.first(fleet)
    if fault.step:
        process = stopped_at(project, fault.step)
    else:
        all_busy(fleet, process := drive(project))
    since = time.monotonic()
    fault.happen(fleet)
    code, errors = ended(process)
    assert (code, bool(re.search(fault.said, errors))) == (fault.code, True), errors
    all_stand(fleet, since)
    assert rows_of(project, fault.statement) == fault.rows
    fault.mend(fleet)
    answered(project, ticks)
    all_stand(fleet, since)
    assert projects.quick(project, "fsck").returncode == 0


@pytest.mark.nightly
def test_programs_that_ignore_sigterm_are_ended_with_their_driver(project: Path, fleet: Fleet) -> None:
    deaf = "import signal\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
    robot_project.move(project, 50)
    (project / "swarm.py").write_text(deaf + (project / "swarm.py").read_text())
    all_busy(fleet, process := drive(project))
    process.send_signal(signal.SIGINT)
    code, errors = ended(process)
    assert code == 130, errors
    all_stand(fleet)
    assert rows_of(project, "SELECT count(*) FROM executions") == [(0,)], "of a run that the user ends, nothing is recorded"
    answered(project, ticks=50)
    assert projects.quick(project, "fsck").returncode == 0


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
    all_stand(fleet)
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
        all_stand(fleet)
        code, _ = ended(process)
        assert code == 1
        found = rows_of(project, "SELECT status, reason LIKE 'rb2 was lost: %' FROM executions ORDER BY started")
        assert found == [("ok", None), ("failed", True)]
        answered(project)


@pytest.mark.nightly
def test_a_power_cut_while_outputs_are_pulled_fails_the_run(project: Path, fleet: Fleet) -> None:
    own = "import os\nif os.environ['SIERRA_ROBOT'] == '2':\n    open('much.bin', 'wb').write(os.urandom(8 << 20))\n"
    (project / "swarm.py").write_text((project / "swarm.py").read_text() + own)
    received = Path("/sys/class/net", fleet.robots["rb2"].card, "statistics/rx_bytes")
    process = stopped_at(project, "pull 1")
    fleet.slow("rb2", "2mbit")
    before = int(received.read_text())
    process.send_signal(signal.SIGCONT)
    until(lambda: int(received.read_text()) > before + (1 << 20), "the transfer has begun", 60)
    fleet.power_cut("rb2")
    code, errors = ended(process)
    assert code == 3, errors
    [(status, reason)] = rows_of(project, "SELECT status, reason FROM executions")
    assert (status, str(reason).partition(": ")[0]) == ("failed", "rb2 has kept its outputs")
    problems = "SELECT place, reason IS NULL, clock_remark FROM robots ORDER BY place"
    assert rows_of(project, problems) == [(1, True, None), (2, False, None), (3, True, None)]
    all_stand(fleet)
    fleet.boot("rb2")
    answered(project, ticks=5)
    assert projects.quick(project, "fsck").returncode == 0


@pytest.mark.nightly
def test_what_a_lost_robot_has_measured_is_collected_when_it_is_used_again(fleet: Fleet, tmp_path: Path) -> None:
    project = robot_project.make(fleet, tmp_path / "project", ticks=600)
    process = drive(project, (*RUN, "--runs", "1"))
    all_busy(fleet, process)
    measured = fleet.robots["rb2"].home
    until(lambda: [path for path in measured.rglob("swarm.csv") if path.read_text().count("\n") > 3], "it has measured", 60)
    fleet.power_cut("rb2")
    code, errors = ended(process)
    assert code == 1, errors
    [(execution, reason)] = rows_of(project, "SELECT execution, reason FROM executions")
    assert str(reason).startswith("rb2 was lost: ")
    [kept] = measured.rglob("swarm.csv")
    text = kept.read_text()
    robot_project.move(project, 3)
    missing = projects.quick(project, *RUN, "--runs", "1")
    assert missing.returncode == 3
    fleet.boot("rb2")
    done = projects.quick(project, *RUN, "--runs", "1")
    assert done.returncode == 0, done.stderr
    lost = f"collected what it had measured in a run of which it was lost; sierra show {execution[:10]} --files"
    assert f"note: rb2: {lost}" in done.stderr
    late = f"SELECT path, kind FROM artifacts WHERE execution = '{execution}' AND path LIKE 'late/2/output/%'"
    assert rows_of(project, late) == [("late/2/output/swarm.csv", "log")]
    assert projects.quick(project, "files", str(execution), "late/2/output/swarm.csv").stdout == text
    assert rows_of(project, "SELECT status, count(*) FROM executions GROUP BY ALL ORDER BY ALL") == [("failed", 1), ("ok", 1)]
    assert projects.quick(project, "fsck").returncode == 0
    assert not list(measured.rglob("swarm.csv"))
    all_stand(fleet)
    [(batch,)] = rows_of(project, f"SELECT batch FROM executions WHERE execution = '{execution}'")
    assert projects.quick(project, "rm", str(batch), "--yes").returncode == 0
    assert projects.quick(project, "fsck").returncode == 0
    assert rows_of(project, "SELECT count(*) FROM artifacts WHERE path LIKE 'late/%'") == [(0,)]
