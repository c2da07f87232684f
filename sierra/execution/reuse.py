"""Reuse: the recorded state of each run of a plan, and the reason why it must be executed."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping
from collections.abc import Set as AbstractSet
from typing import NamedTuple

from sierra.execution.observation import reusable_executions, stale_sessions
from sierra.execution.observation.file_sets import UsedFile
from sierra.execution.observation.reusable_executions import Reusable
from sierra.execution.plan import Plan, context
from sierra.execution.reasons import BY_USEFULNESS, FAILED, PROGRAMS, REUSED, RULES, ChangeReason, Reason
from sierra.store.store import Snapshot, Store
from sierra.util.lazy_definitions import dataclass, field, replace

MANY = 4
"""Ratio of executions to runs above which the query selects these runs only; that is fast, and takes memory."""


@dataclass(frozen=True, slots=True)
class FileCheck:
    """Result of comparing the files that recorded executions used with these files as they are now."""

    stale: Mapping[str, UsedFile] = field(default_factory=dict)
    """Sessions whose executions do not count, each with a file that has changed."""
    reusable: Mapping[str, Reusable] = field(default_factory=dict)
    """By run: an execution that counts although the source or the programs differ."""
    unobserved: AbstractSet[str] = frozenset()
    """Runs that execute again because no run of their experiment was observed."""


@dataclass(frozen=True, slots=True)
class State:
    """Recorded state of a run: the place of its best execution in `BY_USEFULNESS`; None without an execution."""

    usefulness: int | None = None
    reason: str | None = None
    """Reason why the last execution failed, if all failed."""
    failed: int = 0
    """Place of that execution in the order of executions."""
    executions: int = 0
    """Number of executions, and of repeated evaluations."""
    reevaluated: bool = False
    """True if a recorded execution would be evaluated again. Only `foreseen` sets this and `lack`."""
    lack: str | None = None
    """Reason why it cannot be evaluated again although the rules have changed."""
    unchanged: bool = False
    """True if an execution counts although the source or the programs differ."""
    unobserved: bool = False
    """True if it is not known whether the execution used what has changed."""
    failed_twice: bool = False
    """True if its last two executions failed in the same way. Only `foreseen` sets this."""

    @property
    def succeeded(self) -> bool:
        return self.usefulness == REUSED

    @property
    def change(self) -> Reason:
        """Return the reason why the run is executed or reused."""
        if self.reevaluated:
            return Reason(ChangeReason.REEVALUATED)
        if self.unchanged:
            return Reason(ChangeReason.UNCHANGED)
        if self.usefulness is None:
            return Reason(ChangeReason.NEW)
        if self.unobserved and self.usefulness == PROGRAMS:
            return Reason(ChangeReason.UNOBSERVED)
        kind = ChangeReason.FAILED_TWICE if self.failed_twice else BY_USEFULNESS[self.usefulness]
        if kind in (ChangeReason.FAILED, ChangeReason.FAILED_TWICE):
            return Reason(kind, self.reason or "")
        return Reason(kind, self.lack or "") if kind is ChangeReason.RULES else Reason(kind)

    def reused(self) -> State:
        """Return this state with an execution that counts although the source or the programs differ."""
        return replace(self, usefulness=REUSED, unchanged=True)

    def with_files(self, run: str, checked: FileCheck) -> State:
        """Return this state of a run with what the comparison of files found."""
        if run in checked.reusable:
            return self.reused()
        return replace(self, unobserved=True) if run in checked.unobserved else self

    def after(self, usefulness: int, reason: str | None, failed: int, judgements: int) -> State:
        """Return this state with one more execution, which was evaluated `judgements` times."""
        count = self.executions + judgements
        if (
            self.usefulness is None
            or usefulness > self.usefulness
            or (usefulness == FAILED == self.usefulness and failed > self.failed)
        ):
            return State(usefulness, reason, failed, count)
        return State(self.usefulness, self.reason, self.failed, count)


class _LastSession(NamedTuple):
    """The last session of the store, of whichever batch."""

    batch: str | None
    programs: str | None
    batch_rules: str | None
    target: str | None


LAST_SESSION = """
SELECT arg_max(batch, lamport) AS batch, arg_max(programs, lamport) AS programs, arg_max(batch_rules, lamport) AS batch_rules,
       arg_max(coalesce(target, ''), lamport) AS target
