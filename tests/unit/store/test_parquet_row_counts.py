"""The effective execution: one rule for the summary, lists, SQL, statistics and figures."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.api import Project
from sierra.errors import NotFound, UsageError
from tests import projects

MARKED = """
[success]
marker = "stdout"
contains = "fine"
"""
SAYS = projects.SIMULATOR + "print('fine' if seed % 2 else 'not so')\n"


def good(project: Project, batch: str) -> list[int]:
    return [row.succeeded for row in project.records.show(batch).experiments]


@pytest.mark.integration
def test_a_stricter_success_rule_applies_everywhere(tmp_path: Path) -> None:
    project = sierra.open(projects.make(tmp_path, simulator=SAYS))
    first = project.run("population_size=1", runs=8, figures=False)
    assert first.failed == 0
    (tmp_path / "sierra.toml").write_text(projects.CONFIG + MARKED)
    project = sierra.open(tmp_path)
    second = project.run("population_size=1", runs=8, figures=False)
    passed = second.runs - second.failed
    assert 0 < second.failed < 8
    assert good(project, second.batch) == [passed]
    assert project.batches[-1].failed == second.failed
    assert project.sql("SELECT count(*) AS c FROM runs WHERE status = 'ok'").to_pylist() == [{"c": passed}]
    assert project.sql("SELECT count(DISTINCT run) AS c FROM swarm").to_pylist() == [{"c": passed}]
    assert project.statistics(second.batch, "swarm", "coverage").to_pylist()[0]["n"] == passed


@pytest.mark.integration
def test_results_of_an_earlier_program_are_effective_again_when_it_is_restored(tmp_path: Path) -> None:
    program = tmp_path / "outside" / "sim"
    program.parent.mkdir()
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", str(program)))

    def install(value: int) -> None:
        program.write_text(f"#!/bin/sh\nprintf 'tick,v\\n0,{value}\\n' > out.csv\n")
        program.chmod(0o755)

    def values() -> list[int]:
        return [row["v"] for row in sierra.open(root).sql("SELECT v FROM out ORDER BY number").to_pylist()]

    install(1)
    sierra.open(root).run("population_size=1", runs=4, figures=False)
    install(2)
    assert sierra.open(root).run("population_size=1", runs=2, figures=False).executed == 2
    assert values() == [2, 2, 1, 1]
    install(1)
    again = sierra.open(root).run("population_size=1", runs=4, figures=False)
    assert (again.executed, again.reused) == (0, 4)
    assert values() == [1, 1, 1, 1]
    assert sierra.open(root).statistics(again.batch, "out", "v").to_pylist()[0]["mean"] == 1


@pytest.mark.nightly
def test_a_run_of_two_experiments_appears_at_both_points(tmp_path: Path) -> None:
    same = '[variables.idle]\nchanges = [{ set = "//swarm/@count", value = "{7 + 0 * idle}" }]\n'
    project = sierra.open(projects.make(tmp_path, projects.CONFIG + same))
    project.run("idle=1,2", figures=False)
    rows = project.sql("SELECT idle, count(DISTINCT run) AS runs FROM swarm GROUP BY ALL ORDER BY 1").to_pylist()
    assert rows == [{"idle": 1, "runs": 2}, {"idle": 2, "runs": 2}]
    assert {row["idle"] for row in project.sql("SELECT idle FROM runs").to_pylist()} == {None}


def test_values_that_give_the_same_runs_are_reported(tmp_path: Path) -> None:
    capped = '[variables.capped]\nchanges = [{ set = "//swarm/@count", value = "{min(capped, 3)}" }]\n'
    project = sierra.open(projects.make(tmp_path, projects.CONFIG + capped))
    said = "capped=3 and capped=4 have the same runs: their inputs do not differ (also in 1 other cases)"
    assert said in project.plan("capped=2,3,4,5").notes
    assert not any("same runs" in note for note in project.plan("montecarlo.C2").notes)


@pytest.mark.nightly
def test_a_run_of_several_batches_is_counted_once_and_sql_can_be_limited_to_one_batch(tmp_path: Path) -> None:
    project = sierra.open(projects.make(tmp_path))
    first = project.run("population_size=1,2", figures=False).batch
    project.run("population_size=1,2", runs=3, figures=False)
    project.run("population_size=1", "noise=0.1,0.2", figures=False)
    rows = project.sql("SELECT population_size, noise, count(DISTINCT run) AS runs, count(*) AS rows FROM swarm GROUP BY ALL")
    assert sum(row["runs"] for row in rows.to_pylist()) == 8
    assert sum(row["rows"] for row in rows.to_pylist()) == 40
    count = "SELECT count(DISTINCT run) AS runs FROM swarm"
    assert project.sql(count).to_pylist() == [{"runs": 8}]
    assert project.sql(count, within=first).to_pylist() == [{"runs": 4}]
    assert project.sql("SELECT count(*) AS runs FROM runs", within=first[:8]).to_pylist() == [{"runs": 4}]
    shown = projects.quick(tmp_path, "sql", "--batch", first[:8], count, "--json")
    assert '"runs": 4' in shown.stdout


@pytest.mark.integration
def test_runs_with_ragged_outputs_fail_after_a_change_to_strict(tmp_path: Path) -> None:
    ragged = '[outputs.swarm]\nfile = "swarm.csv"\nmismatch = "ragged"\n'
    simulator = projects.SIMULATOR.replace("range(5)", "range(5 + (seed % 5 == 0))")
    root = projects.make(tmp_path, projects.CONFIG + ragged, simulator=simulator)
    assert sierra.open(root).run("population_size=1", runs=12, figures=False).failed == 0
    (root / "sierra.toml").write_text(projects.CONFIG + ragged.replace("ragged", "strict"))
    assert sierra.open(root).run("population_size=1", runs=12, figures=False).failed > 0


@pytest.mark.nightly
def test_changing_the_time_column_does_not_execute_runs_again(tmp_path: Path) -> None:
    root = projects.make(tmp_path, projects.CONFIG + '[outputs.swarm]\nfile = "swarm.csv"\n')
    sierra.open(root).run("population_size=1", figures=False)
    (root / "sierra.toml").write_text(projects.CONFIG + '[outputs.swarm]\nfile = "swarm.csv"\ntime = "tick"\n')
    assert sierra.open(root).run("population_size=1", figures=False).executed == 0


@pytest.mark.integration
def test_runs_execute_again_if_an_ignored_library_named_by_a_variable_changes(tmp_path: Path) -> None:
    """No run is observed: an observed one would count, because it has not read the library."""
    config = 'observe = "none"\n' + projects.CONFIG + '[environment]\nset = { PLUGINS = "{project}/build" }\n'
    root = projects.make(tmp_path, config)
    (root / ".gitignore").write_text("build/\n")
    (root / "build").mkdir()
    (root / "build" / "plugin.so").write_bytes(b"one")
    subprocess.run(["git", "init", "-q", str(root)], check=True)
    first = sierra.open(root).run("population_size=1", figures=False)
    (root / "build" / "plugin.so").write_bytes(b"two")
    second = sierra.open(root).run("population_size=1", figures=False)
    assert (second.batch, second.executed) == (first.batch, 2)


@pytest.mark.nightly
def test_code_in_the_folder_figures_is_part_of_the_source(tmp_path: Path) -> None:
    """No run is observed: an observed one would count, because it has not read the code."""
    root = projects.make(tmp_path, 'observe = "none"\n' + projects.CONFIG)
    first = sierra.open(root).run("population_size=1")
    assert first.figures
    assert sierra.open(root).run("population_size=1").executed == 0
    (root / "figures" / "helper.py").write_text("x = 1\n")
    assert sierra.open(root).run("population_size=1", figures=False).executed == 2


@pytest.mark.integration
def test_statistics_are_computed_over_time_and_over_runs(tmp_path: Path) -> None:
    project = sierra.open(projects.make(tmp_path))
    batch = project.run("population_size=1,2", runs=4, figures=False).batch
    final: list[dict[str, Any]] = project.statistics(batch[:10], "swarm", "coverage").to_pylist()
    assert [row["n"] for row in final] == [4, 4]
    assert {"mean", "sd", "low", "high", "median", "q1", "q3", "min", "max", "iqm"} <= final[0].keys()
    assert project.statistics(batch, "swarm", "coverage", measure=None).num_rows == 10
    with pytest.raises(NotFound, match="no numeric column 'covrage'"):
        project.statistics(batch, "swarm", "covrage")
    with pytest.raises(UsageError, match="unknown measure"):
        project.statistics(batch, "swarm", "coverage", measure="last")


@pytest.mark.integration
def test_a_note_reports_a_table_with_several_rows_at_the_same_time(tmp_path: Path) -> None:
    simulator = projects.SIMULATOR.replace("print(tick, count", "print(tick, 0, sep=',', file=file); print(tick, count")
    summary = sierra.open(projects.make(tmp_path, simulator=simulator)).run("population_size=1")
    assert summary.figures == ()
    assert any("swarm" in note and "same time" in note for note in summary.notes)


@pytest.mark.nightly
def test_programs_are_recorded_once(tmp_path: Path) -> None:
    project = sierra.open(projects.make(tmp_path))
    for runs in (1, 2, 3):
        project.run("population_size=1", runs=runs, figures=False)
    rows = project.sql("SELECT name, path, count(*) AS c FROM programs GROUP BY ALL").to_pylist()
    assert {row["c"] for row in rows} == {1}


@pytest.mark.nightly
def test_a_project_in_a_folder_that_git_ignores_is_outside_git(tmp_path: Path) -> None:
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    (tmp_path / ".gitignore").write_text("/demo/\n")
    project = sierra.open(projects.make(tmp_path / "demo"))
    assert project.run("population_size=1", figures=False).failed == 0
    assert project.sql("SELECT DISTINCT vcs FROM sources").to_pylist() == [{"vcs": "none"}]


@pytest.mark.nightly
def test_the_failure_of_a_csv_file_without_a_header_suggests_header_false(tmp_path: Path) -> None:
    simulator = projects.SIMULATOR.replace('print("tick,coverage", file=file)', "pass")
    root = projects.make(tmp_path, simulator=simulator)
    summary = sierra.open(root).run("population_size=1", figures=False)
    assert summary.failed == 2
    assert "header = false" in summary.failures[0].reason
    (root / "sierra.toml").write_text(projects.CONFIG + '[outputs.swarm]\nfile = "swarm.csv"\nheader = false\n')
    assert sierra.open(root).run("population_size=1", figures=False).failed == 0


def test_a_text_instead_of_a_number_of_the_template_is_reported(tmp_path: Path) -> None:
    plan = sierra.open(projects.make(tmp_path)).plan("population_size=1-8")
    assert any("'1-8'" in note and "the template has the number 1" in note for note in plan.notes)


@pytest.mark.nightly
def test_explain_names_the_changed_program(tmp_path: Path) -> None:
    program = tmp_path / "sim"
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", str(program)))
    for value in (1, 2):
        program.write_text(f"#!/bin/sh\nprintf 'tick,v\\n0,{value}\\n' > out.csv\n")
        program.chmod(0o755)
        said = projects.quick(root, "run", "population_size=1", "-n", "--explain").stdout
        sierra.open(root).run("population_size=1", figures=False)
    assert re.search(r"sim: [0-9a-f]{10} recorded, [0-9a-f]{10} found", said)


@pytest.mark.nightly
def test_the_reason_is_reported_before_runs_execute_again(tmp_path: Path) -> None:
    program = tmp_path / "sim"
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", f"{program} {{project}}/sim.py"))

    def ask(value: int = 1) -> str:
        program.write_text(f"#!/bin/sh\nprintf 'tick,v\\n0,{value}\\n' > out.csv\n")
        program.chmod(0o755)
        return projects.quick(root, "run", "population_size=1", "--no-figures").stderr

    assert "submitted before" not in ask() + ask()
    assert "this query was submitted before; since then: sim: " in ask(2)
    (root / "sim.py").write_text("another")
    assert "this query was submitted before; since then: source: 1 file differs: sim.py" in ask(2)
    (root / "arena.xml").write_text(projects.TEMPLATE.replace("an arena", "the arena"))
    assert "since then: template: arena.xml has changed" in ask(2)
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text().replace('"//swarm/@count"', '"/arena/@size"'))
    assert "since then: sierra.toml makes other inputs" in ask(2)
    assert "submitted before" not in projects.quick(root, "run", "population_size=1", "--runs", "3", "--no-figures").stderr


@pytest.mark.integration
def test_runs_that_write_no_table_are_reported(tmp_path: Path) -> None:
    summary = sierra.open(projects.make(tmp_path, simulator="pass\n")).run("population_size=1")
    assert any("no run wrote a table" in note for note in summary.notes)


@pytest.mark.nightly
def test_a_figure_with_misspelt_columns_is_reported(tmp_path: Path) -> None:
    wrong = (
        '[outputs.swarm]\nfile = "swarm.csv"\ntime = "tik"\n[figures.a]\ncolumn = "coverage"\n[figures.b]\ncolumn = "coverge"\n'
    )
    notes = sierra.open(projects.make(tmp_path, projects.CONFIG + wrong)).run("population_size=1,2").notes
    assert "figure a: output 'swarm' has no column 'tik' for its time ([outputs.swarm] time); did you mean 'tick'?" in notes
    assert any(note.startswith("figure b: no output has 'coverge' as numeric columns") for note in notes)
