"""Captures in the store: which executions have the frames of measured runs, and how they agree with the measurement."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from sierra.store.row_types import CaptureRow
from sierra.store.store import Snapshot, Store

NEWEST = """
SELECT c.* REPLACE (w.judgement AS recorded)
FROM (SELECT unnest($j::VARCHAR[]) AS judgement) w JOIN all_judgements m ON m.judgement = w.judgement
JOIN all_judgements r ON r.execution = m.execution JOIN captures c ON c.recorded = r.judgement
WHERE c.frames > 0 AND c.verdict <> 'failed'
QUALIFY row_number() OVER (PARTITION BY w.judgement ORDER BY c.lamport DESC) = 1
"""


def of_session(store: Store, session: str) -> list[CaptureRow]:
    """Return the captures that a session made, in the order of the runs."""
    return store.select(CaptureRow, "SELECT * FROM captures WHERE session = $s ORDER BY lamport", s=session)


def newest(snapshot: Snapshot, judgements: Collection[str]) -> Mapping[str, CaptureRow]:
    """Return the last capture with frames, by the judgement of the measured execution; none of executions without frames."""
    snapshot.views.make(("captures", "all_judgements"))
    return {row.recorded: row for row in snapshot.select(CaptureRow, NEWEST, j=list(judgements))}
