"""History of some runs, in order: each session and each replay, and the reason why it executed runs.

An execution is compared with earlier executions of the same run, except those that ran at the same time, as the session saw
them: a finding is valid from the time when it was made. If there are several, the best one decides. The order is: failed,
other rules, other programs, successful.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import NamedTuple

from sierra.execution.observation.stale_sessions import OBSERVED
from sierra.execution.reasons import BY_USEFULNESS, FAILED, PROGRAMS, REUSED, RULES, ChangeReason, Reason
from sierra.explain.diff.environment import other_programs, other_rules
from sierra.explain.diff.model import Difference
from sierra.model import Purpose
from sierra.store.row_types import SessionRow
from sierra.store.store import Snapshot
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass
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
    """One session, replay or capture."""

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
    """The package in which it came, and reasons why runs were started or executed more often than requested on a cluster."""


EXECUTED = f"""
CREATE TEMP TABLE happened AS
WITH mine AS (
    SELECT e.judgement, e.judged_at, e.place, e.execution, e.run, e.session, e.batch, e.started, e.ended, e.status, e.reason,
           e.programs, e.ingest_rules, e.purpose, e.lamport, e.packages
    FROM all_judgements e SEMI JOIN wanted USING (run)
),
observed AS (
    SELECT DISTINCT session, run FROM ({OBSERVED} AND e.session IN (SELECT session FROM mine))
    JOIN batch_runs USING (batch, ordinal) WHERE run IN (SELECT run FROM wanted)
),
first AS (SELECT * EXCLUDE (judgement, judged_at, place) FROM mine WHERE judgement = execution),
earlier AS (
    SELECT e.execution, p.execution AS prior, p.lamport, p.programs, p.ingest_rules, p.reason,
           f.lamport IS NOT NULL AND f.lamport < e.lamport AS doubted,
           (p.session, p.run) NOT IN (SELECT (session, run) FROM observed) AS unobserved,
           CASE WHEN p.status NOT IN ('ok', 'accepted') AND (f.lamport IS NULL OR f.lamport < e.lamport) THEN $failed
                WHEN p.ingest_rules <> e.ingest_rules THEN $rules
                WHEN p.programs <> e.programs OR (e.session, p.session) IN (SELECT (session, stale) FROM stale_sessions)
                THEN $programs
                ELSE $good END AS worth
    FROM first e JOIN mine p ON p.run = e.run AND p.execution <> e.execution AND p.place < e.lamport AND p.purpose = 'run'
        AND p.packages IS NOT DISTINCT FROM e.packages
        AND NOT (p.session <> e.session AND p.started < e.ended AND p.ended > e.started)
    LEFT JOIN findings f ON f.execution = p.judgement
    QUALIFY row_number() OVER (
        PARTITION BY e.execution, p.execution ORDER BY p.ingest_rules = e.ingest_rules DESC, p.place DESC, p.judgement
    ) = 1
),
best AS (
    SELECT execution, max(worth) AS worth, arg_max({{'prior': prior, 'programs': programs, 'ingest_rules': ingest_rules,
           'reason': reason, 'doubted': doubted, 'unobserved': unobserved}}, (worth, lamport)) AS best
    FROM earlier GROUP BY execution
)
SELECT m.*, b.worth, b.best, EXISTS (
    SELECT 1 FROM first o WHERE o.run = m.run AND o.purpose = 'run' AND o.session <> m.session AND o.lamport < m.lamport
        AND o.started < m.ended AND o.ended > m.started
) AS beside
FROM first m LEFT JOIN best b USING (execution)
"""  # noqa: S608 - of our own parts


class Executions(NamedTuple):
    """Executions of one session for the same reason, and the best earlier execution of their runs."""

    session: str
    batch: str
    purpose: str
    worth: int | None
    """Place of that earlier execution in `BY_USEFULNESS`; None without one."""
    beside: bool
    """True if another session executed the runs at the same time."""
    doubted: bool | None
    reason: str | None
    was_rules: str | None
    was_programs: str | None
    ingest_rules: str | None
    programs: str | None
    unobserved: bool | None
    """True if no run of the experiment was observed in the session of that earlier execution."""
    executions: int
    failed: int
    started: datetime
    lamport: int
    execution: str
    run: str
    prior: str | None


CAUSES = """
SELECT session, batch, purpose, worth, beside, best.doubted AS doubted, CASE WHEN worth = 0 THEN best.reason END AS reason,
       CASE WHEN worth = 1 THEN best.ingest_rules END AS was_rules, CASE WHEN worth = 2 THEN best.programs END AS was_programs,
       CASE WHEN worth = 1 THEN ingest_rules END AS ingest_rules, CASE WHEN worth = 2 THEN programs END AS programs,
       CASE WHEN worth = 2 THEN best.unobserved END AS unobserved,
       count(*) AS executions, count(*) FILTER (status NOT IN ('ok', 'accepted')) AS failed, min(started) AS started,
       min(lamport) AS lamport, arg_min(execution, lamport) AS execution, arg_min(run, lamport) AS run,
       arg_min(best.prior, lamport) AS prior
