"""Commands about a batch take the name of a query in sierra.toml for it, as `sierra run` does."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import projects

QUERY = """
[queries.sizes]
criteria = "population_size=1,2"
runs = 1
[queries.four]
criteria = "population_size=4"
runs = 1
[package]
title = "A swarm"
license = "MIT"
authors = [{ name = "A. Person" }]
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    folder = projects.make(tmp_path / "project")
    with (folder / "sierra.toml").open("a") as file:
        file.write(QUERY)
    assert projects.quick(folder, "run", "sizes", "--no-figures").returncode == 0
    assert projects.quick(folder, "run", "population_size=4", "--runs", "1", "--no-figures").returncode == 0
    return folder


def _batch(project: Path, query: str) -> str:
    [found] = [one["batch"] for one in json.loads(projects.quick(project, "ls", "--json").stdout) if one["query"] == query]
    return str(found)


CODES = {
    "show NAME": 0,
    "show NAME --files": 0,
    "stats swarm coverage -b NAME": 0,
    "why NAME": 0,
    "rm NAME --dry-run": 0,
    "diff NAME four": 1,
    "attach NAME": 2,
    "cancel NAME": 2,
}


@pytest.mark.parametrize("words", CODES)
def test_a_name_stands_for_the_batch_of_the_query(project: Path, words: str) -> None:
    batch = _batch(project, "population_size=1,2")
    named, identified = (projects.quick(project, *words.replace("NAME", word).split()) for word in ("sizes", batch))
    assert (named.returncode, named.stderr) == (CODES[words], identified.stderr)
    assert named.stdout == identified.stdout


@pytest.mark.integration
def test_a_batch_is_packed_and_replayed_by_the_name_of_its_query(project: Path) -> None:
    replayed = projects.quick(project, "replay", "sizes")
    assert (replayed.returncode, replayed.stdout.count("identical")) == (0, 2), replayed.stdout
    assert projects.quick(project, "package", "sizes", "-o", "../sizes.zip", "--yes", "--no-report").returncode == 0
    assert "population_size=1,2" in projects.quick(project, "open", "../sizes.zip").stdout


def test_a_query_that_has_not_been_run_with_this_code_is_named(project: Path) -> None:
    (project / "sim.py").write_text(projects.SIMULATOR + "\n")
    for words in ("show sizes", "package sizes -o x.zip", "replay sizes", "stats swarm coverage -b sizes"):
        refused = projects.quick(project, *words.split())
        assert refused.returncode != 0
        assert "the query 'sizes' has not been run with this project as it is; see sierra ls" in refused.stderr


def test_a_name_that_begins_an_id_of_something_else_is_refused(project: Path) -> None:
    ids = "SELECT run AS id FROM runs UNION ALL SELECT experiment FROM experiments UNION ALL SELECT execution FROM executions"
    asked = projects.quick(project, "sql", f"SELECT min(id) FROM ({ids}) WHERE id > 'a'", "-f", "csv")
    other = asked.stdout.split()[1]
    config = (project / "sierra.toml").read_text()
    (project / "sierra.toml").write_text(config.replace("[queries.sizes]", f'[queries."{other[:6]}"]'))
    refused = projects.quick(project, "show", other[:6])
    assert refused.returncode == 2
    assert "is the name of a query, and an id begins with it" in refused.stderr
    assert projects.quick(project, "show", other[:9]).returncode == 0


def test_records_are_shown_whatever_the_file_says(project: Path) -> None:
    batch = _batch(project, "population_size=1,2")
    with (project / "sierra.toml").open("a") as file:
        file.write("\n[nonsense]\n")
    assert projects.quick(project, "show", batch).returncode == 0
    assert projects.quick(project, "show", batch, "--files").returncode == 0
    assert "nonsense" in projects.quick(project, "show", "sizes").stderr


def test_names_of_queries_and_programs_of_a_package_are_not_used(project: Path, tmp_path: Path) -> None:
    mark = tmp_path / "executed"
    with (project / "sierra.toml").open("a") as file:
        file.write(f'\n[models.evil]\ncolumn = "coverage"\ncommand = ["touch", "{mark}"]\n')
    batch = _batch(project, "population_size=1,2")
    packed = projects.quick(project, "package", batch, "-o", "../x.zip", "--yes", "--no-report")
    assert packed.returncode == 0, packed.stderr
    mark.unlink(missing_ok=True)
    for words, message in {
        ("stats", "--models"): "nothing of a package is executed",
        ("ls", "--jobs"): "nothing of a package is executed",
        ("show", "sizes"): "'sizes' is not an id",
    }.items():
        refused = projects.quick(project, "open", "../x.zip", *words)
        assert refused.returncode != 0
        assert message in refused.stderr
    assert not mark.exists()
