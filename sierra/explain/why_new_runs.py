"""Reasons for new runs: differences between a plan and the most similar recorded batch."""

from __future__ import annotations

from typing import NamedTuple

from sierra.execution import row_queries
from sierra.execution.observation import stale_sessions
from sierra.execution.plan import Plan
from sierra.execution.reasons import Basis
from sierra.execution.session_records import batch_row, is_kept
from sierra.explain.diff.model import Difference
from sierra.provenance import fingerprint_programs
from sierra.provenance.dependency_model import Programs, mentioned
from sierra.store.store import Snapshot, Store
from sierra.util.lazy_definitions import dataclass


@dataclass(frozen=True, slots=True)
class NewRuns:
    """The reason why runs of a plan or of a batch are new: its differences from a batch that was recorded before."""

    basis: Basis
    batch: str = ""
    query: str = ""
    differences: tuple[Difference, ...] = ()


class Similar(NamedTuple):
    """A recorded batch over the axes of a plan, as it was requested."""

    batch: str
    query: str
    runs: int
    controller: str | None
    scenario: str | None
    base_seed: int
    overrides: list[str]
    target: str | None
    """The target of its last session."""


SIMILAR = """
SELECT b.batch, b.query, b.runs, b.controller, b.scenario, b.base_seed, b.overrides, nullif(s.target, '') AS target
FROM batches b LEFT JOIN (
    SELECT batch, max(lamport) AS asked, arg_max(coalesce(target, ''), lamport) AS target FROM sessions GROUP BY batch
) s USING (batch)
WHERE b.axes = $axes AND b.batch <> $batch
ORDER BY coalesce(s.target, '') = $target DESC, coalesce(s.asked, b.lamport) DESC LIMIT 1
"""


class Known(NamedTuple):
    """The number of recorded batches with one id (0 or 1), and the programs of the last session of that batch."""

    kept: int
    programs: str | None


KNOWN = """
SELECT (SELECT count(*) FROM batches WHERE batch = $batch) AS kept,
       (SELECT arg_max(programs, lamport) FROM sessions WHERE batch = $batch) AS programs
"""
REQUEST = ("query", "runs", "controller", "scenario", "base_seed")
"""The columns of a batch that repeat the request."""


def why_new(plan: Plan, store: Store | None) -> NewRuns:
    """Return the differences between a plan and the last batch over the same axes."""
    if store is None:
        return NewRuns(Basis.EMPTY_STORE)
    if is_kept(plan, store):
        return NewRuns(Basis.SAME_BATCH)
    before = _similar(plan, store)
    if before is None:
        return NewRuns(Basis.NOTHING)
    return NewRuns(Basis.BATCH, before.batch, before.query, why_other(plan, store, before.batch))


def why_other(plan: Plan, store: Store, batch: str) -> tuple[Difference, ...]:
    """Return the differences between a plan and a recorded batch."""
    from sierra.explain.diff.compare import other_plan  # most calls of `sierra run` need no comparison

    return other_plan(plan, store, batch)


def why_again(plan: Plan, store: Store) -> tuple[Difference, ...]:
    """Return the reasons why a repeated query executes runs again.

    There are none for a query that is not a repetition, or that executes nothing again.
    """
    with store.snapshot() as snapshot:
        [known] = snapshot.select(Known, KNOWN, batch=plan.batch.id)
        before = None if known.kept else _similar(plan, snapshot)
    if known.kept:
        return other_programs(plan, store) if known.programs not in (None, plan.programs.id) else ()
    return why_other(plan, store, before.batch) if before and _is_repeated(before, plan) else ()


def _similar(plan: Plan, store: Store | Snapshot) -> Similar | None:
    """Return the last other batch over the same axes, if possible for the same target."""
    axes = [axis.name for axis in plan.batch.axes]
    rows = store.select(Similar, SIMILAR, axes=axes, batch=plan.batch.id, target=plan.target or "")
    return rows[0] if rows else None


def _is_repeated(before: Similar, plan: Plan) -> bool:
    """Check whether a plan was requested in the same words as a recorded batch."""
    now = batch_row(plan)
    same = before.target == plan.target and set(before.overrides) == set(now.overrides)
    return same and all(getattr(before, name) == getattr(now, name) for name in REQUEST)


LAST_PROGRAMS = """
SELECT programs FROM executions SEMI JOIN asked USING (run) WHERE purpose = 'run' ORDER BY lamport DESC LIMIT 1
"""


def other_programs(plan: Plan, store: Store) -> tuple[Difference, ...]:
    """Return the programs that differ from those of the last execution of the plan's runs, which other batches may have too."""
    words = mentioned(plan.batch.spec.words, plan.project.root)
    with store.snapshot() as snapshot:
        stale = stale_sessions.find(plan, snapshot)
        snapshot.add_table("asked", run=(run.id for run in plan.batch.runs))
        last = snapshot.values(str, LAST_PROGRAMS)
        recorded = Programs(tuple(row.program() for row in row_queries.programs(snapshot, last)))
        used = row_queries.used_distributions(snapshot, last)
    lines = [
        *fingerprint_programs.differences(recorded, plan.programs, words, used),
        *([stale_sessions.reason(stale)] if stale else []),
    ]
    return tuple(Difference("programs", line.partition(":")[0], line) for line in lines)
