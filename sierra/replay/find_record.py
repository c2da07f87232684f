"""Find the runs that an id names in the record, with all that their replay needs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from sierra.errors import Missing, NotFound
from sierra.execution import plan_from_record, row_queries
from sierra.execution.plan_from_record import Recalled
from sierra.model import Run, Value
from sierra.replay.options import ReplayOptions
from sierra.store.recorded_files import ChosenExecution, take, where
from sierra.store.sql_names import stored_names
from sierra.store.store import ResolvedId, Snapshot, Store
from sierra.store.table_layout import TableLayout
from sierra.templates.base import Files
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted


@dataclass(slots=True)
class Record:
    """Recorded data of the runs to replay."""

    found: ResolvedId
    of: Recalled
    runs: list[ChosenExecution]
    named: int
    """Number of runs that the id names, including runs without a successful execution."""
    whole: bool
    """True if all successful runs of each experiment are replayed."""
    cells: dict[int, dict[str, Value | None]]
    """Values of each experiment, by its place in the batch."""
    seeds: dict[str, int]
    tables: dict[str, list[str]]
    """Columns of each output that is a table."""
    environment: str
    used: list[str]
    """Names of the Python distributions that executions were observed to use."""
    notes: list[str]


class _RecordedBy(NamedTuple):
    programs: str
    ingest_rules: str
    environment: str


class _Forms(NamedTuple):
    output: str
    forms: list[str]


TABLES = """
SELECT output, list(DISTINCT table_layout ORDER BY table_layout) AS forms FROM all_artifacts SEMI JOIN taken USING (execution)
WHERE kind = 'table' GROUP BY output
"""
"""SQL: the recorded forms of tables, by output."""
REPEATED = ("ok", "accepted", "failed")
"""The statuses of executions that are repeated if their id is named."""
WROTE = "SELECT DISTINCT execution FROM all_artifacts SEMI JOIN taken USING (execution) WHERE kind <> 'log'"
"""SQL: the executions that left files or tables."""


def find(store: Store, subject: ResolvedId, options: ReplayOptions) -> Record:
    """Return the recorded data of the runs to replay. Raises NotFound, Missing if there is nothing to compare with."""
    with store.snapshot() as snapshot:
        named = take(snapshot, subject)
        good = _repeatable(snapshot, subject, named)
        taken = [run for run in good if options.includes(run)]
        if not taken:
            raise NotFound(f"{subject.kind} {short(subject.id)} has no execution to compare with; execute it with sierra run")
        snapshot.views.make(("batch_runs", "experiments", "batches"))
        batch = where(snapshot, subject).batch
        snapshot.add_table("taken", execution=[str(run.judgement) for run in taken])
        by = snapshot.select(
            _RecordedBy,
            "SELECT DISTINCT programs, ingest_rules, environment "
            "FROM all_judgements e SEMI JOIN taken t ON t.execution = e.judgement ORDER BY ALL",
        )
        used = row_queries.used_distributions(snapshot, [row.programs for row in by])
        cells = snapshot.cells(batch)
        [(axes,)] = snapshot.run("SELECT axes FROM batches WHERE batch = $b", {"b": batch})
        tables = dict(snapshot.select(_Forms, TABLES))
        wrote = set(snapshot.values(str, WROTE))
        seeds: dict[str, int] = dict(snapshot.run("SELECT run, seed FROM batch_runs WHERE batch = $b", {"b": batch}))
    record = Record(
        found=subject,
        of=plan_from_record.recall(store, batch, by[0].programs, by[0].ingest_rules),
        runs=taken,
        named=len(named),
        whole=len(taken) == len(good) and subject.kind in ("batch", "experiment"),
        cells={ordinal: {axis: row[axis] for axis in axes} for ordinal, row in cells.items()},
        seeds=seeds,
        tables={name: _columns(forms) for name, forms in sorted(tables.items())},
        environment=by[0].environment,
        used=used,
        notes=[],
    )
    left = sum(run.judgement in wrote or run.status != "ok" for run in taken)  # of others, the end is compared too
    if not left:
        raise Missing(f"{subject.kind} {short(subject.id)} wrote only logs, and logs are not compared")
    if left < len(taken):
        record.notes.append(f"{len(taken) - left} of {counted(len(taken), 'run')} wrote only logs, and logs are not compared")
    if without := len(named) - len(good):
        record.notes.append(f"not executed again: {without} of {counted(len(named), 'run')} without an execution that counts")
    if len({(row.programs, row.ingest_rules) for row in by}) > 1:
        record.notes.append("not all runs were recorded with the same programs and rules; the first ones are used")
    return record


def _repeatable(snapshot: Snapshot, found: ResolvedId, named: Sequence[ChosenExecution]) -> list[ChosenExecution]:
    """Return the executions to repeat: those that count, programs that ended with an error, and the one that is named."""
    if all(one.which == "counts" for one in named):
        return list(named)
    snapshot.views.make(("ended",))
    ended = set(snapshot.values(str, "SELECT judgement FROM ended WHERE batch = $b", b=where(snapshot, found).batch))
    return [one for one in named if one.judgement in ended or (one.which == "asked" and one.status in REPEATED)]


def _columns(forms: list[str]) -> list[str]:
    """Return the columns of tables by their names in SQL, from the recorded forms of these tables."""
    named = (stored_names(list(TableLayout.load(form).columns)) for form in forms)
    return list(dict.fromkeys(name for names in named for name in names))


def inputs(record: Record, runs: Sequence[ChosenExecution], store: Store) -> Iterator[tuple[Run, Files]]:
    """Yield each of these runs with its recorded inputs."""
    for taken, files in plan_from_record.inputs(store, {one.run: one for one in runs}.values()):
        yield Run(taken.run, taken.ordinal, taken.number, record.seeds[taken.run], (), b""), files
