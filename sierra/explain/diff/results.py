"""Differences of results: outputs of two executions by place, results of runs that both have, means of runs that differ.

Means are computed from the last value that each run wrote (the measure `final`), for each experiment that both have. The
interval of their difference is Welch's (1947), for independent samples: degrees of freedom by Satterthwaite, rounded down.
The interval of the difference of two rates is Newcombe's (1998, Statist. Med. 17: 873-890, method 10), from Wilson's
intervals of both. If runs share their seeds, as they do by default, both are rather too wide. Each interval is of one
experiment alone; it is not corrected for the others.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from math import hypot, isfinite, sqrt
from typing import TYPE_CHECKING, NamedTuple

from sierra.config.output_tables import Output
from sierra.config.project_file import LoadedProject
from sierra.deliverables import run_statistics
from sierra.errors import SierraError
from sierra.explain.diff.load_sides import ComparedRuns
from sierra.explain.diff.model import ARROW, Difference, Note, changed, shown
from sierra.ingest.recording_context import rules_of
from sierra.replay import compare_outputs
from sierra.replay.compare_values import Agreement, Verdict, distance
from sierra.stats import student_t
from sierra.stats.rates import Interval, square_and_add
from sierra.store.batch_data import BatchData
from sierra.store.store import Snapshot, Store
from sierra.store.time_axis import names_time
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted, digits_apart, few, short_number

if TYPE_CHECKING:
    pass

LOOKED_AT = 5
"""Number of runs with changed results whose outputs are compared."""
COLUMNS = 4
"""Number of columns whose means are compared."""
ROWS = 2_000_000
"""Number of rows of outputs above which no means are computed."""
LEVEL = 0.95
SHOWN = 8


def of_one(
    snapshot: Snapshot, store: Store, project: LoadedProject, before: ComparedRuns, after: ComparedRuns, notes: list[Note]
) -> Iterator[Difference]:
    """Yield the differences of two executions: their status, and each output."""
    was, now = (_execution(snapshot, side) for side in (before, after))
    if was is None or now is None:
        called = (before if was is None else after).called
        text = f"{called} was never executed; results are not compared"
        notes += [Note(text, "results"), Note(text, "status")]
        return
    yield from changed("status", "status", _ended(was), _ended(now))
    yield from _outputs(snapshot, store, project, was, now, notes)


class Judged(NamedTuple):
    """A judgement of an execution."""

    judgement: str
    ingest_rules: str
    status: str
    reason: str | None


JUDGED = "SELECT e.judgement, e.ingest_rules, e.status, e.reason FROM all_judgements e"


def _execution(snapshot: Snapshot, side: ComparedRuns) -> Judged | None:
    return next(iter(snapshot.select(Judged, f"{JUDGED} JOIN {side.table} t ON t.execution = e.judgement")), None)


def good(snapshot: Snapshot, before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield a difference if the numbers of runs with an effective execution differ."""
    was, now = (
        snapshot.run(f"SELECT count(*) FILTER (counts) FROM {side.table}")[0][0]  # noqa: S608 - our own names
        for side in (before, after)
    )
    if (was == before.runs) != (now == after.runs) or (before.runs == after.runs and was != now):
        line = f"runs with an effective execution: {was} of {before.runs} {ARROW} {now} of {after.runs}"
        yield Difference("status", "good", line, was, now)


def _ended(execution: Judged) -> str:
    return execution.status if execution.status == "ok" else f"{execution.status} ({execution.reason})"


def _outputs(
    snapshot: Snapshot,
    store: Store,
    project: LoadedProject,
    was: Judged,
    now: Judged,
    notes: list[Note],
    run: str = "",
) -> Iterator[Difference]:
    """Yield the outputs in which two executions differ; equal values in different bytes only give a note."""
    try:
        declared = _declared(snapshot, now.ingest_rules, project)
        compared = compare_outputs.compare(snapshot, was.judgement, now.judgement, declared)
    except SierraError as error:
        notes.append(Note(f"{run}results cannot be compared: {error}", "results"))
        return
    if not compared:
        notes.append(Note(f"{run}only logs were written, and logs are not compared", "results"))
    for path, agreement in compared.items():
        if agreement.verdict is Verdict.EQUAL:
            notes.append(Note(f"{run}{path}: {agreement.reason}"))
        elif agreement.verdict is not Verdict.IDENTICAL:
            line = f"results: {run}{path}: {agreement.verdict}: {agreement.reason}"
            was_value, now_value = agreement.recorded_value, agreement.replayed_value
            yield Difference("results", str(path), line, was_value, now_value, tuple(_growth(agreement)))


def _declared(snapshot: Snapshot, rules: str, project: LoadedProject) -> dict[str, Output]:
    """Return the declared outputs with volatile parts and tolerances; the project's current ones override the recorded ones."""
    found = snapshot.values(str, "SELECT declared FROM ingest_rules WHERE ingest_rules = $r", r=rules)
    recorded = rules_of(json.loads(found[0]))[0] if found else {}
    return {**recorded, **project.config.outputs}