FROM sessions
"""


def is_answered(plan: Plan, store: Store) -> bool:
    """Check whether the store's last session was this plan with the same programs, files and rules, and every run succeeded."""
    now = context(plan)
    with store.snapshot() as snapshot:
        if snapshot.select(_LastSession, LAST_SESSION) != [
            _LastSession(plan.batch.id, now.programs, now.batch_rules, plan.target or "")
        ]:
            return False
        if not snapshot.values(int, "SELECT 1 FROM batches WHERE batch = $b LIMIT 1", b=plan.batch.id):
            return False  # its records are lost
        checked, recorded = check(plan, snapshot)
        if stale_sessions.recorded(snapshot) != checked.stale.keys():
            return False
        reused = {run: execution.execution for run, execution in checked.reusable.items()}
        if reused and reusable_executions.recorded(snapshot) != reused:
            return False
        return all(state.succeeded for state in recorded.values())


def check(plan: Plan, records: Store | Snapshot) -> tuple[FileCheck, dict[str, State]]:
    """Compare the files that recorded executions used with these files as they are now; return also the state of each run."""
    with records.snapshot() if isinstance(records, Store) else contextlib.nullcontext(records) as snapshot:
        stale, other = stale_sessions.find_with_sets(plan, snapshot)
        recorded = states(plan, snapshot, FileCheck(stale))
        lacking = [run for run, state in recorded.items() if not state.succeeded]
        checked = FileCheck(stale, *reusable_executions.find(plan, snapshot, lacking, stale, other))
    return checked, {**recorded, **{run: recorded[run].with_files(run, checked) for run in lacking}}


def is_repeated(plan: Plan, store: Store) -> bool:
    """Check whether the batch's last session used the same programs, as far as these are derived from the command."""
    last = "SELECT programs FROM sessions WHERE batch = $b ORDER BY lamport DESC LIMIT 1"
    return store.values(str, last, b=plan.batch.id) == [plan.programs.id]


def states(plan: Plan, records: Store | Snapshot | None, checked: FileCheck | None = None) -> dict[str, State]:
    """Return the recorded state of each run of the batch, by run id. `checked`: the comparison of files, if known."""
    new = State()
    runs = dict.fromkeys((run.id for run in plan.batch.runs), new)
    if records is None:
        return runs
    if checked is None:
        return check(plan, records)[1]
    same: dict[State, State] = {}
    with records.snapshot() if isinstance(records, Store) else contextlib.nullcontext(records) as snapshot:
        snapshot.run("SET threads = 1")  # each thread would hold its own copy of 100,000 runs
        for run, usefulness, reason, failed, judgements in snapshot.each(
            *_statement(plan, snapshot, list(runs), checked.stale.keys())
        ):
            if run in runs:
                state = runs[run].after(usefulness, reason, failed, judgements)
                runs[run] = same.setdefault(state, state)
    for run in (checked.reusable.keys() | checked.unobserved) & runs.keys():
        runs[run] = runs[run].with_files(run, checked)
    return runs


TWICE = """
WITH ends AS (
    SELECT run, arg_max((status, coalesce(reason, '')), place) AS how,
           any_value(signal IS NOT NULL OR exit_code <> 0) AS by_itself,
           row_number() OVER (PARTITION BY run ORDER BY any_value(lamport) DESC) AS back
    FROM all_judgements SEMI JOIN failed USING (run)
    WHERE purpose = 'run' AND packages IS NULL AND programs = $programs AND ingest_rules = $ingest_rules GROUP BY run, execution
)
SELECT run FROM ends WHERE back <= 2 GROUP BY run
HAVING count(*) = 2 AND min(how) = max(how) AND min(how)[1] = 'failed' AND bool_and(by_itself)
"""
"""The runs whose program ended with the same error twice. Limits may be raised, and other failures have other causes."""


