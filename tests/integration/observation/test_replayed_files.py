"""A replay says which files are not those that the recorded executions used, before it blames chance."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests import projects, stores
from tests.tiers import at_night

SIMULATOR = """\
import os, sys, time
factor = open(os.environ["LIBRARY"] + "/factor").read()
extra = os.path.exists(os.environ["LIBRARY"] + "/extra")
noise = time.time_ns() if "noise" in factor else 0
print("tick,value", *(f"{tick},{len(factor) + extra + noise}" for tick in range(3)), sep="\\n", file=open("swarm.csv", "w"))
"""
Make = Callable[..., Path]


@pytest.fixture
def make(tmp_path: Path, require: Callable[..., str]) -> Make:
    """Return a function that makes a project whose runs read a file outside the project that nothing names."""
    require("strace")
    library = tmp_path / "library"
    library.mkdir()

    def made(observe: str, factor: str) -> Path:
        (library / "factor").write_text(factor)
        config = projects.CONFIG.replace("runs = 2", f'runs = 2\nobserve = "{observe}"')
        return projects.make(
            tmp_path / "project", config + f'[environment]\nset = {{ LIBRARY = "{library}" }}\n', simulator=SIMULATOR
        )

    return made


def replay(root: Path, batch: str) -> tuple[int, dict[str, Any]]:
    done = projects.quick(root, "replay", batch, "--json")
    return done.returncode, json.loads(done.stdout)


@pytest.mark.nightly
@pytest.mark.each_case
@pytest.mark.parametrize(("observe", "same"), [("all", True), ("first", None), *at_night([("none", None)])])
def test_the_same_files_are_only_said_where_they_were_observed(make: Make, observe: str, *, same: bool | None) -> None:
    root = make(observe, "noise")
    batch = stores.ask(root, "population_size=1,2")
    said = projects.quick(root, "replay", batch).stdout
    assert ("all files that the runs used, are the same" in said) is (observe == "all")
    assert ("was not recorded" in said) is (observe != "all")
    assert ("only 2 of 4 runs were observed" in said) is (observe == "first")
    code, answer = replay(root, batch)
    assert (code, answer["verdict"], answer["same_files"]) == (1, "different", same)


@pytest.mark.parametrize("observe", ["all", "first"])
def test_a_changed_file_is_named_before_chance_is_blamed(make: Make, observe: str) -> None:
    root = make(observe, "one")
    batch = stores.ask(root, "population_size=1,2")
    (root.parent / "library" / "factor").write_text("other")
    done = projects.quick(root, "replay", batch)
    assert done.returncode == 1
    assert f"are not the same now: {root.parent}/library/factor" in done.stdout + done.stderr
    assert "randomness" not in done.stdout
    assert replay(root, batch)[1]["same_files"] is False


@pytest.mark.nightly
def test_a_file_that_has_come_since_is_named(make: Make) -> None:
    root = make("all", "one")
    batch = stores.ask(root, "population_size=1")
    (root.parent / "library" / "extra").touch()
    code, answer = replay(root, batch)
    assert code == 1
    assert [note for note in answer["notes"] if note.endswith(f"not the same now: {root.parent}/library/extra")]


def test_a_name_that_has_come_into_a_listed_folder_leaves_the_files_in_doubt(make: Make) -> None:
    root = make("all", "noise")
    (root / "sim.py").write_text("import os\nos.listdir(os.environ['LIBRARY'])\n" + SIMULATOR)
    batch = stores.ask(root, "population_size=1")
    assert replay(root, batch)[1]["same_files"] is True
    (root.parent / "library" / "new").touch()
    assert replay(root, batch)[1]["same_files"] is None
    assert "may be found elsewhere" in projects.quick(root, "replay", batch).stdout


@pytest.mark.nightly
def test_an_identical_replay_with_the_same_files_has_no_notes(make: Make) -> None:
    root = make("all", "one")
    code, answer = replay(root, stores.ask(root, "population_size=1"))
    assert (code, answer["verdict"], answer["notes"], answer["same_files"]) == (0, "identical", [], True)


@pytest.mark.nightly
def test_changed_source_is_restored_and_is_no_difference(make: Make) -> None:
    root = make("all", "one")
    batch = stores.ask(root, "population_size=1")
    (root / "sim.py").write_text("print('other')\n")
    code, answer = replay(root, batch)
    assert (code, answer["notes"], answer["same_files"]) == (0, [], True)
