"""Reasons why recorded runs were executed or not, their effective executions, and the effect of repeating the query."""

from __future__ import annotations

from collections.abc import Mapping

from sierra.config.project_file import LoadedProject
from sierra.execution.cluster_status import ClusterSession as OnCluster
from sierra.execution.cluster_status import seen
from sierra.execution.reasons import Basis
from sierra.explain.diff.compare import made_other
from sierra.explain.effective_executions import EffectiveRuns, standings
from sierra.explain.history import Event, events
from sierra.explain.preview_repeat import NextRun, next_run
from sierra.explain.why_new_runs import NewRuns
from sierra.store.recorded_files import where
from sierra.store.store import ResolvedId, Snapshot, Store
from sierra.util.lazy_definitions import dataclass

BATCHES = 10
"""Maximum number of batches in the answer."""

BATCHES_OF_RUN = """
SELECT b.batch FROM batches b LEFT JOIN (SELECT batch, max(lamport) AS asked FROM sessions GROUP BY batch) s USING (batch)
WHERE b.batch IN (SELECT batch FROM batch_runs WHERE run = $r) ORDER BY coalesce(s.asked, b.lamport) DESC
"""
EARLIER = """
WITH s AS (SELECT batch, max(lamport) AS asked, arg_max(coalesce(target, ''), lamport) AS target FROM sessions GROUP BY batch)
SELECT b.batch, b.query FROM batches b JOIN batches this ON this.batch = $b
LEFT JOIN s ON s.batch = b.batch LEFT JOIN s now ON now.batch = this.batch
WHERE b.axes = this.axes AND b.lamport < this.lamport AND b.batch <> this.batch
ORDER BY coalesce(s.target, '') = coalesce(now.target, '') DESC,
         CASE WHEN s.asked < this.lamport THEN s.asked ELSE b.lamport END DESC LIMIT 1
"""


@dataclass(frozen=True, slots=True)
class Why:
    """Answer to `sierra why`."""

    found: ResolvedId
    runs: int
    history: tuple[Event, ...]
    """Events in order; for an execution, only the event of that execution."""
    new_because: Mapping[str, NewRuns]
    """By batch with new runs, its differences from the batch over the same axes that was recorded before it."""
    effective: tuple[EffectiveRuns, ...]
    next_run: NextRun
    """Effect of repeating the query on these runs."""
    clusters: tuple[OnCluster, ...] = ()
    """Sessions on clusters with some of these runs."""


def why(project: LoadedProject, store: Store, prefix: str) -> Why:
    """Return the reasons why the runs of an id were executed or not. Raises NotFound."""
    resolved = store.resolve(prefix)
    with store.snapshot() as snapshot:
        snapshot.run("SET threads = 1")
        batches = _runs(snapshot, resolved)
        history = events(snapshot, batches)
        if resolved.kind == "execution":
            history = [event for event in history if event.session == _session(snapshot, resolved.id)]
        stands = tuple(standings(snapshot, batches))
        [(wanted,)] = snapshot.run("SELECT count(*) FROM wanted")
        these = {row[0] for row in snapshot.run("SELECT run FROM wanted")}
        only = None if resolved.kind == "batch" else these
        firsts = dict.fromkeys(event.batch for event in history if any(cause.new for cause in event.causes))
        before = {batch: _before(snapshot, batch) for batch in list(firsts)[:BATCHES]}
    because = {
        batch: NewRuns(Basis.BATCH, *earlier, made_other(project, store, earlier[0], batch))
        if earlier
        else NewRuns(Basis.NOTHING)
        for batch, earlier in before.items()
    }
    return Why(
        resolved,
        wanted,
        tuple(history),
        because,
        stands,
        next_run(project, store, batches[0], only),
        tuple(seen(store, these)),
    )


def _runs(snapshot: Snapshot, resolved: ResolvedId) -> list[str]:
    """Create the table `wanted` of the runs of an id.

    Returns the batches that the answer covers, last used first.
    """
    if resolved.kind == "batch":
        snapshot.views.make(("batch_runs",))
        snapshot.run("CREATE TEMP TABLE wanted AS SELECT DISTINCT run FROM batch_runs WHERE batch = $b", {"b": resolved.id})
        return [resolved.id]
    origin = where(snapshot, resolved)
    statement = f"CREATE TEMP TABLE wanted AS SELECT DISTINCT m.run FROM batch_runs m WHERE m.batch = $b {origin.only}"  # noqa: S608
    snapshot.run(statement, origin.parameters)
    [(run,), *_] = snapshot.run("SELECT run FROM wanted LIMIT 1")
    batches = [row[0] for row in snapshot.run(BATCHES_OF_RUN, {"r": run})]
    if resolved.kind == "experiment":
        having = {row[0] for row in snapshot.run("SELECT batch FROM experiments WHERE experiment = $x", {"x": resolved.id})}
        batches = [batch for batch in batches if batch in having]
    return batches[:BATCHES]


def _session(snapshot: Snapshot, execution: str) -> str:
    return snapshot.values(str, "SELECT session FROM executions WHERE execution = $e", e=execution)[0]


def _before(snapshot: Snapshot, batch: str) -> tuple[str, str] | None:
    """Return the id and the query of the batch over the same axes that was recorded before another one."""
    return next(iter(snapshot.run(EARLIER, {"b": batch})), None)
