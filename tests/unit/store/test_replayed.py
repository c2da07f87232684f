"""A store can be read as if the executions of replays were the only ones of their runs."""

from __future__ import annotations

from pathlib import Path

import pytest

import sierra
from sierra.replay.options import ReplayOptions
from sierra.replay.replay import replay
from tests import projects

CHANGING = (
    projects.SIMULATOR.replace("noise * (seed % 100)", "{file}.stat().st_size")
    + "sys.exit({file}.stat().st_size > 1 and count == 2)\n"
)


@pytest.mark.nightly
def test_values_and_failures_of_replays_count_instead_of_the_recorded_ones(tmp_path: Path) -> None:
    simulator = f"from pathlib import Path\n{CHANGING}".replace("{file}", f"Path({str(tmp_path / 'size')!r})")
    root = projects.make(tmp_path / "project", simulator=simulator)
    (tmp_path / "size").write_text("1")
    project = sierra.open(root)
    batch = project.run("population_size=1,2", runs=2, figures=False).batch
    (tmp_path / "size").write_text("22")
    values = "SELECT population_size AS size, number, coverage FROM swarm WHERE tick = 0 ORDER BY ALL"
    before = project.store.rows(values)
    first = min(row["run"] for row in project.sql("SELECT run FROM runs WHERE population_size = 1").to_pylist())
    some = replay(project.loaded, project.store, batch, ReplayOptions(1, only=frozenset([first])))
    assert [run.taken.run for run in some.runs] == [first]
    whole = project.replay(batch)
    store = project.store.replayed([whole.id])
    assert [row["coverage"] for row in before] == [1.0] * 4
    assert store.rows(values) == [{"size": 1.0, "number": number, "coverage": 2.0} for number in range(2)]
    assert store.values(int, "SELECT count(*) FROM effective") == [2]
    assert store.rows("SELECT status, count(*) AS n FROM runs GROUP BY ALL ORDER BY ALL") == [
        {"status": "failed", "n": 2},
        {"status": "ok", "n": 2},
    ]
    part = project.store.replayed([some.id]).rows(values)
    assert [row["coverage"] for row in part if row["size"] == 1] in ([1.0, 2.0], [2.0, 1.0])
    assert project.store.rows(values) == before
