"""Execution of a plan, step by step: query → design → inputs → execute → record → analyse → deliver.

`sierra.execution.plans` turns a query into inputs; `run` continues from there and reads as that list. Each step turns values
into values and knows nothing about the other steps; their results are in the store. Everything is idempotent: a repeated
query executes only the runs without a successful execution.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from typing import Any

from sierra import runners
from sierra.execution import records, recover
from sierra.execution.executor import Executor, RunOptions
from sierra.execution.plans import Plan, context, out_of_reach, versioned
from sierra.execution.reuse import FAILED, is_answered, states
from sierra.execution.sessions import Session
from sierra.ingest.consistency import find_odd
from sierra.model import Batch
from sierra.store.store import Store

SHOWN_REASONS = 10


@dataclass(frozen=True, slots=True)
class Failure:
    """Runs without a successful execution that share one reason; with the first of these runs and the end of its log."""

    count: int
    status: str
    reason: str
    run: str
    experiment: Mapping[str, Any]
    number: int
    log: str | None


@dataclass(frozen=True, slots=True)
class Counted:
    """One experiment of the batch: its values, and the numbers of its runs, successful runs and failed runs."""

    values: Mapping[str, Any]
    runs: int
    succeeded: int
    failed: int


@dataclass(frozen=True, slots=True)
class Summary:
    """Result of a query's execution. `failed` and `missing` are numbers of runs without a successful execution."""

    batch: str
    query: str
    experiments: int
    runs: int
    executed: int
    reexecuted: int
    """Number of executed runs that had been executed before."""
    reused: int
    failed: int
    missing: int
    interrupted: bool
    awaited: int = 0
    """Number of the reused runs that another session executed at the same time."""
    reevaluated: int = 0
    """Number of runs that were not executed but evaluated again, because [outputs] or [success] have changed."""
    detached: tuple[str, ...] = ()
    """Ids of sessions on a cluster that continue without this process."""
    counts: tuple[Counted, ...] = ()
    """Numbers of runs by experiment, in the batch's order."""
    failures: tuple[Failure, ...] = ()
    """Failures by reason, most frequent first; at most `SHOWN_REASONS`."""
    notes: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()
    figure_error: str | None = None
    """Reason why no figure could be written (a full disk, a file in the way); the results themselves are recorded."""


def run(plan: Plan, store: Store, options: RunOptions) -> Summary:
    """Execute and record the runs without a successful execution; return a summary.

    When it is interrupted, it ends the runs, or leaves them running if they do not need this process. Finished runs are kept.
    """
    recover.finish_dead(store)
    began = datetime.now(UTC)
    if is_answered(plan, store):
        return _summary(plan, store, len({run.id for run in plan.batch.runs}))
    plan = versioned(plan)
    make = partial(runners.find(options.runner, plan.project.config.runners), options.slots)
    session = Session(store.paths, None if make().stays else plan.project.config.store.place())
    try:
        session.take_number()
        if not records.is_kept(plan, store):
            records.keep(plan, store, session)
        stays = make().stays
        if stays:
            records.prepare(plan, store, session, started=began, runner=options.runner)
        odd = find_odd(store, session.paths, context(plan, session.id, session.number))
        executor = Executor(plan, store, session, make, options)
        if executor.rules_changed:
            executor.failed |= odd
        executor.answer()
        summary = _sum_up(executor)
        if session.paths not in executor.left:
            slots = None if stays else options.slots
            records.close(plan, store, session, asdict(summary), started=began, runner=options.runner, slots=slots)
        return summary
    finally:
        session.close()


def _sum_up(executor: Executor) -> Summary:
    """Return the summary of an execution, counted from the store's current state."""
    plan, store = executor.plan, executor.store
    now = states(plan, store)
    runs = len(now)
    for run in [run for run, state in now.items() if state.succeeded]:
        del now[run]
    bad = now.keys()
    failed = bad & (executor.attempted | executor.failed)
    return _summary(
        plan,
        store,
        runs,
        executed=executor.attempted,
        reexecuted=executor.reexecuted,
        awaited=executor.awaited - executor.attempted - bad,
        reevaluated=executor.reevaluated - executor.attempted,
        failed=failed,
        missing=bad - failed if failed else bad,
        tried={run for run, state in now.items() if state.worth == FAILED} | failed,
        interrupted=executor.interrupted,
        detached=tuple(paths.root.name for paths in executor.left),
        notes=executor.notes,
    )


def _summary(
    plan: Plan,
    store: Store,
    runs: int,
    *,
    executed: AbstractSet[str] = frozenset(),
    reexecuted: AbstractSet[str] = frozenset(),
    awaited: AbstractSet[str] = frozenset(),
    reevaluated: AbstractSet[str] = frozenset(),
    failed: AbstractSet[str] = frozenset(),
    missing: AbstractSet[str] = frozenset(),
    tried: AbstractSet[str] = frozenset(),
    interrupted: bool = False,
    detached: tuple[str, ...] = (),
    notes: tuple[str, ...] = (),
) -> Summary:
    """Return the summary of a session that executed some runs.

    The arguments are sets of run ids. Runs that are neither `failed` nor `missing` are successful. Runs that are `missing` were
    not `executed`. `tried` are the unsuccessful runs that failed, now or earlier.
    """
    failures = tuple(_failures(plan, store, failed)) if failed else ()
    if failures:
        none_good = len(failed | missing) == runs
        notes += tuple(out_of_reach(plan, None if none_good else [failure.log or "" for failure in failures]))
    return Summary(
        batch=plan.batch.id,
        query=plan.text,
        experiments=len(plan.batch.experiments),
        runs=runs,
        executed=len(executed),
        reexecuted=len(reexecuted),
        reused=runs - len(executed | failed) - len(missing),
        awaited=len(awaited),
        reevaluated=len(reevaluated),
        failed=len(failed),
        missing=len(missing),
        interrupted=interrupted,
        detached=detached,
        counts=tuple(_counts(plan.batch, failed | missing if failed else missing, tried)),
        failures=failures,
        notes=(*plan.notes, *dict.fromkeys(notes)),
    )


def _counts(batch: Batch, bad: AbstractSet[str], tried: AbstractSet[str]) -> Iterator[Counted]:
    for experiment in batch.experiments:
        runs = {run.id for run in experiment.runs}
        yield Counted(experiment.values, len(runs), len(runs - bad), len(runs & tried))


REASONS = """
WITH last AS (
    SELECT run, arg_max(status, lamport) AS status, coalesce(arg_max(reason, lamport), '') AS reason,
           nullif(arg_max(coalesce(log_tail, ''), lamport), '') AS log
    FROM executions JOIN failed USING (run) GROUP BY run
)
SELECT count(*), arg_min(status, place), reason, arg_min(run, place), arg_min(log, place)
FROM last JOIN failed USING (run) GROUP BY reason ORDER BY count(*) DESC, min(place) LIMIT $most
"""


def _failures(plan: Plan, store: Store, failed: AbstractSet[str]) -> Iterator[Failure]:
    """Yield the failures of a batch by reason."""
    import pyarrow as pa

    ordered = [run for run in plan.batch.runs if run.id in failed]
    places = {run.id: run for run in reversed(ordered)}
    with store.snapshot() as snapshot:
        snapshot.register("failed", pa.table({"run": list(places), "place": range(len(places), 0, -1)}))
        snapshot.views.make(("executions",))
        for count, status, reason, run, log in snapshot.run(REASONS, {"most": SHOWN_REASONS}):
            first = places[run]
            values = plan.batch.experiments[first.experiment].values
            yield Failure(count, status, reason, run, values, first.number, log)
