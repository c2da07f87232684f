"""Stores whose index cannot be written, or not in the usual way, are read and changed as those without one."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.store import index_builder, index_files
from sierra.store import store as stores_module
from sierra.store.layout import StorePaths
from sierra.store.store import Store
from tests import projects, stores, users

STATEMENTS = ("SELECT * FROM runs ORDER BY ALL", "SELECT * FROM swarm ORDER BY ALL", "SELECT * FROM effective ORDER BY ALL")
REMOVED = "noise=0.5"
READING = (("ls",), ("show", "{batch}"), ("files", "{batch}"), ("why", "{batch}"), ("fsck",), ("sql", STATEMENTS[0]))


@pytest.fixture
def project(recorded: Path, tmp_path: Path) -> Path:
    return stores.copy(recorded, tmp_path / "project")


def paths_of(root: Path) -> StorePaths:
    return StorePaths(root / ".sierra")


def answers(root: Path) -> list[object]:
    index_files._held.clear()
    store = Store(root / ".sierra")
    return [store.rows(statement) for statement in STATEMENTS]


def unindexed(root: Path) -> int:
    """Return the number of segments that a reader finds in no index."""
    with Store(root / ".sierra").snapshot() as snapshot:
        return len(snapshot.listing.rest)


@pytest.fixture
def fixed(project: Path, require: Callable[..., str]) -> Iterator[Callable[[Path], None]]:
    """Yield a function that makes a folder read-only, also for root."""
    made = []

    def fix(folder: Path) -> None:
        mounted = subprocess.run(["mount", "--bind", folder, folder], check=False, capture_output=True)
        require("the right to mount a disk", there=mounted.returncode == 0)
        made.append(folder)
        subprocess.run(["mount", "-o", "remount,bind,ro", folder], check=True, capture_output=True)

    yield fix
    for folder in made:
        subprocess.run(["umount", "--lazy", folder], check=False, capture_output=True)


def said(root: Path) -> list[tuple[int, str, str]]:
    batch = sierra.open(root).batches[0].batch
    done = [projects.quick(root, *(word.format(batch=batch) for word in words)) for words in READING]
    return [(one.returncode, one.stdout.partition(" checked in ")[0], one.stderr) for one in done]


@pytest.mark.each_case
@pytest.mark.parametrize("name", ["[0]*", "{a,b}?", "back\\slash", "run=zzz"])
def test_an_index_has_all_rows_whatever_the_name_of_its_folder(
    recorded: Path, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = stores.copy(recorded, tmp_path / name)
    without = answers(root)
    assert all(without)
    assert index_builder.build(paths_of(root)) is not None
    for in_memory in (index_files.IN_MEMORY, 0):
        monkeypatch.setattr(index_files, "IN_MEMORY", in_memory)
        assert answers(root) == without
        assert not unindexed(root)
        assert not sierra.open(root).maintenance.fsck().findings


def test_an_index_that_would_lack_rows_is_not_built(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def other(*given: Any, **how: Any) -> str:
        return f"(SELECT * REPLACE ('x' || filename AS filename) FROM {read(*given, **how)})"

    read = index_builder.records
    monkeypatch.setattr(index_builder, "records", other)
    told: list[str] = []
    monkeypatch.setattr(index_files, "announce", told.append)
    index_builder.keep_up(paths_of(project), 1)
    assert "NOT NULL" in str(told)
    assert not index_files.published(paths_of(project).index)


def test_a_read_only_store_is_read_with_its_index(project: Path, fixed: Callable[[Path], None]) -> None:
    without = said(project)
    assert index_builder.build(paths_of(project)) is not None
    fixed(project)
    assert unindexed(project) == 0
    assert said(project) == without


def test_an_index_that_cannot_be_removed_stops_a_removal_before_its_segments_are_gone(
    project: Path, fixed: Callable[[Path], None]
) -> None:
    assert index_builder.build(paths_of(project)) is not None
    [batch] = [one.batch for one in sierra.open(project).batches if one.query == REMOVED]
    fixed(paths_of(project).index)
    for words in (("rm", batch, "--yes"), ("gc", "--yes")):
        done = projects.quick(project, *words)
        assert done.returncode == 3
        assert done.stderr.count("\n") == 1, done.stderr
    index_builder.keep_up(paths_of(project), 1)
    assert list((project / ".sierra" / "segments").glob(f"{batch[:12]}-*"))
    subprocess.run(["umount", "--lazy", paths_of(project).index], check=True)
    sierra.open(project).maintenance.collect()
    assert not any(batch.encode() in path.read_bytes() for path in paths_of(project).index.iterdir())
    assert sierra.open(project).maintenance.fsck().sound


def test_a_full_disk_leaves_no_part_of_an_index(project: Path, disk: Callable[[Path, str], Path]) -> None:
    without = answers(project)
    small = disk(paths_of(project).index, "64k")
    index_builder.keep_up(paths_of(project), 1)
    assert list(small.iterdir()) == []
    assert answers(project) == without


def test_a_full_disk_for_temporary_files_leaves_nothing(
    project: Path, tmp_path: Path, disk: Callable[[Path, str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    small = disk(tmp_path / "temporary", "64k")
    monkeypatch.setattr(tempfile, "tempdir", str(small))
    index_builder.keep_up(paths_of(project), 1)
    assert list(small.iterdir()) == []
    assert not paths_of(project).index.exists()


def test_without_a_folder_for_temporary_files_no_index_is_built(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without = answers(project)
    monkeypatch.setattr(tempfile, "tempdir", str(project / "nowhere"))
    index_builder.keep_up(paths_of(project), 1)
    assert not paths_of(project).index.exists()
    assert answers(project) == without


def test_an_index_is_read_from_its_file_where_there_are_no_files_in_memory(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without = answers(project)
    monkeypatch.delattr(os, "memfd_create")
    path = index_builder.build(paths_of(project))
    assert path is not None
    assert unindexed(project) == 0
    assert answers(project) == without
    path.write_bytes(path.read_bytes()[:-1])
    assert answers(project) == without
    assert unindexed(project) > 0


def test_files_in_memory_that_are_refused_do_not_matter(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError(1, "Operation not permitted")

    without = answers(project)
    assert index_builder.build(paths_of(project)) is not None
    monkeypatch.setattr(os, "memfd_create", refuse)
    assert answers(project) == without


def test_an_index_that_may_not_be_attached_stays(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as where /proc is not mounted."""
    without = answers(project)
    path = index_builder.build(paths_of(project))
    assert path is not None
    monkeypatch.setattr(stores_module, "attach", lambda _: "ATTACH '/nowhere/1' AS gone (TYPE duckdb, READ_ONLY)")
    assert answers(project) == without
    assert path.exists()


@pytest.mark.real
def test_another_user_reads_with_the_index_and_builds_none(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, require: Callable[..., Any]
) -> None:
    require("the right to add users", there=os.geteuid() == 0 and shutil.which("useradd") is not None)
    monkeypatch.setattr(stores_module, "MANY", 1)
    monkeypatch.setattr(index_builder, "WORTH", 1)
    with users.a_user("sierra-index", ids=False) as user, tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        root = stores.copy(recorded, Path(folder, "project"))
        expected = answers(root)
        shutil.rmtree(paths_of(root).index)
        subprocess.run(["chmod", "-R", "a+rwX", root], check=True)

        def read() -> None:
            assert answers(root) == expected
            assert not paths_of(root).index.exists()

        users.called_as(user, read)
        path = index_builder.build(paths_of(root))
        assert path is not None

        def read_indexed() -> None:
            assert answers(root) == expected
            assert unindexed(root) == 0

        users.called_as(user, read_indexed)
        path.chmod(0)

        def read_without() -> None:
            assert answers(root) == expected
            assert unindexed(root) > 0

        users.called_as(user, read_without)
