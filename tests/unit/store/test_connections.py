"""Successive queries on one store share a DuckDB instance, and nothing else."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from sierra.errors import SqlError
from sierra.store.connections import Database, connect
from sierra.store.store import Snapshot, Store
from sierra.util import signals

SEEN = (
    "SELECT view_name FROM duckdb_views() WHERE NOT internal UNION ALL SELECT table_name FROM duckdb_tables() "
    "UNION ALL SELECT name || value FROM duckdb_settings() WHERE name NOT IN ('temp_directory', 'allowed_directories')"
)

LONG = "SELECT sum(a.range * b.range) FROM range(100000000) a, range(100000000) b"
"""A statement that takes hours, and that DuckDB can interrupt."""


@pytest.fixture
def store(recorded: Path) -> Store:
    return Store(recorded / ".sierra")


def of_commands(number: signal.Signals) -> None:
    signals.handle()


def of_the_prompt(number: signal.Signals) -> None:
    signal.signal(number, lambda *_: signals.raise_in_handler(KeyboardInterrupt()))


def of_python(number: signal.Signals) -> None:
    signal.signal(number, signal.default_int_handler)


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("ask", [lambda one: one.execute(LONG), lambda one: one.sql(LONG).limit(1).fetchall()])
@pytest.mark.parametrize(
    ("handle", "number"), [(of_commands, signal.SIGINT), (of_the_prompt, signal.SIGTERM), (of_python, signal.SIGINT)]
)
def test_a_signal_ends_a_statement_in_all_threads_of_duckdb(
    ask: Callable[[Database], object], handle: Callable[[signal.Signals], None], number: signal.Signals
) -> None:
    before = {number: signal.getsignal(number) for number in signals.ENDING}
    for _ in range(10):
        with connect() as connection:
            watch = threading.Timer(100, connection.interrupt)  # or the test hangs
            press = threading.Timer(0.1, signal.raise_signal, (number,))
            try:
                handle(number)
                watch.start()
                press.start()
                with pytest.raises(KeyboardInterrupt):
                    ask(connection)
                assert watch.is_alive()
            finally:
                watch.cancel()
                press.join()
                for other, handler in before.items():
                    signal.signal(other, handler)
            assert connection.execute("SELECT 1").fetchall() == [(1,)]


def seen(snapshot: Snapshot) -> set[str]:
    return {row[0] for row in snapshot.each(SEEN, {})}


def is_asked(snapshot: Snapshot) -> None:
    snapshot.sql("SELECT * FROM runs")
    snapshot.sql("SELECT * FROM main.batch_runs")


def sets(snapshot: Snapshot) -> None:
    for setting in ("threads = 1", "TimeZone = 'Asia/Kathmandu'", "memory_limit = '100MB'", "preserve_insertion_order = false"):
        snapshot.run(f"SET {setting}")


def makes(snapshot: Snapshot) -> None:
    snapshot.run("CREATE TEMP TABLE wanted AS SELECT 1 AS a")
    snapshot.run("CREATE TEMP VIEW wished AS SELECT * FROM wanted")
    snapshot.add_table("given", a=[1])
    assert snapshot.sql("SELECT * FROM given JOIN wished USING (a)").num_rows == 1


def goes_wrong(snapshot: Snapshot) -> None:
    snapshot.run("SET threads = 1")
    with pytest.raises(SqlError):
        snapshot.sql("SELECT nothing FROM runs")


def leaves_rows(snapshot: Snapshot) -> None:
    next(iter(snapshot.each("SELECT * FROM range(1000000)", {})))


@pytest.mark.integration
@pytest.mark.parametrize("before", [is_asked, sets, makes, goes_wrong, leaves_rows])
def test_a_query_finds_no_state_of_the_preceding_one(store: Store, before: Callable[[Snapshot], None]) -> None:
    with store.snapshot(theirs=True) as snapshot:
        found = seen(snapshot)
    for theirs in (True, False):
        with store.snapshot(theirs=theirs) as snapshot:
            before(snapshot)
    with store.snapshot(theirs=True) as snapshot:
        assert seen(snapshot) == found
        assert snapshot.sql("SELECT count(*) AS n FROM runs").to_pylist()[0]["n"] > 0
        with pytest.raises(SqlError):
            snapshot.sql("SELECT * FROM given")


def test_concurrent_queries_are_isolated(store: Store) -> None:
    with store.snapshot() as one, store.snapshot() as other:
        found = seen(other)
        makes(one)
        is_asked(one)
        sets(one)
        assert seen(other) == found
        makes(other)


def test_a_query_on_another_store_cannot_read_the_first(store: Store, tmp_path: Path) -> None:
    shutil.copytree(store.paths.root, tmp_path / "other")
    other = Store(tmp_path / "other")
    file = next(path for segment in store.segments() for path in segment.files.values())
    for _ in range(2):
        assert store.rows(f"SELECT count(*) AS n FROM read_parquet('{file}')")[0]["n"] > 0
        with pytest.raises(SqlError, match="disabled by configuration"):
            other.sql(f"SELECT * FROM read_parquet('{file}')")


def test_added_and_removed_segments_are_visible_to_the_next_query(store: Store, tmp_path: Path) -> None:
    root = tmp_path / "project"
    shutil.copytree(store.paths.root, root)
    known = Store(root)
    runs = "SELECT count(*) AS n FROM executions"
    assert known.rows(runs)[0]["n"] > 0
    for segment in root.glob("segments/*"):
        shutil.move(segment, tmp_path / segment.name)
    assert known.rows(runs)[0]["n"] == 0
    for segment in tmp_path.glob("*-*"):
        shutil.move(segment, root / "segments" / segment.name)
    assert known.rows(runs) == store.rows(runs)


@pytest.mark.integration
def test_temporary_files_of_a_large_query_are_removed_with_it(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    shutil.copytree(store.paths.root, tmp_path / "project")
    with Store(tmp_path / "project").snapshot() as snapshot:
        snapshot.run("SET memory_limit = '60MB'")
        snapshot.run("SET threads = 1")
        snapshot.run("CREATE TEMP TABLE large AS SELECT range AS a, hash(range) AS b FROM range(10000000)")
        assert list(tmp_path.glob("sierra-*/*"))
    assert list(tmp_path.glob("sierra-*")) == []


def test_no_progress_bar_appears_among_what_a_program_prints() -> None:
    """Where DuckDB takes Python for an interactive one, it draws a bar for each statement that takes long."""
    asked = "SELECT value FROM duckdb_settings() WHERE name = 'enable_progress_bar'"
    program = f"from sierra.store.connections import connect; print(connect().execute({asked!r}).fetchall())"
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert done.stdout == "[('false',)]\n"
