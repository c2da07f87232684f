"""Queries that are submitted as a file: `sierra run query.json`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import sierra
from tests import projects
from tests.projects import quick


@pytest.fixture
def project(tmp_path: Path) -> Path:
    return projects.make(tmp_path / "project")


@pytest.mark.integration
def test_run_accepts_the_json_that_a_dry_run_printed(project: Path) -> None:
    asked = ("run", "population_size=1,2", "noise=0.5", "--runs", "1", "--set", "/arena/@size=20")
    printed = quick(project, *asked, "-n", "--json").stdout
    (project.parent / "query.json").write_text(printed)
    done = json.loads(quick(project, "run", "../query.json", "--json", "--no-figures").stdout)
    assert (done["batch"], done["executed"]) == (json.loads(printed)["batch"], 2)
    assert json.loads(quick(project, *asked, "--json", "--no-figures").stdout)["executed"] == 0


def test_run_accepts_a_file_with_only_a_request(project: Path) -> None:
    (project.parent / "query.json").write_text('{"criteria": ["population_size=1,2"], "runs": 1}')
    assert json.loads(quick(project, "run", "../query.json", "-n", "--json").stdout)["to_execute"] == 2
    plan = sierra.open(project).plan("population_size=1,2", runs=1)
    assert plan.batch.id == json.loads(quick(project, "run", "../query.json", "-n", "--json").stdout)["batch"]


def test_a_file_whose_batch_has_changed_is_reported(project: Path) -> None:
    (project.parent / "query.json").write_text(quick(project, "run", "population_size=1", "-n", "--json").stdout)
    (project / "arena.xml").write_text(projects.TEMPLATE.replace("0.1", "0.2"))
    done = quick(project, "run", "../query.json", "-n")
    assert done.returncode == 0
    assert "the project has changed since" in done.stderr


@pytest.mark.integration
def test_the_request_of_a_recorded_batch_gives_the_same_batch(project: Path) -> None:
    opened = sierra.open(project)
    batch = opened.run("noise=0.5", runs=1, sets=[("/arena/@size", "20")], figures=False).batch
    assert opened.plans.resolve(opened.plan(batch[:10]).request).batch.id == batch


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "query.json: not JSON: Expecting value"),
        ("[]", "query.json: a request should be an object, as in {"),
        ("{}", "query.json: 'criteria' is missing"),
        ('{"criteria": []}', "query.json: criteria should not be empty"),
        ('{"criteria": ["population_size=1"], "runs": 0}', "query.json: runs should be greater than 0, not 0"),
        ('{"criteria": ["population_size=1"], "run": 1}', "query.json: unknown key 'run'; did you mean 'runs'?"),
        ('{"request": {"criteria": ["x=1"], "runs": "x"}}', 'query.json: request.runs should be a whole number, not "x"'),
        ('{"request": {"criteria": ["x=1"], "run": 1}}', "query.json: unknown key 'request.run'; did you mean 'runs'?"),
        (
            '{"request": {"criteria": ["x=1"], "overrides": [{"xpath": "", "value": "1"}]}}',
            "query.json: request.overrides.0.xpath should",
        ),
    ],
)
def test_an_invalid_file_is_refused_in_one_line(project: Path, text: str, said: str) -> None:
    (project.parent / "query.json").write_text(text)
    done = quick(project, "run", "../query.json")
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_missing_file_is_refused_in_one_line(project: Path) -> None:
    done = quick(project, "run", "no.json")
    assert (done.returncode, len(done.stderr.splitlines())) == (3, 1)


def test_options_together_with_a_file_are_refused(project: Path) -> None:
    (project.parent / "query.json").write_text('{"criteria": ["population_size=1"]}')
    done = quick(project, "run", "../query.json", "--runs", "3")
    assert done.returncode == 2
    assert "complete request" in done.stderr


@pytest.mark.parametrize(
    "words", [("p\udcff=1",), ("population_size=1", "--set", "/\udcff=1"), ("population_size=1", "--scenario", "\udcff")]
)
def test_half_of_a_character_in_a_query_is_refused(project: Path, words: tuple[str, ...]) -> None:
    refused = quick(project, "run", *words, "-n")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "fault" not in refused.stderr
