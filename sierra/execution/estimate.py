"""What answering a plan on a cluster would ask for; nothing is submitted or written."""

from __future__ import annotations

import os
from pathlib import Path

from sierra import runners
from sierra.execution import timing
from sierra.execution.plans import Plan
from sierra.execution.reuse import foreseen, states
from sierra.execution.status import claimed
from sierra.provenance import source
from sierra.runners.cluster.estimate import Estimate, propose
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.store.store import Store

OF_JOB = 200.0
"""Bytes of a run among the jobs of its element, about: what no other run has."""
OF_RECORD = 600.0
"""Bytes of what is recorded of a run, about, beside its files."""
WROTE = """
WITH those AS (
    SELECT execution FROM executions e JOIN batches b USING (batch) JOIN recipes r USING (recipe)
    WHERE e.status = 'ok' AND e.purpose = 'run' AND r.command = $command
)
SELECT sum(size) / (SELECT count(*) FROM those) AS bytes FROM artifacts SEMI JOIN those USING (execution)
"""


def proposal(plan: Plan, store: Store | None, runner: str, *, detach: bool) -> Estimate | None:
    """What is missing of a plan, as that runner's cluster would be asked for it; None where it has none, or nothing is missing
    that is not on a cluster already. `detach`: nobody would follow.

    Raises ConfigError.
    """
    found = runners.scheduler_of(runner, plan.project.config.runners)
    missing = {run for run, state in foreseen(plan, store, states(plan, store)).items() if not (state.good or state.anew)}
    wanted = missing - (claimed(store).keys() if store and missing else set())
    count = len(wanted)
    if found is None or not count:
        return None
    scheduler, table = found
    wrote = _wrote(plan, store) if store else None
    return propose(
        runner,
        scheduler,
        table,
        StorePaths(ProjectPaths(plan.project.root).store).work,
        count=count,
        times=timing.expected(plan, store, wanted),
        each=None if wrote is None else OF_JOB + OF_RECORD + wrote,
        beside=_code(plan),
        waits=not detach,
    )


def _wrote(plan: Plan, store: Store) -> float | None:
    """Bytes that good runs with the same command left in the mean; None where there are none."""
    [row] = store.rows(WROTE, command=list(plan.batch.recipe.command))
    return None if row["bytes"] is None else float(row["bytes"])


def _code(plan: Plan) -> tuple[int, int]:
    """How many files the code has, and their bytes, as they lie in the project now."""
    manifest = plan.source.manifest if plan.source else plan.checkout.manifest if plan.checkout else b""
    paths = source.paths(manifest)
    return len(paths), sum(_size(plan.project.root / os.fsdecode(path)) for path in paths)


def _size(path: Path) -> int:
    try:
        return path.lstat().st_size
    except OSError:
        return 0