FROM happened GROUP BY ALL ORDER BY executions DESC, execution
"""


class Cut(NamedTuple):
    """Attempts of a session that were cut off, with the number of runs that they had started."""

    session: str
    times: int
    interrupted: int
    errors: list[str]


CUT = """
WITH mine AS (
    SELECT DISTINCT a.session, a.array_task FROM attempts a JOIN executions e USING (attempt) SEMI JOIN wanted USING (run)
)
SELECT session, count(*) AS times, sum(interrupted_runs)::INT AS interrupted,
       coalesce(list(DISTINCT error ORDER BY error) FILTER (error <> ''), []) AS errors
FROM attempts SEMI JOIN mine USING (session, array_task) WHERE state = 'cut off' AND interrupted_runs > 0 GROUP BY session
"""


class Copies(NamedTuple):
    """Executions of a session that were executed twice."""

    session: str
    copies: int
    other: int
    execution: str


COPIED = """
SELECT e.session, count(*) AS copies, count(*) FILTER (NOT same) AS other, min(execution) AS execution
FROM duplicates JOIN executions e USING (execution) WHERE e.run IN (SELECT run FROM wanted) GROUP BY e.session
"""
IMPORTED = "SELECT session, packages[1] AS package FROM imported_sessions"
SESSIONS = "SELECT * FROM all_sessions WHERE list_contains($b, batch) OR list_contains($s, session)"


class Reevaluated(NamedTuple):
    """Runs whose executions a session evaluated again, with the rules before and after."""

    session: str
    batch: str
    runs: int
    judged_at: datetime
    lamport: int
    ingest_rules: list[str]
    was_rules: list[str]


JUDGED = """
SELECT j.session, any_value(j.batch) AS batch, count(DISTINCT j.run) AS runs, min(j.judged_at) AS judged_at,
       min(j.lamport) AS lamport, list(DISTINCT j.ingest_rules) AS ingest_rules, list(DISTINCT e.ingest_rules) AS was_rules
