"""Any number of concurrent sessions: none waits for a lock, none fails, and no run is executed twice."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from sierra.errors import Missing
from sierra.execution import sessions
from sierra.store.layout import StorePaths
from tests.conftest import held
from tests.waiting import until

EIGHT = range(8)
Simulate = Callable[..., Any]


def at_once(project: Any, askings: list[tuple[str, ...]]) -> list[Any]:
    """Start all sessions together; return how each one ended."""
    processes = [project.start("run", *words, "-j", "2", "--no-figures") for words in askings]
    ends = [project.end_of(process, 200) for process in processes]
    assert [line for end in ends for line in end.stderr.splitlines() if line.startswith("sierra:")] == []
    assert (project.work(), project.left_running()) == ([], [])
    return ends


def assert_each_once(project: Any, runs: int) -> None:
    assert set(project.executed().values()) == {1}
    assert len(project.executed()) == runs
    assert project.sql("SELECT count(*) AS n, count(DISTINCT run) AS runs FROM executions WHERE status = 'ok'") == [
        {"n": runs, "runs": runs}
    ]
    assert project.sql("SELECT count(*) AS n, count(DISTINCT run) AS runs FROM swarm") == [{"n": 2 * runs, "runs": runs}]


@pytest.mark.integration
def test_eight_sessions_of_one_query_share_the_runs_even_without_a_store(simulate: Simulate) -> None:
    project = simulate()
    ends = at_once(project, [("size.Log8", "--runs", "10")] * 8)
    assert [end.returncode for end in ends] == [0] * 8
    assert_each_once(project, 40)
    assert project.sql("SELECT count(*) AS n FROM batch_runs") == [{"n": 40}]
    assert project.sql("SELECT count(*) AS n FROM batches") == [{"n": 1}]
    assert project.sql("SELECT count(*) AS n FROM experiments") == [{"n": 4}]


@pytest.mark.nightly
def test_eight_sessions_of_overlapping_queries_share_their_common_runs(simulate: Simulate) -> None:
    project = simulate()
    some = [
        ("size.Log8", "--runs", "5"),
        ("size.Log8", "--runs", "10"),
        ("size=1,2,3", "--runs", "7"),
        ("size=8,3", "--runs", "4"),
    ]
    ends = at_once(project, some * 2)
    assert [end.returncode for end in ends] == [0] * 8
    assert_each_once(project, 47)
    assert project.sql("SELECT batch, count(*) AS n FROM batch_runs GROUP BY 1 ORDER BY 2")[-1]["n"] == 40
    assert project.sql("SELECT count(*) AS n FROM batch_runs") == [{"n": 20 + 40 + 21 + 8}]


@pytest.mark.nightly
def test_eight_different_sessions_do_not_interfere_and_readers_never_fail(simulate: Simulate) -> None:
    project = simulate()
    assert project.ask("run", "size=99", "--runs", "1", "--no-figures").returncode == 0
    done = threading.Event()
    faults: list[str] = []
    reads: list[int] = []

    def read() -> None:
        while not done.is_set():
            for words in (("sql", "SELECT count(*) FROM runs JOIN swarm USING (run)"), ("ls",)):
                end = project.ask(*words)
                reads.append(end.returncode)
                if end.returncode or end.stderr:
                    faults.append(end.stderr)

    reader = threading.Thread(target=read)
    reader.start()
    try:
        ends = at_once(project, [(f"size={n + 1}", f"speed={n},{n + 1}", "--runs", "5") for n in EIGHT])
    finally:
        done.set()
        reader.join()
    assert [end.returncode for end in ends] == [0] * 8
    assert (faults, len(reads) >= 2) == ([], True)
    assert_each_once(project, 81)


@pytest.mark.integration
def test_readers_see_only_complete_records_during_execution(simulate: Simulate) -> None:
    project = simulate(held(21))
    project.ask("run", "size=99", "--runs", "1", "--no-figures")
    processes = [project.start("run", f"size={n}", "--runs", "20", "-j", "2", "--no-figures") for n in (1, 2)]
    seen = set()
    while any(process.poll() is None for process in processes):
        (row,) = project.sql("SELECT count(*) AS n, (SELECT count(*) FROM swarm) AS t FROM executions WHERE status = 'ok'")
        assert row["t"] == 2 * row["n"]
        seen.add(row["n"])
        if len(seen) > 1:
            project.open()
        time.sleep(0.1)
    assert len(seen) > 1
    assert [project.end_of(process).returncode for process in processes] == [0, 0]


@pytest.mark.integration
def test_runs_that_fail_in_a_concurrent_session_are_not_executed_again(simulate: Simulate) -> None:
    project = simulate('until [ -e "${0%/*}/../gate" ]; do sleep 0.02; done; echo broken >&2; exit 4')
    asked = ("run", "size=1,2", "--runs", "3", "-j", "2", "--no-figures")
    one = project.start(*asked)
    project.until_executed(1, one)
    two = project.start(*asked)
    until(lambda: len(list(project.folder.glob(".sierra/work/*/claims.json"))) == 2)
    (project.folder.parent / "gate").touch()
    ends = [project.end_of(process) for process in (one, two)]
    assert [end.returncode for end in ends] == [1, 1]
    assert set(project.executed().values()) == {1}
    assert all("6 failed" in end.stdout for end in ends)


@pytest.mark.nightly
def test_summary_counts_runs_of_concurrent_sessions_apart_from_earlier_ones(simulate: Simulate) -> None:
    project = simulate(held(1))
    assert project.ask("run", "size=1", "--runs", "1", "--no-figures").returncode == 0
    one = project.start("run", "size=1,2", "--runs", "1", "-j", "2", "--no-figures")
    project.until_executed(2, one)
    two = project.start("run", "size=1,2,3", "--runs", "1", "-j", "2", "--no-figures")
    until(lambda: len(project.executed()) == 3, "the second has begun what nobody else executes")
    project.open()
    ends = [project.end_of(process) for process in (one, two)]
    assert [end.returncode for end in ends] == [0, 0]
    assert "2 runs: 1 executed, 1 reused\n" in ends[0].stdout
    assert "3 runs: 1 executed, 2 reused (1 executed meanwhile by another session)\n" in ends[1].stdout


# ---------------------------------------------------------------- claims


def test_claims_hold_until_their_session_is_finished(tmp_path: Any) -> None:
    store = StorePaths(tmp_path)
    one, two = sessions.Session(store), sessions.Session(store)
    assert one.claim({"a", "b"}) == {"a", "b"}
    assert two.claim({"b", "c"}) == {"c"}
    one.recorded = False
    one.close()
    assert sessions.others(store, two.id) == {"a", "b"}
    with sessions.dead(store) as found:
        assert [paths.root for paths in found] == [one.paths.root]
        with sessions.dead(store) as again:
            assert again == []
        assert two.claim({"b"}) == set()
    assert two.claim({"b"}) == {"b"}
    two.close()
    assert sorted(path.name for path in store.work.iterdir()) == ["lock", "mark"]


@pytest.mark.integration
def test_live_short_sessions_are_never_considered_dead(tmp_path: Any) -> None:
    store = StorePaths(tmp_path)
    wrong: list[Any] = []
    over = threading.Event()

    def watch() -> None:
        while not over.is_set():
            with sessions.dead(store) as found:
                wrong.extend(found)

    watchers = [threading.Thread(target=watch) for _ in range(2)]
    for watcher in watchers:
        watcher.start()
    give_up = time.monotonic() + 2
    while time.monotonic() < give_up:
        session = sessions.Session(store)
        session.claim({"a"})
        session.close()
    over.set()
    for watcher in watchers:
        watcher.join()
    assert wrong == []
    assert sorted(path.name for path in store.work.iterdir()) == ["lock", "mark"]


def test_claims_are_ignored_on_file_systems_without_locks(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(descriptor: int, how: int) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", flock)
    store = StorePaths(tmp_path)
    one, two = sessions.Session(store, logged=False), sessions.Session(store, logged=False)
    assert (one.claim({"a"}), two.claim({"a"})) == ({"a"}, {"a"})
    with sessions.dead(store) as found:
        assert found == []


def test_a_lock_that_may_only_be_read_names_its_file_where_only_what_may_be_written_is_locked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(descriptor: int, how: int) -> None:
        raise OSError(errno.EBADF, "Bad file descriptor")  # as NFS answers

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(Missing, match=f"cannot write to {tmp_path}/work/lock: Permission denied"):
        sessions.Session(StorePaths(tmp_path), logged=False)


def test_session_with_an_old_empty_owner_file_is_dead_on_file_systems_without_locks(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(descriptor: int, how: int) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", flock)
    store = StorePaths(tmp_path)
    owner = sessions.Session(store, logged=False).paths.owner(0)
    owner.write_text("")
    with sessions.dead(store) as found:
        assert found == [], "it may be about to sign"
    os.utime(owner, (1, 1))
    with sessions.dead(store) as found:
        assert [paths.owner(0) for paths in found] == [owner]
    assert sessions.all_of(store) == []


WITHOUT_LOCKS = """
import errno
import os, fcntl
def flock(descriptor, how):
    raise OSError(errno.ENOLCK, "No locks available")
fcntl.flock = flock
from sierra.cli.main import main
main()
"""


@pytest.mark.integration
def test_killed_session_is_recovered_on_file_systems_without_locks(simulate: Simulate, tmp_path: Path) -> None:
    project = simulate(held(8))
    program = tmp_path / "without_locks.py"
    program.write_text(WITHOUT_LOCKS)
    words = [sys.executable, str(program), "run", "size.Log8", "--runs", "5", "-j1", "--no-figures"]
    ask = partial(subprocess.Popen, words, cwd=project.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    died = ask()
    project.until_executed(5, died)
    died.kill()
    died.communicate()
    assert len(project.work()) == 1
    project.open()
    assert project.end_of(ask()).returncode == 0
    assert (project.work(), project.left_running()) == ([], [])
    assert sum(project.executed().values()) <= 21, "only what was in flight is executed twice"
    assert project.sql("SELECT count(*) AS n, count(DISTINCT run) AS runs FROM executions WHERE status = 'ok'") == [
        {"n": 20, "runs": 20}
    ]


def test_unwritable_store_is_reported(tmp_path: Any) -> None:
    (tmp_path / "work").write_text("a file")
    with pytest.raises(Missing, match="cannot write to"):
        sessions.Session(StorePaths(tmp_path))
