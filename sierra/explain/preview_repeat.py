"""Preview of repeating a recorded batch's query now, with the current project."""

from __future__ import annotations

from collections.abc import Container

from sierra.config.project_file import LoadedProject
from sierra.design.query.query_request import repeated
from sierra.errors import SierraError
from sierra.execution import resolve_plan, targets
from sierra.execution.build.state import BuildState
from sierra.execution.dry_run import forecast, has_other_files
from sierra.execution.plan import Plan
from sierra.execution.reasons import Reason
from sierra.explain.diff.model import Difference
from sierra.explain.why_new_runs import other_programs, why_other
from sierra.store.row_types import BatchRow
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass


@dataclass(frozen=True, slots=True)
class NextRun:
    """The effect of repeating a batch's query now."""

    batch: str
    """Id of the batch whose query it is."""
    error: str = ""
    """Reason why the query cannot be repeated as it is."""
    other_batch: str = ""
    """Id of the batch that the query makes now, if that is another one."""
    differences: tuple[Difference, ...] = ()
    """Differences that make it another batch, or, for the same batch, the programs that differ."""
    reasons: tuple[tuple[int, Reason], ...] = ()
    """Numbers of runs by the reason why they would be executed or reused."""
    build: BuildState | None = None
    """State of the products of `[build]`; until they are built, it is unknown which runs would be executed."""


def next_run(project: LoadedProject, store: Store, batch: str, runs: Container[str] | None) -> NextRun:
    """Return the effect of repeating the query on these runs (None: on all). Executes nothing."""
    try:
        plan = _plan(project, store, batch)
    except SierraError as error:
        return NextRun(batch, error=str(error))
    if plan.batch.id != batch:
        return NextRun(batch, other_batch=plan.batch.id, differences=why_other(plan, store, batch), build=plan.build)
    reasons = forecast(plan, store, runs).reasons
    programs = other_programs(plan, store) if has_other_files(reasons) else ()
    return NextRun(
        batch,
        differences=programs,
        reasons=tuple((count, reason) for reason, count in reasons.most_common()),
        build=plan.build,
    )


def _plan(project: LoadedProject, store: Store, batch: str) -> Plan:
    [row] = store.select(BatchRow, "SELECT * FROM batches WHERE batch = $b", b=batch)
    [runs] = store.values(int, "SELECT max(number) + 1 AS runs FROM batch_runs WHERE batch = $b", b=batch)
    plan = resolve_plan.plan(project, repeated(row._asdict(), runs, targets.recorded(store, batch)))
    plan.check_programs()
    return plan
