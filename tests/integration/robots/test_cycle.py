"""Runs on robots with real sshd, and the faults that they must survive."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from sierra.links.base import LinkOptions
from sierra.links.fabric import Fabric
from tests.support.robot_fleet import Fleet
from tests.support.robot_runs import Runs, job


@pytest.fixture
def runs(fleet: Fleet, tmp_path: Path) -> Iterator[Runs]:
    options = LinkOptions(ssh_config=str(fleet.ssh_config))
    homes = {name: robot.home for name, robot in fleet.robots.items()}
    yield Runs(tmp_path, homes, lambda name, _: Fabric(name, options), disk_min=1, grace=1.0)
    for name, robot in fleet.robots.items():
        if robot.process is not None:
            assert not [line for line in fleet.commands(name) if "go.py" in line]


def test_a_run_on_three_robots(runs: Runs, fleet: Fleet):
    first, second = runs.run(job(1), job(2))
    assert (first.exit_code, first.error, second.error) == (0, None, None)
    assert [file.path for file in first.outputs] == ["1/here.csv", "2/here.csv", "3/here.csv"]
    rows = [row for table, row in runs.rows if table == "robots"]
    assert [row["host"] for row in rows[:3]] == list(fleet.names)
    print([row["start_skew_ns"] / 1e6 for row in rows], [row["rtt_ns"] / 1e6 for row in rows])
    print(first.started, second.started - first.started)
