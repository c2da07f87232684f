"""Queries are planned where a program of the runs is missing: the ids are the same, but nothing is executed there."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

import sierra
from sierra.errors import Missing
from tests import projects

QUERY = ("population_size=1,2", "--runs", "2")
LACKING = "the program 'simulate' was not found"


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project whose simulator is in PATH, and that has executed a query."""
    base = tmp_path_factory.mktemp("simulator")
    config = projects.CONFIG.replace("python3 sim.py", "simulate")
    folder = projects.make(base / "project", config, simulator=f"#!/usr/bin/env python3\n{projects.SIMULATOR}")
    (base / "bin").mkdir()
    program = base / "bin" / "simulate"
    shutil.move(folder / "sim.py", program)
    program.chmod(0o755)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
        projects.run(folder, *QUERY)
        assert projects.quick(folder, "run", *QUERY, "--inputs", str(base / "there")).returncode == 0
    return folder


def files(folder: Path) -> dict[Path, bytes]:
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_inputs_are_the_same_without_the_simulator(executed: Path, tmp_path: Path) -> None:
    done = projects.quick(executed, "run", *QUERY, "--inputs", str(tmp_path / "inputs"))
    assert (done.returncode, projects.other_notes(done.stderr)) == (0, "")
    assert files(tmp_path / "inputs") == files(executed.parent / "there")


@pytest.mark.parametrize("query", [QUERY, ("{batch}",)], ids=["criteria", "a recorded batch"])
def test_a_preview_names_the_missing_program(executed: Path, query: tuple[str, ...]) -> None:
    [batch] = json.loads(projects.quick(executed, "ls", "--json").stdout)
    words = [word.format(batch=batch["batch"]) for word in query]
    done = projects.quick(executed, "run", *words, "--dry-run", "--json")
    assert done.returncode == 0, done.stderr
    preview = json.loads(done.stdout)
    assert (preview["batch"], preview["runs"], preview["to_execute"]) == (batch["batch"], 4, 4)
    [note] = [text for text in preview["notes"] if LACKING in text]
    assert note.startswith("nothing can be executed or reused here: ")
    assert f"note: {note}\n" in done.stderr
    assert "\n" not in note


@pytest.mark.parametrize(
    "words",
    [
        ("run", *QUERY),
        ("run", *QUERY, "--explain"),
        ("run", *QUERY, "--until", "ci(coverage) < 1", "--max-runs", "9"),
        ("try", "population_size=1"),
    ],
    ids=["run", "explained", "study", "try"],
)
def test_nothing_is_executed_without_the_program(executed: Path, words: tuple[str, ...]) -> None:
    before = files(executed / ".sierra")
    done = projects.quick(executed, *words)
    assert (done.returncode, LACKING in done.stderr) == (3, True), done.stderr
    assert files(executed / ".sierra") == before


def test_the_plan_names_the_program_and_is_not_executed(executed: Path) -> None:
    project = sierra.open(executed)
    plan = project.plan("population_size=1,2", runs=2)
    assert LACKING in plan.lacking
    with pytest.raises(Missing, match=LACKING):
        project.execute(plan)


def test_why_still_says_that_the_query_cannot_be_repeated(executed: Path) -> None:
    assert LACKING in projects.quick(executed, "why").stdout
