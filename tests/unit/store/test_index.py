"""The index: no answer depends on it, whatever has become of it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import duckdb
import pytest

import sierra
from sierra.errors import Damaged
from sierra.store import connections, index_builder, index_files, segments, stored_results
from sierra.store.layout import StorePaths
from sierra.store.schema import DERIVED, RECORDED
from sierra.store.store import Store
from tests import projects, stores

STATEMENTS = (
    *(f"SELECT * FROM {name} ORDER BY ALL" for name in (*RECORDED, *DERIVED)),
    "SELECT * FROM swarm ORDER BY ALL",
    "SELECT * FROM notes ORDER BY ALL",
    "DESCRIBE runs",
    "SHOW TABLES",
    "SHOW ALL TABLES",
    "SELECT table_name FROM duckdb_tables() ORDER BY ALL",
    "SHOW DATABASES",
    "SHOW/**/SCHEMAS",
    "SELECT count(*) FROM (SHOW ALL)",
    "DESCRIBE",
    "DESCRIBE -- all",
    "SELECT datname FROM pg_catalog.pg_database",
    "SELECT relname FROM pg_class",
    "SELECT name FROM sqlite_master",
)


@pytest.fixture
def project(recorded: Path, tmp_path: Path) -> Path:
    return stores.copy(recorded, tmp_path / "project")


def paths_of(root: Path) -> StorePaths:
    return StorePaths(root / ".sierra")


def answers(root: Path) -> list[object]:
    store = Store(root / ".sierra")
    found: list[object] = [store.sql(statement).to_pylist() for statement in STATEMENTS]
    found.append(sorted(segment.name for segment in store.segments()))
    found.append(store.outputs())
    return found


def keep(root: Path) -> Path:
    """Move an index aside, and return its new place."""
    [path] = index_files.published(paths_of(root).index)
    return path.rename(root / path.name)


def test_answers_are_the_same_with_an_index_and_without(project: Path) -> None:
    without = answers(project)
    assert index_builder.build(paths_of(project)) is not None
    assert answers(project) == without
    with Store(project / ".sierra").snapshot() as snapshot:
        assert snapshot.listing.rest == []


@pytest.mark.parametrize("many", [0, stored_results.LARGE])
def test_an_index_knows_only_the_segments_before_it(project: Path, many: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """New segments are read as well as it, and added to the next one.

    In a store with many runs, its results are used for those that the new segments do not touch.
    """
    monkeypatch.setattr(stored_results, "LARGE", many)
    assert index_builder.build(paths_of(project)) is not None
    sierra.open(project).run("population_size=7", runs=1, figures=False)
    with Store(project / ".sierra").snapshot() as snapshot:
        assert 0 < len(snapshot.listing.rest) < len(snapshot.listing.names)
        plan = str(snapshot.rows("EXPLAIN SELECT * FROM runs"))
        assert ("stored_runs" in plan) == (many == 0)
    old = answers(project)
    assert index_builder.build(paths_of(project)) is not None
    assert answers(project) == old
    shutil.rmtree(project / ".sierra" / "index")
    assert answers(project) == old


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def swap(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:16384] + content[20480:24576] + content[16384:20480] + content[24576:])


def shorten(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def replace(path: Path) -> None:
    path.write_text("not an index\n")


@pytest.mark.parametrize("damage", [flip, swap, shorten, replace])
def test_a_damaged_index_is_not_used(project: Path, damage: Callable[[Path], None]) -> None:
    without = answers(project)
    path = index_builder.build(paths_of(project))
    assert path is not None
    damage(path)
    assert answers(project) == without


def test_an_index_of_another_store_changes_no_answer(project: Path, tmp_path: Path) -> None:
    without = answers(project)
    other = stores.copy(project, tmp_path / "other")
    sierra.open(other).run("population_size=9", runs=1, figures=False)
    path = index_builder.build(paths_of(other))
    assert path is not None
    (project / ".sierra" / "index").mkdir()
    shutil.copy(path, project / ".sierra" / "index")
    assert answers(project) == without


def test_what_is_removed_is_in_no_index(project: Path) -> None:
    opened = sierra.open(project)
    batch = opened.batches[-1].batch
    path = index_builder.build(paths_of(project))
    assert path is not None
    assert batch.encode() in path.read_bytes()
    opened.remove(batch)
    for left in (project / ".sierra" / "segments").rglob("*"):
        assert left.is_dir() or batch.encode() not in left.read_bytes()
    assert not list(paths_of(project).index.iterdir())


def test_a_store_that_may_not_be_written_is_read_with_its_index(project: Path) -> None:
    assert index_builder.build(paths_of(project)) is not None
    for path in [project / ".sierra", project / ".sierra" / "index"]:
        path.chmod(0o555)
    with Store(project / ".sierra").snapshot() as snapshot:
        assert snapshot.listing.rest == []
    for path in [project / ".sierra", project / ".sierra" / "index"]:
        path.chmod(0o755)


@pytest.mark.parametrize(
    ("change", "table"),
    [
        ("UPDATE executions SET status = 'failed'", "executions"),
        ("UPDATE stored_runs SET executions = 5", "runs"),
        ("DELETE FROM outputs WHERE output = 'swarm'", "swarm"),
    ],
)
def test_fsck_compares_an_index_with_the_segments(project: Path, change: str, table: str) -> None:
    assert index_builder.build(paths_of(project)) is not None
    opened = sierra.open(project)
    assert not opened.fsck().findings
    path = keep(project)
    connection = duckdb.connect(str(path))
    connection.execute(change)
    connection.close()
    index_files.publish(paths_of(project), 12, path.read_bytes())
    [finding] = opened.fsck().findings
    assert finding.path.startswith("index/")
    assert f"its rows of {table} are not those of the segments" in finding.what
    opened.repair()
    assert not opened.fsck().findings
    assert not list(paths_of(project).index.iterdir())


def unindexed(root: Path) -> list[object]:
    """Return the answers without any index."""
    aside = root / "aside"
    (root / ".sierra" / "index").rename(aside)
    found = answers(root)
    aside.rename(root / ".sierra" / "index")
    return found


def test_segments_that_others_replace_do_not_count(project: Path) -> None:
    """While somebody reads, replaced segments stay on the disk, and so do indexes with their rows."""
    opened = sierra.open(project)
    assert index_builder.build(paths_of(project)) is not None
    with opened.store.snapshot():
        opened.remove(opened.batches[-1].batch)
        assert answers(project) == unindexed(project)
        opened.collect()
        assert answers(project) == unindexed(project)
        assert index_builder.build(paths_of(project)) is not None
        assert answers(project) == unindexed(project)
        with Store(project / ".sierra").snapshot() as snapshot:
            assert snapshot.listing.rest == []
    opened.collect()
    assert not any(b"98677f6730518a21" in path.read_bytes() for path in index_files.published(paths_of(project).index))
    assert not opened.fsck().findings


def test_a_damaged_segment_that_replaces_others_is_looked_at_by_each_reader(project: Path) -> None:
    opened = sierra.open(project)
    with opened.store.snapshot():
        opened.remove(opened.batches[-1].batch)
    [replacing] = [one for one in segments.on_disk(paths_of(project).segments) if one.replaces and one.files]
    Path(min(replacing.files.values())).write_bytes(b"")
    assert index_builder.build(paths_of(project)) is not None
    with pytest.raises(Damaged, match=replacing.name):
        answers(project)
    opened.repair()
    assert answers(project) == unindexed(project)


MIXED = """\
import sys
arena = open(sys.argv[1]).read()
count = int(arena.split('<swarm count="')[1].split('"')[0])
value, more = {1: ("4", "1"), 2: ("0.5", "fast"), 3: ("9007199254740993", "7"), 4: ("slow", "")}[count]
with open("mixed.csv", "w") as file:
    print("value,more", value + "," + more, sep="\\n", file=file)
