"""The index: no answer depends on it, whatever has become of it."""

from __future__ import annotations

import contextlib
import gc
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import duckdb
import pytest

import sierra
from sierra.errors import Damaged, Missing, SqlError
from sierra.store import index_builder, index_files, index_reader, local_connection, segments, view_sql
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


def answers(root: Path, statements: Sequence[str] = STATEMENTS) -> list[object]:
    store = Store(root / ".sierra")
    found: list[object] = [store.sql(statement).to_pylist() for statement in statements]
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


@pytest.mark.parametrize("many", [0, view_sql.LARGE])
def test_an_index_knows_only_the_segments_before_it(project: Path, many: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """New segments are read as well as it, and added to the next one.

    In a store with many runs, its results are used for those that the new segments do not touch.
    """
    monkeypatch.setattr(view_sql, "LARGE", many)
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


def of_other_format(path: Path) -> None:
    path.rename(path.with_name("0" * 8 + path.name[8:]))


def of_other_storage(path: Path) -> None:
    """Write the number of a version of DuckDB's format that does not exist yet, in a file with the right name."""
    content = bytearray(path.read_bytes())
    content[12:20] = (998).to_bytes(8, "little")
    named_anew(path, bytes(content))


def published(paths: StorePaths, segments: int, content: bytes) -> Path:
    with tempfile.NamedTemporaryFile() as file:
        file.write(content)
        file.flush()
        return index_files.publish(paths, segments, Path(file.name))


def named_anew(path: Path, content: bytes) -> Path:
    """Replace an index by one of this content, whose name tells its hash."""
    path.unlink()
    return published(StorePaths(path.parents[1]), index_files.segments_of(path), content)


def link_elsewhere(path: Path) -> None:
    path.rename(path.parents[2] / "moved")
    path.symlink_to(path.parents[2] / "moved")


def link_nowhere(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def file_for_folder(path: Path) -> None:
    shutil.rmtree(path.parent)
    path.parent.write_text("no folder\n")


def link_for_folder(path: Path) -> None:
    path.parent.rename(path.parents[2] / "moved")
    path.parent.symlink_to(path.parents[2] / "moved")


DAMAGES = (
    *(flip, swap, shorten, replace, of_other_format, of_other_storage, link_elsewhere, link_nowhere, folder, pipe, empty),
    *(file_for_folder, link_for_folder),
)


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_index_is_not_used(project: Path, damage: Callable[[Path], None]) -> None:
    without = answers(project, STATEMENTS[::6])
    path = index_builder.build(paths_of(project))
    assert path is not None
    damage(path)
    assert answers(project, STATEMENTS[::6]) == without


def test_an_index_of_another_store_changes_no_answer(project: Path, tmp_path: Path) -> None:
    without = answers(project)
    other = stores.copy(project, tmp_path / "other")
    sierra.open(other).run("population_size=9", runs=1, figures=False)
    path = index_builder.build(paths_of(other))
    assert path is not None
    (project / ".sierra" / "index").mkdir()
    shutil.copy(path, project / ".sierra" / "index")
    assert answers(project) == without


LISTINGS = (
    *("SELECT count(*) FROM sqlite_master", "SELECT * FROM pg_catalog.pg_tables", "SELECT count(*) FROM pg_class"),
    *("SHOW DATABASES", "SHOW SCHEMAS", "SHOW", "DESCRIBE", "-- all\nSHOW", "SELECT name FROM (SHOW)"),
)


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("statement", LISTINGS)
def test_no_list_of_tables_shows_the_index(project: Path, statement: str) -> None:
    store = Store(project / ".sierra")
    without = store.sql(statement).to_pylist()
    assert index_builder.build(store.paths) is not None
    assert store.sql(statement).to_pylist() == without


@pytest.mark.integration
def test_messages_about_wrong_statements_do_not_name_the_index(project: Path) -> None:
    assert index_builder.build(paths_of(project)) is not None
    for name in ("segment", "outputs", "experiments_1", "stored_effectiv"):
        with pytest.raises(SqlError, match=f"Table with name {name} does not exist") as raised:
            Store(project / ".sierra").sql(f"SELECT * FROM {name}")
        assert "index_" not in str(raised.value)
        with Store(project / ".sierra").snapshot() as snapshot:
            snapshot.add_table("own", number=[1])  # so that it cannot do without the index any more
            with pytest.raises(SqlError) as raised:
                snapshot.sql(f"SELECT * FROM {name}")
            assert str(raised.value) == f"Catalog Error: Table with name {name} does not exist!"


@pytest.mark.integration
def test_a_table_that_cannot_be_read_is_read_from_the_segments(project: Path) -> None:
    """An index whose name tells its hash may have been damaged before it was hashed."""
    without = answers(project)
    path = index_builder.build(paths_of(project))
    assert path is not None
    whole = path.read_bytes()
    broken = 0
    for block in range((len(whole) - 12288) // 16384):
        content = bytearray(whole)
        content[12288 + block * 16384 + 5000] ^= 1
        path = named_anew(path, bytes(content)) if path.exists() else published(paths_of(project), 12, bytes(content))
        statement = STATEMENTS[block % len(STATEMENTS)]
        assert Store(project / ".sierra").sql(statement).to_pylist() == without[block % len(STATEMENTS)]
        broken += not path.exists()
    assert broken


def test_what_is_removed_is_in_no_index(project: Path) -> None:
    opened = sierra.open(project)
    batch = opened.batches[-1].batch
    path = index_builder.build(paths_of(project))
    assert path is not None
    assert batch.encode() in path.read_bytes()
    opened.records.remove(batch)
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
    assert not opened.maintenance.fsck().findings
    path = keep(project)
    connection = duckdb.connect(str(path))
    connection.execute(change)
    connection.close()
    index_files.publish(paths_of(project), 12, path)
    [finding] = opened.maintenance.fsck().findings
    assert finding.path.startswith("index/")
    assert f"its rows of {table} are not those of the segments" in finding.what
    opened.maintenance.repair()
    assert not opened.maintenance.fsck().findings
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
        opened.records.remove(opened.batches[-1].batch)
        assert answers(project) == unindexed(project)
        opened.maintenance.collect()
        assert answers(project) == unindexed(project)
        assert index_builder.build(paths_of(project)) is not None
        assert answers(project) == unindexed(project)
        with Store(project / ".sierra").snapshot() as snapshot:
            assert snapshot.listing.rest == []
    opened.maintenance.collect()
    assert not any(b"98677f6730518a21" in path.read_bytes() for path in index_files.published(paths_of(project).index))
    assert not opened.maintenance.fsck().findings


def test_a_damaged_segment_that_replaces_others_is_looked_at_by_each_reader(project: Path) -> None:
    opened = sierra.open(project)
    with opened.store.snapshot():
        opened.records.remove(opened.batches[-1].batch)
    [replacing] = [one for one in segments.on_disk(paths_of(project).segments) if one.replaces and one.files]
    Path(min(replacing.files.values())).write_bytes(b"")
    assert index_builder.build(paths_of(project)) is not None
    with pytest.raises(Damaged, match=replacing.name):
        answers(project)
    opened.maintenance.repair()
    assert answers(project) == unindexed(project)


REMOVED = "noise=0.5"
"""The query of a batch whose segments hold nothing of other batches."""


def last_batch(root: Path) -> str:
    [batch] = [one.batch for one in sierra.open(root).batches if one.query == REMOVED]
    return batch


def of_batch(root: Path, batch: str) -> list[Path]:
    """Return the files below the folder of indexes with the id of a batch, and the indexes with rows of its segments."""
    found = []
    for path in (root / ".sierra" / "index").rglob("*"):
        if path.is_file() and (batch.encode() in path.read_bytes() or batch[:12].encode() in path.read_bytes()):
            found.append(path)
    return found


@pytest.mark.integration
def test_a_removal_that_dies_leaves_no_rows_in_an_index(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever it has done last, the next gc completes it."""
    opened, batch = sierra.open(project), last_batch(project)
    assert index_builder.build(paths_of(project)) is not None
    for step in ("sierra.store.compaction.sync", "sierra.store.index_files.remove_all"):
        root = stores.copy(project, project.with_name(step))
        with monkeypatch.context() as patch:
            patch.setattr(step, lambda *_: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                sierra.open(root).records.remove(batch)
        sierra.open(root).maintenance.collect()
        assert of_batch(root, batch) == []
    assert of_batch(project, batch)
    assert opened.maintenance.fsck().sound


@pytest.mark.integration
def test_an_index_without_segments_that_somebody_has_deleted_is_built_from_nothing(project: Path) -> None:
    batch = last_batch(project)
    assert index_builder.build(paths_of(project)) is not None
    for path in (project / ".sierra" / "segments").glob(f"{batch[:12]}-*"):
        shutil.rmtree(path)
    for query in ("population_size=7", "population_size=8"):
        sierra.open(project).run(query, runs=1, figures=False)
    assert index_builder.build(paths_of(project)) is not None
    assert of_batch(project, batch) == []


@pytest.mark.integration
def test_segments_that_a_repair_puts_aside_are_in_no_index(project: Path) -> None:
    batch = last_batch(project)
    assert index_builder.build(paths_of(project)) is not None
    for path in (project / ".sierra" / "segments").glob(f"{batch[:12]}-*/executions.parquet"):
        flip(path)
    sierra.open(project).maintenance.repair()
    assert not index_files.published(paths_of(project).index)


@pytest.mark.integration
def test_an_index_of_another_store_does_not_keep_this_one_from_having_its_own(project: Path, tmp_path: Path) -> None:
    other = stores.copy(project, tmp_path / "other")
    sierra.open(other).run("population_size=9", runs=1, figures=False)
    theirs = index_builder.build(paths_of(other))
    assert theirs is not None
    (project / ".sierra" / "index").mkdir()
    copied = Path(shutil.copy(theirs, project / ".sierra" / "index"))
    own = index_builder.build(paths_of(project))
    assert own is not None
    assert own.exists()
    assert not copied.exists()
    with Store(project / ".sierra").snapshot() as snapshot:
        assert (snapshot.listing.rest, snapshot.listing.without) == ([], frozenset())


@pytest.mark.integration
def test_removing_needs_no_index_and_takes_what_a_killed_builder_has_left(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = project.with_name("temporary")
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    killed = f"import os\nfrom pathlib import Path\nfrom sierra.store import index_builder, index_files\n{KILLED}"
    subprocess.run(
        [sys.executable, "-c", killed, project / ".sierra"], env={**os.environ, "TMPDIR": str(temporary)}, check=False
    )
    [left] = temporary.iterdir()
    assert left.name.startswith(index_files.PREFIX)
    batch = last_batch(project)
    index = project / ".sierra" / "index"
    index.write_text("no folder\n")
    sierra.open(project).records.remove(batch)
    assert index.read_text() == "no folder\n"
    assert not left.exists()


KILLED = """
import signal, sys
from sierra.store.layout import StorePaths
index_files.publish = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
index_builder.build(StorePaths(Path(sys.argv[1])))
"""


@pytest.mark.integration
def test_a_folder_in_the_place_of_an_index_stops_neither_removing_nor_gc(project: Path) -> None:
    path = index_builder.build(paths_of(project))
    assert path is not None
    strange = path.with_name(f"{path.name[:9]}{'9' * 9}-{'0' * 16}.duckdb")
    strange.mkdir()
    flip(path)
    sierra.open(project).maintenance.collect()
    assert not path.exists()
    sierra.open(project).records.remove(last_batch(project))
    assert strange.exists()
    sierra.open(project).maintenance.repair()
    assert not strange.exists()
    assert sierra.open(project).maintenance.fsck().sound


@pytest.mark.integration
@pytest.mark.parametrize("error", [Missing("too many open files"), Damaged("a file"), MemoryError(), OSError(5, "I/O error")])
def test_what_a_builder_lacks_does_not_matter_to_a_command(
    project: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*_: object) -> bool:
        raise error

    monkeypatch.setattr(index_builder, "WORTH", 1)
    monkeypatch.setattr(index_builder, "_is_sound", fail)
    assert sierra.open(project).run("population_size=7", runs=1, figures=False).executed == 1
    assert not index_files.published(paths_of(project).index)


@pytest.mark.integration
def test_a_large_index_that_has_changed_since_it_was_read_is_not_read_again(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that is too large for a copy in memory is read from its file."""
    monkeypatch.setattr(index_files, "IN_MEMORY", 0)
    path = index_builder.build(paths_of(project))
    assert path is not None
    with Store(project / ".sierra").snapshot() as snapshot:
        assert snapshot.listing.rest == []
    flip(path)
    with Store(project / ".sierra").snapshot() as snapshot:
        assert snapshot.listing.facts is None


def copies_in_memory() -> set[int]:
    found = set()
    for path in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if "memfd:sierra-index" in str(path.readlink()):
                found.add(path.stat().st_ino)
    return found


@pytest.mark.integration
def test_indexes_that_nobody_uses_any_more_are_not_kept_in_memory(project: Path) -> None:
    """A process may run for weeks, and each new index is another copy."""
    index_files._held.clear()
    before = copies_in_memory()
    for number in range(4):
        assert index_builder.build(paths_of(project)) is not None
        assert len(answers(project, STATEMENTS[:3])) == 5
        sierra.open(project).run(f"population_size={number + 5}", runs=1, figures=False)
        assert not sierra.open(project).maintenance.fsck().findings
    gc.collect()
    assert len([path for path in index_reader._facts if path.parent == paths_of(project).index]) == 1
    assert len(copies_in_memory() - before) <= 2  # that of the next connection, and that of a connection that is kept


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
    execute = local_connection.Interruptible._call

    def noted(self: local_connection.Interruptible, *arguments: Any, **named: Any) -> object:
        for statement in arguments[1:2]:
            if isinstance(statement, str) and "output.1.parquet" in statement:
                read.append(statement.split()[0])
        return execute(self, *arguments, **named)

    monkeypatch.setattr(local_connection.Interruptible, "_call", noted)

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


def test_a_user_is_told_what_takes_long(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_builder, "WORTH", 1)
    assert "index" not in projects.quick(project, "gc", "--yes").stderr
    shutil.rmtree(paths_of(project).index)
    monkeypatch.setattr(index_builder, "LONG", 2)
    told = projects.quick(project, "gc", "--yes").stderr
    assert re.search(r"note: building an index of \d+ segments, so that", told)


AXES = projects.CONFIG + 'seg = "//swarm/@kind"\nfilename = "//arena/@size"\n'
ODD = (
    projects.SIMULATOR
    + """
import json
with open("odd.jsonl", "w") as file:
    print(json.dumps({"x": [1, 2] if count == 2 else count, "y": None if count == 3 else "a"}), file=file)
"""
)


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Path]]:
    """A project whose axes are called like columns of an index and have several types, and the indexes of each moment."""
    folder = tmp_path_factory.mktemp("odd")
    template = projects.TEMPLATE.replace('controller="none"', 'controller="none" kind="0"')
    root = projects.make(folder / "project", AXES, simulator=ODD, template=template)
    indexes = []
    for query in ("population_size=1,2", "filename=20", "seg=1,2", "noise=0.5", "seg=a,b", "population_size=3"):
        sierra.open(root).run(query, runs=1, figures=False)
        path = index_builder.build(paths_of(root))
        assert path is not None
        indexes.append(path.rename(folder / path.name))
    return root, indexes


TABLES = ("effective", "experiments", "points", "runs", "swarm", "odd")


@pytest.mark.integration
@pytest.mark.parametrize("many", [0, view_sql.LARGE])
def test_columns_and_notes_do_not_depend_on_an_index(
    odd: tuple[Path, list[Path]], many: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither on their order, nor on axes that are called like the index's own columns."""
    monkeypatch.setattr(view_sql, "LARGE", many)
    root, indexes = odd

    def asked() -> list[object]:
        found: list[object] = []
        for name in TABLES:
            table = Store(root / ".sierra").sql(f"SELECT * FROM {name} ORDER BY ALL")
            found.append((name, table.column_names, table.to_pylist(), table.schema.metadata))
        return found

    without = asked()
    for path in indexes:
        copied = Path(shutil.copy(path, paths_of(root).index))
        assert asked() == without
        copied.unlink()


@pytest.mark.integration
def test_fsck_finds_nothing_wrong_with_columns_of_lists_and_numbers(odd: tuple[Path, list[Path]]) -> None:
    root, indexes = odd
    copied = Path(shutil.copy(indexes[-1], paths_of(root).index))
    assert not sierra.open(root).maintenance.fsck().findings
    copied.unlink()


@pytest.mark.integration
def test_a_table_of_which_nothing_is_current_has_no_records(project: Path) -> None:
    opened = sierra.open(project)
    [replayed] = opened.store.values(str, "SELECT DISTINCT batch FROM executions WHERE purpose = 'replay'")
    assert index_builder.build(paths_of(project)) is not None
    with opened.store.snapshot():
        opened.records.remove(replayed)
        with opened.store.snapshot() as snapshot:
            assert snapshot.listing.without
            assert (snapshot.holds("replays"), snapshot.holds("executions")) == (False, True)


@pytest.mark.integration
@pytest.mark.parametrize("lost", ["REPLACES", "MANIFEST"])
def test_a_segment_that_waits_for_a_damaged_one_is_looked_at_by_each_reader(project: Path, lost: str) -> None:
    """The lost file may come back."""
    folder = paths_of(project).segments
    old = min(segments.on_disk(folder), key=lambda one: (one.batch, one.name))
    others = [one for one in segments.on_disk(folder) if one.batch == old.batch]
    last = segments.Writer(project / "last", old.batch)
    last.mark(segments.REPLACES, [old.name])
    name = last.seal()
    new = segments.Writer(project / "new", old.batch)
    for path in sorted((folder / old.name).iterdir()):
        if path.name not in segments.MARKS:
            shutil.copy(path, new.folder)
    if (folder / old.name / segments.OUTPUTS).exists():
        shutil.copy(folder / old.name / segments.OUTPUTS, new.folder)
    new.mark(segments.AFTER, [name])
    new.publish(folder)
    last.publish(folder)
    assert len([one for one in segments.on_disk(folder) if one.batch == old.batch]) == len(others) + 2
    without = answers(project)
    aside = (folder / name / lost).rename(project / lost)
    with contextlib.suppress(Damaged):
        index_builder.build(paths_of(project))
    aside.rename(folder / name / lost)
    assert answers(project) == without


@pytest.mark.integration
def test_contents_whose_first_file_is_lost_are_read_from_another(project: Path) -> None:
    store = Store(project / ".sierra")
    holding: dict[str, list[Path]] = {}
    for path in stores.files(project, "objects"):
        for (digest,) in duckdb.execute(f"SELECT DISTINCT sha256 FROM '{path}'").fetchall():
            holding.setdefault(digest, []).append(path)
    digest = min(digest for digest, paths in holding.items() if len(paths) > 1)
    content = store.object(digest)
    assert index_builder.build(store.paths) is not None
    min(holding[digest]).unlink()
    assert store.object(digest) == content
    assert index_files.published(store.paths.index)


@pytest.mark.integration
def test_contents_that_were_lost_are_stored_again(project: Path) -> None:
    """An index still has the records of a lost file, so that the store seems to have its contents."""
    opened = sierra.open(project)
    held = {path: duckdb.execute(f"SELECT sha256 FROM '{path}'").fetchall() for path in stores.files(project, "objects")}
    source = opened.store.values(str, "SELECT sha256 FROM blobs ORDER BY ALL")[0]
    assert index_builder.build(opened.store.paths) is not None
    with opened.store.snapshot() as snapshot:
        assert snapshot.kept_sizes([source]).keys() == {source}
    for each in held:
        if (source,) in held[each]:
            each.unlink()
    with opened.store.snapshot() as snapshot:
        assert not snapshot.kept_sizes([source])
    opened.run("population_size=7", runs=1, figures=False)
    assert opened.store.object(source)


def test_a_user_is_told_if_no_index_can_be_built(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(index_files, "announce", told.append)
    monkeypatch.setattr(index_builder, "STORAGE", "v0.1")
    index_builder.keep_up(paths_of(project), 1)
    [note] = told
    assert note.startswith("no index could be built, so commands look at each segment: ")
    assert not index_files.published(paths_of(project).index)


def test_a_snapshot_that_leaves_an_index_stays_settled(project: Path) -> None:
    assert index_builder.build(paths_of(project)) is not None
    with Store(project / ".sierra").snapshot() as snapshot:
        snapshot.settle()
        before = snapshot.rows("SELECT * FROM swarm ORDER BY ALL")
        snapshot.sql("SHOW ALL TABLES")
        assert "settled" in str(snapshot.rows("EXPLAIN SELECT * FROM swarm"))
        assert snapshot.rows("SELECT * FROM swarm ORDER BY ALL") == before


def test_statements_do_not_see_tables_of_touched_runs(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view_sql, "LARGE", 0)
    assert index_builder.build(paths_of(project)) is not None
    sierra.open(project).run("population_size=7", runs=1, figures=False)
    with Store(project / ".sierra").snapshot() as snapshot:
        assert snapshot.sql("SELECT count(*) FROM runs").to_pylist()
        assert not [row for row in snapshot.sql("SHOW TABLES").to_pylist() if "touched" in str(row) or "index_" in str(row)]
        with pytest.raises(SqlError, match="does not exist"):
            snapshot.sql('SELECT * FROM "touched runs"')
