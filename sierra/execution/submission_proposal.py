"""Proposal for the submission of a plan's missing runs to a cluster, from records; nothing is submitted or written."""

from __future__ import annotations

import os
from collections.abc import Container
from pathlib import Path
from typing import NamedTuple

from sierra import runners
from sierra.execution import expected_durations
from sierra.execution.dry_run import forecast
from sierra.execution.plan import Plan
from sierra.provenance import source
from sierra.runners.cluster.resource_estimate import Estimate, propose
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.store.store import Store

OF_JOB = 200.0
"""Approximate bytes that one run adds to the job list of its array task, without the parts that runs share."""
OF_RECORD = 600.0
"""Approximate bytes of the records of one run, without its files."""


class Written(NamedTuple):
    """The mean size of what successful runs wrote; None without such runs."""

    bytes: float | None


WROTE = """
WITH those AS (
    SELECT execution FROM executions e JOIN batches b USING (batch) JOIN specs r USING (spec)
    WHERE e.status IN ('ok', 'accepted') AND e.purpose = 'run' AND r.command = $command
)
SELECT sum(size)::DOUBLE / (SELECT count(*) FROM those) AS bytes
FROM (SELECT DISTINCT execution, path, size FROM artifacts SEMI JOIN those USING (execution))
"""


def proposal(
    plan: Plan, store: Store | None, runner: str, *, detach: bool, runs: Container[str] | None = None
) -> Estimate | None:
    """Return the estimate of a plan's missing runs on the cluster of that runner.

    Returns None if the runner has no cluster, or if all missing runs are on a cluster already. With `detach`, no process
    would follow the jobs. `runs`: only these runs are submitted. Raises ConfigError.
    """
    cluster = runners.scheduler_of(runner, plan.project.config.runners)
    if cluster is None or not (wanted := forecast(plan, store, runs).to_execute):
        return None
    scheduler, table = cluster
    wrote = _wrote(plan, store) if store else None
    _, times = expected_durations.expected(plan, store, wanted, runner=runner)
    return propose(
        runner,
        scheduler,
        table,
        StorePaths(ProjectPaths(plan.project.root).store).work,
        count=len(wanted),
        times=times,
        each=None if wrote is None else OF_JOB + OF_RECORD + wrote,
        beside=_code(plan),
        waits=not detach,
        gpus=plan.limits.most.gpus,
        cores=plan.limits.most.cores or 1,
    )


def _wrote(plan: Plan, store: Store) -> float | None:
    """Return the mean bytes that successful runs with the same command wrote; None without such runs."""
    [written] = store.select(Written, WROTE, command=list(plan.batch.spec.command))
    return written.bytes


def _code(plan: Plan) -> tuple[int, int]:
    """Return the number of files of the code, and their bytes, as they are in the project now."""
    manifest = plan.source.manifest if plan.source else plan.checkout.manifest if plan.checkout else b""
    paths = source.paths(manifest)
    return len(paths), sum(_size(plan.project.root / os.fsdecode(path)) for path in paths)


def _size(path: Path) -> int:
    try:
        return path.lstat().st_size
    except OSError:
        return 0