def _growth(agreement: Agreement) -> Iterator[str]:
    """Yield a line that shows how a difference grows over the rows."""
    if agreement.growth:
        yield ", ".join(f"difference {distance(far)} until {shown(until)}" for until, far in agreement.growth)


SHARED = """
WITH shared AS (
    SELECT run, any_value(b.execution) AS was, any_value(a.execution) AS now, any_value(b.result) AS was_result,
           any_value(a.result) AS now_result
    FROM before b JOIN after a USING (run) GROUP BY run
)
SELECT count(*), count(*) FILTER (was <> now AND was_result IS DISTINCT FROM now_result), count(*) FILTER (was = now)
FROM shared
"""


class Other(NamedTuple):
    """A run that both sides have, with its effective executions and its place."""

    run: str
    was: str
    now: str
    ordinal: int
    number: int


OTHERS = """
SELECT DISTINCT run, b.execution AS was, a.execution AS now, b.ordinal, b.number FROM before b JOIN after a USING (run)
WHERE b.execution <> a.execution AND b.result IS DISTINCT FROM a.result ORDER BY b.ordinal, b.number LIMIT $most
"""


def of_shared(snapshot: Snapshot, store: Store, project: LoadedProject, notes: list[Note]) -> Iterator[Difference]:
    """Yield differences of runs that both sides have with different effective executions."""
    [(count, others, same)] = snapshot.run(SHARED)
    if count:
        notes.append(Note(f"{counted(count, 'run')} in both, {same} with the same effective execution"))
    if not others:
        return
    details: list[str] = []
    differing = 0
    looked = snapshot.select(Other, OTHERS, most=LOOKED_AT)
    for row in looked:
        [was, now] = (snapshot.select(Judged, f"{JUDGED} WHERE judgement = $e", e=judged)[0] for judged in (row.was, row.now))
        differences = list(_outputs(snapshot, store, project, was, now, notes, f"run {short(row.run)}: "))
        differing += bool(differences)
        details += [difference.line.removeprefix("results: ") for difference in differences]
    if differing or others > len(looked):
        line = f"results: {others} of {counted(count, 'run')} in both wrote different bytes"
        yield Difference("results", "runs", line, None, others, tuple(details))


@dataclass(frozen=True, slots=True)
class Mean:
    """Statistics of one column in one experiment, over the runs of a side."""

    n: int
    mean: float
    sd: float
    rate: tuple[float, float] | None = None
    """Wilson's interval, if the mean is a rate."""


def means(
    store: Store,
    project: LoadedProject,
    before: ComparedRuns,
    after: ComparedRuns,
    chosen: Sequence[tuple[int, int]],
    rows: int,
    notes: list[Note],
) -> Iterator[Difference]:
    """Yield differences of the means of these pairs of experiments, unless their outputs have more than `ROWS` rows."""
    if rows > ROWS:
        text = f"means of {rows} rows are not compared; compute those of a batch with sierra stats OUTPUT COLUMN -b HASH"
        notes.append(Note(text, "results"))
        return
    done, left = 0, []
    for output, columns in _columns(store, project, before, after).items():
        for column in columns:
            if done == COLUMNS:
                left.append(f"{output}.{column}")
                continue
            try:
                old, new = (_means(project, store, side, output, column) for side in (before, after))
            except SierraError as error:
                notes.append(Note(f"the means of {output} are not compared: {error}", "results"))
                break
            done += 1
            yield from _apart(before, chosen, old, new, output, column)
    if left:
        notes.append(
            Note(f"the means of {done} columns are compared; the means of these are not: {few(left, SHOWN)}", "results")
        )


OTHER = "was <> now AND other_result AND was_executed IS NOT NULL AND now_executed IS NOT NULL"


def of_places(snapshot: Snapshot) -> Iterator[Difference]:
    """Yield a difference with the number of paired runs that wrote other bytes, if the runs themselves are different."""
    [(count, all_runs)] = snapshot.run(f"SELECT count(*) FILTER ({OTHER}), count(*) FROM both_sides")  # noqa: S608 - our own
    if count:
        yield Difference("results", "bytes", f"results: {count} of {all_runs} runs wrote different bytes", None, count)


