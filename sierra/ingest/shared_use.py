"""Executions that used the same thing outside their folders at the same time, and so may have each other's data.

An execution is doubtful if it wrote a file and read it again (`reread` in `files_written`): another one that wrote a file of
the same name meanwhile would have replaced its data. It is also doubtful if it made the name itself (`reread_new`), and an
execution of another run has made the same. Nothing is wrong if the name is the execution's own, because it contains a process
id, say. Therefore observed executions of two runs of an experiment are compared: if both wrote a file of
this name, all most likely did. Those that overlapped another one in time fail, except in experiments of which no observed run
did. If only one run was observed, the caller has another one observed, or else decides (`final`) as if both had written it.

A port is doubtful if it was in use, or if the execution connected to it and no process of its own listened there; see the
table `channels`. Which ports are the executions' own is seen by those that observed executions bound: those of the batch, and
others at the same time. A port that none has bound is that of a service that runs do not start, and that they may share. An
execution that listened on a port of its own is doubtful for the comparison with others alone (`wider`), because the next one
may fail to bind it. So it is if two runs listened on the same port, unless a run was seen to take another one when the first
was in use: such a program looks for a free one.

A `Kind` of things that executions may share is a query for what observed executions used, and words.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
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
    """A query for all uses: `execution`, `name`, and whether the execution is `doubtful`; NULL: if another one is so, too."""
    reason: str
    cure: str
    wider: str = ""
    """Another query, for what a second run is to be observed; by default the same."""
    usual: float = 0.0
    """The part of the runs with such uses that have a name in common, below which it is by chance, as for ports at random.

    The part of all runs counts, and that of the runs of an experiment, if it is reached in this part of the experiments.
    """
    on_host: bool = False
    """True if executions on different hosts never share them."""


FILES = Kind(
    "files_written",
    "use IN ('reread', 'reread_new')",
    "SELECT execution, path AS name, CASE use WHEN 'reread' THEN true WHEN 'reread_new' THEN NULL ELSE false END AS doubtful "
    "FROM files_written",
    "writes and reads {names}, which other runs use at the same time",
    "execute with --jobs 1, in a container, or pass {output}",
)
LISTENING = "use IN ('listened', 'reused', 'in_use', 'searched')"
NEARBY = """
SELECT name, use FROM channels JOIN all_judgements e USING (execution) WHERE EXISTS (
    FROM (
        SELECT min(started) AS started, max(ended) AS ended FROM all_judgements
        WHERE run IN (SELECT run FROM batch_runs WHERE batch = $batch) GROUP BY session
    ) s WHERE e.started <= s.ended AND e.ended >= s.started
)
"""
"""The uses by executions of a batch, and by others while one of its sessions executed."""
CHANNELS = f"""
SELECT execution, name, CASE
    WHEN use IN ('reused', 'in_use', 'connected') THEN true
    WHEN use = 'listened' AND name NOT IN (SELECT name FROM ({NEARBY}) WHERE use = 'searched') THEN {{listened}}
    ELSE false END AS doubtful
FROM channels
WHERE use NOT IN ('searched', 'given') AND (use <> 'connected' OR name IN (SELECT name FROM ({NEARBY}) WHERE {LISTENING}))
"""
DISPLAY = "regexp_matches(name, '^@?/tmp/[.]X11-unix/X[0-9]+$')"
"""An X server that cannot lock a display takes another one, or ends before it has bound anything (see `xvfb-run -a`)."""
PORTS = Kind(
    "channels",
    LISTENING,
    CHANNELS.format(listened=f"CASE WHEN {DISPLAY} THEN false END"),
    "{names} {verb} used by several runs at the same time",
    "execute with --jobs 1, in a container, or use {port}",
    CHANNELS.format(listened="true"),
    usual=0.5,
    on_host=True,
)
KINDS = (FILES, PORTS)
OUTSIDE = PORTS._replace(
    uses=f"""
