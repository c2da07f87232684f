"""Statistics over the runs of a batch, and the values of its runs, with the project's labels and units."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from math import isfinite
from typing import TYPE_CHECKING

from sierra.config.deliverable_tables import Figure
from sierra.config.project_file import LoadedProject
from sierra.deliverables.gallery import Gallery
from sierra.design.query import condition
from sierra.errors import UsageError
from sierra.model import Value
from sierra.stats import aggregate as stats
from sierra.stats import survival
from sierra.stats.comparison.model import RunValue
from sierra.stats.selection import Selection
from sierra.store.batch_data import BatchData
from sierra.store.public_result import Result
from sierra.store.sql_names import column_names
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass, replace

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.stats.comparison.rank_distributions import Floats

MEASURES = ("final", "mean", "time_mean", "time_to")
WITH_TIMES = (("time_to", "own"), ("time_mean", "carry"), ("time_mean", "linear"))
"""The measures that can be used with times: a survival curve, and a mean by steps or by trapezoids."""
AUTO = "auto"
"""Stands for `final`, and for `mean` in tables of events, whose last rows say nothing about the others."""


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of one column over the runs of a batch."""

    batch: str
    output: str
    column: str
    time: str
    """The name of the time column; `row` for an output without one."""
    threshold: float | None
    chosen: tuple[str, ...]
    """The names of the statistics that were chosen; empty: the usual ones."""
    table: pa.Table
    """The columns `experiment`, perhaps `t`, and those of the statistics, with a row for each experiment or time."""
    cells: Mapping[int, Mapping[str, Value]]
    """The values of the axes for each experiment, by its position in the batch."""
    labelled: Mapping[int, Mapping[str, Value]]
    """The same with the labels of controllers and scenarios instead of their names."""
    axes: tuple[str, ...]
    durations: Container[str]
    """The columns that are durations, whose unit is ns."""
    notes: tuple[str, ...]
    """The notes for the reader."""
    sql: str

    def with_axes(self, names: Sequence[str], *, labels: bool = False) -> pa.Table:
        """Return the table with the values of the axes after `experiment`, as columns with these names.

        `labels`: of controllers and scenarios, instead of their names.
        """
        import pyarrow as pa

        table, ordinals, cells = self.table, self.table.column(0).to_pylist(), self.labelled if labels else self.cells
        for position, (name, axis) in enumerate(zip(names, self.axes, strict=True), 1):
            table = table.add_column(position, name, pa.array([cells[ordinal][axis] for ordinal in ordinals]))
        return table


class StatisticsResult(Result):
    """Statistics for users of SIERRA from Python, with the values of the axes.

    If an axis has the name of another column, that column gets a `_` after its name, as outputs' columns do in SQL. The
    schema's metadata hold the statement (`sierra:sql`) and notes for the reader (`sierra:note`).
    """

    def __init__(self, statistics: Statistics, *, labels: bool = False) -> None:
        """`labels`: of controllers and scenarios, instead of their names."""
        names = column_names(statistics.table.column_names, taken=statistics.axes)
        table = replace(statistics, table=statistics.table.rename_columns(names)).with_axes(statistics.axes, labels=labels)
        super().__init__(
            table.replace_schema_metadata({"sierra:sql": statistics.sql, "sierra:note": "; ".join(statistics.notes)})
        )
        self.statistics = statistics

    def with_labels(self) -> Result:
        """Return the same for a reader: with the labels of controllers and scenarios."""
        return StatisticsResult(self.statistics, labels=True)