sys.exit(count == 4)
"""


@pytest.mark.integration
def test_files_of_outputs_are_not_read_to_learn_what_their_columns_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even where the columns differ. Only files with rows that do not count are, because these influence nothing."""
    opened = sierra.open(projects.make(tmp_path / "mixed", simulator=MIXED))
    for count in (1, 2, 3):
        opened.run(f"population_size={count}", figures=False)
    read: list[str] = []
    execute = connections.Interruptible._call

    def noted(self: connections.Interruptible, *arguments: Any, **named: Any) -> object:
        for statement in arguments[1:2]:
            if isinstance(statement, str) and "output.1.parquet" in statement:
                read.append(statement.split()[0])
        return execute(self, *arguments, **named)

    monkeypatch.setattr(connections.Interruptible, "_call", noted)

    def asked() -> list[object]:
        read.clear()
        with Store(opened.root / ".sierra").snapshot() as snapshot:
            return [snapshot.rows("SELECT * FROM mixed ORDER BY ALL"), snapshot.views.notes, snapshot.views.sql_names]

    without = asked()
    assert "SELECT" in read
    assert index_builder.build(paths_of(opened.root)) is not None
    assert asked() == without
    assert read == ["CREATE"]
    opened.run("population_size=4", figures=False)
    assert asked() == without
    assert index_builder.build(paths_of(opened.root)) is not None
    assert asked() == without
    opened.replay(opened.batches[0].batch)
    with_replay = asked()
    assert index_builder.build(paths_of(opened.root)) is not None
    assert asked() == with_replay == without
    assert "SELECT" in read
    flip(min((opened.root / ".sierra" / "segments").glob("*/output.1.parquet")))
    opened.run("population_size=1,2", figures=False)
    assert index_builder.build(paths_of(opened.root)) is not None
    with pytest.raises(Damaged, match=r"output\.1\.parquet has other bytes"):
        asked()