SELECT execution, name, true AS doubtful FROM channels WHERE use = 'connected' AND starts_with(name, '127.0.0.1:')
AND name <> '127.0.0.1:53' AND name NOT IN (SELECT name FROM ({NEARBY}) WHERE {LISTENING})
"""
)
"""Servers of this host, without those for names, that no observed run has started."""
USED_OUTSIDE = f"""
SELECT name FROM ({OUTSIDE.uses}) JOIN all_judgements USING (execution) WHERE session = $session AND purpose = 'run'
GROUP BY name HAVING count(DISTINCT run) > 1 ORDER BY name
"""
UNDECIDED = '; no second run was observed, so set observe = "all" if each run has a name of its own'
ON_HOST = ("/tmp/", "/var/tmp/", "/dev/shm/", "/run/", "/var/run/")  # noqa: S108 - no file is made there
"""Folders that executions on different hosts do not share."""
MEMBERS = """
members AS (
    SELECT run, min(ordinal) AS ordinal, count(*) OVER (PARTITION BY min(ordinal)) = 1 AS alone
    FROM batch_runs WHERE batch = $batch GROUP BY run
)
"""
SHARED = f"""
WITH {MEMBERS},
mine AS (
    SELECT DISTINCT execution, run, ordinal, CASE WHEN alone THEN -1 ELSE ordinal END AS scope,
           bool_or(status IN ('ok', 'accepted')) OVER (PARTITION BY execution) AS ok,
           min(lamport) OVER (PARTITION BY session) AS place
    FROM all_judgements JOIN members USING (run) WHERE purpose = 'run'
),
observed AS (
    SELECT execution, run, place, ordinal, ok, coalesce(o.reason, '') AS reason
    FROM mine JOIN observations o USING (execution) WHERE method = 'strace'
),
last AS (
    SELECT scope, reason, run, max(place) AS last
    FROM (SELECT unnest([ordinal, -1]) AS scope, reason, run, place FROM observed WHERE ok) GROUP BY ALL
),
witnesses AS (SELECT scope, reason, arg_max(run, last, 2) AS runs, max(last, 2) AS lasts FROM last GROUP BY ALL),
alike AS (
    SELECT *, count(DISTINCT run) FILTER (doubtful IS NULL) OVER (PARTITION BY name) AS runs,
           count(DISTINCT run) FILTER (doubtful IS NULL) OVER () AS all_runs,
           count(DISTINCT run) FILTER (doubtful IS NULL) OVER (PARTITION BY scope, name) AS near,
           count(DISTINCT run) FILTER (doubtful IS NULL) OVER (PARTITION BY scope) AS all_near
    FROM ({{uses}}) JOIN mine USING (execution)
),
usual AS (
    SELECT *, near > 1 AND near >= $usual * all_near AS is_usual,
           count(DISTINCT scope) FILTER (is_usual) OVER () AS usual_scopes,
           count(DISTINCT scope) FILTER (all_near > 1) OVER () AS scopes
    FROM alike
),
used AS (
    SELECT DISTINCT name, execution, run, place, scope,
           coalesce(doubtful, (runs > 1 AND runs >= $usual * all_runs) OR (is_usual AND usual_scopes >= $usual * scopes))
               AS doubtful
    FROM usual
),
doubtful AS (
    SELECT d.name, d.scope, coalesce(bool_or(
        (w.runs[1] <> d.run AND w.lasts[1] >= d.place) OR (w.runs[2] <> d.run AND w.lasts[2] >= d.place)
    ), false) AS witnessed
    FROM used d LEFT JOIN observed o USING (execution)
    LEFT JOIN witnesses w ON w.scope = d.scope AND w.reason IN ('', coalesce(o.reason, ''))
    WHERE d.doubtful GROUP BY d.name, d.scope, d.execution
),
unknown AS (SELECT name, list_sort(list(DISTINCT scope)) AS scopes FROM doubtful WHERE NOT witnessed GROUP BY name)
SELECT name, count(DISTINCT run) > 1 AS decided, coalesce(any_value(scopes), []) AS scopes
FROM used LEFT JOIN unknown USING (name)
GROUP BY name HAVING bool_or(doubtful) AND (decided OR len(scopes) > 0) ORDER BY name
"""
"""The things by which executions are doubtful that a second run used, too, or of which nobody knows that.

