"""Commands about a batch take the name of a query in sierra.toml for it, as `sierra run` does."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import projects

QUERY = """
[queries.sizes]
criteria = "population_size=1,2"
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


@pytest.mark.parametrize("words", ["show NAME", "show NAME --files", "stats swarm coverage -b NAME"])
def test_a_name_stands_for_the_batch_of_the_query(project: Path, words: str) -> None:
    batch = projects.quick(project, "sql", "SELECT batch FROM batches ORDER BY created LIMIT 1", "-f", "csv").stdout.split()[1]
    named, identified = (projects.quick(project, *words.replace("NAME", word).split()) for word in ("sizes", batch))
    assert (named.returncode, named.stderr) == (0, identified.stderr)
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
