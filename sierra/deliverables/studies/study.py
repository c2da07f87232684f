"""A sequential study: looks at a growing batch, until a rule holds or the schedule ends.

1. The first batch is executed. Then the rule, the schedule of looks and the correction for looking are recorded, before any
   interval is computed. The id of the study follows from them, so they were fixed before the batch began.
2. Each look executes an ordinary batch. It has the runs of the look before, which are reused, and more of them.
3. The look's intervals and its decision are recorded together as one segment. So a study that is killed at any time continues
   with the first look that is not recorded, when the same words are given again.

A decision is never made again, whatever happens to the runs afterwards. Only a look that showed nothing about the rule,
because an experiment had no successful run, is repeated.

Also: the intervals that a look at a batch sees, and whether they are narrow enough.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeVar

from sierra.config.deliverable_tables import Figure
from sierra.config.project_file import LoadedProject
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.studies import wording
from sierra.design.query import until
from sierra.design.query.until import Condition, Rule
from sierra.errors import NotFound, SierraError, UsageError
from sierra.execution.observer import Observer
from sierra.execution.plan import Plan
from sierra.execution.sessions import Session
from sierra.execution.summary import Summary
from sierra.model import Value
from sierra.stats import looks
from sierra.stats.looks import estimate
from sierra.stats.selection import PARTS, Selection
from sierra.stats.shipped import ORDER_STATISTICS
from sierra.store import study_records
from sierra.store.batch_data import BatchData
from sierra.store.lamport_clock import stamp
from sierra.store.row_types import LookIntervalRow, LookRow, StudyRow
from sierra.store.store import Store
from sierra.store.study_records import Decision
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.text import counted, few, like

if TYPE_CHECKING:
    import pyarrow as pa


HOLDS_FOR_EQUAL_VALUES = (ORDER_STATISTICS,)
"""Methods whose interval may have no width. Others take the spread of the runs for the true one; equal values have none."""


@dataclass(frozen=True, slots=True)
class Seen:
    """The intervals of all conditions and experiments, without the id of the look; and notes on what is not in them."""

    intervals: tuple[LookIntervalRow, ...]
    notes: tuple[str, ...]


def check(rule: Rule, project: LoadedProject, level: float) -> None:
    """Raise UsageError for a statistic that is unknown or has no interval of this confidence."""
    for condition in rule.conditions:
        selection = Selection.of([condition.statistic], project.config.statistics, level)
        if not (selection.definitions and selection.statistics[condition.statistic].interval):
            raise UsageError(
                f"statistic {condition.statistic!r} has no interval that could become narrow; see sierra stats --help"
            )


def find_columns(store: Store, batch: str, rule: Rule) -> None:
    """Raise NotFound for a condition that does not name one column of a batch's runs. Values are not looked at."""
    with BatchData(store, batch) as frame:
        for condition in rule.conditions:
            _table(frame, condition)


def see(project: LoadedProject, store: Store, batch: str, rule: Rule, level: float) -> Seen:
    """Return the intervals of a batch's runs at this confidence. Raises NotFound, UsageError for a column that does not fit."""
    intervals: list[LookIntervalRow] = []
    notes: dict[str, None] = {}
    with BatchData(store, batch) as frame:
        gallery = Gallery(project, store, frame, only=frame.names)
        for condition in rule.conditions:
            figure = Figure(table=_table(frame, condition), column=(condition.column,))
            output, samples = gallery.output(figure), gallery.column(figure)
            measure = "mean" if gallery.takes_mean(output) else "final"
            selection = Selection.of([condition.statistic], project.config.statistics, level)
            table, _ = samples.by_experiment(measure, selection)
            intervals += _rows(condition, table, sorted(gallery.planned))
            of_rates = gallery.about_rates(samples, table, measure)
            notes.update(dict.fromkeys((*gallery.notes, *of_rates, *samples.about(measure))))
    return Seen(tuple(intervals), tuple(notes))


