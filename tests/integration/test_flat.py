"""A command costs what it does, not what the project has been through: its work is counted in two stores."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

import sierra
from sierra.store import index_builder
from sierra.store.layout import StorePaths
from tests import large_stores, projects, stores

FEW, COPIES = 10, 100
TESTS = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """Return a project with few segments, the same with hundreds, and a batch of both; an index names all segments."""
    small = projects.make(tmp_path_factory.mktemp("flat") / "small")
    for query in ("population_size=9", "population_size=1,2"):  # the second one records only what is new
        batch = sierra.open(small).run(query, figures=False).batch
    large_stores.multiply(small, batch, FEW)
    large = stores.copy(small, small.with_name("large"))
    large_stores.multiply(large, batch, COPIES, first=FEW + 1)
    for root in (small, large):
        assert index_builder.build(StorePaths(root / ".sierra")) is not None
    return small, large, batch


def counts(root: Path, *arguments: str) -> Mapping[str, int]:
    target = root.with_suffix(".json")
    command = [sys.executable, "-m", "tests.support.counted", str(target), *arguments]
    subprocess.run(command, check=True, capture_output=True, cwd=root, env={**os.environ, "PYTHONPATH": str(TESTS)})
    found: dict[str, int] = json.loads(target.read_text())
    return found


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    "arguments",
    [
        ["ls"],
        ["sql", "SELECT count(*) FROM runs"],
        ["show", "{batch}"],
        ["files", "{batch}"],
        ["why", "{batch}"],
        ["run", "population_size=1,2", "-n"],
        ["run", "population_size=1,2", "--no-figures"],
        ["run", "population_size=3", "--no-figures"],
    ],
    ids=" ".join,
)
def test_a_command_does_the_same_work_in_a_large_store(both: tuple[Path, Path, str], arguments: list[str]) -> None:
    small, large, batch = both
    words = [word.format(batch=batch) for word in arguments]
    for root in (small, large):
        counts(root, *words)  # caches have what the first of these commands puts there
    assert counts(large, *words) == counts(small, *words)


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    "arguments", [["ls"], ["show", "{batch}"], ["run", "population_size=1,2", "--no-figures"]], ids=" ".join
)
def test_segments_that_an_index_does_not_name_cost_no_more_each_if_there_are_more(
    both: tuple[Path, Path, str], tmp_path: Path, arguments: list[str]
) -> None:
    _, large, batch = both
    words = [word.format(batch=batch) for word in arguments]
    found = []
    for copies in (0, 3, 9):
        root = stores.copy(large, tmp_path / f"{copies} copies")
        large_stores.multiply(root, batch, copies, first=FEW + COPIES + 1)
        counts(root, *words)
        found.append(counts(root, *words))
    none, three, nine = found
    for what in none.keys() - {"modules"}:  # many files are hashed by several threads
        assert nine[what] - none[what] <= 3.5 * (three[what] - none[what]), what
