"""Count the state of a batch after a session, from the store."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from collections.abc import Set as AbstractSet
from typing import NamedTuple

from sierra.execution.plan import Plan
from sierra.execution.plan_notes import out_of_reach, without_gpu_memory
from sierra.execution.shown_records import Failed
from sierra.execution.summary import Counted, Failure, Summary
from sierra.model import Batch
from sierra.store.store import Store
from sierra.util.lazy_definitions import replace
from sierra.util.text import counted, few
from sierra.worker.shared_services import UNOBSERVED

SHOWN_REASONS = 10


def of_session(
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
    only: AbstractSet[str] | None = None,
) -> Summary:
    """Return the summary of a session that executed some runs.

    The arguments are sets of run ids. Runs that are neither `failed` nor `missing` are successful. Runs that are `missing` were
    not `executed`. `tried` are the unsuccessful runs that failed, now or earlier. `only`: the session was limited to these
    runs; None if it was not limited.
    """
    failures = tuple(_failures(plan, store, failed)) if failed else ()
    if failures:
        none_good = len(failed | missing) == runs
        logs = [failure.log or "" for failure in failures]
        notes += (*out_of_reach(plan, None if none_good else logs), *without_gpu_memory(plan.limits.most.gpus, logs))
    left_out = len(missing - only) if only is not None else 0
    if left_out:
        notes += (f"figures and statistics of this batch lack {counted(left_out, 'run')} that this session has left out",)
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
        selected=None
        if only is None
        else sum(all(run.id in only for run in experiment.runs) for experiment in plan.batch.experiments),
        left_out=left_out,
        target=plan.target,
        notes=(*plan.notes, *dict.fromkeys(notes)),
    )


def _counts(batch: Batch, bad: AbstractSet[str], tried: AbstractSet[str]) -> Iterator[Counted]:
    for experiment in batch.experiments:
        runs = {run.id for run in experiment.runs}
        yield Counted(experiment.values, len(runs), len(runs - bad), len(runs & tried))


class _Accepted(NamedTuple):
    ordinal: int
    outcome: str
    runs: int


ACCEPTED = """
SELECT ordinal, outcome, count(*) AS runs FROM effective WHERE batch = $b AND outcome <> 'success' GROUP BY ALL ORDER BY ALL
"""


def with_outcomes(plan: Plan, store: Store, summary: Summary) -> Summary:
    """Return the summary of a recorded session, in which ends that [success] accepts are no successes."""
    if not plan.project.config.success.accept:
        return summary
    ends = Counter[int]()
    for row in (accepted := store.select(_Accepted, ACCEPTED, b=plan.batch.id)):
        ends[row.ordinal] += row.runs
    counts = (
        replace(row_before, succeeded=row_before.succeeded - ends[ordinal], accepted=ends[ordinal])
        for ordinal, row_before in enumerate(summary.counts)
    )
    return replace(summary, counts=tuple(counts), outcomes=_outcomes(accepted))


def _outcomes(accepted: Iterable[_Accepted]) -> dict[str, int]:
    """Return the number of runs of all experiments by an accepted end."""
    outcomes = Counter[str]()
    for row in accepted:
        outcomes[row.outcome] += row.runs
    return dict(outcomes)


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
    ordered = [run for run in plan.batch.runs if run.id in failed]
    places = {run.id: run for run in reversed(ordered)}
    with store.snapshot() as snapshot:
        snapshot.add_table("failed", run=places, place=range(len(places), 0, -1))
        snapshot.views.make(("executions",))
        for count, status, reason, run, log in snapshot.run(REASONS, {"most": SHOWN_REASONS}):
            first = places[run]
            values = plan.batch.experiments[first.experiment].values
            yield Failure(count, status, reason, run, values, first.number, log)


def of_recorded(
    store: Store,
    batch: str,
    *,
    executed: int,
    failed: int,
    interrupted: bool,
    detached: tuple[str, ...],
    notes: tuple[str, ...],
    unfinished: int | None = None,
) -> Summary:
    """Return the summary of a recorded batch after some of its runs were followed on a cluster.

    `executed` is the number of runs that ended meanwhile; `failed` of these failed. `unfinished`: the runs were a part of the
    batch, and so many of them were not executed; None if they were not a part.
    """
    from sierra.execution import show_record

    shown = show_record.batch(store, batch)
    counts = tuple(Counted(row.values, row.runs, row.succeeded, row.failed, row.accepted) for row in shown.experiments)
    succeeded, unsuccessful = sum(row.succeeded + row.accepted for row in counts), sum(row.failed for row in counts)
    missing = max(0, shown.row.runs - succeeded - unsuccessful)
    return Summary(
        batch=batch,
        query=shown.sessions[-1].query if shown.sessions else shown.row.query,
        experiments=len(counts),
        runs=shown.row.runs,
        executed=executed,
        reexecuted=0,
        reused=max(0, succeeded - executed + failed),
        failed=unsuccessful,
        missing=missing,
        interrupted=interrupted,
        detached=detached,
        counts=counts,
        outcomes=_outcomes(store.select(_Accepted, ACCEPTED, b=batch)),
        failures=tuple(_failure(store, row) for row in shown.failures[:SHOWN_REASONS]),
        target=shown.sessions[-1].target if shown.sessions else None,
        left_out=0 if unfinished is None else max(0, missing - unfinished),
        notes=tuple(dict.fromkeys(notes)),
    )


class Last(NamedTuple):
    """The last execution of a run: its status and the end of its log."""

    status: str
    log_tail: str | None


LAST = "SELECT status, log_tail FROM executions WHERE run = $r ORDER BY lamport DESC LIMIT 1"


def _failure(store: Store, failed: Failed) -> Failure:
    [last] = store.select(Last, LAST, r=failed.run)
    return Failure(failed.runs, last.status, failed.reason, failed.run, failed.values, failed.number, last.log_tail or None)


OF_UNKNOWN_FILES = """
SELECT count(DISTINCT e.session) FROM effective f JOIN executions e USING (execution)
WHERE f.batch = $batch AND e.session NOT IN (
    SELECT s.session FROM observations o JOIN executions s USING (execution)
    WHERE o.method = 'strace' AND NOT contains(coalesce(o.reason, ''), $unobserved)
)
"""


def unobserved_services(plan: Plan, store: Store) -> tuple[str, ...]:
    """Return a note if runs of the plan are reused that shared services whose files are not known; else nothing.

    If they were observed, their files belong to the sets of files of the observed runs, and a change of one of them is noticed.
    """
    names = [service.name for service in plan.batch.spec.around.services if service.shared]
    if not names or not any(store.values(int, OF_UNKNOWN_FILES, batch=plan.batch.id, unobserved=UNOBSERVED)):
        return ()
    named = few([repr(name) for name in names], 3)
    return (
        f"runs are reused that shared {named}, of which it was not observed what files it reads: "
        "a change of a file that only this service reads is not noticed",
    )