def _table(frame: BatchData, condition: Condition) -> str:
    """Return the table that a condition means. Raises NotFound for an unknown table or column, or for several such tables."""
    if condition.table and condition.table not in frame.names:
        raise NotFound(
            f"--until: the runs have no table {condition.table!r}; {like(condition.table, frame.names, 'they have')}"
        )
    outputs = frame.outputs({condition.table} if condition.table else None)
    having = [output for output in outputs if condition.column in output.columns]
    having = [output for output in having if output.name in frame.written] or having
    if len(having) == 1:
        return having[0].name
    if having:
        names = ", ".join(output.name for output in having)
        raise NotFound(f"--until: several tables have a column {condition.column!r} ({names}); write TABLE.{condition.column}")
    columns = list(dict.fromkeys(column for output in outputs for column in output.columns))
    of = f"table {condition.table!r} has" if condition.table else "the runs have"
    raise NotFound(f"--until: {of} no numeric column {condition.column!r}; {like(condition.column, columns, 'there are')}")


def _rows(condition: Condition, table: pa.Table, ordinals: list[int]) -> Iterator[LookIntervalRow]:
    names = ("experiment", "n", *(f"{condition.statistic}{part}" for part in PARTS))
    columns = zip(*(table.column(name).to_pylist() for name in names), strict=True)
    by_experiment = {experiment: values for experiment, *values in columns}
    for ordinal in ordinals:
        n, value, low, high, method = by_experiment.get(ordinal, (0, None, None, None, None))
        wanted = None if value is None else condition.wanted(value)
        half_width = None if low is None else (high - low) / 2
        holds, needed = False, None
        if half_width is not None and wanted is not None and (half_width > 0 or method in HOLDS_FOR_EQUAL_VALUES):
            holds = half_width < wanted
            needed = None if holds else estimate(n, half_width, wanted)
        yield LookIntervalRow(
            "", str(condition), ordinal, n, value, low, high, method, half_width, wanted, holds=holds, needed=needed
        )


Dated = TypeVar("Dated", StudyRow, LookRow)
ALPHA = 0.05
SHOWN = 3


@dataclass(frozen=True, slots=True)
class Design:
    """The rule and the schedule of a study, which are fixed before the first look."""

    row: StudyRow
    rule: Rule
    schedule: tuple[int, ...]

    @property
    def level(self) -> float:
        """Return the confidence of the intervals of each look."""
        return looks.level(self.row.alpha, len(self.schedule))


@dataclass(frozen=True, slots=True)
class Look:
    """A look with its intervals: one for each condition of the rule and each experiment."""

    row: LookRow
    intervals: tuple[LookIntervalRow, ...]

    def as_dict(self) -> dict[str, object]:
        """Return the look for JSON."""
        return {**self.row._asdict(), "intervals": [interval._asdict() for interval in self.intervals]}


@dataclass(frozen=True, slots=True)
class Outcome:
    """A study after some of its looks."""

    kind: ClassVar[str] = "study"
    design: Design
    looks: tuple[Look, ...]
    experiments: Mapping[int, Mapping[str, Value]]
    """The values of the variables by the position of the experiment in the batch."""
    summary: Summary | None = None
    """The last batch that was executed now."""
    problem: str | None = None
    """The reason why the recorded looks no longer follow from the store, in one line; known of studies that are shown."""

    @property
    def decision(self) -> Decision | None:
        """Return the last decision; None before the first look."""
        return Decision(self.looks[-1].row.decision) if self.looks else None

    @property
    def needed(self) -> int | None:
        """Return the estimated runs per experiment with which the rule would hold; None if it holds, or without an estimate."""
        too_wide = [interval for interval in self.looks[-1].intervals if not interval.holds] if self.looks else []
        known = [interval.needed for interval in too_wide if interval.needed is not None]
        return max(known) if known and len(known) == len(too_wide) else None

    def as_dict(self) -> dict[str, object]:
        """Return the study for JSON, without the summary of the batch."""
        experiments = [{"ordinal": ordinal, **values} for ordinal, values in self.experiments.items()]
        return {
            "kind": self.kind,
            **self.design.row._asdict(),
            "schedule": list(self.design.schedule),
            "level": self.design.level,
            "decision": self.decision,
            "needed": self.needed,
            "problem": self.problem,
            "experiments": experiments,
            "looks": [look.as_dict() for look in self.looks],
        }


@dataclass(frozen=True, slots=True)
class Actions:
    """The steps of a look that belong to an ordinary batch."""

    plan: Callable[[int], Plan]
    """Return the plan with this number of runs per experiment."""
    execute: Callable[[Plan], Summary]


