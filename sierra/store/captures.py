"""Captures in the store: which executions have the frames of measured runs, and how they agree with the measurement."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from sierra.store.row_types import CaptureRow
from sierra.store.store import Snapshot, Store

NEWEST = """
SELECT * FROM captures WHERE list_contains($j, recorded) AND frames > 0 AND verdict <> 'failed'
QUALIFY row_number() OVER (PARTITION BY recorded ORDER BY lamport DESC) = 1
"""


def of_session(store: Store, session: str) -> list[CaptureRow]:
    """Return the captures that a session made, in the order of the runs."""
    return store.select(CaptureRow, "SELECT * FROM captures WHERE session = $s ORDER BY lamport", s=session)


def newest(snapshot: Snapshot, judgements: Collection[str]) -> Mapping[str, CaptureRow]:
    """Return the last capture with frames of each of these judgements of measured executions, if it has one."""
    snapshot.views.make(("captures",))
    return {row.recorded: row for row in snapshot.select(CaptureRow, NEWEST, j=list(judgements))}
