"""Models in figures of all kinds that draw them, with two variables, one of them with names."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import sierra
from sierra.deliverables.gallery import Gallery
from sierra.store.batch_data import BatchData
from tests import projects

SCENARIOS = """
[scenarios.a]
[scenarios.b]
changes = [{ set = "//noise", value = "0.7" }]
[scenarios.c]
changes = [{ set = "//noise", value = "1.7" }]
"""
MODELS = """
[models.mean_field]
expression = "population_size * t + 9"
column = "coverage"
label = "mean field"
[models.final]
sql = '''SELECT DISTINCT population_size, scenario, 5 * population_size AS coverage FROM swarm WHERE scenario <> 'c' '''
column = "coverage"
"""
KINDS = ("timeseries", "summary", "bar", "box", "violin", "strip", "heatmap")
FIGURES = (
    "".join(f"[figures.{kind}]\nkind = '{kind}'\ntable = 'swarm'\ncolumn = 'coverage'\n" for kind in KINDS)
    + """
[figures.names]
kind = "summary"
table = "swarm"
column = "coverage"
x = "scenario"
labels = { a = "first" }
[figures.facets]
kind = "summary"
table = "swarm"
column = "coverage"
facet = "scenario"
log_y = true
"""
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = projects.make(tmp_path_factory.mktemp("models") / "project", projects.CONFIG + SCENARIOS)
    sierra.open(root).run("population_size=1,2,3", "scenario=a,b,c", runs=3, figures=False)
    (root / "sierra.toml").write_text(projects.CONFIG + SCENARIOS + MODELS + FIGURES)
    return root


def text(file: Path) -> str:
    return " ".join(re.sub(r"<[^>]+>", " ", file.read_text()).split())


@pytest.mark.nightly
def test_all_kinds_that_draw_models_show_them(root: Path) -> None:
    done = projects.sierra(root, "figures")
    assert done.returncode == 0, done.stderr
    assert "model final: no value for 3 of 9 experiments: no row" in done.stderr
    assert "is left out" not in done.stderr
    before = {}
    for file in sorted(root.glob("figures/*/*.svg")):
        dashes = file.read_text().count("stroke-dasharray")
        shown = text(file)
        assert "model mean field: RMSE" in shown, file
        assert ("model final: RMSE" in shown) == (file.stem != "timeseries"), file
        assert dashes >= (0 if file.stem == "heatmap" else 4), file
        assert shown.count("mean field") >= 2, f"{file}: not in the legend, or in no title of a panel"
        before[file] = file.read_bytes()
    assert len(before) == len(KINDS) + 2
    assert projects.sierra(root, "figures", "--check").returncode == 0
    projects.sierra(root, "figures")
    assert {file: file.read_bytes() for file in before} == before


@pytest.mark.nightly
def test_times_in_seconds_are_those_of_the_data(root: Path) -> None:
    config = projects.CONFIG + SCENARIOS + MODELS + FIGURES
    (root / "sierra.toml").write_text(config + "[outputs.swarm]\nfile = 'swarm.csv'\ntime = 'tick'\nticks_per_second = 2\n")
    project = sierra.open(root)
    with BatchData(project.store, project.records.batch()) as frame:
        drawing = Gallery(project.loaded, project.store, frame).drawing("timeseries", project.config.figures["timeseries"])
    (model,) = drawing.models
    assert model.table.column("t").to_pylist() == drawing.tables["coverage"].column("t").to_pylist()
    assert model.table.column("t").to_pylist()[:3] == [0, 0.5, 1]
    assert model.table.column("value").to_pylist()[:3] == [9, 10, 11]
    (root / "sierra.toml").write_text(config)
