"""Observed runs that use other files than their siblings are reported, unless the seed chooses the files by design."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests import projects
from tests.waiting import until

CODE = """\
import ctypes, os, sys
here = os.path.dirname(os.path.abspath(sys.argv[0]))
text = open(sys.argv[1]).read()
seed = int(text.split('<random seed="')[1].split('"')[0])
count = int(text.split('<swarm count="')[1].split('"')[0])
order = {seeds}.index(seed)
print("tick,value\\n1,2", file=open("swarm.csv", "w"))
"""
DIFFERS = "some observed runs used files that others of their experiment did not: "


@pytest.fixture
def said(tmp_path: Path, require: Callable[..., str]) -> Callable[[str], tuple[str, Path]]:
    """Return a function that executes code in three runs of two experiments, and returns what was said, and the project.

    In the code, `order` is the number of the run in its experiment, and `count` that of the experiment.
    """
    require("strace")

    def execute(code: str) -> tuple[str, Path]:
        config = projects.CONFIG.replace("runs = 2", 'runs = 3\nobserve = "all"').replace("sim.py", "../simulator/sim.py")
        root = projects.make(tmp_path / "project", config)
        planned = projects.quick(root, "run", "population_size=1", "-n", "--json")
        assert planned.returncode == 0, planned.stderr
        folder = tmp_path / "simulator"
        folder.mkdir()
        for name in ("1.txt", "2.txt", "0.txt", "extra"):
            (folder / name).write_text(name)
        (folder / "sim.py").write_text(CODE.format(seeds=seeds(root)) + code)
        done = projects.quick(root, "run", "population_size=1,2", "-j", "1", "--no-figures")
        assert done.returncode == 0, done.stderr
        return projects.other_notes(done.stderr), root

    return execute


def seeds(root: Path) -> list[int]:
    """Return the seeds of three runs."""
    from sierra.api import Project

    plan = Project(root).plan("population_size=1", runs=3)
    return [run.seed for run in plan.batch.runs]


def sql(root: Path, statement: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(projects.quick(root, "sql", "--format", "json", statement).stdout)
    return found


@pytest.mark.integration
def test_a_run_that_reads_a_file_that_its_siblings_do_not_read_is_reported(said: Callable[[str], tuple[str, Path]]) -> None:
    text, root = said('if order == 1 and count == 2: open(here + "/extra").read()')
    assert DIFFERS + f"{root.parent}/simulator/extra (by 1 of 3, e.g. run " in text
    assert text.count("note:") == 1


@pytest.mark.nightly
def test_runs_that_use_the_same_files_are_not_reported(said: Callable[[str], tuple[str, Path]]) -> None:
    assert said('open(here + "/extra").read()')[0] == ""


@pytest.mark.nightly
def test_files_that_differ_between_experiments_are_not_reported(said: Callable[[str], tuple[str, Path]]) -> None:
    assert said('open(here + f"/{count}.txt").read()')[0] == ""


@pytest.mark.nightly
def test_files_of_one_kind_that_the_seed_chooses_are_not_reported(said: Callable[[str], tuple[str, Path]]) -> None:
    assert said('open(here + f"/{order}.txt").read()')[0] == ""


@pytest.mark.nightly
def test_a_choice_that_not_every_run_makes_is_reported(said: Callable[[str], tuple[str, Path]]) -> None:
    text, root = said('if order < 2: open(here + f"/{order}.txt").read()')
    assert DIFFERS + f"{root.parent}/simulator/0.txt (by 1 of 3" in text


@pytest.mark.integration
def test_another_program_is_reported_although_each_run_has_one_of_its_own(said: Callable[[str], tuple[str, Path]]) -> None:
    assert "/bin/" in said('os.system(["true", "uname >program.txt", "ls / >program.txt"][order])')[0].partition(DIFFERS)[2]


@pytest.mark.integration
def test_a_file_that_a_run_reads_and_writes_is_no_input(said: Callable[[str], tuple[str, Path]]) -> None:
    text, _ = said('if order: open(here + "/cache", "a+").read()')
    assert DIFFERS not in text


@pytest.mark.integration
def test_a_file_that_another_process_changes_between_two_runs_is_reported(
    said: Callable[[str], tuple[str, Path]], tmp_path: Path
) -> None:
    folder = tmp_path / "simulator"

    def change() -> None:
        until((folder / "asked").exists)
        (folder / "extra").write_text("other")
        (folder / "changed").touch()

    other = threading.Thread(target=change)
    other.start()
    ask = 'open(here + "/asked", "w")\n    while not os.path.exists(here + "/changed"): time.sleep(0.01)'
    text, _ = said(f'import time\nif order == 1 and count == 1:\n    {ask}\nopen(here + "/extra").read()')
    other.join()
    assert f"files changed between observed runs of this batch, so that its runs are not comparable: {folder}/extra" in text
