"""Recorded objects as Python values and as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import sierra
from sierra.execution.shown_records import ShownBatch, ShownExecution, ShownExperiment, ShownRun, ShownSession
from tests import projects, stores


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = projects.make(tmp_path_factory.mktemp("shown") / "project")
    stores.ask(root, "population_size=1,2", runs=1)
    return root


@pytest.mark.integration
def test_each_kind_of_object_has_a_class_whose_form_in_json_is_printed(root: Path) -> None:
    project = sierra.open(root)
    batch = project.records.show(project.batches[0].batch)
    assert isinstance(batch, ShownBatch)
    experiment = project.records.show(batch.experiments[0].experiment)
    assert isinstance(experiment, ShownExperiment)
    run = project.records.show(experiment.runs[0].run)
    assert isinstance(run, ShownRun)
    execution = project.records.show(run.executions[0].execution)
    assert isinstance(execution, ShownExecution)
    session = project.records.show(batch.sessions[0].session)
    assert isinstance(session, ShownSession)
    for shown, identity in (
        (batch, batch.row.batch),
        (experiment, experiment.experiment),
        (run, str(run.row["run"])),
        (execution, execution.row.execution),
        (session, session.session),
    ):
        printed = json.loads(projects.quick(root, "show", identity, "--json").stdout)
        assert (printed["kind"], list(printed)) == (shown.kind, list(shown.as_dict()))


@pytest.mark.integration
def test_values_of_experiments_are_columns_in_json(root: Path) -> None:
    project = sierra.open(root)
    batch = project.records.show(project.batches[0].batch)
    assert isinstance(batch, ShownBatch)
    assert [one.values for one in batch.experiments] == [{"population_size": 1}, {"population_size": 2}]
    printed = json.loads(projects.quick(root, "show", batch.row.batch, "--json").stdout)
    assert [one["population_size"] for one in printed["experiments"]] == [1, 2]


def test_columns_of_a_run_and_an_execution_that_are_null_are_left_out_of_json(root: Path) -> None:
    project = sierra.open(root)
    [execution, _] = project.sql("SELECT execution FROM executions").column(0).to_pylist()
    shown = project.records.show(execution)
    assert isinstance(shown, ShownExecution)
    assert shown.row.signal is None
    assert not {"signal", "attempt", "isolation"} & shown.as_dict().keys()
