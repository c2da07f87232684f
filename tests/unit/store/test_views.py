"""Views of the store return the same in whatever order files are read."""

from __future__ import annotations

from itertools import permutations

import duckdb
import pytest

from sierra.store.views import LATEST

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
    rows = connection.execute(f"{LATEST} SELECT session, programs, submitted, lamport FROM latest").fetchall()
    assert rows == [("late", "lates programs", 90, 7)]
