"""Default figures: those whose columns differ most between the experiments; and notes on tables that have none."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import sierra
from sierra.config import project_file
from sierra.config.deliverable_tables import Figure
from sierra.deliverables import default_figures
from sierra.deliverables.gallery import Gallery
from sierra.model import Axis
from sierra.store.batch_data import BatchData
from tests.projects import CONFIG, make, quick

WIDE = """\
import random, sys
text = open(sys.argv[1]).read()
count, seed = (int(text.split(before)[1].split('"')[0]) for before in ('<swarm count="', '<random seed="'))
rng = random.Random(seed)
names = [f"a{number:02}" for number in range(20)]
with open("wide.csv", "w") as file:
    print(*names, "energy", "huge", sep=",", file=file)
    print(*(rng.random() for _ in names), count * 10 + rng.random(), rng.choice((1e308, 9e307)), sep=",", file=file)
"""

BODIES = """with open("way.csv", "w") as file:
    print("tick,robot,x", file=file)
    for tick in range(3):
        for robot in (1, 2):
            print(tick, robot, tick * robot + 0.5, sep=",", file=file)
"""


@pytest.mark.nightly
def test_columns_that_differ_between_experiments_have_figures_before_others(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=WIDE)
    assert quick(folder, "run", "population_size=1,2,4", "--runs", "4", "--no-figures").returncode == 0
    done = quick(folder, "figures", "--json")
    assert done.returncode == 0, done.stderr
    assert "6 more figures can be drawn" in done.stderr + done.stdout
    drawn = {Path(path).stem for path in json.loads(done.stdout)}
    assert "wide_energy_summary" in drawn
    assert len(drawn) == 16


EVENTS = """\
import sys
n = int(open(sys.argv[1]).read().split('<swarm count="')[1].split('"')[0])
with open("ball.csv", "w") as file:
    print("{time},height,mode", file=file)
    for at, height, mode in ((0, 4, 0), (1, 0, 0), (1, n, 1), (2, 3, 1)):
        print(at, height, mode, sep=",", file=file)
"""
"""The values before and after an event have the same time; the whole number `mode` tells them apart."""


@pytest.mark.integration
@pytest.mark.parametrize(("time", "declared"), [("t", ""), ("simulated", ', time = "simulated"')])
def test_last_row_of_each_time_is_proposed_for_values_before_and_after_an_event(
    tmp_path: Path, time: str, declared: str
) -> None:
    outputs = f'[outputs.ball]\nfile = "ball.csv"\ntime = "{time}"\n' if declared else ""
    folder = make(tmp_path / "project", CONFIG + outputs, simulator=EVENTS.replace("{time}", time))
    done = quick(folder, "run", "population_size=1,3", "--no-figures")
    assert done.returncode == 0, done.stderr
    sql = f"SELECT * FROM ball QUALIFY row = max(row) OVER (PARTITION BY run, {time})"
    table = f'[tables.ball_last] sql = "{sql}"{declared}'
    proposal = f"or take the last row of each time, for example: {table}"
    for words in (("stats", "ball", "height"), ("figures",)):
        assert proposal in quick(folder, *words).stderr
    with (folder / "sierra.toml").open("a") as file:
        file.write(table.replace("] ", "]\n", 1).replace(", time", "\ntime") + "\n")
    said = quick(folder, "stats", "ball_last", "height", "--format", "csv", "--measure", "mean", "--statistic", "mean").stdout
    assert [line.split(",")[6] for line in said.splitlines()[1:]] == ["2.6666666666666665", "3.3333333333333335"]


@pytest.mark.integration
def test_a_note_proposes_the_mean_of_what_was_measured_and_not_of_the_number_of_a_robot(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=BODIES)
    done = quick(folder, "run", "population_size=1", "--runs", "2")
    assert (done.returncode, "figures/" in done.stdout) == (0, False), done.stderr
    table = '[tables.way_mean] sql = "SELECT run, tick, avg(x) AS x FROM way GROUP BY run, tick"'
    assert done.stderr.rstrip().endswith(f"or make one row of them, for example: {table}")
    with (folder / "sierra.toml").open("a") as file:
        file.write(table.replace("] ", "]\n", 1) + "\n")
    assert "way_mean_x_timeseries" in quick(folder, "figures").stdout


@pytest.mark.integration
def test_a_variable_with_one_value_is_no_dimension_of_figures(tmp_path: Path) -> None:
    declared = '[figures.map]\nkind = "heatmap"\ncolumn = "coverage"\n[controllers.A]\n'
    folder = make(tmp_path / "project", CONFIG + declared)
    batch = sierra.open(folder).run("population_size=1,2", "noise=0,0.5", "controller=A", runs=1, figures=False).batch
    with BatchData(sierra.open(folder).store, batch) as frame:
        gallery = Gallery(project_file.load(folder), sierra.open(folder).store, frame)
        drawn = gallery.drawing("map", default_figures.wanted(gallery, "map")[0]["map"])
        assert [axis.name for axis in drawn.axes] == ["population_size", "noise"]
        assert "controller = A" in drawn.note.split("; ")
        named = Figure(kind="summary", column="coverage", facet="controller")
        assert [axis.name for axis in gallery.drawing("by", named).axes] == ["population_size", "noise", "controller"]
        alone = Figure(kind="summary", column="coverage", where="population_size = 1 AND noise = 0.5")
        assert [axis.name for axis in gallery.drawing("one", alone).axes] == ["population_size"]


@pytest.mark.integration
def test_default_figures_over_one_varied_variable_are_no_maps(tmp_path: Path) -> None:
    folder = make(tmp_path / "project")
    batch = sierra.open(folder).run("population_size=1,2", "noise=0.5", runs=1, figures=False).batch
    with BatchData(sierra.open(folder).store, batch) as frame:
        gallery = Gallery(project_file.load(folder), sierra.open(folder).store, frame)
        wanted, _ = default_figures.wanted(gallery, None)
    assert {figure.kind for figure in wanted.values()} == {"timeseries", "summary"}


@pytest.mark.parametrize(
    ("axes", "series", "expected"),
    [(1, True, ["timeseries", "summary"]), (1, False, ["summary"]), (2, True, ["timeseries", "heatmap", "summary"])],
)
def test_default_figures_of_a_column_depend_on_the_axes_of_the_batch(axes: int, series: bool, expected: list[str]) -> None:
    found = default_figures.of_columns("robots", ["energy"], (Axis("size", (1, 2)),) * axes, series=series)
    assert [f.kind for f in found.values()] == expected
    assert list(found) == [f"robots_energy_{kind}" for kind in expected]