def statistics(
    project: LoadedProject,
    store: Store,
    batch: str,
    output: str,
    column: str,
    measure: str | None,
    threshold: float | None = None,
    times: str | None = None,
    chosen: Sequence[str] = (),
    among: Callable[[Gallery], Container[int]] | None = None,
    where: str = "",
) -> Statistics:
    """Return statistics of one column, as `sierra.api.Project.statistics` does.

    `among` returns the positions of the experiments that the notes count, if a reader sees only these. `where` is an SQL
    condition on the rows that count. Raises NotFound, UsageError.
    """
    _check_reduction("final" if measure == AUTO else measure, threshold, times)
    of_times = [name for name in chosen if name in survival.STATISTICS] if chosen else list(survival.STATISTICS)
    if chosen and of_times and measure != "time_to":
        raise UsageError(f"statistic {of_times[0]!r} is one of times until a threshold; it needs the measure time_to")
    if chosen and measure == "time_to" and times is not None:
        raise UsageError("the Kaplan-Meier curve (time_to at own times) has no statistics to choose, and no table for papers")
    others = [name for name in chosen if name not in survival.STATISTICS]
    selection = Selection.of(others, project.config.statistics) if chosen else None
    wanted = stats.USUAL if selection is None else selection
    with BatchData(store, batch) as frame:
        gallery = Gallery(project, store, frame, only={output})
        figure = Figure(table=output, column=(column,), where=where)
        samples = gallery.column(figure, measure=measure or "final")
        if measure == AUTO:
            measure = "mean" if gallery.takes_mean(gallery.output(figure)) else "final"
        curves: dict[int, tuple[survival.Step, ...]] = {}
        notes: list[str] = []
        if measure == "time_to" and threshold is not None:
            curves = {ordinal: survival.curve(runs) for ordinal, runs in survival.times(samples.column, threshold).items()}
        if measure == "time_to" and times is not None:
            table, text = survival.curves_table(curves), survival.statement()
        elif measure is None:
            table, text, notes = samples.at_times(times or "own", wanted)
        else:
            table, text = samples.by_experiment(measure, wanted, threshold, steps=times == "carry")
            notes += samples.about(measure)
        if curves and times is None:
            table = survival.with_statistics(table, curves, of_times)
            notes += _about_times(curves, of_times, others=bool(others) or not chosen)
        shown, coverage, planned = table, samples.coverage, gallery.planned
        if among:
            kept = among(gallery)
            shown = table.filter([ordinal in kept for ordinal in table.column("experiment").to_pylist()])
            coverage = replace(coverage, runs={ordinal: runs for ordinal, runs in coverage.runs.items() if ordinal in kept})
            planned = {ordinal: runs for ordinal, runs in planned.items() if ordinal in kept}
        if selection:
            notes += selection.notes(shown)
        notes += gallery.about_digits(output, [column])
        if not selection or "mean" in chosen:
            notes += gallery.about_rates(samples, shown, measure)
        notes = [
            *gallery.notes,
            *stats.left_out([] if "remaining" in table.column_names else [shown], coverage, planned, threshold),
            *notes,
        ]
        return Statistics(
            batch=batch,
            output=output,
            column=column,
            time=gallery.time(gallery.output(figure)) or "row",
            threshold=threshold,
            chosen=tuple(dict.fromkeys(chosen)),
            table=table,
            cells=frame.cells(),
            labelled=gallery.cells,
            axes=tuple(axis.name for axis in frame.axes()),
            durations=frame.durations(output),
            notes=tuple(notes),
            sql="\n\n".join(filter(None, (frame.statements(output), text))),
        )


def output_and_columns(
    project: LoadedProject, store: Store, batch: str, output: str, columns: tuple[str, ...]
) -> tuple[str, tuple[str, ...]]:
    """Return the name of an output or derived table of a batch, as it is spelled there, and the columns.

    An empty `output` is the only one with the columns; without `columns`, it must have only one. Raises NotFound, UsageError.
    """
    with BatchData(store, batch) as frame:
        gallery = Gallery(project, store, frame, only={output} if output else frame.names)
        table = gallery.output(Figure(table=output, column=columns))
        return table.name, columns or (gallery.only_column(table),)


@dataclass(frozen=True, slots=True)
class RunTable:
    """The runs of a batch as one number each."""

    output: str
    column: str
    measure: str
    threshold: float | None
    unit: str
    axes: tuple[str, ...]
    cells: Mapping[int, Mapping[str, Value]]
    """The values of the axes for each experiment, by its position in the batch."""
    labelled: Mapping[int, Mapping[str, Value]]
    """The same with the labels of controllers and scenarios instead of their names."""
    values: Mapping[int, tuple[RunValue, ...]]
    """The runs with a finite value, by the position of their experiment; minus `offset`."""
    planned: Mapping[int, int]
    """The number of requested runs of each experiment."""
    notes: tuple[str, ...]
    rate: bool = False
    """True if the values 0 and 1 of the column are a rate."""
    offset: int = 0
    """The number that was subtracted from all values, because floats do not hold the digits of the column."""

    def shown(self, ordinal: int) -> dict[str, Value]:
        """Return the values of the axes in an experiment, as a reader sees them."""
        return {name: self.labelled[ordinal][name] for name in self.axes}

    def minus(self, offset: int) -> RunTable:
        """Return the same runs, from whose values another whole number is subtracted."""
        if offset == self.offset:
            return self
        moved = float(self.offset - offset)
        values = {
            ordinal: tuple(replace(run, value=run.value + moved) for run in runs) for ordinal, runs in self.values.items()
        }
        return replace(self, values=values, offset=offset)

    def among(self, experiments: str) -> RunTable:
        """Return the runs of the experiments that a condition on variables selects; "": all. Raises QueryError."""
        if not experiments:
            return self
        kept = condition.among(experiments, self.axes, self.cells, self.labelled)
        return replace(
            self,
            cells={ordinal: self.cells[ordinal] for ordinal in self.cells if ordinal in kept},
            labelled={ordinal: self.labelled[ordinal] for ordinal in self.labelled if ordinal in kept},
            values={ordinal: self.values[ordinal] for ordinal in self.values if ordinal in kept},
            planned={ordinal: self.planned[ordinal] for ordinal in self.planned if ordinal in kept},
        )


