"""The platforms of simulators with real simulators: their examples, from the stock files to figures and replays."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import projects
from tests.simulators import Environment, Install, values


@pytest.fixture
def started(installed: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], tuple[Path, Environment]]:
    """Return a function that copies the example of a simulator, whose programs are then in `PATH`."""

    def started(simulator: str) -> tuple[Path, Environment]:
        environment = installed(simulator)
        monkeypatch.setenv("PATH", f"{environment.bin}{os.pathsep}{os.environ['PATH']}")
        done = projects.quick(tmp_path, "init", "--example", simulator, "demo")
        assert done.returncode == 0, done.stderr
        return tmp_path / "demo", environment

    return started


Started = Callable[[str], tuple[Path, Environment]]


def test_the_example_of_sumo_goes_from_a_query_to_figures(started: Started, require: Callable[..., str]) -> None:
    root, sumo = started("sumo")
    works = subprocess.run([sumo.bin / "sumo", "--version"], check=False, capture_output=True).returncode == 0
    require("the system's libraries that SUMO needs", there=works)
    done = projects.quick(root, "run", "vehicles_per_hour=50,300", "--runs", "3")
    assert done.returncode == 0, done.stderr
    assert len(list((root / "figures").glob("*/*.png"))) == 2
    lost = 'SELECT vehicles_per_hour AS v, avg("timeLoss") AS lost FROM trips GROUP BY v ORDER BY v'
    few, many = (float(str(row["lost"])) for row in projects.sql(root, lost))
    assert few < many
    sums = 'SELECT sum("timeLoss") AS s FROM trips WHERE vehicles_per_hour = 300 GROUP BY run'
    assert len(values(root, sums)) == 3
    assert "Eclipse SUMO sumo 1.28.0" in values(root, "SELECT version FROM programs WHERE name = 'sumo: program'")


def test_dates_in_outputs_of_sumo_are_no_difference(started: Started, require: Callable[..., str]) -> None:
    root, sumo = started("sumo")
    works = subprocess.run([sumo.bin / "sumo", "--version"], check=False, capture_output=True).returncode == 0
    require("the system's libraries that SUMO needs", there=works)
    summary, _ = projects.run(root, "scale=0.5,1", "--runs", "1")
    assert (summary["executed"], summary["failed"]) == (2, 0)
    replayed = projects.quick(root, "replay", summary["batch"][:10])
    assert (replayed.returncode, "equal (2 runs: 2 equal)" in replayed.stdout) == (0, True), replayed.stdout
