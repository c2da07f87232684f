"""`sierra gc` removes unneeded files, merges small files, and loses nothing."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.maintenance import gc, transaction
from sierra.store.schema import RECORDED
from tests import projects, stores
from tests.conftest import held
from tests.waiting import until


@pytest.fixture(scope="module")
def made(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with batches that were submitted several times, so that there are many segments."""
    root = stores.copy(recorded, tmp_path_factory.mktemp("gc") / "project")
    for query in ("population_size=1,2", "noise=0.5") * 2:
        sierra.open(root).run(query, figures=False)
    return root


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    return stores.copy(made, tmp_path / "project")


def everything(root: Path) -> dict[str, Any]:
    """Return all content that is visible in SQL and through `sierra show --files`."""
    around = ("objects", "blobs", "specs", "sources", "environments", "programs", "ingest_rules")
    with sierra.open(root).store.snapshot() as snapshot:

        def rows(what: str) -> list[dict[str, Any]]:
            found: list[dict[str, Any]] = snapshot.sql(f"SELECT {what}").to_pylist()
            return found

        tables = {name: rows(f"* FROM {name} ORDER BY ALL") for name in RECORDED if name not in around}
        tables |= {name: rows(f"DISTINCT * FROM {name} ORDER BY ALL") for name in around}
        return tables | {name: rows(f"* EXCLUDE (row) FROM {name} ORDER BY run, row") for name in ("swarm", "notes")}


def processes() -> Iterator[tuple[int, bytes]]:
    """Yield all processes with their words."""
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            yield int(path.name), (path / "cmdline").read_bytes()


def segments(root: Path) -> int:
    return len(list(root.glob(".sierra/segments/*")))


@pytest.mark.integration
def test_many_small_segments_are_merged_without_losing_rows(root: Path) -> None:
    before, count = everything(root), segments(root)
    dry = projects.quick(root, "gc", "--dry-run")
    assert (dry.returncode, segments(root)) == (0, count)
    assert "small segments, merged into" in dry.stdout
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert segments(root) <= 6 < count
    assert everything(root) == before
    assert sierra.open(root).maintenance.fsck().findings == ()
    assert projects.quick(root, "gc", "--yes").stdout == "nothing to remove: everything is needed\n"
    assert sierra.open(root).run("population_size=1,2", figures=False).executed == 0


@pytest.mark.nightly
def test_gc_without_a_terminal_needs_yes(root: Path) -> None:
    before = stores.state(root)
    ended = projects.quick(root, "gc")
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert stores.state(root) == before


@pytest.mark.integration
def test_unreferenced_and_unfinished_files_are_removed(root: Path) -> None:
    store = sierra.open(root).store
    writer = store.writer(store.paths.work / "test", store.segments()[0].batch)
    from sierra.store.objects import Objects

    objects = Objects(writer.path("objects"))
    unneeded = objects.add(b"nobody needs this")
    needed = sierra.open(root).sql("SELECT input FROM batch_runs LIMIT 1").to_pylist()[0]["input"]
    objects.add(store.object(needed))
    objects.close()
    store.publish(writer)
    (root / ".sierra" / ".format.4194399").write_text("")
    image = root / ".sierra" / "images" / f"sha256-{'0' * 64}"
    image.mkdir(parents=True)
    (image / ".rootfs.sqfs.4194399").write_text("")
    (image.parent / ".saved.abc.4194399").mkdir()
    (image.parent / ".saved.abc.4194399" / "image.tar").write_text("")
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert store.object(needed)
    assert not store.rows("SELECT 1 FROM objects WHERE sha256 = $d", d=unneeded)
    assert not (root / ".sierra" / ".format.4194399").exists()
    assert list((root / ".sierra").glob("images/**/.*")) == []
    assert sierra.open(root).maintenance.fsck().findings == ()


@pytest.mark.integration
def test_finished_runs_of_a_dead_session_are_recorded(simulate: Callable[..., Any]) -> None:
    project = simulate(held(5))
    running = project.start("run", "size=1", "--runs", "8", "-j", "2", "--no-figures")
    project.until_executed(6, running)
    running.kill()
    running.communicate()
    assert "dead: work/" in project.quick("fsck").stdout
    assert project.quick("gc", "--yes").returncode == 0
    assert project.work() == []
    assert project.left_running() == []
    assert project.quick("fsck").returncode == 0
    project.open()
    assert project.quick("run", "size=1", "--runs", "8", "--no-figures").returncode == 0
    assert project.sql("SELECT count(*) AS n FROM executions") == [{"n": 8}]


