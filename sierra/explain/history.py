"""History of some runs, in order: each session and each replay, and the reason why it executed runs.

An execution is compared with earlier executions of the same run, except those that ran at the same time, as the session saw
them: a finding is valid from the time when it was made. If there are several, the best one decides. The order is: failed,
other rules, other programs, successful.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sierra.execution.reasons import FAILED, PROGRAMS, REUSED, RULES, WORTH, ChangeReason, Reason
from sierra.explain.diff.environment import other_programs, other_rules
from sierra.model import Purpose
from sierra.store.store import Snapshot
from sierra.util.hashing import short
from sierra.util.text import counted, few

SHOWN = 4


@dataclass(frozen=True, slots=True)
class Cause:
    """Reason for some executions."""

    executions: int
    reason: Reason
    execution: str
    """Id of one of the executions."""
    run: str
    new: bool
    """True if it was the first execution of these runs."""


@dataclass(frozen=True, slots=True)
class Event:
    """One session or one replay."""

    session: str
    when: datetime | None
    kind: str
    """`session` for a session, `replay`, or another purpose."""
    batch: str
    query: str
    executed: int
    """Number of executed runs among the selected ones. `failed`: how many of these executions failed."""
    failed: int
    reevaluated: int
    """Number of runs with a recorded execution that was evaluated again by other rules."""
    other_rules: str
    """Differences of these rules; empty if nothing was evaluated again."""
    reused: int | None
    """Number of reused runs of the whole batch; None for a replay or a session that was not recorded."""
    ended: bool
    """True if it ended and was recorded."""
    causes: tuple[Cause, ...]
    notes: tuple[str, ...] = ()
    """Reasons why runs were started or executed more often than requested on a cluster."""


EXECUTED = """
CREATE TEMP TABLE happened AS
WITH mine AS (
    SELECT e.judgement, e.judged_at, e.place, e.execution, e.run, e.session, e.batch, e.started, e.ended, e.status, e.reason,
           e.programs, e.ingest_rules, e.purpose, e.lamport
    FROM all_judgements e SEMI JOIN wanted USING (run)
),
first AS (SELECT * EXCLUDE (judgement, judged_at, place) FROM mine WHERE judgement = execution),
earlier AS (
    SELECT e.execution, p.execution AS prior, p.lamport, p.programs, p.ingest_rules, p.reason,
           f.lamport IS NOT NULL AND f.lamport < e.lamport AS doubted,
           CASE WHEN p.status <> 'ok' AND (f.lamport IS NULL OR f.lamport < e.lamport) THEN $failed
                WHEN p.ingest_rules <> e.ingest_rules THEN $rules WHEN p.programs <> e.programs THEN $programs
                ELSE $good END AS worth
    FROM first e JOIN mine p ON p.run = e.run AND p.execution <> e.execution AND p.place < e.lamport AND p.purpose = 'run'
        AND NOT (p.session <> e.session AND p.started < e.ended AND p.ended > e.started)
    LEFT JOIN findings f ON f.execution = p.judgement
    QUALIFY row_number() OVER (
        PARTITION BY e.execution, p.execution ORDER BY p.ingest_rules = e.ingest_rules DESC, p.place DESC, p.judgement
    ) = 1
),
best AS (
    SELECT execution, max(worth) AS worth, arg_max({'prior': prior, 'programs': programs, 'ingest_rules': ingest_rules,
           'reason': reason, 'doubted': doubted}, (worth, lamport)) AS best
    FROM earlier GROUP BY execution
)
SELECT m.*, b.worth, b.best, EXISTS (
    SELECT 1 FROM first o WHERE o.run = m.run AND o.purpose = 'run' AND o.session <> m.session AND o.lamport < m.lamport
        AND o.started < m.ended AND o.ended > m.started
) AS beside
FROM first m LEFT JOIN best b USING (execution)
"""
CAUSES = """
SELECT session, batch, purpose, worth, beside, best.doubted AS doubted, CASE WHEN worth = 0 THEN best.reason END AS reason,
       CASE WHEN worth = 1 THEN best.ingest_rules END AS was_rules, CASE WHEN worth = 2 THEN best.programs END AS was_programs,
       CASE WHEN worth = 1 THEN ingest_rules END AS ingest_rules, CASE WHEN worth = 2 THEN programs END AS programs,
       count(*) AS executions, count(*) FILTER (status <> 'ok') AS failed, min(started) AS started,
       min(lamport) AS lamport, arg_min(execution, lamport) AS execution, arg_min(run, lamport) AS run,
       arg_min(best.prior, lamport) AS prior
FROM happened GROUP BY ALL ORDER BY executions DESC, execution
"""
CUT = """
WITH mine AS (
    SELECT DISTINCT a.session, a.array_task FROM attempts a JOIN executions e USING (attempt) SEMI JOIN wanted USING (run)
)
SELECT session, count(*) AS times, sum(interrupted_runs)::INT AS interrupted, list(DISTINCT error ORDER BY error) AS errors
FROM attempts SEMI JOIN mine USING (session, array_task) WHERE state = 'cut off' AND interrupted_runs > 0 GROUP BY session
"""
COPIED = """
SELECT e.session, count(*) AS copies, count(*) FILTER (NOT same) AS other, min(execution) AS execution
FROM duplicates JOIN executions e USING (execution) WHERE e.run IN (SELECT run FROM wanted) GROUP BY e.session
"""
ASKINGS = """
SELECT * FROM sessions WHERE list_contains($b, batch) OR list_contains($s, session)
"""
JUDGED = """
SELECT j.session, any_value(j.batch) AS batch, count(DISTINCT j.run) AS runs, min(j.judged_at) AS judged_at,
       min(j.lamport) AS lamport, list(DISTINCT j.ingest_rules) AS ingest_rules, list(DISTINCT e.ingest_rules) AS was_rules
