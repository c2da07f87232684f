"""The rows that a connection holds are those of the segments, whatever is added, replaced or damaged meanwhile."""

from __future__ import annotations

from pathlib import Path

import pytest

import sierra
from sierra.api import Project
from sierra.errors import Damaged
from sierra.store import rest_rows
from sierra.store.store import Store
from tests import stores
from tests.tiers import needs_extension

COUNT = "SELECT count(*) FROM executions"
BY_BATCH = "SELECT batch, count(*) AS n FROM batch_runs GROUP BY batch ORDER BY batch"


@pytest.fixture
def project(tmp_path: Path) -> Project:
    (tmp_path / "sierra.toml").write_text(
        'template = "t.xml"\ncommand = "true {input}"\nseed = "//e/@seed"\nruns = 2\n[variables]\nn = "//e/@n"\n'
    )
    (tmp_path / "t.xml").write_text('<e seed="0" n="0"/>')
    return sierra.open(tmp_path)


def others(store: Store) -> Store:
    """Return the same store as another process would read it: without what this one holds."""
    return Store(store.paths.root).unindexed()


def test_rows_of_later_segments_are_added(project: Project) -> None:
    for number in range(1, 5):
        stores.ask(project.root, f"n={number}")
        assert project.store.values(int, COUNT) == [2 * number]
        assert project.store.rows(BY_BATCH) == others(project.store).rows(BY_BATCH)


@needs_extension("trials")
def test_a_first_row_of_a_table_is_seen(project: Project) -> None:
    from sierra.extensions.trials import mark_trial

    stores.ask(project.root, "n=1")
    assert project.store.values(int, "SELECT count(*) FROM trials") == [0]
    run = project.store.values(str, "SELECT execution FROM executions LIMIT 1")[0]
    assert project.store.values(int, "SELECT count(*) FROM all_judgements WHERE status = 'ok'") == [2]
    mark_trial(project, run, valid=False, reason="seen to fall")
    assert project.store.values(int, "SELECT count(*) FROM trials") == [1]
    assert project.store.values(int, "SELECT count(*) FROM all_judgements WHERE status = 'ok'") == [1]


def test_users_statements_list_none_of_these_tables(project: Project) -> None:
    stores.ask(project.root, "n=1")
    assert project.store.values(int, COUNT) == [2]
    for statement in ("SHOW ALL TABLES", "SELECT table_name FROM information_schema.tables", "FROM duckdb_tables()"):
        assert "rest rows" not in str(project.sql(statement).to_pylist())
    assert project.store.values(int, COUNT) == [2]


def test_rows_of_removed_batches_are_gone(project: Project) -> None:
    first = stores.ask(project.root, "n=1")
    stores.ask(project.root, "n=2")
    assert project.store.values(int, COUNT) == [4]
    project.records.remove(first)
    assert project.store.values(int, COUNT) == [2]
    assert project.store.rows(BY_BATCH) == others(project.store).rows(BY_BATCH)


def test_large_files_are_read_where_they_are(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    stores.ask(project.root, "n=1")
    assert project.store.values(int, COUNT) == [2]
    monkeypatch.setattr(rest_rows, "MOST_BYTES", 10_000)
    for number in range(2, 9):
        stores.ask(project.root, f"n={number}")
        assert project.store.values(int, COUNT) == [2 * number]


@pytest.mark.parametrize("statement", [COUNT, "SELECT count(*) FROM effective"])
@pytest.mark.parametrize("most", [0, 1 << 20])
def test_a_file_that_is_damaged_after_it_was_read_is_reported(
    project: Project, monkeypatch: pytest.MonkeyPatch, statement: str, most: int
) -> None:
    monkeypatch.setattr(rest_rows, "MOST_BYTES", most)
    stores.ask(project.root, "n=1")
    for _ in range(2):
        assert project.store.values(int, statement) == [2]
    [path] = project.paths.store.glob("segments/*/executions.parquet")
    path.chmod(0o644)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(Damaged, match="executions"):
        project.store.values(int, statement)