@pytest.mark.integration
@pytest.mark.parametrize("words", [("gc", "--yes"), ("run", "size=2", "--no-figures")])
def test_temporary_files_of_a_killed_worker_are_removed(
    simulate: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    with tempfile.TemporaryDirectory(prefix="t-", dir="/tmp") as temporary:
        monkeypatch.setenv("TMPDIR", temporary)
        project = simulate(f'[ "$SIERRA_SEED" ] && touch "$TMPDIR/left"\n{held(0)}')
        running = project.start("run", "size=1", "--runs", "2", "-j", "2", "--no-figures")
        until(lambda: len(list(Path(temporary).glob("sierra-*/*/tmp/left"))) == 2)
        work = str(project.folder / ".sierra/work")
        [worker] = [pid for pid, words in processes() if words.startswith(sys.executable.encode()) and work.encode() in words]
        os.kill(running.pid, signal.SIGSTOP)
        os.kill(worker, signal.SIGKILL)
        running.kill()
        running.communicate()
        assert list(Path(temporary).glob("sierra-*/*/tmp/left"))
        project.open()
        assert project.quick(*words).returncode == 0
        assert list(Path(temporary).glob("sierra-*")) == []


@pytest.mark.integration
@pytest.mark.parametrize("words", [("gc", "--yes"), ("rm", "{batch}", "--yes")])
def test_a_store_that_another_process_has_just_begun_to_use_is_busy_and_not_damaged(
    root: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.setattr(transaction, "PATIENCE_S", 0.05)
    project = sierra.open(root)
    called = [word.format(batch=project.batches[0].batch) for word in words]
    with transaction.changing(project.store.paths):  # a session that has not recorded its batch yet
        ended = projects.quick(root, *called)
    assert (ended.returncode, ended.stderr.count("\n")) == (3, 1)
    assert ended.stderr.startswith("sierra: the store is busy")


@pytest.mark.nightly
def test_killed_gc_neither_loses_nor_duplicates_rows(made: Path, tmp_path: Path) -> None:
    numbers = random.Random(4)
    before = everything(made)
    for attempt in range(4):
        root = stores.copy(made, tmp_path / str(attempt))
        folder, count = root / ".sierra" / "segments", segments(root)
        process = subprocess.Popen([str(projects.SIERRA), "gc", "--yes"], cwd=root, stdout=subprocess.DEVNULL)
        while process.poll() is None and len(list(folder.iterdir())) <= count and attempt % 2:
            time.sleep(0.0005)
        time.sleep(numbers.random() * (0.02 if attempt % 2 else 1.5))
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert everything(root) == before
        assert sierra.open(root).maintenance.fsck().sound
        assert projects.quick(root, "gc", "--yes").returncode == 0
        assert everything(root) == before
        assert sierra.open(root).maintenance.fsck().findings == ()
        shutil.rmtree(root)


@pytest.mark.nightly
def test_gc_during_a_running_batch_loses_nothing(simulate: Callable[..., Any]) -> None:
    project = simulate(r"sleep 0.15; printf 't,v\n1,1\n2,4\n' > swarm.csv")
    for _ in range(2):
        assert project.quick("run", "size=1", "--runs", "3", "--no-figures").returncode == 0
        assert project.quick("run", "size=1", "--runs", "2", "--no-figures").returncode == 0
    running = project.start("run", "size=1,2", "--runs", "15", "-j", "2", "--no-figures")
    while running.poll() is None:
        project.quick("gc", "--yes")
        project.quick("fsck")
    assert project.end_of(running).returncode == 0
    assert project.quick("gc", "--yes").returncode == 0
    assert project.quick("fsck").returncode == 0
    assert project.sql("SELECT count(*) AS n, count(DISTINCT run) AS runs FROM executions WHERE status = 'ok'") == [
        {"n": 30, "runs": 30}
    ]
    assert project.sql("SELECT count(*) AS n, sum(v)::INT AS v FROM swarm") == [{"n": 60, "v": 150}]


@pytest.mark.nightly
def test_gc_keeps_files_that_a_reader_has_open(root: Path) -> None:
    store = sierra.open(root).store
    with store.snapshot() as snapshot:
        found = gc.collect(store)
        assert found is not None
        assert found.left > 0
        assert snapshot.sql("SELECT count(*) AS n FROM executions").to_pylist() == [{"n": 12}]
    again = gc.collect(store)
    assert again is not None
    assert again.left == 0
    assert sierra.open(root).maintenance.fsck().findings == ()