def design(project: LoadedProject, plan: Plan, rule_text: str, most: int) -> Design:
    """Return the design of a study whose first look is at the batch of a plan. Raises QueryError, UsageError."""
    rule = until.parse(rule_text)
    schedule = looks.schedule(len(plan.batch.experiments[0].runs), most)
    check(rule, project, looks.level(ALPHA, len(schedule)))
    row = StudyRow(
        study="",
        batch=plan.batch.id,
        query=plan.text,
        rule=str(rule),
        schedule=json.dumps(schedule),
        alpha=ALPHA,
        correction=looks.CORRECTION,
        begun=datetime.now(UTC),
        lamport=0,
    )
    return Design(row._replace(study=study_records.study_id(row)), rule, schedule)


def conduct(
    project: LoadedProject, store: Store, planned: Design, first: Plan, actions: Actions, observer: Observer
) -> Outcome:
    """Execute and record the looks of a study that are not recorded yet, until a decision ends it; return all looks.

    The study is incomplete if a batch was interrupted, or left on a cluster. Raises NotFound for a rule that does not fit the
    runs, and SierraError if the project changes between two looks.
    """
    study = _continued(store, planned)
    observer.notice(
        f"study {short(study.row.study)}{' continues' if study.row.lamport else ''}: {wording.of_schedule(study.schedule)}"
    )
    done = _recorded(store, study.row.study)
    for text in _earlier(store, study, first):
        observer.notice(text)
    summary, plan = None, first
    for number, runs in enumerate(study.schedule, 1):
        last = done.get(number)
        if last is not None and last.row.decision == Decision.more:
            continue
        if number > 1:
            plan = _larger(first, actions.plan(runs))
        summary = actions.execute(plan)
        if last is None or last.row.decision == Decision.stopped:
            if summary.interrupted or summary.detached or summary.missing:
                break
            study = _begun(store, study, summary)
            last = done[number] = _record_look(project, store, study, plan, summary, number, observer)
        observer.notice(wording.of_look(last, _values(first), len(study.schedule)))
        if last.row.decision != Decision.more:
            break
    return Outcome(study, _ordered(done), _values(first), summary)


def find(store: Store, study: str) -> Outcome | None:
    """Return a recorded study; None if there is none with this id."""
    row = study_records.find(store, study)
    if row is None:
        return None
    planned = Design(row, until.parse(row.rule), tuple(study_records.schedule(row)))
    done = _ordered(_recorded(store, study))
    return Outcome(planned, done, _recorded_values(store, done[-1].row.batch) if done else {})


def checked(project: LoadedProject, store: Store, outcome: Outcome) -> Outcome:
    """Return a study with the first problem of its looks: what its intervals are by the store as it is now."""
    for look in outcome.looks:
        if look.intervals and (problem := _problem(project, store, outcome.design, look)):
            return replace(outcome, problem=f"look {look.row.number} {problem}")
    return outcome


def _problem(project: LoadedProject, store: Store, study: Design, look: Look) -> str | None:
    try:
        now = see(project, store, look.row.batch, study.rule, look.row.level).intervals
    except SierraError as error:
        return f"cannot be computed again: {error}"
    was = {(interval.condition, interval.ordinal): interval for interval in look.intervals}
    for interval in now:
        if (before := was.get((interval.condition, interval.ordinal))) is None or before[3:7] != interval[3:7]:
            seen = wording.of_interval(before) if before else "nothing"
            return f"saw {seen}, but by the store as it is now: {wording.of_interval(interval)} (n = {interval.n})"
    return None


def _continued(store: Store, planned: Design) -> Design:
    """Return a study as it is recorded, if it is."""
    row = study_records.find(store, planned.row.study)
    return replace(planned, row=row) if row else planned


def _begun(store: Store, study: Design, summary: Summary) -> Design:
    """Return a study that is recorded; record it first, if it is new. Raises NotFound if the rule does not fit the runs."""
    if study.row.lamport:
        return study
    if not _without_success(summary):
        find_columns(store, summary.batch, study.rule)
    return replace(study, row=study_records.find(store, study.row.study) or _record(store, study.row))