def others(snapshot: Snapshot, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the pairs of experiments in which different runs wrote different bytes."""
    rows = snapshot.run(f"SELECT DISTINCT ordinal FROM both_sides WHERE {OTHER}")  # noqa: S608 - our own
    found = {row[0] for row in rows}
    return [pair for pair in pairs if pair[0] in found]


def rows(snapshot: Snapshot) -> int:
    """Return the number of rows of the outputs of both sides."""
    statement = (
        "SELECT coalesce(sum(rows), 0)::BIGINT FROM all_artifacts WHERE kind = 'table' AND execution IN "
        "(SELECT execution FROM before UNION ALL SELECT execution FROM after)"
    )
    snapshot.views.make(("all_artifacts",))
    count: int = snapshot.run(statement)[0][0]
    return count


def _columns(store: Store, project: LoadedProject, before: ComparedRuns, after: ComparedRuns) -> dict[str, list[str]]:
    """Return the numeric columns that both sides wrote, by output, without time columns."""
    written = []
    for side in (before, after):
        with BatchData(store, side.batch.batch) as frame:
            written.append({table.name: table.columns for table in frame.outputs(frame.written)})
    times = {name: output.time for name, output in project.config.outputs.items()}
    return {
        name: [column for column in columns if column in written[1][name] and not _is_time(column, times.get(name))]
        for name, columns in written[0].items()
        if name in written[1]
    }


def _is_time(column: str, declared: str | None) -> bool:
    return column == declared or names_time(column)


def _means(project: LoadedProject, store: Store, side: ComparedRuns, output: str, column: str) -> dict[int, Mean]:
    """Return the statistics of a column by the experiment's place, without experiments of which no run has a value.

    Only Wilson's intervals are kept, because they tell rates: `welch` computes those of other means from `sd`.
    """
    table = run_statistics.statistics(project, store, side.batch.batch, output, column, "final").table
    names = ("experiment", "n", "mean", "sd", "low", "high", "interval")
    rows = zip(*(table.column(name).to_pylist() for name in names), strict=True)
    return {
        position: Mean(n, mean, sd or 0.0, (low, high) if interval == "Wilson" else None)
        for position, n, mean, sd, low, high, interval in rows
        if n and mean is not None
    }


Means = Mapping[int, Mean]


def _apart(
    before: ComparedRuns, pairs: Sequence[tuple[int, int]], old: Means, new: Means, output: str, column: str
) -> Iterator[Difference]:
    both = [(was, old[was], new[now]) for was, now in pairs if was in old and now in new]
    other = [pair for pair in both if pair[1].mean != pair[2].mean]
    if not other:
        return
    lines, beyond = [], 0
    for ordinal, was, now in other:
        interval = newcombe(was, now) or welch(was, now)
        beyond += interval is not None and not interval[0] <= 0 <= interval[1]
        lines.append(f"{_where(before, ordinal)}: {_compared(was, now, interval)}")
    called = f"results: mean of {column} ({output}, at the end)"
    if len(both) == 1:
        line = f"{called}: {lines[0].removeprefix(f'{_where(before, other[0][0])}: ')}"
        yield Difference("results", f"{output}.{column}", line, other[0][1].mean, other[0][2].mean)
        return
    counts = f"different in {len(other)} of {len(both)} experiments"
    outside = f"0 is outside the 95 % interval of the difference in {beyond or 'none'} of them"
    line = f"{called}: {counts}; {outside} (each interval is of one experiment alone, not corrected for {len(both)})"
    yield Difference(
        "results", f"{output}.{column}", line, [m.mean for _, m, _ in both], [m.mean for _, _, m in both], tuple(lines)
    )


def _where(side: ComparedRuns, place: int) -> str:
    values = {name: value for name, value in side.cells[place].items() if name in side.batch.axes}
    return " ".join(f"{name}={shown(value)}" for name, value in values.items())


def _compared(was: Mean, now: Mean, interval: tuple[float, float] | None) -> str:
    spread = f"95 % interval {interval[0]:+.4g} to {interval[1]:+.4g}" if interval else "no interval"
    digits = digits_apart([was.mean, now.mean])
    means = f"{short_number(was.mean, digits)} {ARROW} {short_number(now.mean, digits)}"
    return f"{means} ({now.mean - was.mean:+.4g}, {spread}, n = {was.n} and {now.n})"


def newcombe(was: Mean, now: Mean) -> tuple[float, float] | None:
    """Return the 95 % interval of the difference of two rates; None if one of the two is not a rate."""
    if was.rate is None or now.rate is None:
        return None
    _, low, high = square_and_add(Interval(was.mean, *was.rate), Interval(now.mean, *now.rate))
    return low, high


def welch(was: Mean, now: Mean) -> tuple[float, float] | None:
    """Return the 95 % interval of the difference of two means; None if a side has fewer than two values."""
    if min(was.n, now.n) < 2:
        return None
    errors = [mean.sd / sqrt(mean.n) for mean in (was, now)]
    error = hypot(*errors)
    if not isfinite(error):
        return None
    parts = [(own / error) ** 2 if error else 0.0 for own in errors]
    weight = sum(part**2 / (mean.n - 1) for part, mean in zip(parts, (was, now), strict=True))
    freedom = 1 / weight if weight else float(was.n + now.n - 2)
    t = student_t.quantiles((1 + LEVEL) / 2, max(1, int(freedom)))[-1]
    return now.mean - was.mean - t * error, now.mean - was.mean + t * error
