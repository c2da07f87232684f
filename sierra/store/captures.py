"""Captures in the store: which executions have the frames of measured runs, and how they agree with the measurement."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

from sierra.store.row_types import CaptureRow
from sierra.store.store import Snapshot, Store

NEWEST = """
SELECT c.* REPLACE (w.judgement AS recorded)
FROM (SELECT unnest($j::VARCHAR[]) AS judgement) w JOIN all_judgements m ON m.judgement = w.judgement
JOIN all_judgements r ON r.execution = m.execution JOIN captures c ON c.recorded = r.judgement
WHERE c.frames > 0 AND c.verdict <> 'failed'
QUALIFY row_number() OVER (PARTITION BY w.judgement ORDER BY c.lamport DESC) = 1
"""


CUT_OFF = """
SELECT g.execution, e.session, g.run, g.rendering FROM renderings g JOIN executions e USING (execution)
WHERE list_contains($r, g.run) AND e.status IN ('ok', 'accepted') AND g.execution NOT IN (SELECT execution FROM captures)
"""


class CutOff(NamedTuple):
    """A successful execution for capture that was never compared with the measured one."""

    execution: str
    session: str
    run: str
    rendering: str


def cut_off(store: Store, runs: Collection[str]) -> list[CutOff]:
    """Return the executions of these runs whose capture ended before they were compared, or has not ended."""
    return store.select(CutOff, CUT_OFF, r=sorted(runs)) if runs else []


def of_executions(store: Store, executions: Collection[str]) -> list[CaptureRow]:
    """Return the captures of these executions, in the order of the runs."""
    return store.select(
        CaptureRow, "SELECT * FROM captures WHERE list_contains($e, execution) ORDER BY lamport", e=list(executions)
    )


def newest(snapshot: Snapshot, judgements: Collection[str]) -> Mapping[str, CaptureRow]:
    """Return the last capture with frames, by the judgement of the measured execution; none of executions without frames."""
    snapshot.views.make(("captures", "all_judgements"))
    return {row.recorded: row for row in snapshot.select(CaptureRow, NEWEST, j=list(judgements))}