FROM judgements j SEMI JOIN wanted USING (run) JOIN all_judgements e ON e.judgement = j.execution GROUP BY j.session
"""


class Replay(NamedTuple):
    """A replay, and what it replayed."""

    replay: str
    kind: str
    target: str
    verdict: str


REPLAYS = "SELECT replay, kind, target, verdict FROM replays WHERE list_contains($s, replay)"
CAPTURES = "SELECT DISTINCT session FROM captures WHERE list_contains($s, session)"


def events(snapshot: Snapshot, batches: Sequence[str]) -> list[Event]:
    """Return all events of the runs in the table `wanted`, and all sessions of these batches, in order."""
    snapshot.views.make(
        (
            "executions",
            "all_judgements",
            "findings",
            "all_sessions",
            "replays",
            "captures",
            "batch_runs",
            "attempts",
            "duplicates",
            "stale_sessions",
            "imported_sessions",
            "observations",
        )
    )
    snapshot.run(EXECUTED, {"failed": FAILED, "rules": RULES, "programs": PROGRAMS, "good": REUSED})
    rows = snapshot.select(Executions, CAUSES)
    reevaluated = {row.session: row for row in snapshot.select(Reevaluated, JUDGED)}
    snapshot.run("DROP TABLE happened")
    executed: dict[str, list[Executions]] = {}
    for row in rows:
        executed.setdefault(row.session, []).append(row)
    recorded = snapshot.select(SessionRow, SESSIONS, b=list(batches), s=[*executed, *reevaluated])
    sessions = {row.session: row for row in recorded}
    keys = list(dict.fromkeys((*sessions, *executed, *reevaluated)))
    replays = {row.replay: row for row in snapshot.select(Replay, REPLAYS, s=keys)}
    ended = {*sessions, *replays, *snapshot.values(str, CAPTURES, s=keys)}
    notes = _notes(snapshot)

    def place(key: str) -> int:
        numbers = [row.lamport for row in executed.get(key, ())]
        numbers += [row.lamport for row in (sessions.get(key), reevaluated.get(key)) if row is not None]
        return min(numbers)

    return [
        _event(
            snapshot,
            key,
            executed.get(key, []),
            sessions.get(key),
            replays.get(key),
            reevaluated.get(key),
            notes.get(key, []),
            ended=key in ended,
        )
        for key in sorted(keys, key=place)
    ]


def _event(
    snapshot: Snapshot,
    session: str,
    rows: Sequence[Executions],
    submission: SessionRow | None,
    replay: Replay | None,
    reevaluated: Reevaluated | None,
    notes: Sequence[str],
    *,
    ended: bool,
) -> Event:
    rules = other_rules(snapshot, reevaluated.was_rules, reevaluated.ingest_rules) if reevaluated else None
    first = next(part for part in (submission, *rows, reevaluated) if part is not None)
    purpose = rows[0].purpose if rows else "run"
    return Event(
        session=session,
        when=submission.started if submission else _began(rows, reevaluated),
        kind="session" if purpose == "run" else purpose,
        batch=first.batch,
        query=submission.query if submission else "",
        executed=sum(row.executions for row in rows),
        failed=sum(row.failed for row in rows),
        reevaluated=reevaluated.runs if reevaluated else 0,
        other_rules="" if rules is None else _lines(rules),
        reused=submission.reused if submission else None,
        ended=ended,
        causes=tuple(_cause(snapshot, row, replay) for row in rows),
        notes=tuple(notes),
    )


def _began(rows: Sequence[Executions], reevaluated: Reevaluated | None) -> datetime | None:
    """Return the time of the first action of a session without a record."""
    return min((row.started for row in rows), default=reevaluated.judged_at if reevaluated else None)


def _notes(snapshot: Snapshot) -> dict[str, list[str]]:
    """Return notes by session: on its origin, and on runs that were started or executed more often than requested, and why."""
    notes: dict[str, list[str]] = {}
    for cut in snapshot.select(Cut, CUT):
        why = few(cut.errors, SHOWN) or "unknown cause"
        which = f"array tasks were interrupted {cut.times} times" if cut.times > 1 else "an array task was interrupted"
        line = f"{which} while {counted(cut.interrupted, 'run')} executed; these runs were started again: {why}"
        notes.setdefault(cut.session, []).append(line)
    for copied in snapshot.select(Copies, COPIED):
        other = f"{copied.other} of them with different results" if copied.other else "with the same results"
        which = f"{copied.copies} (for example, {short(copied.execution)}), {other}"
        line = f"executed twice, because two copies of an array task ran at the same time: {which}"
        notes.setdefault(copied.session, []).append(line)
    for session, package in snapshot.run(IMPORTED):
        notes.setdefault(session, []).append(f"executed elsewhere; it came in package {short(package)}")
    return notes


def _cause(snapshot: Snapshot, row: Executions, replay: Replay | None) -> Cause:
    new = row.worth is None and row.purpose == "run" and not row.beside
    return Cause(row.executions, _why(snapshot, row, replay), row.execution, row.run, new)


def _why(snapshot: Snapshot, row: Executions, replay: Replay | None) -> Reason:
    if row.purpose == Purpose.CAPTURE:
        return Reason(ChangeReason.CAPTURE)
    if row.purpose != Purpose.RUN:
        of = f" of {replay.kind} {short(replay.target)}: {replay.verdict}" if replay else " that did not end"
        return Reason(ChangeReason.REPLAY, of)
    if row.worth is None:
        return Reason(ChangeReason.CONCURRENT if row.beside else ChangeReason.NEW)
    match BY_USEFULNESS[row.worth]:
        case ChangeReason.FAILED:
            return Reason(ChangeReason.FINDING if row.doubted else ChangeReason.FAILED, row.reason or "")
        case ChangeReason.RULES:
            return Reason(ChangeReason.RULES, _lines(other_rules(snapshot, [row.was_rules or ""], [row.ingest_rules or ""])))
        case ChangeReason.PROGRAMS:
            if row.was_programs == row.programs:
                if row.unobserved:
                    return Reason(ChangeReason.UNOBSERVED, changed_files(snapshot, row.session))
                return Reason(
                    ChangeReason.PROGRAMS, f"files that they used have changed: {changed_files(snapshot, row.session)}"
                )
            programs = other_programs(snapshot, [row.was_programs or ""], [row.programs or ""])
            return Reason(ChangeReason.PROGRAMS, _lines(programs))
        case _:
            return Reason(ChangeReason.JUST_EXECUTED, short(row.prior or ""))


def changed_files(snapshot: Snapshot, session: str) -> str:
    """Return the files, used by observed earlier executions, that had changed when a session began."""
    paths = snapshot.values(str, "SELECT DISTINCT path FROM stale_sessions WHERE session = $s ORDER BY 1", s=session)
    return few(paths, SHOWN)


def _lines(changes: Iterator[Difference]) -> str:
    return few([change.line for change in changes], SHOWN) or "the differences are not recorded"
