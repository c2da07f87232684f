"""Effective executions: for each batch, the effective execution of runs, and the reason if there is none.

The module states the rule of the table `effective` in words.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sierra.execution.reasons import ChangeReason, Reason
from sierra.explain.diff.environment import other_programs, other_rules
from sierra.explain.diff.load_sides import make_runs
from sierra.store.recorded_files import Place
from sierra.store.store import Snapshot
from sierra.store.views import LATEST
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


ASKED = f"{LATEST} SELECT programs, ingest_rules FROM latest WHERE batch = $b"  # noqa: S608 - of our own parts
STANDINGS = """
SELECT t.counts, t.execution IS NOT NULL AS tried, coalesce(t.status = 'ok', false) AS good, e.reason, e.programs,
       e.ingest_rules, count(*) AS runs, min(t.run) AS run, arg_min(t.own, t.run) AS execution
FROM standing t LEFT JOIN (
    SELECT judgement AS execution, CASE WHEN status <> 'ok' THEN coalesce(reason, status) END AS reason,
           CASE WHEN status = 'ok' THEN programs END AS programs, CASE WHEN status = 'ok' THEN ingest_rules END AS ingest_rules
    FROM all_judgements WHERE judgement IN (SELECT execution FROM standing WHERE NOT counts)
) e ON e.execution = t.execution
GROUP BY ALL ORDER BY runs DESC, run
"""


def standings(snapshot: Snapshot, batches: list[str]) -> Iterator[EffectiveRuns]:
    """Yield the situation of the runs in the table `wanted`, in each of these batches."""
    snapshot.views.make(("batch_runs", "sessions", "all_judgements", "batches"))
    for batch in batches:
        make_runs(snapshot, Place(batch), "standing", good_first=True, only=" AND m.run IN (SELECT run FROM wanted)")
        latest = snapshot.rows(ASKED, b=batch) or [{"programs": None, "ingest_rules": None}]
        for row in snapshot.rows(STANDINGS):
            told = {**row, "now_programs": latest[0]["programs"], "now_rules": latest[0]["ingest_rules"]}
            yield EffectiveRuns(batch, row["runs"], row["counts"], _why(snapshot, told), row["run"], row["execution"])
        snapshot.run("DROP TABLE standing")


def _why(snapshot: Snapshot, row: dict[str, Any]) -> Reason:
    if row["counts"]:
        return Reason(ChangeReason.REUSED)
    if not row["tried"]:
        return Reason(ChangeReason.NEVER)
    if not row["good"]:
        return Reason(ChangeReason.FAILED, row["reason"] or "")
    return Reason(ChangeReason.STALE, _other(snapshot, row))


def _other(snapshot: Snapshot, row: dict[str, Any]) -> str:
    return few([*_differences(snapshot, row)], SHOWN) or "the differing programs or rules are not recorded"


def _differences(snapshot: Snapshot, row: dict[str, Any]) -> Iterator[str]:
    if row["programs"] != row["now_programs"]:
        yield from (one.line for one in other_programs(snapshot, [row["programs"]], [row["now_programs"]]))
    if row["ingest_rules"] != row["now_rules"]:
        yield from (one.line for one in other_rules(snapshot, [row["ingest_rules"]], [row["now_rules"]]))
