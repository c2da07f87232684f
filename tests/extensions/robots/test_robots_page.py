"""The page on robots is followed on three robots, and their motors are off after its runs, however these end."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import projects
from tests.support import pages, robot_fleet, robot_project
from tests.support.robot_fleet import Fleet
from tests.waiting import until

pytestmark = [pytest.mark.integration, pytest.mark.real]
PAGE = pages.DOCS / "how-to" / "robots.md"
SSH = '#!/bin/sh\nexec /usr/bin/ssh -F "$HOME/.ssh/config" "$@"\n'


@pytest.fixture
def robots(require: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fleet]:
    """Yield robots that the user's configuration of OpenSSH calls robot1, robot2 and robot3."""
    robot_fleet.needed(require)
    with Fleet(3, disk="200m") as fleet:
        home = tmp_path / "home"
        for name, text in {
            ".ssh/config": fleet.ssh_config.read_text().replace("Host rb", "Host robot"),
            "bin/ssh": SSH,
        }.items():
            (home / name).parent.mkdir(parents=True)
            (home / name).write_text(text)
        (home / "bin" / "ssh").chmod(0o755)
        pages.as_user(monkeypatch)
        monkeypatch.setenv("HOME", str(home))
        monkeypatch.setenv("PATH", str(home / "bin"), prepend=":")  # its ssh finds the configuration by HOME
        yield fleet


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Return an empty folder."""
    (tmp_path / "project").mkdir()
    return tmp_path / "project"


def speeds(fleet: Fleet) -> list[list[float]]:
    """Return what each motor was told, the last speed last."""
    logs = [robot.home / "bin" / "motor.log" for robot in fleet.robots.values()]
    return [[float(speed) for speed in log.read_text().split()] if log.exists() else [] for log in logs]


def test_the_example_executes_on_three_robots_and_their_motors_are_off_afterwards(robots: Fleet, project: Path) -> None:
    pages.follow(PAGE, project)
    rows = "SELECT speed, robot, count(*) AS rows, count(DISTINCT run) AS runs FROM way GROUP BY ALL ORDER BY ALL"
    assert [tuple(row.values()) for row in projects.sql(project, rows)] == [
        (speed, robot, 20, 2) for speed in (0.1, 0.2) for robot in (1, 2, 3)
    ]
    assert projects.sql(project, "SELECT DISTINCT status, reason FROM executions") == [{"status": "ok", "reason": None}]
    for told in speeds(robots):
        assert sum(speed != 0 for speed in told) == 40
        assert told[-1] == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_motors_are_off_after_a_run_of_the_example_that_is_ended(robots: Fleet, project: Path, number: signal.Signals) -> None:
    follow_until_it_runs(project)
    with robot_project.drive(project, ("run", "speed=0.3", "--on", "robots", "--no-figures")) as process:
        until(lambda: all(told and told[-1] for told in speeds(robots)), "all move")
        process.send_signal(number)
        process.communicate(timeout=60)
    for name in robots.names:
        until(lambda name=name: not robots.commands(name), lambda name=name: robots.commands(name), 60)
    assert [told[-1] for told in speeds(robots)] == [0, 0, 0]


def follow_until_it_runs(project: Path) -> None:
    """Write the files of the page, and install the motors."""
    for block in pages.blocks(PAGE):
        if block.title:
            (project / block.title).write_text(block.text)
        elif block.kind == "sh":
            for command, _ in pages.steps(block):
                code, _, messages = pages.run(command, project)
                assert code == 0, messages
