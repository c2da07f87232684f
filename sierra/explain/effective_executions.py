"""Effective executions: for each batch, the effective execution of runs, and the reason if there is none.

The module states the rule of the table `effective` in words.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from sierra.execution.observation.stale_sessions import OBSERVED
from sierra.execution.reasons import ChangeReason, Reason
from sierra.explain.diff.environment import other_programs, other_rules
from sierra.explain.diff.load_sides import make_runs
from sierra.explain.diff.model import Difference
from sierra.store import view_sql
from sierra.store.recorded_files import Place
from sierra.store.store import Snapshot
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import few

SHOWN = 4


@dataclass(frozen=True, slots=True)
class EffectiveRuns:
    """Group of runs of one batch in the same situation."""

    batch: str
    runs: int
    is_effective: bool
    reason: Reason
    run: str
    """Id of one of the runs."""
    execution: str | None
    """Effective execution of that run, or else its last one."""


class Latest(NamedTuple):
    """The last session of a batch, its programs and its rules."""

    session: str | None
    programs: str | None
    ingest_rules: str | None


class Standing(NamedTuple):
    """Runs in the same situation; programs and rules are those of their last execution, if that was successful."""

    counts: bool
    unchanged: bool
    """True if the execution counts although the source or the programs differ."""
    tried: bool
    good: bool
    reason: str | None
    programs: str | None
    ingest_rules: str | None
    imported: bool
    """True if that execution came in a package."""
    unobserved: bool
    """True if no run of its experiment was observed in its session."""
    runs: int
    run: str
    execution: str | None


OF_LAST_SESSION = " SELECT session, programs, ingest_rules FROM latest WHERE batch = $b"
STANDINGS = f"""
WITH last AS (SELECT * FROM all_judgements WHERE judgement IN (SELECT execution FROM standing WHERE NOT counts))
SELECT t.counts,
       coalesce(t.own IN (SELECT execution FROM reused_executions WHERE session = $session), false) AS unchanged,
       t.execution IS NOT NULL AS tried, coalesce(t.status IN ('ok', 'accepted'), false) AS good, e.reason, e.programs,
       e.ingest_rules, coalesce(e.imported, false) AS imported, coalesce(e.unobserved, false) AS unobserved,
       count(*) AS runs, min(t.run) AS run, arg_min(t.own, t.run) AS execution
FROM standing t LEFT JOIN (
    SELECT judgement AS execution, CASE WHEN status NOT IN ('ok', 'accepted') THEN coalesce(reason, status) END AS reason,
           CASE WHEN status IN ('ok', 'accepted') THEN programs END AS programs,
           CASE WHEN status IN ('ok', 'accepted') THEN ingest_rules END AS ingest_rules,
           packages IS NOT NULL AS imported, status IN ('ok', 'accepted') AND (session, run) NOT IN (
               SELECT (session, run) FROM ({OBSERVED} AND e.session IN (SELECT session FROM last))
               JOIN batch_runs USING (batch, ordinal) WHERE run IN (SELECT run FROM last)
           ) AS unobserved
    FROM last
) e ON e.execution = t.execution
GROUP BY ALL ORDER BY runs DESC, run
"""  # noqa: S608 - of our own parts


def standings(snapshot: Snapshot, batches: list[str]) -> Iterator[EffectiveRuns]:
    """Yield the situation of the runs in the table `wanted`, in each of these batches."""
    snapshot.views.make(
        (
            "batch_runs",
            "sessions",
            "executions",
            "all_judgements",
            "batches",
            "stale_sessions",
            "reused_executions",
            "origins",
            "observations",
        )
    )
    for batch in batches:
        make_runs(snapshot, Place(batch), "standing", good_first=True, only=" AND m.run IN (SELECT run FROM wanted)")
        latest = next(iter(snapshot.select(Latest, view_sql.latest() + OF_LAST_SESSION, b=batch)), Latest(None, None, None))
        for row in snapshot.select(Standing, STANDINGS, session=latest.session):
            yield EffectiveRuns(batch, row.runs, row.counts, _why(snapshot, row, latest), row.run, row.execution)
        snapshot.run("DROP TABLE standing")


def _why(snapshot: Snapshot, row: Standing, latest: Latest) -> Reason:
    if row.counts and row.unchanged:
        names = snapshot.values(str, "SELECT DISTINCT name FROM unused_changes WHERE session = $s ORDER BY 1", s=latest.session)
        return Reason(ChangeReason.UNCHANGED, few(names, SHOWN))
    if row.counts:
        return Reason(ChangeReason.REUSED)
    if not row.tried:
        return Reason(ChangeReason.NEVER)
    if not row.good:
        return Reason(ChangeReason.FAILED, row.reason or "")
    if (row.programs, row.ingest_rules) == latest[1:] and row.imported:
        return Reason(ChangeReason.STALE, "it came in a package, and in this batch other executions count")
    if (row.programs, row.ingest_rules) == latest[1:]:
        unobserved = "not observed, and files that other runs of its session used have changed"
        return Reason(ChangeReason.STALE, unobserved if row.unobserved else "files that it used have changed")
    differences = [difference.line for difference in _differences(snapshot, row, latest)]
    return Reason(ChangeReason.STALE, few(differences, SHOWN) or "the differing programs or rules are not recorded")


def _differences(snapshot: Snapshot, row: Standing, latest: Latest) -> Iterator[Difference]:
    if row.programs != latest.programs:
        yield from other_programs(snapshot, _ids(row.programs), _ids(latest.programs))
    if row.ingest_rules != latest.ingest_rules:
        yield from other_rules(snapshot, _ids(row.ingest_rules), _ids(latest.ingest_rules))


def _ids(identity: str | None) -> list[str]:
    return [identity] if identity else []
