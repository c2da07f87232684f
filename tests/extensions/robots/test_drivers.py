"""Drivers of robots that are killed, stopped, or two at once: `sierra run --on robots` as a process."""

from __future__ import annotations

import os
import shutil
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
from tests.support import robot_project
from tests.support.killed_driver import NAMES
from tests.support.robot_fleet import GUEST, Fleet
from tests.support.robot_project import all_busy, all_idle, all_stand, answered, drive, over_openssh
from tests.terminals import Terminal
from tests.tiers import at_night
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.integration

STEPS = {f"SIGKILL {name} {number}" for name in NAMES for number in (1, 3)}
STEPS |= {f"SIGINT {name} 3" for name in NAMES} | {
    f"SIGKILL {step}" for step in ("arm 2", "clock 100", "journal 2", "pull 2", "done 4")
}
"""The steps at which drivers are killed or interrupted at night; a batch of two runs on three robots reaches each of them."""


@pytest.fixture
def project(fleet: Fleet, tmp_path: Path) -> Iterator[Path]:
    yield robot_project.make(fleet, tmp_path)
    all_stand(fleet)


def test_robots_stop_when_their_driver_is_killed(project: Path, fleet: Fleet):
    with drive(project) as process:
        all_busy(fleet, process)
        process.kill()
    all_stand(fleet)
    answered(project)


@pytest.mark.parametrize("step", ["SIGKILL at 2", "SIGINT arm 2", *at_night(STEPS)])
def test_a_driver_that_ends_at_a_step_leaves_nothing_that_moves(project: Path, fleet: Fleet, step: str):
    number, _, step = step.partition(" ")
    robot_project.move(project, 5)
    process = drive(project, step=(number, step))
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode in ({-signal.SIGKILL} if number == "SIGKILL" else {130, 0}), errors
    assert "fault" not in errors
    all_stand(fleet)
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
        output, errors = process.communicate(timeout=PATIENCE_S)
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
        _, errors = second.communicate(timeout=PATIENCE_S)
        assert second.returncode == 3
        [line] = [line for line in errors.splitlines() if "in use by" in line]
        assert " (session " in line
        first.send_signal(signal.SIGINT)
        assert first.wait(PATIENCE_S) == 130
    answered(other)


def fleet_of(project: Path, folder: Path, hosts: dict[str, str]) -> Path:
    """Make another project like one, with these robots by name; return its folder."""
    shutil.copytree(project, folder, ignore=shutil.ignore_patterns(".sierra"))
    text = (folder / "sierra.toml").read_text().partition("[runners.robots.fleet.")[0]
    robots = "".join(f'[runners.robots.fleet.{name}]\nhost = "{host}"\n' for name, host in hosts.items())
    (folder / "sierra.toml").write_text(text.replace("count = 3", f"count = {len(hosts)}") + robots)
    return folder


@pytest.mark.nightly
def test_fleets_that_share_a_robot_and_users_of_it_take_turns(
    project: Path, fleet: Fleet, tmp_path_factory: pytest.TempPathFactory
) -> None:
    make, others = partial(fleet_of, project), tmp_path_factory.mktemp("others")
    for name in fleet.names:
        fleet.configure(name, f"AllowUsers {GUEST}")
    robot_project.move(project, 600)
    first = make(others / "first", {"rb1": "rb1", "rb2": "rb2"})
    robot_project.move(project, 5)
    second = make(others / "second", {"rb2": "rb2", "rb3": "rb3"})
    third = make(others / "third", {"rb3": "rb3"})
    guest = make(others / "guest", {"rb2": f"{GUEST}@rb2"})
    with drive(first) as process:
        until(lambda: all(list(fleet.robots[name].home.rglob("swarm.csv")) for name in ("rb1", "rb2")), "both execute", 60)
        for other in (second, guest):
            refused = projects.quick(other, *robot_project.RUN)
            assert refused.returncode == 3
            [line] = [line for line in refused.stderr.splitlines() if "in use by" in line]
            assert line.startswith("sierra: rb2: in use by ")
            assert " (session " in line
            assert Project(other).sql("SELECT count(*) AS n FROM executions").to_pylist() == [{"n": 0}]
        alone = projects.quick(third, *robot_project.RUN, "--runs", "1")
        assert alone.returncode == 0, alone.stderr
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 130
    for other in (guest, second):
        done = projects.quick(other, *robot_project.RUN, "--runs", "1")
        assert done.returncode == 0, done.stderr
        assert projects.quick(other, "fsck").returncode == 0


