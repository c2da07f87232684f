"""Executions that used the same thing outside their folders at the same time, and so may have each other's data.

An execution is doubtful if it wrote a file and read it again (`reread` in `files_written`): another one that wrote a file of
the same name meanwhile would have replaced its data. Nothing is wrong if the name is the execution's own, because it
contains a process id, say. Therefore observed executions of two runs are compared: if both wrote a file of this name, all of
the batch most likely did. Those that overlapped another one in time fail. If only one run was observed, the caller has
another one observed, or else decides (`settle`) as if both had written it.

A `Kind` of things that executions may share is a query for what observed executions used, and words.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from sierra.ingest.recording_context import Context
from sierra.model import Status
from sierra.store.layout import SessionPaths
from sierra.store.row_types import FindingRow
from sierra.store.store import Snapshot, Store
from sierra.util.text import few

NAMED = 3


class Kind(NamedTuple):
    """A kind of things that executions may share."""

    table: str
    """The table that the query reads."""
    doubts: str
    """A condition for the rows of doubtful executions."""
    uses: str
    """A query for all uses: `execution`, `name`, and whether the execution is `doubtful`."""
    reason: str
    cure: str


FILES = Kind(
    "files_written",
    "use = 'reread'",
    "SELECT execution, path AS name, use = 'reread' AS doubtful FROM files_written",
    "writes and reads {names}, which other runs use at the same time",
    "execute with --jobs 1, in a container, or pass {output}",
)
KINDS = (FILES,)
UNDECIDED = '; no second run was observed, so set observe = "all" if each run has a name of its own'
ON_HOST = ("/tmp/", "/var/tmp/", "/dev/shm/", "/run/", "/var/run/")  # noqa: S108 - no file is made there
"""Folders that executions on different hosts do not share."""
SHARED = """
WITH mine AS (
    SELECT DISTINCT execution, run FROM all_judgements SEMI JOIN (FROM batch_runs WHERE batch = $batch) USING (run)
    WHERE purpose = 'run'
),
observed AS (
    SELECT count(DISTINCT run) AS runs FROM mine SEMI JOIN (FROM observations WHERE method = 'strace') USING (execution)
)
SELECT name, count(DISTINCT run) > 1 AS decided FROM ({uses}) u JOIN mine USING (execution), observed
GROUP BY name, observed.runs HAVING bool_or(doubtful) AND (count(DISTINCT run) > 1 OR observed.runs = 1) ORDER BY name
"""
"""The things by which executions are doubtful that a second run used, too, or of which nobody knows that."""
OVERLAPPING = """
WITH near AS (
    SELECT judgement, execution, run, batch, session, status, purpose, started, ended,
           CASE WHEN $on_host THEN host END AS place, (session, host, slot, attempt) AS lane
    FROM all_judgements
    WHERE run IN (SELECT run FROM batch_runs WHERE batch = $batch) OR session IN (
        SELECT session FROM all_judgements SEMI JOIN (FROM ({uses}) WHERE list_contains($names, name)) USING (execution)
    )
),
timed AS (
    SELECT *, min(lane) OVER all_there <> max(lane) OVER all_there AND (
        coalesce(max(ended) OVER (by_time ROWS BETWEEN UNBOUNDED PRECEDING AND 1 PRECEDING) > started, false)
        OR coalesce(lead(started) OVER by_time < ended, false)
    ) AS overlaps
    FROM (SELECT DISTINCT ON (execution) * FROM near)
    WINDOW by_time AS (PARTITION BY place ORDER BY started, execution), all_there AS (PARTITION BY place)
)
SELECT n.judgement, n.run, n.batch FROM near n JOIN timed t USING (execution)
WHERE n.status = 'ok' AND n.purpose = 'run' AND (t.overlaps OR (n.session = $session AND epoch(n.ended) > $lost))
ORDER BY n.batch, n.judgement
"""
"""The judgements of executions that overlapped another one in time. Those of one slot follow each other, whatever a clock says.
"""


class _Shared(NamedTuple):
    name: str
    decided: bool


class _Overlapping(NamedTuple):
    judgement: str
    run: str
    batch: str


def find(store: Store, session: SessionPaths, context: Context, lost: float = math.inf, *, settle: bool = False) -> set[str]:
    """Find successful executions of a batch that shared something with others, record findings, and return their runs.

    `lost`: the time since which a run of the session was executing that is not recorded, in seconds since the epoch. `settle`:
    executions are taken as sharing a thing that only one observed run has used.
    """
    found: dict[str, tuple[_Overlapping, str]] = {}
    with store.snapshot() as snapshot:
        for kind in KINDS:
            names = [one for one in _shared(snapshot, context.batch, kind) if one.decided or settle]
            reason = kind.reason.replace("{names}", few([one.name for one in names], NAMED)) + f"; {kind.cure}"
            reason += "" if all(one.decided for one in names) else UNDECIDED
            for one in _overlapping(snapshot, context, kind, names, lost):
                found.setdefault(one.judgement, (one, reason))
    now, lamport = datetime.now(UTC), context.lamport()
    for batch in sorted({one.batch for one, _ in found.values()}):
        writer = store.writer(session.segment, batch)
        writer.records(
            FindingRow(judgement, now, Status.FAILED, reason, lamport)
            for judgement, (one, reason) in found.items()
            if one.batch == batch
        )
        store.publish(writer)
    return {one.run for one, _ in found.values()}


def undecided(store: Store, context: Context) -> str | None:
    """Return a run of a batch whose observation would tell whether executions share something; None if none is needed."""
    with store.snapshot() as snapshot:
        for kind in KINDS:
            names = [one for one in _shared(snapshot, context.batch, kind) if not one.decided]
            [*users] = snapshot.values(str, _users(kind), names=[one.name for one in names]) if names else ()
            for one in _overlapping(snapshot, context, kind, names, math.inf):
                if one.batch == context.batch and one.run not in users:
                    return one.run
    return None


def _users(kind: Kind) -> str:
    return f"SELECT DISTINCT run FROM all_judgements JOIN ({kind.uses}) USING (execution) WHERE list_contains($names, name)"


def _shared(snapshot: Snapshot, batch: str, kind: Kind) -> list[_Shared]:
    if not snapshot.holds(kind.table):
        return []
    snapshot.views.make((kind.table, "observations", "batch_runs", "all_judgements"))
    if not snapshot.run(f"SELECT 1 FROM {kind.table} WHERE {kind.doubts} LIMIT 1"):
        return []
    return snapshot.select(_Shared, SHARED.replace("{uses}", kind.uses), batch=batch)


def _overlapping(snapshot: Snapshot, context: Context, kind: Kind, names: Sequence[_Shared], lost: float) -> list[_Overlapping]:
    if not names:
        return []
    shared = [one.name for one in names]
    return snapshot.select(
        _Overlapping,
        OVERLAPPING.replace("{uses}", kind.uses),
        batch=context.batch,
        session=context.session,
        names=shared,
        on_host=all(name.startswith(ON_HOST) for name in shared),
        lost=min(lost, 1e18),
    )
