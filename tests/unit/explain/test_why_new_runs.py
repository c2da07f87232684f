"""Reasons for new executions, also of queries that are not recorded themselves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import projects


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A project with two recorded experiments, whose program has changed since then."""
    program = tmp_path / "simulator"
    program.write_text("#!/bin/sh\nprintf 'tick,value\\n0,1\\n' > swarm.csv\n")
    program.chmod(0o755)
    folder = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", str(program)))
    projects.run(folder, "population_size=1,2", "--runs", "1")
    program.write_text(program.read_text() + "# edited\n")
    return folder


@pytest.mark.integration
@pytest.mark.parametrize("query", ["population_size=1", "population_size=2,3", "population_size=1,2"])
def test_a_query_that_is_new_is_explained_by_the_programs_of_its_recorded_runs(root: Path, query: str) -> None:
    done = projects.quick(root, "run", query, "--runs", "1", "--dry-run", "--explain")
    assert (done.returncode, done.stderr) == (0, "")
    assert "executed with other programs" in done.stdout
    assert "simulator: " in done.stdout


@pytest.mark.integration
@pytest.mark.parametrize("query", [("population_size=1,2", "--set", "//noise=0.2"), ("population_size=2,3", "--runs", "3")])
def test_a_plan_is_compared_in_the_same_words_as_the_batch_that_it_becomes(tmp_path: Path, query: tuple[str, ...]) -> None:
    folder = projects.make(tmp_path / "project", projects.CONFIG)
    before, _ = projects.run(folder, "population_size=1,2")
    based = 'seed = { set = "//random/@seed", base = 7 }'
    config = projects.CONFIG.replace('seed = "//random/@seed"', based) + '[environment]\nset = { SPEED = "2" }\n'
    (folder / "sierra.toml").write_text(config)
    planned = json.loads(projects.quick(folder, "run", *query, "--dry-run", "--explain", "--json").stdout)["new_because"]
    after, _ = projects.run(folder, *query)
    differences = json.loads(projects.quick(folder, "diff", before["batch"], after["batch"], "--json").stdout)["differences"]
    kinds = ("query", "variables", "seed")
    assert planned[1:] == [one["line"] for one in differences if one["kind"] in kinds and one["name"] != "seed"]
    assert {one["kind"] for one in differences} >= set(kinds)


@pytest.mark.integration
def test_other_arguments_with_the_same_words_are_a_difference_of_the_command(tmp_path: Path) -> None:
    folder = projects.make(tmp_path / "project", projects.CONFIG.replace("{input}", "{input} 'a b'"))
    projects.run(folder, "population_size=1")
    (folder / "sierra.toml").write_text(projects.CONFIG.replace("{input}", "{input} a b"))
    explained = json.loads(projects.quick(folder, "run", "population_size=1", "-n", "--explain", "--json").stdout)
    assert explained["new_because"][1:] == [
        "command: python3 {project}/sim.py {input} 'a b' → python3 {project}/sim.py {input} a b"
    ]
