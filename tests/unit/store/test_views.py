"""Views of the store return the same in whatever order files are read."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import duckdb
import pytest

from sierra.store import view_sql
from sierra.store.row_types import ROWS, BatchRow
from sierra.store.schema import DERIVED, RECORDED
from sierra.store.view_sql import latest
from sierra.store.views import RESULTS, RESULTS_FROM
from tests.support import rows_of_tables
from tests.support.rows_of_tables import filled

SESSIONS = [("early", 3, 30), ("late", 7, 90), ("tied", 7, 60)]  # another store's session can have the same lamport time
JUDGEMENTS = [
    ("late", 7, 80),
    ("late", 6, 85),
    ("early", 3, 20),
]  # the first one of a commit has the lamport time of its session


@pytest.mark.parametrize("order", [*permutations(range(3))])
def test_the_last_session_of_a_batch_is_one_row_in_any_order(order: tuple[int, ...]) -> None:
    connection = duckdb.connect()
    for table in (
        "origins (batch VARCHAR, packages VARCHAR[])",
        "stale_sessions (session VARCHAR, stale VARCHAR)",
        "sessions (batch VARCHAR, session VARCHAR, programs VARCHAR, ingest_rules VARCHAR, ended INT, lamport INT)",
        "all_judgements (batch VARCHAR, session VARCHAR, programs VARCHAR, ingest_rules VARCHAR, judged_at INT, place INT, "
        "purpose VARCHAR, packages VARCHAR[])",
    ):
        connection.execute(f"CREATE TABLE {table}")
    for session, lamport, time in (SESSIONS[number] for number in order):
        connection.execute(
            "INSERT INTO sessions VALUES ('b', ?, ? || 's programs', 'rules', ?, ?)", [session, session, time, lamport]
        )
    for session, place, time in (JUDGEMENTS[number] for number in order):
        values = [session, session, time, place]
        connection.execute("INSERT INTO all_judgements VALUES ('b', ?, ? || 's programs', 'rules', ?, ?, 'run', NULL)", values)
    rows = connection.execute(f"{latest()} SELECT session, programs, submitted, lamport FROM latest").fetchall()
    assert rows == [("late", "lates programs", 90, 7)]


def test_each_query_has_its_columns_whether_or_not_the_store_has_rows_of_its_tables(tmp_path: Path) -> None:
    view_sql._text.cache_clear()
    for number, kinds in enumerate(([*ROWS.values()], [BatchRow])):
        store = rows_of_tables.store(tmp_path / str(number), [filled(kind) for kind in kinds])
        with store.snapshot() as snapshot:
            for name, table in DERIVED.items():
                columns = [row["column_name"] for row in snapshot.rows(f"DESCRIBE {name}")]
                assert {column.name for column in table.columns} <= {*columns}, name
                snapshot.rows(f"FROM {name}")
    assert view_sql._text.cache_info().currsize == len([*view_sql.HERE.glob("*.sql")])


def test_results_follow_from_the_tables_that_their_views_read(tmp_path: Path) -> None:
    store = rows_of_tables.store(tmp_path, [filled(row) for row in ROWS.values()])
    with store.snapshot() as snapshot:
        snapshot.views.make(RESULTS)
        assert RECORDED.keys() & {name.strip('"') for name in snapshot.views.made} == RESULTS_FROM


def test_a_view_reads_tables_and_neither_its_own_relations_nor_columns() -> None:
    text = (
        "WITH seen AS (SELECT run, programs FROM batch_runs) SELECT a IS DISTINCT FROM o.b FROM seen JOIN batches b USING (x)"
    )
    assert view_sql.tables_in(text) == ["batch_runs", "batches"]
