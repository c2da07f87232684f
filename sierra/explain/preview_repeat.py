"""Preview of repeating a recorded batch's query now, with the current project."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container
from dataclasses import dataclass

from sierra.config.project_file import LoadedProject
from sierra.errors import SierraError
from sierra.execution import resolve_plan
from sierra.execution.cluster_status import claimed
from sierra.execution.reasons import ChangeReason, Reason
from sierra.execution.resolve_plan import Plan
from sierra.execution.reuse import foreseen, states
from sierra.explain.why_new_runs import other_programs, why_other
from sierra.query.query_input import repeated
from sierra.store.store import Store


@dataclass(frozen=True, slots=True)
class NextRun:
    """The effect of repeating a batch's query now."""

    batch: str
    """Id of the batch whose query it is."""
    error: str = ""
    """Reason why the query cannot be repeated as it is."""
    other_batch: str = ""
    """Id of the batch that the query makes now, if that is another one."""
    differences: tuple[str, ...] = ()
    """Differences that make it another batch, or, for the same batch, the programs that differ; one line each."""
    reasons: tuple[tuple[int, Reason], ...] = ()
    """Numbers of runs by the reason why they would be executed or reused."""


def next_run(project: LoadedProject, store: Store, batch: str, runs: Container[str] | None) -> NextRun:
    """Return the effect of repeating the query on these runs (None: on all). Executes nothing."""
    try:
        plan = _plan(project, store, batch)
    except SierraError as error:
        return NextRun(batch, error=str(error))
    if plan.batch.id != batch:
        return NextRun(batch, other_batch=plan.batch.id, differences=tuple(why_other(plan, store, batch)))
    found = {run: state for run, state in foreseen(plan, store, states(plan, store)).items() if runs is None or run in runs}
    there = {} if all(state.succeeded for state in found.values()) else claimed(store)
    on_cluster = Reason(ChangeReason.ON_CLUSTER)
    counted = Counter(on_cluster if run in there and not state.succeeded else state.change for run, state in found.items())
    programs = other_programs(plan, store) if counted[Reason(ChangeReason.PROGRAMS)] else ()
    reasons = tuple((count, reason) for reason, count in counted.most_common())
    return NextRun(batch, differences=tuple(programs), reasons=reasons)


def _plan(project: LoadedProject, store: Store, batch: str) -> Plan:
    [row] = store.rows("SELECT * FROM batches WHERE batch = $b", b=batch)
    [last] = store.rows("SELECT max(number) + 1 AS runs FROM batch_runs WHERE batch = $b", b=batch)
    return resolve_plan.plan(project, repeated(row, last["runs"]))