def _without_success(summary: Summary) -> list[Mapping[str, Value]]:
    """Return the experiments of which no run succeeded."""
    return [experiment.values for experiment in summary.counts if not experiment.succeeded]


def _record(store: Store, row: Dated, others: Sequence[NamedTuple] = ()) -> Dated:
    """Record a study, or a look with its intervals, as one segment; return it with its position in the logical order."""
    session = Session(store.paths, logged=False)
    try:
        session.take_number()
        row = row._replace(lamport=stamp(session.number, session.id))
        writer = store.writer(session.paths.segment, row.batch)
        writer.records([row])
        writer.records(others)
        store.publish(writer)
        return row
    finally:
        session.close()


def _recorded(store: Store, study: str) -> dict[int, Look]:
    """Return the recorded looks of a study by number."""
    rows = study_records.looks(store, study)
    intervals = study_records.intervals(store, rows)
    return {row.number: Look(row, tuple(intervals[row.look])) for row in rows}


def _ordered(done: Mapping[int, Look]) -> tuple[Look, ...]:
    return tuple(look for _, look in sorted(done.items()))


def _larger(first: Plan, plan: Plan) -> Plan:
    """Return the plan of a look. Raises SierraError if it does not contain the runs of the first look."""
    if {run.id for run in first.batch.runs} <= {run.id for run in plan.batch.runs}:
        return plan
    raise SierraError(
        "the project has changed since the first look of this study, so its runs would be new; undo the change, or run the "
        "command again to begin another study"
    )


OVERLAP = """
SELECT DISTINCT study FROM looks JOIN batch_runs USING (batch)
WHERE run = $run AND study <> $study ORDER BY study
"""


def _earlier(store: Store, study: Design, first: Plan) -> Iterator[str]:
    """Yield a note on other studies that have looked at the same runs: this one's correction does not count their looks."""
    others = store.values(str, OVERLAP, run=first.batch.runs[0].id, study=study.row.study)
    if others:
        known = few([short(other) for other in others], SHOWN)
        yield f"study {known} looked at the same runs; the intervals of this study are not corrected for those looks"


def _record_look(
    project: LoadedProject, store: Store, study: Design, plan: Plan, summary: Summary, number: int, observer: Observer
) -> Look:
    """Look at a batch, decide, and record both."""
    seen = Seen((), ())
    empty = _without_success(summary)
    if summary.failed:
        observer.notice(f"{counted(summary.failed, 'failed run')} of this look not counted")
    if not empty:
        seen = see(project, store, plan.batch.id, study.rule, study.level)
        for text in seen.notes:
            observer.notice(text)
    decision, reason = _decide(study, plan, seen.intervals, empty, number)
    row = LookRow(
        look="",
        study=study.row.study,
        number=number,
        batch=plan.batch.id,
        runs=study.schedule[number - 1],
        level=study.level,
        decision=decision,
        reason=reason,
        decided=datetime.now(UTC),
        lamport=0,
    )
    row = row._replace(look=study_records.look_id(row, seen.intervals))
    rows = [interval._replace(look=row.look) for interval in seen.intervals]
    return Look(_record(store, row, rows), tuple(rows))


def _decide(
    study: Design, plan: Plan, seen: Sequence[LookIntervalRow], empty: Sequence[Mapping[str, Value]], number: int
) -> tuple[Decision, str]:
    if empty:
        return Decision.stopped, f"no run of {wording.of_point(empty[0])} succeeded"
    if all(interval.holds for interval in seen):
        return Decision.reached, "the rule holds in every experiment"
    reason = wording.of_worst(seen, _values(plan))
    return (Decision.missed if number == len(study.schedule) else Decision.more), reason


def _values(plan: Plan) -> dict[int, Mapping[str, Value]]:
    return {experiment.ordinal: experiment.values for experiment in plan.batch.experiments}


def _recorded_values(store: Store, batch: str) -> dict[int, Mapping[str, Value]]:
    with store.snapshot() as snapshot:
        snapshot.views.make(("batches",))
        [(axes,)] = snapshot.run("SELECT axes FROM batches WHERE batch = $b", {"b": batch}) or [([],)]
        cells = snapshot.cells(batch)
    return {ordinal: {name: value for name in axes if (value := row.get(name)) is not None} for ordinal, row in cells.items()}
