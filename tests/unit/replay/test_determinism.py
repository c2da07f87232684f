"""Runs whose output changes when they are executed again are detected, recorded and displayed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import sierra
from tests import projects

NOISY = projects.SIMULATOR.replace("count * tick", "__import__('time').time_ns() % 1000 + count * tick")
PROBE = "[determinism]\nprobe = true\n"


def make(folder: Path, simulator: str, more: str = "") -> sierra.Project:
    return sierra.open(projects.make(folder / "project", projects.CONFIG + more, simulator=simulator))


@pytest.mark.integration
def test_ls_and_show_report_runs_whose_output_changed_in_a_replay(tmp_path: Path) -> None:
    project = make(tmp_path, NOISY)
    batch = project.run("population_size=1,2", figures=False).batch
    assert [row.nondeterministic for row in project.batches] == [0]
    [first] = [run.taken.run for run in project.replay(batch, runs=1).runs][:1]
    assert [row.nondeterministic for row in project.batches] == [2]
    assert "2 not deterministic" in projects.quick(project.root, "ls").stdout
    shown = project.records.show(first).nondeterminism
    assert [(row.executions, row.results, row.verdict) for row in shown] == [(2, 2, "different")]
    assert len(project.records.show(batch).nondeterminism) == 2
    assert "nondeterminism:" in projects.quick(project.root, "show", first).stdout


@pytest.mark.nightly
def test_equal_outputs_and_declared_differences_are_not_reported(tmp_path: Path) -> None:
    project = make(tmp_path, projects.SIMULATOR)
    project.replay(project.run("population_size=1", figures=False).batch)
    assert [row.nondeterministic for row in project.batches] == [0]
    declared = '[outputs.swarm]\nfile = "swarm.csv"\nvolatile = ["coverage"]\n'
    other = make(tmp_path / "other", NOISY, declared)
    assert other.replay(other.run("population_size=1", figures=False).batch).verdict == "equal"
    assert [row.nondeterministic for row in other.batches] == [0]
    assert other.sql("SELECT DISTINCT verdict FROM nondeterminism").to_pylist() == [{"verdict": "equal"}]


@pytest.mark.integration
def test_nondeterminism_is_detected_in_runs_executed_again_without_a_replay(tmp_path: Path) -> None:
    project = make(
        tmp_path, NOISY, '[store]\nraw = false\n[outputs.swarm]\nfile = "swarm.csv"\n'
    )  # else they are evaluated again by changed rules
    batch = project.run("population_size=1", figures=False).batch
    config = project.root / "sierra.toml"
    config.write_text(config.read_text().replace("[outputs.swarm]", "[outputs.other]"))
    again = sierra.open(project.root).run("population_size=1", figures=False)
    assert (again.batch, again.executed, again.reexecuted) == (batch, 2, 2)
    assert [row.nondeterministic for row in project.batches] == [2]
    assert [row.verdict for row in project.records.show(batch).nondeterminism] == [None, None]


@pytest.mark.integration
def test_changed_programs_are_not_reported_as_nondeterminism(tmp_path: Path) -> None:
    program = tmp_path / "sim"
    program.write_text("#!/bin/sh\nprintf 'tick,v\\n0,1\\n' > out.csv\n")
    program.chmod(0o755)
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", str(program)))
    project = sierra.open(root)
    project.run("population_size=1", figures=False)
    program.write_text("#!/bin/sh\nprintf 'tick,v\\n0,2\\n' > out.csv\n")
    assert project.run("population_size=1", figures=False).reexecuted == 2
    assert [row.nondeterministic for row in project.batches] == [0]


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    ("simulator", "said"),
    [
        (projects.SIMULATOR, "was executed twice: both executions wrote the same bytes"),
        (NOISY, "the second execution is different: swarm.csv: row 0: 'coverage' was"),
    ],
)
def test_a_probe_executes_one_run_twice_before_the_batch_and_reports_the_result(
    tmp_path: Path, simulator: str, said: str
) -> None:
    project = make(tmp_path, simulator, PROBE)
    ended = projects.quick(project.root, "run", "population_size=1,2", "--json", "--no-figures")
    answer = json.loads(ended.stdout)
    assert ended.returncode == 0
    assert (answer["runs"], answer["failed"] + answer["missing"]) == (4, 0)
    assert said in answer["notes"][0]
    counts = project.sql("SELECT purpose, count(*) AS n FROM executions GROUP BY ALL ORDER BY 1").to_pylist()
    assert counts == [{"purpose": "replay", "n": 1}, {"purpose": "run", "n": 4}]
    assert not json.loads(projects.quick(project.root, "run", "population_size=1,2", "--json", "--no-figures").stdout)["notes"]


@pytest.mark.nightly
def test_a_probe_of_a_failed_run_reports_nothing(tmp_path: Path) -> None:
    project = make(tmp_path, "raise SystemExit(3)", PROBE)
    summary = project.run("population_size=1,2", figures=False)
    assert (summary.failed, [note for note in summary.notes if "twice" in note]) == (4, [])