@pytest.mark.nightly
def test_drivers_over_openssh_are_killed_and_lose_a_radio(project: Path, fleet: Fleet) -> None:
    over_openssh(project)
    robot_project.move(project, 50)
    with drive(project) as process:
        all_busy(fleet, process)
        process.kill()
    all_stand(fleet)
    for folder in [one for robot in fleet.robots.values() for one in robot.home.rglob("runs/*")]:
        shutil.rmtree(folder)
    with drive(project) as process:
        all_busy(fleet, process)
        fleet.radio("rb2", up=False)
        all_idle(fleet)
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 3, errors
    assert robot_project.rows_of(project, "SELECT status, reason LIKE 'rb2 was lost: %' FROM executions") == [("failed", True)]
    fleet.radio("rb2", up=True)
    answered(project, ticks=50)
    assert projects.quick(project, "fsck").returncode == 0


PASSPHRASE = "open sesame"


def with_passphrase(project: Path, fleet: Fleet) -> tuple[Terminal, str]:
    """Start a driver in a terminal, over OpenSSH with a locked key; return the terminal and the question of the client."""
    over_openssh(project)
    robot_project.move(project, 5)
    locked = fleet.folder / "locked"
    shutil.copy(fleet.key, locked)
    subprocess.run(["ssh-keygen", "-q", "-p", "-P", "", "-N", PASSPHRASE, "-f", locked], check=True)
    fleet.ssh_config.write_text(fleet.ssh_config.read_text().replace(f"IdentityFile {fleet.key}", f"IdentityFile {locked}"))
    sierra = Path(sys.executable).with_name("sierra")
    never = {"SSH_AUTH_SOCK": "", "SSH_ASKPASS_REQUIRE": "never"}
    terminal = Terminal(project, str(sierra), *robot_project.QUERY, environment=never)
    return terminal, f"Enter passphrase for key '{locked}': "


@pytest.mark.nightly
def test_ssh_asks_for_the_passphrase_of_each_robot_in_turn(project: Path, fleet: Fleet) -> None:
    terminal, prompt = with_passphrase(project, fleet)
    with terminal:
        for _ in fleet.names:
            terminal.expect(prompt)
            time.sleep(1)  # in which no other client may ask too
            terminal.type(f"{PASSPHRASE}\n")
        assert terminal.end() == 0, terminal.shown
    assert terminal.shown.count(f"{prompt}\r\n") == terminal.shown.count("Enter") == len(fleet.names), terminal.shown
    assert "sesame" not in terminal.shown
    robot_project.is_recorded(project, 5)


@pytest.mark.nightly
@pytest.mark.parametrize("answered", [0, 1])
def test_ssh_asks_nothing_after_ctrl_c(project: Path, fleet: Fleet, answered: int) -> None:
    terminal, prompt = with_passphrase(project, fleet)
    with terminal:
        for _ in range(answered):
            terminal.answer(prompt, PASSPHRASE)
        terminal.expect(prompt)
        terminal.type("\x03")
        assert terminal.end() == 130, terminal.shown
    assert terminal.shown.count("Enter") == answered + 1, terminal.shown


@pytest.mark.nightly
def test_connections_that_the_user_has_opened_are_used(
    project: Path, fleet: Fleet, tmp_path_factory: pytest.TempPathFactory
) -> None:
    over_openssh(project)
    robot_project.move(project, 5)
    sockets = tmp_path_factory.mktemp("s")
    config = project / "sierra.toml"
    text = config.read_text()
    for name in fleet.names:
        link = f'link_options = {{ control_path = "{sockets / name}" }}'
        text = text.replace(f'host = "{name}"\n', f'host = "{name}"\n{link}\n')
    config.write_text(text)
    refused = projects.quick(project, *robot_project.QUERY)
    assert refused.returncode == 3
    assert "no ControlMaster answers at " in refused.stderr
    before = {name: robot.log.count("Accepted publickey") for name, robot in fleet.robots.items()}
    client = ["ssh", "-F", str(fleet.ssh_config)]
    try:
        for name in fleet.names:
            subprocess.run([*client, "-M", "-S", sockets / name, "-N", "-f", name], check=True, stderr=subprocess.DEVNULL)
        answered(project, ticks=5)
        assert {
            name: fleet.robots[name].log.count("Accepted publickey") - before[name] for name in fleet.names
        } == dict.fromkeys(fleet.names, 1)
    finally:
        for name in fleet.names:
            subprocess.run([*client, "-S", sockets / name, "-O", "exit", name], check=False, capture_output=True)
