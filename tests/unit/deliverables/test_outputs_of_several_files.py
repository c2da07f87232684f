"""Statistics and figures of outputs with several files per run."""

from __future__ import annotations

from pathlib import Path

import pytest

import sierra
import sierra.store.export_recorded_files
from sierra.api import Project
from sierra.errors import UsageError
from sierra.util.text import natural
from tests import projects

FLOORS = """\
for floor in range(1, 13):
    with open(f"floor-{floor}.csv", "w") as file:
        print("tick,heat" if TICKS else "heat", file=file)
        for row in range(ROWS):
            print(*([TICKS(floor, row)] if TICKS else []), 100 * floor + row, sep=",", file=file)
"""
DECLARED = projects.CONFIG + '[outputs.floor]\nfile = "floor-*.csv"\n'
REFUSED = "2 runs with more than one row at the same time; statistics over runs need one value per run and time"


def _project(root: Path, *, rows: int = 1, ticks: str = "None", config: str = DECLARED, script: str = FLOORS) -> Project:
    return sierra.open(projects.make(root, config, simulator=f"ROWS, TICKS = {rows}, {ticks}\n{script}"))


@pytest.mark.integration
@pytest.mark.parametrize(("rows", "ticks"), [(1, "None"), (2, "None"), (2, "lambda floor, row: row")])
def test_statistics_and_figures_refuse_outputs_with_several_rows_per_time(tmp_path: Path, rows: int, ticks: str) -> None:
    project = _project(tmp_path / "p", rows=rows, ticks=ticks)
    summary = project.run("population_size=1")
    assert summary.figures == ()
    [note] = [note for note in summary.notes if "figure" in note]
    assert note.startswith(f"no figure of output 'floor': {REFUSED}")
    assert note.endswith("A run has 12 files of this output: file in [outputs.floor] can name one of them")
    for measure in ("final", "mean", None):
        with pytest.raises(UsageError, match=REFUSED):
            project.statistics(summary.batch, "floor", "heat", measure=measure)
    asked = projects.quick(project.root, "stats", summary.batch[:12], "floor", "heat")
    assert (asked.returncode, asked.stderr.count("\n")) == (2, 1)
    with pytest.raises(UsageError, match=REFUSED):
        _explicit(project, summary.batch)


def _explicit(project: Project, batch: str) -> None:
    """Declare a figure in the project and draw it."""
    file = project.root / "sierra.toml"
    file.write_text(file.read_text() + '[figures.heat]\nkind = "summary"\ntable = "floor"\ncolumn = "heat"\n')
    sierra.open(project.root).deliverables.draw(batch, "heat")


@pytest.mark.integration
def test_final_value_is_that_of_the_last_file_if_files_continue_in_time(tmp_path: Path) -> None:
    project = _project(tmp_path / "p", rows=2, ticks="lambda floor, row: 2 * floor + row")
    summary = project.run("population_size=1")
    assert project.statistics(summary.batch, "floor", "heat").column("mean").to_pylist() == [1201.0]
    assert {Path(file).stem for file in summary.figures} == {"floor_heat_summary", "floor_heat_timeseries"}


@pytest.mark.nightly
def test_statistics_work_if_the_glob_matches_one_file_per_run(tmp_path: Path) -> None:
    config = projects.CONFIG + '[outputs.floor]\nfile = "floor-12*.csv"\n'
    project = _project(tmp_path / "p", rows=3, config=config)
    summary = project.run("population_size=1", figures=False)
    assert project.statistics(summary.batch, "floor", "heat").column("mean").to_pylist() == [1202.0]


@pytest.mark.nightly
def test_files_are_listed_in_numeric_order(tmp_path: Path) -> None:
    project = _project(tmp_path / "p")
    summary = project.run("population_size=1", runs=1, figures=False)
    names = [f"floor-{number}.csv" for number in range(1, 13)]
    assert project.sql("SELECT file FROM floor").column(0).to_pylist() == names
    listed = project.records.files(summary.batch)
    assert isinstance(listed, sierra.store.export_recorded_files.Listing)
    assert [file.path for file in listed.files if file.kind == "table"] == [f"output/{name}" for name in names]
    execution = project.sql("SELECT execution FROM executions").column(0)[0].as_py()
    shown = [one.path for one in project.records.show(execution).artifacts]
    assert shown == names


def test_natural_sort_orders_names_by_their_numbers() -> None:
    names = ["a", "floor-2", "floor-10", "floor-10.5", "floor-10b", "floor-x", "2", "10", "01", "1", "²", ""]
    assert sorted(names, key=natural) == [
        "",
        "01",
        "1",
        "2",
        "10",
        "a",
        "floor-2",
        "floor-10",
        "floor-10.5",
        "floor-10b",
        "floor-x",
        "²",
    ]


LITERAL = """\
for name in ("robot[0].csv", "robot0.csv"):
    with open(name, "w") as file:
        print("v", name.count("["), sep="\\n", file=file)
"""


@pytest.mark.nightly
def test_file_names_with_brackets_are_matched_literally(tmp_path: Path) -> None:
    config = projects.CONFIG + '[outputs.one]\nfile = "robot[0].csv"\n'
    project = _project(tmp_path / "p", config=config, script=LITERAL)
    summary = project.run("population_size=1", runs=1, figures=False)
    assert summary.failed == 0
    rows = project.sql("SELECT file, v FROM one ORDER BY v").to_pylist()
    assert rows == [{"file": "robot0.csv", "v": 0}, {"file": "robot[0].csv", "v": 1}]
    listed = project.records.files(summary.batch, "robot[0].csv")
    assert isinstance(listed, sierra.store.export_recorded_files.Listing)
    assert [file.path for file in listed.files] == ["output/robot[0].csv"]


METRIC = '[equivalence.heat]\ntable = "floor"\ncolumn = "heat"\nmargin = 1\n'


@pytest.mark.nightly
def test_missing_column_of_an_equivalence_metric_is_reported(tmp_path: Path) -> None:
    project = _project(tmp_path / "p", config=DECLARED + METRIC.replace('"heat"', '"haet"'))
    summary = project.run("population_size=1", figures=False)
    [note] = [note for note in project.replay(summary.batch).notes if "equivalence" in note]
    assert note.startswith("[equivalence]: output 'floor' has no column 'haet'; did you mean 'heat'?")
    assert "Error" not in note


@pytest.mark.integration
def test_equivalence_metric_refuses_outputs_with_several_rows_per_time(tmp_path: Path) -> None:
    project = _project(tmp_path / "p", config=DECLARED + METRIC)
    summary = project.run("population_size=1", figures=False)
    [note] = [note for note in project.replay(summary.batch).notes if "equivalence" in note]
    assert note.startswith(f"[equivalence]: output 'floor': {REFUSED}")
    assert note.endswith("no experiment is tested for equivalence")
