"""Preview of repeating a recorded batch's query now, with the current project."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container

from sierra.config.project_file import LoadedProject
from sierra.errors import SierraError
from sierra.execution import plans
from sierra.execution.plans import Plan
from sierra.execution.reuse import foreseen, states
from sierra.execution.status import ON_CLUSTER, claimed
from sierra.explain.changes import other_programs, why_other
from sierra.query.request import repeated
from sierra.store.store import Store
from sierra.util.hashing import short


def again(project: LoadedProject, store: Store, batch: str, runs: Container[str] | None) -> list[str]:
    """Return the effect of repeating the query on these runs (None: on all), one line each. Executes nothing."""
    try:
        plan = _plan(project, store, batch)
    except SierraError as error:
        return [f"cannot be asked again as it is: {error}"]
    if plan.batch.id != batch:
        because = [f"other runs, those of batch {short(plan.batch.id)}, since:", *why_other(plan, store, batch)]
        return [*because, f"(sierra run {short(batch)} asks for these, with the code of then)"]
    found = {run: state for run, state in foreseen(plan, store, states(plan, store)).items() if runs is None or run in runs}
    there = {} if all(state.succeeded for state in found.values()) else claimed(store)
    counted = Counter(ON_CLUSTER if run in there and not state.succeeded else state.why for run, state in found.items())
    lines = [f"{_runs(count)}: {why}" for why, count in counted.most_common()]
    return [*lines, *(other_programs(plan, store) if counted["executed with other programs"] else [])]


def _runs(count: int) -> str:
    return "1 run" if count == 1 else f"{count} runs"


def _plan(project: LoadedProject, store: Store, batch: str) -> Plan:
    [row] = store.rows("SELECT * FROM batches WHERE batch = $b", b=batch)
    [last] = store.rows("SELECT max(number) + 1 AS runs FROM batch_runs WHERE batch = $b", b=batch)
    return plans.plan(project, repeated(row, last["runs"]))
