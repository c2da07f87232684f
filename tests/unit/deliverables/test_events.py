"""Tables of events have no time: each run counts by the mean of its rows, and not by its last event."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import projects

CONFIG = """\
command = "python3 {project}/sim.py {demand} {seed}"
runs = 3
observe = "none"
[variables]
demand = {}
[outputs.trips]
file = "trips.xml"
format = "xml"
rows = "//trip"
mismatch = "ragged"
"""
SIMULATOR = """\
import sys
trips = 4 + int(sys.argv[2]) % 23
rows = "".join(f'<trip duration="{(7 * number + 3) % 5}"/>' for number in range(trips))
open("trips.xml", "w").write(f"<trips>{rows}</trips>")
"""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "project"
    folder.mkdir()
    (folder / "sierra.toml").write_text(CONFIG)
    (folder / "sim.py").write_text(SIMULATOR)
    return folder


@pytest.mark.integration
def test_a_run_counts_by_the_mean_of_its_events(root: Path) -> None:
    done = projects.quick(root, "run", "demand=1,2")
    assert done.returncode == 0, done.stderr
    assert "the mean of each run's rows is taken, not the last row" in done.stderr
    assert not list(root.glob("figures/*/*timeseries*"))
    of_runs = "SELECT run, avg(duration) AS mean FROM trips WHERE demand = 1 GROUP BY run"
    [expected] = projects.sql(root, f"SELECT avg(mean) AS mean FROM ({of_runs})")
    said = projects.quick(root, "stats", "trips", "duration", "--json")
    [first, _] = json.loads(said.stdout)
    assert first["mean"] == pytest.approx(expected["mean"])
    last = json.loads(projects.quick(root, "stats", "trips", "duration", "--measure", "final", "--json").stdout)
    assert last[0]["mean"] != pytest.approx(expected["mean"]), "the last event is used if it is asked for"


@pytest.mark.nightly
def test_a_table_without_any_row_is_noted(root: Path) -> None:
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("//trip", "//trp"))
    done = projects.quick(root, "run", "demand=1")
    assert done.returncode == 0, done.stderr
    assert "output 'trips' has no row in any run, rows = \"//trp\": is this right?" in done.stderr
    assert "table trips from trips.xml: 0 rows; no columns" in done.stdout
