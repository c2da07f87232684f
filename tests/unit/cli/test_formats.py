"""Lists and statistics in formats for programs, and statistics of some rows."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from tests import projects

MEAN = ("stats", "swarm", "coverage", "--measure", "mean", "--statistic", "mean", "--json")


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = projects.make(tmp_path_factory.mktemp("formats") / "project")
    projects.run(folder, "population_size=1,2", "noise=0", "--runs", "1")
    projects.run(folder, "noise=0", "--runs", "1", "--set", "//arena/@size=20, 30")
    return folder


def test_ls_lists_full_ids_and_all_columns_as_csv(project: Path) -> None:
    batches = json.loads(projects.quick(project, "ls", "--json").stdout)
    done = projects.quick(project, "ls", "--format", "csv")
    assert (done.returncode, done.stderr) == (0, "")
    rows = list(csv.DictReader(io.StringIO(done.stdout)))
    assert [row["batch"] for row in rows] == [batch["batch"] for batch in batches]
    assert [row["overrides"] for row in rows] == ["", "//arena/@size=20, 30"]
    assert [(row["query"], row["runs"], row["state"]) for row in rows] == [
        ("population_size=1,2 noise=0", "2", "complete"),
        ("noise=0", "1", "complete"),
    ]
    assert {"controller", "scenario", "target", "changed", "study", "package", "submitted"} <= rows[0].keys()


def test_ls_as_json_is_what_the_option_json_prints(project: Path) -> None:
    assert projects.quick(project, "ls", "-f", "json").stdout == projects.quick(project, "ls", "--json").stdout
    assert projects.quick(project, "ls", "-f", "markdown").stdout.startswith("| batch | submitted | query |")
    assert "package" not in projects.quick(project, "ls").stdout


def test_cluster_jobs_are_no_csv(project: Path) -> None:
    refused = projects.quick(project, "ls", "--jobs", "--format", "csv")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert "--jobs prints a table or JSON" in refused.stderr
    assert projects.quick(project, "ls", "--jobs", "--format", "json").stdout == "[]\n"


def test_statistics_of_the_rows_that_fulfil_a_condition(project: Path) -> None:
    first = json.loads(projects.quick(project, "ls", "--json").stdout)[0]["batch"]
    whole = json.loads(projects.quick(project, *MEAN, "-b", first).stdout)
    late = json.loads(projects.quick(project, *MEAN, "-b", first, "--where", "tick >= 3").stdout)
    assert [row["mean"] for row in whole] == [2.0, 4.0]
    assert [row["mean"] for row in late] == [3.5, 7.0]


@pytest.mark.parametrize(
    ("words", "code", "complaint"),
    [
        (("swarm", "coverage", "--where", "ticks > 3"), 2, "where = 'ticks > 3'"),
        (("swarm", "coverage", "--where", "tick > 99"), 1, "where = 'tick > 99'"),
        (("--models", "--where", "tick > 3"), 2, "leave out --where"),
    ],
)
def test_a_condition_that_does_not_fit_is_named(project: Path, words: tuple[str, ...], code: int, complaint: str) -> None:
    refused = projects.quick(project, "stats", *words)
    assert (refused.returncode, refused.stdout) == (code, ""), refused.stderr
    assert complaint in refused.stderr
