"""A trial that somebody marked as invalid is kept, does not count, and is executed once more."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import sierra
from sierra.config.project_file import load
from sierra.deliverables.report import batch_state
from sierra.errors import NotFound, UsageError
from sierra.extensions.trials import mark_trial
from sierra.extensions.trials.report_section import section
from tests import projects, stores


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = projects.make(tmp_path / "p")
    stores.ask(root, "population_size=2")
    return root


@pytest.mark.integration
def test_an_invalid_trial_does_not_count_and_its_run_is_executed_again(root: Path) -> None:
    project = sierra.open(root)
    first = projects.sql(root, "SELECT run, execution FROM effective ORDER BY run")
    marked = projects.quick(
        root, "trial", "invalid", first[0]["execution"][:12], "--reason", "robot 2 fell", "--operator", "Ada"
    )
    assert marked.returncode == 0, marked.stderr
    assert projects.sql(root, "SELECT execution, status, reason FROM executions WHERE status <> 'ok'") == [
        {"execution": first[0]["execution"], "status": "invalid", "reason": "invalid trial: robot 2 fell"}
    ]
    assert projects.sql(root, "SELECT DISTINCT run FROM swarm") == [{"run": first[1]["run"]}]
    listed = projects.quick(root, "ls").stdout
    assert "complete" not in listed
    assert "failed" in listed
    summary = project.run("population_size=2", figures=False)
    assert (summary.executed, summary.reused) == (1, 1)
    assert projects.sql(root, "SELECT count(*) AS executions FROM executions") == [{"executions": 3}]
    shown = project.records.show(first[0]["execution"]).as_dict()["trials"]
    assert [(one["valid"], one["reason"], one["operator"]) for one in shown] == [(False, "robot 2 fell", "Ada")]
    assert not project.maintenance.fsck().findings


@pytest.mark.integration
def test_the_last_mark_counts_and_earlier_ones_stay(root: Path) -> None:
    project = sierra.open(root)
    [run, _] = [row["run"] for row in projects.sql(root, "SELECT run FROM effective ORDER BY run")]
    row = mark_trial(project, run, valid=False, reason="wet floor", note="at noon")
    mark_trial(project, row.execution, valid=True)
    assert projects.sql(root, "SELECT valid, reason, note FROM all_trials ORDER BY lamport") == [
        {"valid": False, "reason": "wet floor", "note": "at noon"},
        {"valid": True, "reason": None, "note": "at noon"},
    ]
    assert projects.sql(root, "SELECT valid, note FROM trials") == [{"valid": True, "note": "at noon"}]
    assert projects.sql(root, "SELECT count(*) AS runs FROM effective") == [{"runs": 2}]


@pytest.mark.integration
def test_a_report_says_which_trials_count(root: Path) -> None:
    project = sierra.open(root)
    first, other = (row["execution"] for row in projects.sql(root, "SELECT execution FROM effective ORDER BY run"))
    mark_trial(project, first, valid=False, reason="wet floor")
    project.run("population_size=2", figures=False)
    mark_trial(project, first, valid=True)  # but a later execution counts
    mark_trial(project, other, note="at noon")
    found = section(batch_state.read(load(root), project.store, project.records.batch()))
    assert found is not None
    assert re.findall(r"<td[^>]*>(yes|no)</td>", found.body) == ["no", "yes"]


def test_marks_without_a_reason_or_an_execution_are_refused(root: Path) -> None:
    project = sierra.open(root)
    [run, _] = [row["run"] for row in projects.sql(root, "SELECT run FROM effective ORDER BY run")]
    with pytest.raises(UsageError, match="an invalid trial needs a reason"):
        mark_trial(project, run, valid=False, reason=" ")
    with pytest.raises(UsageError, match="note: use one line"):
        mark_trial(project, run, note="one\ntwo")
    with pytest.raises(NotFound, match="is a batch; name one execution"):
        mark_trial(project, str(project.batches[-1].batch), note="x")
    mark_trial(project, run, valid=False, reason="gone")
    with pytest.raises(NotFound, match="has no execution that counts"):
        mark_trial(project, run, valid=False, reason="twice")