def failed_twice(plan: Plan, store: Store, recorded: Mapping[str, State]) -> set[str]:
    """Return the runs whose program ended with the same error twice, with the programs and rules of a plan."""
    failed = [run for run, state in recorded.items() if state.usefulness == FAILED and state.executions > 1]
    if not failed:
        return set()
    with store.snapshot() as snapshot:
        snapshot.add_table("failed", run=failed)
        snapshot.views.make(("all_judgements",))
        rows = snapshot.run(TWICE, {"programs": plan.programs.id, "ingest_rules": context(plan).ingest_rules})
    return {run for (run,) in rows}


def foreseen(plan: Plan, store: Store | None, recorded: Mapping[str, State]) -> dict[str, State]:
    """Return these states with the effect of evaluating executions again by changed rules, and with those that failed twice."""
    bad = [run for run, state in recorded.items() if state.usefulness in (FAILED, RULES)]
    if store is None or not bad:
        return dict(recorded)
    from sierra.ingest.rejudge import foresee

    now = context(plan)
    result = dict(recorded)
    for run in failed_twice(plan, store, recorded):
        result[run] = replace(recorded[run], failed_twice=True)
    for evaluation in foresee(store, now, bad, mismatched=rules_changed(plan, store)):
        result |= {run: replace(recorded[run], reevaluated=True) for run in evaluation.possible}
        result |= {run: replace(recorded[run], lack=lack) for run, lack in evaluation.lacking.items()}
    return result


def rules_changed(plan: Plan, store: Store) -> bool:
    """Check whether the last session of the batch used other rules, including the rules for differences between siblings."""
    last = "SELECT batch_rules FROM sessions WHERE batch = $b ORDER BY lamport DESC LIMIT 1"
    return any(rules != context(plan).batch_rules for rules in store.values(str, last, b=plan.batch.id))


# Runs of one spec are executed only for batches of that spec. Some of these batches may have been removed. Executions that came
# in packages are not reused, because nothing proves how they were made.
OF_SPEC = (
    "FROM {judged} WHERE purpose = 'run' AND packages IS NULL AND (batch IN (SELECT batch FROM batches WHERE spec = $spec) "
    "OR batch NOT IN (SELECT batch FROM batches))"
)
EACH = f"""
SELECT run, CASE WHEN status NOT IN ('ok', 'accepted') THEN {FAILED} WHEN ingest_rules <> $ingest_rules THEN {RULES}
    WHEN programs <> $programs OR list_contains($stale, session) THEN {PROGRAMS} ELSE {REUSED} END AS usefulness,
    CASE WHEN usefulness = {FAILED} THEN reason END, CASE WHEN usefulness = {FAILED} THEN lamport ELSE 0 END, {{count}}
{OF_SPEC}
"""
REEVALUATED = """(
SELECT run, batch, session, purpose, programs, lamport, judgements, packages, j.status AS status, j.reason AS reason,
       j.ingest_rules AS ingest_rules
FROM (
    SELECT execution, any_value(run) AS run, any_value(batch) AS batch, any_value(session) AS session,
           any_value(purpose) AS purpose,
           any_value(programs) AS programs, any_value(lamport) AS lamport, count(*) AS judgements,
           any_value(packages) AS packages,
           arg_max({'status': status, 'reason': reason, 'ingest_rules': ingest_rules},
                   (ingest_rules = $ingest_rules, place, judgement)) AS j
    FROM all_judgements GROUP BY execution
))"""
"""SQL: executions as evaluated by the requested rules, or else as they were evaluated last."""


def _statement(
    plan: Plan, snapshot: Snapshot, runs: list[str], stale: Collection[str]
) -> tuple[str, dict[str, str | list[str]]]:
    """Return the statement for the executions that may belong to these runs, and its parameters."""
    spec = {"spec": plan.batch.spec_id}
    snapshot.views.make(("all_judgements", "batches"))
    [(count,)] = snapshot.run(f"SELECT count(*) {OF_SPEC.format(judged='all_judgements')}", spec)
    reevaluated = snapshot.holds("judgements")
    statement = (
        EACH.format(judged=REEVALUATED, count="judgements") if reevaluated else EACH.format(judged="all_judgements", count="1")
    )
    if count > MANY * len(runs):
        snapshot.add_table("asked", run=runs)
        statement += " AND run IN (SELECT run FROM asked)"
    return statement, {**spec, "stale": [*stale], "programs": plan.programs.id, "ingest_rules": context(plan).ingest_rules}
