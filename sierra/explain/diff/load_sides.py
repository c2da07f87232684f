"""Operands of a comparison: two sides with everything that the store has about each; their runs are in temporary tables.

A run is represented by its effective execution (or its last one) in the batch whose session is the latest; an experiment is
represented in the same way. A plan is a side whose runs were not executed, and so has no table of runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from sierra.errors import UsageError
from sierra.execution.plan import Plan
from sierra.execution.row_queries import axis_values, required_row
from sierra.execution.session_records import batch_row
from sierra.model import RunSpec, Value
from sierra.store.recorded_files import ChosenExecution, Place, where
from sierra.store.row_types import BatchRow, SessionRow, SourceRow, SpecRow
from sierra.store.spec_rows import run_spec
from sierra.store.store import ResolvedId, Snapshot
from sierra.store.view_sql import COUNTS, ORDER, latest
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass

BEFORE, AFTER = "before", "after"
ONE = ("run", "execution")
"""Kinds of objects that are one run."""


@dataclass(frozen=True, slots=True)
class ComparedRuns:
    """One side of a comparison."""

    found: ResolvedId
    table: str
    """Name of the table of its runs; empty if their executions are not compared.

    Columns: `ordinal`, `number`, `run`, `seed` and `input`; `own`, `result` and `status` of the execution that represents the
    run; `execution`, the judgement of it that is used; and `counts`, true if that is effective. To save memory, `input` and
    `result` are 128-bit numbers that replace the digests.
    """
    runs: int
    batch: BatchRow
    spec: RunSpec
    names: Sequence[str]
    """Names of the input files of each run."""
    session: SessionRow | None
    """Session of this side: for a batch or an experiment the last one. None if it is not recorded."""
    source: SourceRow | None
    """State of the code that this session recorded, or else any other session. None without a recorded source."""
    experiments: Mapping[int, str]
    """Ids of the experiments, by their places in the batch."""
    cells: Mapping[int, Mapping[str, Value]]
    """Values of each experiment, by its place in the batch, including the controller or scenario of the whole batch."""
    plan: Plan | None = None
    """The plan, which has what the store may lack: the manifest of the source, images, and files beside the inputs."""

    @property
    def is_one(self) -> bool:
        return self.found.kind in ONE

    @property
    def called(self) -> str:
        return f"{self.found.kind} {short(self.found.id)}"

    @property
    def target(self) -> str | None:
        """Return the target that was requested; None if there is none."""
        return self.plan.target if self.plan else self.session.target if self.session else None


def check(before: ResolvedId, after: ResolvedId) -> None:
    """Check that two objects can be compared by their kinds. Raises UsageError."""
    if before.kind != after.kind and not (before.kind in ONE and after.kind in ONE):
        raise UsageError(
            f"{short(before.id)} is a {before.kind} and {short(after.id)} is a {after.kind}; compare two of the same kind, "
            "or a run with an execution"
        )


RUNS = """
CREATE TEMP TABLE {table} AS
{latest},
m AS (
    SELECT ordinal, number, any_value(run) AS run, any_value(seed) AS seed,
           md5_number(concat_ws(' ', any_value(input), array_to_string(any_value(other_inputs), ' '))) AS input
    FROM batch_runs m WHERE batch = $b {only} GROUP BY ordinal, number
),
e AS (
    SELECT e.run, e.judgement AS execution, e.execution AS own, md5_number(e.result) AS result, e.status, {order} AS place,
           {counts} AS counts
    FROM all_candidates e LEFT JOIN latest l ON l.batch = $b WHERE {which}
),
one AS (
    SELECT ordinal, number, any_value(m.run) AS run, any_value(seed) AS seed, any_value(input) AS input,
           arg_max({{'execution': execution, 'own': own, 'result': result, 'status': status, 'counts': counts}},
                   ({best}place)) AS e
    FROM m LEFT JOIN e ON e.run = m.run GROUP BY ordinal, number
)
SELECT ordinal, number, run, seed, input, e.execution AS execution, e.own AS own, e.result AS result, e.status AS status,
       coalesce(e.counts, false) AS counts
FROM one
"""


def make_runs(snapshot: Snapshot, origin: Place, table: str, *, good_first: bool = False, only: str = "") -> None:
    """Create the table of one side's runs; with `good_first`, prefer the last successful execution if none is effective."""
    snapshot.views.make(("sessions", "stale_sessions", "all_candidates", "origins"))
    named = {} if origin.execution is None else {"named": origin.execution}
    statement = RUNS.format(
        table=table,
        latest=latest(),
        only=origin.only + only,
        order=ORDER,
        counts=f"coalesce({COUNTS}, false)",
        which="e.execution = $named" if named else "e.purpose = 'run'",
        best="counts, status IN ('ok', 'accepted'), " if good_first else "counts, ",
    )
    snapshot.run(statement, {**origin.parameters, **named})


def gather(snapshot: Snapshot, found: ResolvedId, table: str) -> ComparedRuns:
    """Return everything that the store has about one side."""
    place = where(snapshot, found)
    make_runs(snapshot, place, table)
    return _recorded(snapshot, found, place.batch, table)


def of_batch(snapshot: Snapshot, batch: str) -> ComparedRuns:
    """Return everything that the store has about a batch, except executions of its runs."""
    return _recorded(snapshot, ResolvedId("batch", batch, batch), batch)


RUNS_OF_BATCH = "(SELECT DISTINCT ordinal, number FROM batch_runs WHERE batch = $b)"