A witness tells that another run does not use them: a run of the same experiment, observed in the same session or later, that
succeeded and of which no more is hidden than of the doubtful one. If an experiment has only one run, any other run is one.
"""
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
),
seen AS (
    SELECT e.session, e.batch, m.ordinal, bool_or(u.execution IS NOT NULL) AS uses
    FROM near e JOIN batch_runs m USING (batch, run) JOIN observations o USING (execution)
    LEFT JOIN (FROM ({uses}) WHERE list_contains($names, name)) u USING (execution)
    WHERE e.purpose = 'run' AND (
        u.execution IS NOT NULL OR (o.method = 'strace' AND o.reason IS NULL AND e.status IN ('ok', 'accepted'))
    )
    GROUP BY ALL
),
exempt AS (
    SELECT n.judgement FROM near n JOIN batch_runs m USING (batch, run) JOIN seen USING (session, batch, ordinal)
    GROUP BY n.judgement HAVING NOT bool_or(seen.uses)
)
SELECT n.judgement, n.run, n.batch, n.session
FROM near n JOIN timed t USING (execution) ANTI JOIN exempt x ON x.judgement = n.judgement
WHERE n.status IN ('ok', 'accepted') AND n.purpose = 'run' AND (t.overlaps OR (n.session = $session AND epoch(n.ended) > $lost))
ORDER BY n.batch, n.judgement
"""
"""The judgements of executions that overlapped another one in time. Those of one slot follow each other, whatever a clock says.

Experiments are left out of which the session has observed runs, if none of these used any of the things.
"""
OTHERS = f"""
WITH {MEMBERS},
others AS (
    SELECT DISTINCT run, ordinal, list_contains($near, run) AS near FROM members
    JOIN all_judgements USING (run)
    WHERE status IN ('ok', 'accepted') AND purpose = 'run' AND run NOT IN (
        SELECT run FROM all_judgements JOIN ({{uses}}) USING (execution) WHERE list_contains($names, name)
    )
),
scoped AS (SELECT run, near, unnest([ordinal, -1]) AS scope FROM others)
SELECT arg_max(run, (near, run)) FROM scoped WHERE list_contains($scopes, scope) GROUP BY scope ORDER BY scope
"""
"""One run of each of some experiments (-1: of any) that is not known to use the things; if possible one of those nearby."""
UNSEEN = f"""
WITH {MEMBERS},
mine AS (
    SELECT run, ordinal, status IN ('ok', 'accepted') AS ok, execution IN (SELECT execution FROM observations) AS observed
    FROM all_judgements JOIN members USING (run) WHERE session = $session AND purpose = 'run'
)
SELECT max(run) FILTER (ok) FROM mine GROUP BY ordinal
HAVING bool_or(observed) AND NOT bool_or(observed AND ok) AND bool_or(ok)
"""
"""A successful run of each experiment of which all runs that the session has observed have failed."""


class _Shared(NamedTuple):
    name: str
    decided: bool
    scopes: list[int]
    """Experiments of which a second run must be observed; -1: a run of any other experiment."""


class _Overlapping(NamedTuple):
    judgement: str
    run: str
    batch: str
    session: str


