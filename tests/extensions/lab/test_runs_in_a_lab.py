"""Whole batches on hosts over SSH, by `sierra run --on lab` as processes; each fault costs time and never a result.

After each fault, each run is recorded once, and no run was executed more often than the fault makes necessary.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.worker.processes import descendants
from tests import projects
from tests.support import lab_project
from tests.support.lab_project import QUERY, drive, ended, executed, rows_of, sessions
from tests.support.robot_fleet import Fleet, Proxy
from tests.tiers import at_night
from tests.waiting import until

pytestmark = [pytest.mark.integration, pytest.mark.each_case]

GOOD = "SELECT count(*), count(DISTINCT run) FROM executions WHERE status = 'ok'"
SHORT = "lease = 10"
LARGE = '\nimport os\nopen("large.bin", "wb").write(os.urandom(4 << 20))\n'


def test_runs_are_dealt_to_all_hosts_and_recorded_like_local_ones(fleet: Fleet, tmp_path: Path) -> None:
    project = lab_project.make(fleet, tmp_path / "project", 0.1)
    code, errors = ended(drive(project, *QUERY, "10"))
    assert code == 0, errors
    assert rows_of(project, GOOD) == [(20, 20)]
    hosts = {host for (host,) in rows_of(project, "SELECT DISTINCT host FROM executions")}
    assert hosts == set(fleet.names)
    assert max(executed(fleet).values()) == 1
    here = lab_project.make(fleet, tmp_path / "here", 0.1)
    (here / "sim.py").write_text((here / "sim.py").read_text().replace(lab_project.EXECUTED, "/dev/null"))
    (project / "sim.py").write_text((here / "sim.py").read_text())
    assert projects.quick(here, "run", "speed=1,2", "--runs", "10", "--no-figures").returncode == 0
    results = "SELECT run, result FROM executions ORDER BY ALL"
    code, errors = ended(drive(project, *QUERY, "10"))
    assert code == 0, errors
    assert set(rows_of(here, results)) <= set(rows_of(project, results)), "ids and results are the same everywhere"
    assert not [folder for name in fleet.names for folder in sessions(fleet, name)], "the hosts forget what was fetched"


@pytest.mark.nightly
def test_an_unreachable_host_is_named_and_the_others_go_on(fleet: Fleet, tmp_path: Path) -> None:
    project = lab_project.make(fleet, tmp_path / "project")
    fleet.power_cut("rb2")
    code, errors = ended(drive(project, *QUERY, "5"))
    assert code == 0, errors
    assert len([line for line in errors.splitlines() if "rb2" in line]) == 1, errors
    assert rows_of(project, GOOD) == [(10, 10)]


def test_without_any_host_nothing_is_submitted(fleet: Fleet, tmp_path: Path) -> None:
    project = lab_project.make(fleet, tmp_path / "project")
    for name in fleet.names:
        fleet.refuse_logins(name)
    fleet.new_host_key("rb1")
    fleet.forget_host_key("rb3")
    code, errors = ended(drive(project, *QUERY, "5"))
    assert code == 3, errors
    [line] = [line for line in errors.splitlines() if line.startswith("sierra: ")]
    assert "no host of the lab can be used" in line
    assert not [folder for name in fleet.names for folder in sessions(fleet, name)]


def test_a_link_that_is_cut_for_seconds_costs_nothing(fleet: Fleet, tmp_path: Path) -> None:
    project = lab_project.make(fleet, tmp_path / "project", 1.0)
    process = drive(project, *QUERY, "15")
    until(lambda: len(executed(fleet)) > 5, "runs have begun")
    fleet.radio("rb2", up=False)
    time.sleep(12)
    fleet.radio("rb2", up=True)
    code, errors = ended(process)
    assert code == 0, errors
    assert "rb2" in errors
    assert rows_of(project, GOOD) == [(30, 30)]
    assert max(executed(fleet).values()) == 1, "nothing is executed twice"


@pytest.mark.nightly
def test_the_runs_of_a_host_that_is_cut_off_for_ever_go_to_others(fleet: Fleet, tmp_path: Path) -> None:
    project = lab_project.make(fleet, tmp_path / "project", 1.0, SHORT)
    process = drive(project, *QUERY, "15")
    until(lambda: len(executed(fleet, "rb2")) > 2, "runs have begun on rb2")
    fleet.radio("rb2", up=False)
    code, errors = ended(process)
    assert code == 0, errors
    assert rows_of(project, GOOD) == [(30, 30)]
    assert not fleet.commands("rb2") or not [line for line in fleet.commands("rb2") if "sim.py" in line]


@pytest.mark.nightly
def test_after_a_restart_of_a_host_its_runs_are_executed_again(fleet: Fleet, tmp_path: Path) -> None:
    project = lab_project.make(fleet, tmp_path / "project", 1.0, SHORT)
    process = drive(project, *QUERY, "15")
    until(lambda: len(executed(fleet, "rb2")) > 2, "runs have begun on rb2")
    fleet.reboot("rb2")
    code, errors = ended(process)
    assert code == 0, errors
    assert rows_of(project, GOOD) == [(30, 30)]


@pytest.mark.parametrize("program", ["keeper", *at_night(["front", "array_task"])])
def test_a_program_of_the_host_that_is_killed_is_started_again(fleet: Fleet, tmp_path: Path, program: str) -> None:
    project = lab_project.make(fleet, tmp_path / "project", 1.0)
    process = drive(project, *QUERY, "10")
    until(lambda: len(executed(fleet, "rb2")) > 1, "runs have begun on rb2")
    fleet.enter("rb2", "pkill", "-KILL", "-f", program)
    code, errors = ended(process)
    assert code == 0, errors
    assert rows_of(project, GOOD) == [(20, 20)]
    if program != "array_task":
        assert max(executed(fleet).values()) == 1


def test_what_hosts_have_when_their_driver_is_killed_is_recorded_by_the_next_one(fleet: Fleet, tmp_path: Path) -> None:
    project = lab_project.make(fleet, tmp_path / "project", 1.0)
    process = drive(project, *QUERY, "10")
    until(lambda: len(executed(fleet)) >= 6, "runs have begun")
    process.send_signal(signal.SIGKILL)
    process.communicate()
    code, errors = ended(drive(project, *QUERY, "10"))
    assert code == 0, errors
    assert rows_of(project, GOOD) == [(20, 20)]
    assert max(executed(fleet).values()) == 1


@pytest.mark.nightly
def test_a_detached_batch_is_executed_without_this_machine(fleet: Fleet, tmp_path: Path) -> None:
    project = lab_project.make(fleet, tmp_path / "project", 0.3, SHORT)
    code, errors = ended(drive(project, *QUERY, "10", "--detach"))
    assert code == 0, errors
    until(lambda: len(executed(fleet)) == 20, "all runs have begun")
    code, errors = ended(drive(project, "attach"))
    assert code == 0, errors
    assert rows_of(project, GOOD) == [(20, 20)]


def test_a_cancelled_batch_ends_on_all_hosts(fleet: Fleet, tmp_path: Path) -> None:
    project = lab_project.make(fleet, tmp_path / "project", 30)
    process = drive(project, *QUERY, "10")
    until(lambda: len(executed(fleet)) >= 6, "runs have begun")
    assert projects.quick(project, "cancel").returncode == 0
    code, errors = ended(process)
    assert code == 130, errors
    until(lambda: not [line for name in fleet.names for line in fleet.commands(name) if "sim.py" in line], "no run is alive")


@pytest.mark.nightly
def test_a_host_with_a_full_disk_is_put_aside(fleet: Fleet, tmp_path: Path) -> None:
    project = lab_project.make(fleet, tmp_path / "project", 0.5)
    process = drive(project, *QUERY, "15")
    until(lambda: len(executed(fleet, "rb2")) > 2, "runs have begun on rb2")
    fleet.fill_disk("rb2")
    code, errors = ended(process)
    assert code == 0, errors
    assert "rb2" in errors
    assert rows_of(project, GOOD) == [(30, 30)]


@pytest.mark.nightly
def test_a_full_disk_of_this_machine_loses_no_result(fleet: Fleet, tmp_path: Path, disk: Callable[[Path, str], Path]) -> None:
    project = lab_project.make(fleet, disk(tmp_path / "project", "50m"), 0.5)
    (project / "sim.py").write_text(lab_project.SIMULATOR.replace("SECONDS", "0.5") + LARGE)
    code, errors = ended(drive(project, *QUERY, "15"))
    assert code == 3, errors
    assert "space" in errors
    disk(project, "500m")
    code, errors = ended(drive(project, *QUERY, "15"))
    assert code == 0, errors
    assert rows_of(project, GOOD) == [(30, 30)]
    assert max(executed(fleet).values()) == 1


@pytest.mark.nightly
@pytest.mark.parametrize("lease", [600, 10])
def test_a_driver_that_was_asleep_goes_on(fleet: Fleet, tmp_path: Path, lease: int) -> None:
    project = lab_project.make(fleet, tmp_path / "project", 1.0, f"lease = {lease}")
    process = drive(project, *QUERY, "15")
    until(lambda: len(executed(fleet)) >= 6, "runs have begun")
    asleep = [process.pid, *descendants(process.pid)]
    for pid in asleep:
        os.kill(pid, signal.SIGSTOP)
    time.sleep(20)
    for pid in asleep:
        os.kill(pid, signal.SIGCONT)
    code, errors = ended(process)
    assert code == 0, errors
    assert rows_of(project, GOOD) == [(30, 30)]
    if lease > 20:
        assert max(executed(fleet).values()) == 1


@pytest.mark.nightly
def test_the_clock_of_a_host_orders_nothing(fleet: Fleet, tmp_path: Path) -> None:
    fleet.set_clock("rb2", 2 * 86400)
    project = lab_project.make(fleet, tmp_path / "project")
    code, errors = ended(drive(project, *QUERY, "10"))
    assert code == 0, errors
    offsets = dict(rows_of(project, "SELECT node, max(clock_offset_s) FROM attempts GROUP BY node"))
    assert abs(offsets["rb2"] - 2 * 86400) < 60
    assert abs(offsets["rb1"]) < 5
    latest = "SELECT max(ended) < now() + INTERVAL 1 HOUR, max(epoch(ended) - epoch(started)) < 60 FROM executions"
    assert rows_of(project, latest) == [(True, True)]


@pytest.mark.nightly
def test_two_drivers_share_the_slots_of_hosts(fleet: Fleet, tmp_path: Path) -> None:
    here = [lab_project.make(fleet, tmp_path / name, 0.5) for name in ("one", "other")]
    drivers = [drive(project, *QUERY, "10") for project in here]
    most = 0
    while any(driver.poll() is None for driver in drivers):
        most = max([most, *(sum("sim.py" in line for line in fleet.commands(name)) for name in fleet.names)])
        time.sleep(0.1)
    for driver, project in zip(drivers, here, strict=True):
        code, errors = ended(driver)
        assert code == 0, errors
        assert rows_of(project, GOOD) == [(20, 20)]
    assert 0 < most <= 2


@pytest.mark.nightly
def test_a_run_that_holds_two_cores_has_two_slots_of_its_host_also_beside_another_driver(fleet: Fleet, tmp_path: Path) -> None:
    wide, narrow = (lab_project.make(fleet, tmp_path / name, 0.5) for name in ("wide", "narrow"))
    config = wide / "sierra.toml"
    config.write_text(config.read_text().replace('"{input}"]', '"{input}", "wide"]') + "[limits]\ncores = 2\n")
    drivers = [drive(project, *QUERY, "5") for project in (wide, narrow)]
    most = 0
    while any(driver.poll() is None for driver in drivers):
        for name in fleet.names:
            running = [line for line in fleet.commands(name) if "sim.py" in line]
            most = max(most, len(running) + sum("wide" in line for line in running))
        time.sleep(0.1)
    for driver, project in zip(drivers, (wide, narrow), strict=True):
        code, errors = ended(driver)
        assert code == 0, errors
        assert rows_of(project, GOOD) == [(10, 10)]
    assert most == 2


@pytest.mark.nightly
def test_hosts_join_and_leave_while_a_batch_executes(fleet: Fleet, tmp_path: Path) -> None:
    hosts = tmp_path / "hosts"
    hosts.write_text("# the lab\n2/rb1\n2/rb2  # window\n")
    project = lab_project.make(fleet, tmp_path / "project", 1.0, hosts=f'hosts_file = "{hosts}"')
    process = drive(project, *QUERY, "20")
    until(lambda: len(executed(fleet, "rb1")) > 1, "runs have begun on rb1")
    hosts.write_text("2/rb2\n2/rb3\n")
    until(lambda: len(executed(fleet, "rb3")) > 0, "runs have begun on rb3")
    code, errors = ended(process)
    assert code == 0, errors
    assert rows_of(project, GOOD) == [(40, 40)]
    assert max(executed(fleet).values()) == 1
    assert "rb1" in errors
    assert len(executed(fleet, "rb1")) < len(executed(fleet, "rb2"))


@pytest.mark.nightly
def test_a_long_way_to_the_hosts_only_takes_time(fleet: Fleet, tmp_path: Path) -> None:
    with contextlib.ExitStack() as opened:
        ways = [opened.enter_context(Proxy(fleet.robots[name].address, delay=0.05)) for name in fleet.names]
        hosts = [fleet.through(name, way.port) for name, way in zip(fleet.names, ways, strict=True)]
        project = lab_project.make(fleet, tmp_path / "project", hosts=f"hosts = {json.dumps([f'2/{host}' for host in hosts])}")
        code, errors = ended(drive(project, *QUERY, "10"))
    assert code == 0, errors
    assert rows_of(project, GOOD) == [(20, 20)]
    assert max(executed(fleet).values()) == 1