def _recorded(snapshot: Snapshot, resolved: ResolvedId, batch_id: str, table: str = "") -> ComparedRuns:
    """Return a side of recorded runs: those in a table, or all of a batch."""
    snapshot.views.make(("batch_runs", "specs", "sources", "replays"))
    batch = required_row(BatchRow, snapshot, "SELECT * FROM batches WHERE batch = $b", b=batch_id)
    row = required_row(SpecRow, snapshot, "SELECT * FROM specs WHERE spec = $r", r=batch.spec)
    count = f"SELECT ordinal, count(*) FROM {table or RUNS_OF_BATCH} GROUP BY ordinal"  # noqa: S608 - our own names
    runs: dict[int, int] = dict(snapshot.run(count, {} if table else {"b": batch_id}))
    cells = {position: cell for position, cell in snapshot.cells(batch_id).items() if position in runs}
    session = _session(snapshot, resolved, batch_id)
    return ComparedRuns(
        found=resolved,
        table=table,
        runs=sum(runs.values()),
        batch=batch,
        spec=run_spec(row),
        names=row.files,
        session=session,
        source=_source(snapshot, row.source, session.source if session else None),
        experiments={ordinal: str(cell["experiment"]) for ordinal, cell in cells.items()},
        cells={ordinal: {**_whole(batch), **axis_values(batch.axes, cell)} for ordinal, cell in cells.items()},
    )


def of_plan(plan: Plan) -> ComparedRuns:
    """Return a plan as a side, which nothing was executed of."""
    batch = batch_row(plan)
    return ComparedRuns(
        found=ResolvedId("batch", plan.batch.id, plan.batch.id),
        table="",
        runs=len(plan.batch.runs),
        batch=batch,
        spec=plan.batch.spec,
        names=plan.batch.runs[0].names,
        session=None,
        source=None,
        experiments={experiment.ordinal: experiment.id for experiment in plan.batch.experiments},
        cells={experiment.ordinal: {**_whole(batch), **experiment.values} for experiment in plan.batch.experiments},
        plan=plan,
    )


def _whole(batch: BatchRow) -> dict[str, Value]:
    """Return the controller and the scenario that all experiments of a batch share."""
    return {name: value for name in ("controller", "scenario") if (value := getattr(batch, name)) is not None}


def _session(snapshot: Snapshot, found: ResolvedId, batch: str) -> SessionRow | None:
    if found.kind == "execution":
        of = "session = (SELECT session FROM executions WHERE execution = $i)"
        identity = found.id
    else:
        of, identity = "batch = $i", batch
    statement = f"SELECT * FROM sessions WHERE {of} ORDER BY lamport DESC LIMIT 1"  # noqa: S608 - of our own parts
    return next(iter(snapshot.select(SessionRow, statement, i=identity)), None)


SOURCE = "SELECT * FROM sources WHERE tree = $t ORDER BY source <> $s NULLS LAST LIMIT 1"


def _source(snapshot: Snapshot, tree: str | None, known: str | None) -> SourceRow | None:
    return next(iter(snapshot.select(SourceRow, SOURCE, t=tree, s=known or "")), None)


BOTH = """
CREATE TEMP VIEW both_sides AS
SELECT b.ordinal, b.number, a.ordinal AS now_ordinal, a.number AS now_number, b.run AS was, a.run AS now,
       b.execution AS was_executed, a.execution AS now_executed, b.seed AS was_seed, a.seed AS now_seed,
       b.input IS DISTINCT FROM a.input AS other_input,
       b.result IS DISTINCT FROM a.result AS other_result
FROM {before} b JOIN pairs p ON p.was = b.ordinal JOIN {after} a ON a.ordinal = p.now {same}
"""


def pair(before: ComparedRuns, after: ComparedRuns) -> list[tuple[int, int]]:
    """Return the experiments that both sides have, by their places.

    A single experiment is paired with the one that it is compared with. Some variables do not separate experiments: an axis
    that only one batch has, with one value, and a controller or a scenario that is not an axis of either.
    """
    if before.found.kind != "batch":
        return [(next(iter(before.cells)), next(iter(after.cells)))]
    names = list(_telling(before, after))
    places = {tuple(cell.get(name) for name in names): ordinal for ordinal, cell in after.cells.items()}
    keys = {ordinal: tuple(cell.get(name) for name in names) for ordinal, cell in before.cells.items()}
    return [(ordinal, places[key]) for ordinal, key in keys.items() if key in places]


def pair_runs(snapshot: Snapshot, before: ComparedRuns, after: ComparedRuns, pairs: Sequence[tuple[int, int]]) -> None:
    """Create the temporary view `both_sides` of the runs of paired experiments."""
    snapshot.add_table("pairs", was=(was for was, _ in pairs), now=(now for _, now in pairs))
    same = "" if before.is_one else "AND a.number = b.number"
    snapshot.run(BOTH.format(before=before.table, after=after.table, same=same))


def _telling(before: ComparedRuns, after: ComparedRuns) -> Iterator[str]:
    """Yield the axes that distinguish experiments."""
    for name in dict.fromkeys((*before.batch.axes, *after.batch.axes)):
        values = [{cell.get(name) for cell in side.cells.values()} for side in (before, after)]
        if {None} not in values or any(len(several) > 1 for several in values):
            yield name


def chosen_executions(snapshot: Snapshot, side: ComparedRuns, places: Sequence[tuple[int, int]]) -> list[ChosenExecution]:
    """Return some of a side's runs, by their experiments' places and their numbers, in that order."""
    statement = f"SELECT run, own, status, execution FROM {side.table} WHERE ordinal = $o AND number = $n"  # noqa: S608
    found = []
    for ordinal, number in places:
        [(run, execution, status, judgement)] = snapshot.run(statement, {"o": ordinal, "n": number})
        found.append(ChosenExecution(side.experiments[ordinal], ordinal, number, run, execution, status, "asked", judgement))
    return found
