"""Runs in containers on the hosts of a lab: each gets the pinned image."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests import containers, projects
from tests.support import lab_project
from tests.support.lab_project import QUERY, drive, ended, rows_of
from tests.support.robot_fleet import Fleet

pytestmark = [pytest.mark.integration, pytest.mark.real]

SIMULATOR = 'test ! -e /home/robot/.cache || exit 1\nprintf "t,x\\n0,%s\\n" "$2" > swarm.csv\n'


@pytest.fixture
def project(fleet: Fleet, tmp_path: Path, require: Callable[..., str]) -> Path:
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    require("apptainer")
    project = lab_project.make(fleet, tmp_path / "project")
    (project / "sim.sh").write_text(SIMULATOR)
    (project / "sim.py").unlink()
    config = project / "sierra.toml"
    command = config.read_text().replace('["/usr/bin/python3", "sim.py", "{input}"]', '["sh", "sim.sh", "{input}", "7"]')
    config.write_text(f'{command}[container]\nimage = "{containers.busybox(tmp_path)}"\n')
    assert projects.quick(project, "image", "pin").returncode == 0
    return project


def test_hosts_get_the_pinned_image_and_give_the_same_bytes(fleet: Fleet, project: Path) -> None:
    code, errors = ended(drive(project, *QUERY, "3", "--engine", "apptainer"))
    assert code == 0, errors
    statement = "SELECT i.engine, e.status, count(*) FROM executions e JOIN isolations i USING (isolation) GROUP BY ALL"
    assert rows_of(project, statement) == [("apptainer", "ok", 6)]
    [batch] = projects.values(project, "SELECT batch FROM sessions")
    replayed = projects.quick(project, "replay", str(batch), "--engine", "apptainer")
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr


def test_an_image_in_the_storage_of_an_engine_is_refused(project: Path, require: Callable[..., str]) -> None:
    require("podman")
    code, errors = ended(drive(project, *QUERY, "3", "--engine", "podman"))
    assert code == 2, errors
    assert "a lab executes containers whose image is a file; use --engine apptainer" in errors