def values_of_runs(
    project: LoadedProject,
    store: Store,
    batch: str,
    output: str,
    column: str,
    measure: str | None,
    threshold: float | None = None,
    where: str = "",
) -> RunTable:
    """Return the runs of a batch, each reduced to one number by a measure (None: `AUTO`).

    `where` is an SQL condition on the rows that count. Without `output` and `column`, it is the only numeric column. Raises
    NotFound, UsageError.
    """
    _check_reduction(measure, threshold, None)
    with BatchData(store, batch) as frame:
        gallery = Gallery(project, store, frame, only={output} if output else frame.names)
        table = gallery.output(Figure(table=output, column=(column,) if column else ()), "table (--table)")
        chosen = column or gallery.only_column(table)
        measure = measure or ("mean" if gallery.takes_mean(table) else "final")
        offset = 0 if measure == "time_to" else frame.offset(table.name, chosen)
        samples = gallery.column(Figure(table=table.name, column=(chosen,), where=where), offset, measure)
        rows = stats.values_of_runs(samples.column, measure, threshold).to_pylist()
        seeds = frame.seeds()
        values: dict[int, list[RunValue]] = {ordinal: [] for ordinal in gallery.planned}
        for row in rows:
            value = row["last"] if row["never"] else row["value"]
            if value is not None and isfinite(value):
                seed = seeds[row["experiment"], row["run"]]
                values[row["experiment"]].append(RunValue(seed, float(value), not row["never"]))
        notes = [*stats.left_out((), samples.coverage), *samples.about(measure)]
        if not (samples.rate or offset) and measure != "time_to" and stats.may_be_rate(samples.column, measure):
            notes.append(
                f"all values of {chosen} are 0 or 1 (to compare them as rates, {gallery.key_of_rates(table.name, chosen)})"
            )
        return RunTable(
            output=table.name,
            column=chosen,
            measure=measure,
            threshold=threshold,
            unit=gallery.unit(table, gallery.time(table) if measure == "time_to" else chosen),
            axes=tuple(axis.name for axis in frame.axes()),
            cells=frame.cells(),
            labelled=gallery.cells,
            values={ordinal: tuple(runs) for ordinal, runs in values.items()},
            planned=gallery.planned,
            notes=(*gallery.notes, *notes),
            rate=samples.remains_rate(measure) and not offset,
            offset=offset,
        )


@dataclass(frozen=True, slots=True)
class RunSeries:
    """The runs of a batch over time."""

    time: str
    """The name of the time column with its unit."""
    times: list[float]
    values: Mapping[int, Mapping[int, Floats]]
    """The values at these times, by the position of the experiment and by seed, minus `offset`; NaN where a run has none."""
    offset: int = 0
    """The number that was subtracted from all values, as in `RunTable`."""


def runs_over_time(
    project: LoadedProject, store: Store, batch: str, output: str, column: str, grid: list[float] | None
) -> RunSeries:
    """Return the runs of a batch at common times, which `grid` may give. Raises UsageError for an output without a time."""
    import numpy as np

    with BatchData(store, batch) as frame:
        gallery = Gallery(project, store, frame, only={output})
        table = gallery.output(Figure(table=output, column=(column,)))
        time = gallery.time(table)
        if not time or table.rows < 2:
            raise UsageError(
                f"output {output!r} has no time, so it cannot be compared over time; see time in [outputs.{output}]"
            )
        offset = frame.offset(table.name, column)
        rows, times = gallery.column(Figure(table=output, column=(column,)), offset).runs_over_time(grid)
        places = np.searchsorted(np.array(times), rows.column("t").to_numpy())
        seeds = frame.seeds()
        values: dict[int, dict[int, Floats]] = {ordinal: {} for ordinal in gallery.planned}
        runs = zip(rows.column("experiment").to_pylist(), rows.column("run").to_pylist(), strict=True)
        numbers = rows.column("value").to_numpy(zero_copy_only=False).astype(float)
        for (ordinal, run), index, number in zip(runs, places.tolist(), numbers.tolist(), strict=True):
            series = values[ordinal].setdefault(seeds[ordinal, run], np.full(len(times), np.nan))
            series[index] = number
        unit = gallery.unit(table, time)
        return RunSeries(f"{time} [{unit}]" if unit else time, times, values, offset)


def _about_times(curves: Mapping[int, Sequence[survival.Step]], of_times: Sequence[str], *, others: bool) -> list[str]:
    """Return notes on which runs the statistics of times count."""
    notes = []
    censored = sum(step.censored for steps in curves.values() for step in steps)
    if censored and others:
        notes.append(
            f"mean, median and all others except {' and '.join(survival.STATISTICS)} are those of the runs that reached it"
        )
    if censored and "restricted_mean" in of_times:
        notes.append(f"restricted_mean is the mean time up to {survival.horizon(curves.values()):.12g}")
    return notes


def _check_reduction(measure: str | None, threshold: float | None, times: str | None) -> None:
    if measure is not None and measure not in MEASURES:
        raise UsageError(f"unknown measure {measure!r}; known are {', '.join(MEASURES)}, or None for statistics at each time")
    if (measure == "time_to") != (threshold is not None):
        raise UsageError("measure 'time_to' needs a threshold, for example threshold = 0.9; no other measure has one")
    if threshold is not None and not isfinite(threshold):
        raise UsageError(f"a threshold must be a finite number, not {threshold}")
    if measure is not None and times is not None and (measure, times) not in WITH_TIMES:
        raise UsageError(
            f"times {times!r} needs statistics at each time, but a measure ({measure!r}) gives one value for all times"
        )
