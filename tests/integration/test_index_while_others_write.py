"""Readers get the same answers with the index and without it while another process records, removes, merges and builds."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import sierra
from sierra.store import index_builder, index_files
from sierra.store.store import Store
from tests import stores

TESTS = Path(__file__).parents[2]
WRITER = """
import sys
import sierra
from sierra.store import index_builder
index_builder.WORTH = 1  # build after each command
project = sierra.open(sys.argv[1])
for step in range(int(sys.argv[2])):
    batch = project.run(f"noise=0.{step + 11}", runs=1, figures=False).batch
    if step % 2:
        project.records.remove(batch)
    if step % 3 == 0:
        project.maintenance.collect()
"""
BUILDER = """
import sys
from pathlib import Path
from sierra.store import index_builder, layout
index_builder.build(layout.StorePaths(Path(sys.argv[1])))
"""
STATEMENTS = (
    "SELECT count(*) FROM runs",
    "SELECT * FROM effective ORDER BY ALL",
    "SELECT run, tick, coverage FROM swarm ORDER BY ALL",
    "SELECT * FROM artifacts ORDER BY ALL",
)


def answers(store: Store) -> list[object]:
    with store.snapshot() as snapshot:
        return [snapshot.sql(statement).to_pylist() for statement in STATEMENTS]


@pytest.mark.parametrize("steps", [3, pytest.param(40, marks=pytest.mark.nightly)])
def test_answers_are_the_same_while_others_write(recorded: Path, tmp_path: Path, steps: int) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    store = Store(root / ".sierra")
    assert index_builder.build(store.paths) is not None
    environment = {**os.environ, "PYTHONPATH": str(TESTS)}
    words = [sys.executable, "-c", WRITER, str(root), str(steps)]
    compared, used = 0, set()
    with subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as writer:
        ended = False
        while not ended:
            ended = writer.poll() is not None
            before = store.names()
            found, wanted = answers(store), answers(store.unindexed())
            if store.names() == before:
                assert found == wanted
                compared += 1
            used |= {path.name for path in index_files.published(store.paths.index)}
        assert writer.stderr is not None
        assert writer.returncode == 0, writer.stderr.read()
    assert compared
    assert len(used) > 1
    assert sierra.open(root).maintenance.fsck().sound


def test_two_builders_at_once_both_succeed(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    store = Store(root / ".sierra")
    without = answers(store)
    with store.snapshot():  # which reads meanwhile
        both = [subprocess.Popen([sys.executable, "-c", BUILDER, root / ".sierra"]) for _ in range(2)]
        assert [one.wait() for one in both] == [0, 0]
    assert index_files.published(store.paths.index)
    assert answers(store) == without
    assert sierra.open(root).maintenance.fsck().sound