def find(store: Store, session: SessionPaths, context: Context, lost: float = math.inf, *, final: bool = False) -> set[str]:
    """Find successful executions of a batch that shared something with others, record findings, and return their runs.

    `lost`: the time since which a run of the session was executing that is not recorded, in seconds since the epoch. `final`:
    executions of the session are taken as sharing a thing that only one observed run has used.
    """
    findings: dict[str, tuple[_Overlapping, str]] = {}
    with store.snapshot() as snapshot:
        for kind in KINDS:
            shared = _shared(snapshot, context.batch, kind)
            for decided in (True, False) if final else (True,):
                names = [resource for resource in shared if resource.decided is decided]
                said = kind.reason.replace("{names}", few([resource.name for resource in names], NAMED))
                reason = said.replace("{verb}", "are" if len(names) > 1 else "is") + f"; {kind.cure}"
                reason += "" if decided else UNDECIDED
                for execution in _overlapping(snapshot, context, kind, names, lost):
                    if decided or execution.session == context.session:
                        findings.setdefault(execution.judgement, (execution, reason))
    now, lamport = datetime.now(UTC), context.lamport()
    for batch in sorted({execution.batch for execution, _ in findings.values()}):
        writer = store.writer(session.segment, batch)
        writer.records(
            FindingRow(judgement, now, Status.FAILED, reason, lamport)
            for judgement, (execution, reason) in findings.items()
            if execution.batch == batch
        )
        store.publish(writer)
    return {execution.run for execution, _ in findings.values()}


def undecided(store: Store, context: Context) -> set[str]:
    """Return the runs of a batch whose observation would tell whether executions share something: one of each experiment."""
    runs: set[str] = set()
    with store.snapshot() as snapshot:
        for kind in KINDS:
            kind = kind._replace(uses=kind.wider or kind.uses)
            names = [resource for resource in _shared(snapshot, context.batch, kind) if not resource.decided]
            near = [
                execution.run
                for execution in _overlapping(snapshot, context, kind, names, math.inf)
                if execution.batch == context.batch
            ]
            if near:
                scopes = sorted({scope for resource in names for scope in resource.scopes})
                query = OTHERS.replace("{uses}", kind.uses)
                given = {"batch": context.batch, "names": [resource.name for resource in names], "near": near, "scopes": scopes}
                runs.update(snapshot.values(str, query, **given))
    return runs


def unseen(store: Store, context: Context) -> set[str]:
    """Return a run of each experiment whose observation is needed, because the runs that the session has observed failed."""
    with store.snapshot() as snapshot:
        if not snapshot.holds("observations"):
            return set()
        snapshot.views.make(("observations", "batch_runs", "all_judgements"))
        return set(snapshot.values(str, UNSEEN, batch=context.batch, session=context.session))


def notes(store: Store, context: Context) -> Iterator[str]:
    """Yield a warning for servers that several runs of a session used at the same time, and that no run has started."""
    with store.snapshot() as snapshot:
        if not snapshot.holds(OUTSIDE.table):
            return
        snapshot.views.make((OUTSIDE.table, "observations", "batch_runs", "all_judgements"))
        names = [
            _Shared(name, True, []) for name in snapshot.values(str, USED_OUTSIDE, batch=context.batch, session=context.session)
        ]
        if any(execution.session == context.session for execution in _overlapping(snapshot, context, OUTSIDE, names, math.inf)):
            said = few([resource.name for resource in names], NAMED)
            yield (
                f"runs at the same time used a server that no run has started: {said}; if runs "
                "change its state, execute with --jobs 1, or let each run start its own ([services.NAME], {port})"
            )


def _shared(snapshot: Snapshot, batch: str, kind: Kind) -> list[_Shared]:
    if not snapshot.holds(kind.table):
        return []
    snapshot.views.make((kind.table, "observations", "batch_runs", "all_judgements"))
    if not snapshot.run(f"SELECT 1 FROM {kind.table} WHERE {kind.doubts} LIMIT 1"):
        return []
    return snapshot.select(_Shared, SHARED.replace("{uses}", kind.uses), batch=batch, usual=kind.usual)


def _overlapping(snapshot: Snapshot, context: Context, kind: Kind, names: Sequence[_Shared], lost: float) -> list[_Overlapping]:
    if not names:
        return []
    shared = [resource.name for resource in names]
    return snapshot.select(
        _Overlapping,
        OVERLAPPING.replace("{uses}", kind.uses),
        batch=context.batch,
        session=context.session,
        names=shared,
        on_host=kind.on_host or all(name.startswith(ON_HOST) for name in shared),
        lost=min(lost, 1e18),
    )