FROM judgements j SEMI JOIN wanted USING (run) JOIN all_judgements e ON e.judgement = j.execution GROUP BY j.session
"""
REPLAYS = "SELECT replay, kind, target, verdict FROM replays WHERE list_contains($s, replay)"


def tell(snapshot: Snapshot, batches: Sequence[str]) -> list[Event]:
    """Return all events of the runs in the table `wanted`, and all sessions of these batches, in order."""
    snapshot.views.make(
        ("executions", "all_judgements", "findings", "sessions", "replays", "batch_runs", "attempts", "duplicates")
    )
    snapshot.run(EXECUTED, {"failed": FAILED, "rules": RULES, "programs": PROGRAMS, "good": REUSED})
    rows = snapshot.rows(CAUSES)
    judged = {row["session"]: row for row in snapshot.rows(JUDGED)}
    sessions_of = [*(row["session"] for row in rows), *judged]
    snapshot.run("DROP TABLE happened")
    sessions = {row["session"]: row for row in snapshot.rows(ASKINGS, b=list(batches), s=sessions_of)}
    by_session: dict[str, list[dict[str, Any]]] = {session: [] for session in sessions}
    for row in rows:
        by_session.setdefault(row["session"], []).append(row)
    for session in judged:
        by_session.setdefault(session, [])
    replays = {row["replay"]: row for row in snapshot.rows(REPLAYS, s=list(by_session))}
    more = _more(snapshot)
    places = {
        key: min(row["lamport"] for row in (*those, *(named[key] for named in (sessions, judged) if key in named)))
        for key, those in by_session.items()
    }
    return [
        _event(snapshot, key, by_session[key], sessions.get(key), replays.get(key), more.get(key, []), judged.get(key))
        for key in sorted(places, key=lambda key: places[key])
    ]


def _event(
    snapshot: Snapshot,
    session: str,
    rows: Sequence[Mapping[str, Any]],
    asking: Mapping[str, Any] | None,
    replay: Mapping[str, Any] | None,
    more: Sequence[str],
    judged: Mapping[str, Any] | None,
) -> Event:
    executed = sum(row["executions"] for row in rows)
    failed = sum(row["failed"] for row in rows)
    purpose = rows[0]["purpose"] if rows else "run"
    return Event(
        session=session,
        when=asking["started"] if asking else _began(rows, judged),
        kind="session" if purpose == "run" else purpose,
        batch=(asking or (*rows, judged or {})[0])["batch"],
        query=asking["query"] if asking else "",
        executed=executed,
        failed=failed,
        reevaluated=judged["runs"] if judged else 0,
        other_rules=_lines(other_rules(snapshot, judged["was_rules"], judged["ingest_rules"])) if judged else "",
        reused=asking["reused"] if asking else None,
        ended=asking is not None or replay is not None,
        causes=tuple(_cause(snapshot, row, replay) for row in rows),
        notes=tuple(more),
    )


def _began(rows: Sequence[Mapping[str, Any]], judged: Mapping[str, Any] | None) -> datetime | None:
    """Return the time of the first action of a session without a record."""
    return min((row["started"] for row in rows), default=judged["judged_at"] if judged else None)


def _more(snapshot: Snapshot) -> dict[str, list[str]]:
    """Return, by session, lines about runs that were started or executed more often than requested, and the reasons."""
    told: dict[str, list[str]] = {}
    for row in snapshot.rows(CUT):
        why = few([trouble for trouble in row["errors"] if trouble], SHOWN) or "unknown cause"
        which = f"array tasks were interrupted {row['times']} times" if row["times"] > 1 else "an array task was interrupted"
        line = f"{which} while {counted(row['interrupted'], 'run')} executed; these runs were started again: {why}"
        told.setdefault(row["session"], []).append(line)
    for row in snapshot.rows(COPIED):
        other = f"{row['other']} of them with different results" if row["other"] else "with the same results"
        which = f"{row['copies']} (for example, {short(row['execution'])}), {other}"
        line = f"executed twice, because two copies of an array task ran at the same time: {which}"
        told.setdefault(row["session"], []).append(line)
    return told


def _cause(snapshot: Snapshot, row: Mapping[str, Any], replay: Mapping[str, Any] | None) -> Cause:
    new = row["worth"] is None and row["purpose"] == "run" and not row["beside"]
    return Cause(row["executions"], _why(snapshot, row, replay), row["execution"], row["run"], new)


def _why(snapshot: Snapshot, row: Mapping[str, Any], replay: Mapping[str, Any] | None) -> Reason:
    if row["purpose"] != Purpose.RUN:
        of = f" of {replay['kind']} {short(replay['target'])}: {replay['verdict']}" if replay else " that did not end"
        return Reason(ChangeReason.REPLAY, of)
    if row["worth"] is None:
        return Reason(ChangeReason.CONCURRENT if row["beside"] else ChangeReason.NEW)
    match WORTH[row["worth"]]:
        case ChangeReason.FAILED:
            return Reason(ChangeReason.FINDING if row["doubted"] else ChangeReason.FAILED, row["reason"] or "")
        case ChangeReason.RULES:
            return Reason(ChangeReason.RULES, _lines(other_rules(snapshot, [row["was_rules"]], [row["ingest_rules"]])))
        case ChangeReason.PROGRAMS:
            return Reason(ChangeReason.PROGRAMS, _lines(other_programs(snapshot, [row["was_programs"]], [row["programs"]])))
        case _:
            return Reason(ChangeReason.JUST_EXECUTED, short(row["prior"]))


def _lines(changes: Iterator[Any]) -> str:
    return few([change.line for change in changes], SHOWN) or "the differences are not recorded"
