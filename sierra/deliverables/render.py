"""Render figures from the store: the figures that `sierra.toml` declares, or else the default figures that fit.

Figures are drawn from aggregates that SQL computes; the project adds labels and units. A figure that cannot be
drawn (no such column in this batch, no finite value in it) is reported, and the others are still drawn.
"""

from __future__ import annotations

import json
import re
from collections.abc import Container, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.config import figure_options
from sierra.config.deliverable_tables import Figure
from sierra.config.group_names import resolve
from sierra.config.output_tables import Output
from sierra.config.project_file import LoadedProject
from sierra.deliverables import overlay, seconds, suggest_tables
from sierra.deliverables.figures.drawing import Drawing, draw
from sierra.deliverables.figures.gather import Batch, gather
from sierra.deliverables.record import Content, Recorder
from sierra.errors import Missing, NotFound, SierraError, UsageError
from sierra.execution import targets
from sierra.model import Axis, Value
from sierra.stats import aggregate as stats
from sierra.stats import survival
from sierra.stats.comparison.model import RunValue
from sierra.stats.selection import Selection
from sierra.store.derived_tables import Definition
from sierra.store.layout import ProjectPaths
from sierra.store.row_types import DeliverableRow
from sierra.store.samples import MIXED, Column, Frame, NoRuns, OutputTable, names_time
from sierra.store.segments import disk_errors
from sierra.store.sql_names import column_names
from sierra.store.store import Store
from sierra.store.union_files import TEXT
from sierra.util.fs import write_whole
from sierra.util.hashing import sha256, short
from sierra.util.text import counted, like

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.stats.comparison.rank_distributions import Floats

MEASURES = ("final", "mean", "time_to")
AUTO = "auto"
"""Stands for `final`, and for `mean` in tables of events, whose last rows say nothing about the others."""
ONE_FILE = "file in [outputs.{}] can name one of them"
AT_MOST = 16
"""The largest number of default figures of one batch; others are reported, and drawn on request."""


def figures(
    project: LoadedProject, store: Store, batch: str, name: str | None = None, *, again: bool = True
) -> tuple[list[Path], list[str]]:
    """Draw a batch's figures, or the one called `name`; return the files, and what could not be drawn and why.

    Without `again`, figures that were drawn from the same data in the same way are left as they are. Raises NotFound if no
    figure has that name, SierraError if that figure cannot be drawn.
    """
    with Frame(store, batch) as frame:
        gallery = _Gallery(project, store, frame, name=name)
        wanted, notes = gallery.wanted(name)
        drawer = _Drawer(store, project.root, batch, again=again)
        drawn: list[Path] = []
        for figure_name, figure in wanted.items():
            try:
                drawn += drawer.draw(gallery.drawing(figure_name, figure))
            except Missing:
                raise
            except SierraError as error:
                if name is not None:
                    raise
                notes.append(f"figure {figure_name}: {error}")
        notes += (*gallery.declared_notes, *gallery.time_notes.values())
    notes += drawer.close()
    return drawn, notes


def content(project: LoadedProject, store: Store, row: DeliverableRow) -> Content:
    """Return the content of a recorded figure by its definition and the data that the store has now."""
    definition = json.loads(row.definition)
    figure = Figure.model_validate(definition["figure"])
    if named := overlay.targets_of(definition):
        with ExitStack() as frames:
            batches = overlay.batches_of(named, row.batches)
            return _overlay(_galleries(project, store, batches, frames), row.name, figure).content()
    with Frame(store, row.batch) as frame:
        only = {figure.table} if figure.table or figure.sql else None
        return _Gallery(project, store, frame, only=only).drawing(row.name, figure).content()


def overlaid(
    project: LoadedProject, store: Store, batches: Mapping[str, str], name: str | None = None
) -> tuple[list[Path], list[str]]:
    """Draw the figures of several batches together, by target; return the files, and what could not be drawn and why.

    Raises NotFound if no figure has that name, SierraError if that figure cannot be drawn.
    """
    with ExitStack() as frames:
        galleries = _galleries(project, store, batches, frames)
        first, *others = galleries.values()
        wanted, notes = first.wanted(name)
        drawer = _Drawer(store, project.root, *batches.values(), again=True)
        drawn: list[Path] = []
        for figure_name, found in wanted.items():
            try:
                figure = overlay.fitting(found, declared=bool(project.config.figures))
                called = figure_name.replace("_heatmap", "_summary") if figure is not found else figure_name
                drawn += drawer.draw(_overlay(galleries, "_".join((called, *galleries)), figure))
            except Missing:
                raise
            except SierraError as error:
                if name is not None:
                    raise
                notes.append(f"figure {figure_name}: {error}")
        notes += dict.fromkeys(note for gallery in (first, *others) for note in gallery.time_notes.values())
    notes += drawer.close()
    return drawn, notes


def _galleries(project: LoadedProject, store: Store, batches: Mapping[str, str], frames: ExitStack) -> dict[str, _Gallery]:
    return {
        target: _Gallery(project.for_target(target), store, frames.enter_context(Frame(store, batch)), target)
        for target, batch in batches.items()
    }


def _overlay(galleries: Mapping[str, _Gallery], name: str, figure: Figure) -> Drawing:
    return overlay.merged({target: gallery.drawing(name, figure) for target, gallery in galleries.items()})


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
) -> pa.Table:
    """Return statistics of one column, as `sierra.api.Project.statistics` does, with the values of the axes.

    The columns are `experiment`, one for each axis, and those of the statistics. If an axis has the name of another column,
    that column gets a `_` after its name, as outputs' columns do in SQL. The schema's metadata hold the statement
    (`sierra:sql`) and notes for the reader (`sierra:note`). Raises NotFound, UsageError.
    """
    _check_reduction("final" if measure == AUTO else measure, threshold, times)
    of_times = [name for name in chosen if name in survival.STATISTICS] if chosen else list(survival.STATISTICS)
    if chosen and of_times and measure != "time_to":
        raise UsageError(f"statistic {of_times[0]!r} is one of times until a threshold; it needs the measure time_to")
    if chosen and measure == "time_to" and times is not None:
        raise UsageError("the Kaplan-Meier curve (time_to at own times) has no statistics to choose, and no table for papers")
    others = [name for name in chosen if name not in survival.STATISTICS]
    selection = Selection.of(others, project.config.statistics) if chosen else None
    wanted = stats.STATISTICS if selection is None else selection
    with Frame(store, batch) as frame:
        gallery = _Gallery(project, store, frame, only={output})
        figure = Figure(table=output, column=(column,))
        samples = gallery.column(figure)
        if measure == AUTO:
            measure = "mean" if gallery.takes_mean(gallery.output(figure)) else "final"
        curves: dict[int, tuple[survival.Step, ...]] = {}
        notes: list[str] = []
        if measure == "time_to" and threshold is not None:
            curves = {place: survival.curve(runs) for place, runs in survival.times(samples.frame, threshold).items()}
        if measure == "time_to" and times is not None:
            table, text, notes = survival.curves_table(curves), survival.statement(), notes
        elif measure is None:
            table, text, notes = samples.at_times(times or "own", wanted)
        else:
            (table, text), notes = samples.by_experiment(measure, wanted, threshold), notes
        if curves and times is None:
            table = survival.with_statistics(table, curves, of_times)
            notes += _about_times(curves, of_times, others=bool(others) or not chosen)
        if selection:
            notes += selection.notes(table)
        if not selection or "mean" in chosen:
            notes += _about_rates(table, column, output, asked=samples.rate and measure != "time_to")
        notes = [
            *gallery.target_notes,
            *gallery.declared_notes,
            *gallery.time_notes.values(),
            *stats.left_out([] if "remaining" in table.column_names else [table], samples.coverage, gallery.planned, threshold),
            *notes,
        ]
        text = "\n\n".join(filter(None, (frame.statements(output), text)))
        about = {
            "axes": [axis.name for axis in frame.axes()],
            "statistics": list(dict.fromkeys(chosen)),
            "output": output,
            "column": column,
            "time": gallery.time(gallery.output(figure)) or "row",
            "threshold": threshold,
        }
        metadata = {
            "sierra:batch": batch,
            "sierra:sql": text,
            "sierra:note": "; ".join(notes),
            "sierra:statistics": json.dumps(about, ensure_ascii=False),
        }
        return _with_axes(table, frame).replace_schema_metadata(metadata)


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
    """The runs with a finite value, by the position of their experiment."""
    planned: Mapping[int, int]
    """The number of requested runs of each experiment."""
    notes: tuple[str, ...]

    def shown(self, ordinal: int) -> dict[str, Value]:
        """Return the values of the axes in an experiment, as a reader sees them."""
        return {name: self.labelled[ordinal][name] for name in self.axes}


def values_of_runs(
    project: LoadedProject,
    store: Store,
    batch: str,
    output: str,
    column: str,
    measure: str | None,
    threshold: float | None = None,
) -> RunTable:
    """Return the runs of a batch, each reduced to one number by a measure (None: `AUTO`).

    Without `output` and `column`, it is the only numeric column. Raises NotFound, UsageError.
    """
    _check_reduction(measure, threshold, None)
    with Frame(store, batch) as frame:
        gallery = _Gallery(project, store, frame, only={output} if output else frame.names)
        found = gallery.output(Figure(table=output, column=(column,) if column else ()))
        chosen = column or gallery.only_column(found)
        samples = gallery.column(Figure(table=found.name, column=(chosen,)))
        measure = measure or ("mean" if gallery.takes_mean(found) else "final")
        rows = stats.values_of_runs(samples.frame, measure, threshold).to_pylist()
        seeds = frame.seeds()
        values: dict[int, list[RunValue]] = {ordinal: [] for ordinal in gallery.planned}
        for row in rows:
            value = row["last"] if row["never"] else row["value"]
            if value is not None and isfinite(value):
                seed = seeds[row["experiment"], row["run"]]
                values[row["experiment"]].append(RunValue(seed, float(value), not row["never"]))
        untimed = [f"{counted(samples.coverage.untimed, 'row')} without a time left out"] if samples.coverage.untimed else []
        return RunTable(
            output=found.name,
            column=chosen,
            measure=measure,
            threshold=threshold,
            unit=gallery.unit(found, gallery.time(found) if measure == "time_to" else chosen),
            axes=tuple(axis.name for axis in frame.axes()),
            cells=frame.cells(),
            labelled=gallery.cells,
            values={ordinal: tuple(runs) for ordinal, runs in values.items()},
            planned=gallery.planned,
            notes=(*gallery.target_notes, *gallery.declared_notes, *gallery.time_notes.values(), *untimed),
        )


@dataclass(frozen=True, slots=True)
class RunSeries:
    """The runs of a batch over time."""

    time: str
    """The name of the time column with its unit."""
    times: list[float]
    values: Mapping[int, Mapping[int, Floats]]
    """The values at these times, by the position of the experiment and by seed; NaN where a run has none."""


def runs_over_time(
    project: LoadedProject, store: Store, batch: str, output: str, column: str, grid: list[float] | None
) -> RunSeries:
    """Return the runs of a batch at common times, which `grid` may give. Raises UsageError for an output without a time."""
    import numpy as np

    with Frame(store, batch) as frame:
        gallery = _Gallery(project, store, frame, only={output})
        found = gallery.output(Figure(table=output, column=(column,)))
        time = gallery.time(found)
        if not time or found.rows < 2:
            raise UsageError(
                f"output {output!r} has no time, so it cannot be compared over time; see time in [outputs.{output}]"
            )
        rows, times = gallery.column(Figure(table=output, column=(column,))).runs_over_time(grid)
        places = np.searchsorted(np.array(times), rows.column("t").to_numpy())
        seeds = frame.seeds()
        values: dict[int, dict[int, Floats]] = {ordinal: {} for ordinal in gallery.planned}
        runs = zip(rows.column("experiment").to_pylist(), rows.column("run").to_pylist(), strict=True)
        numbers = rows.column("value").to_numpy(zero_copy_only=False).astype(float)
        for (ordinal, run), place, number in zip(runs, places.tolist(), numbers.tolist(), strict=True):
            series = values[ordinal].setdefault(seeds[ordinal, run], np.full(len(times), np.nan))
            series[place] = number
        unit = gallery.unit(found, time)
        return RunSeries(f"{time} [{unit}]" if unit else time, times, values)


def _tables(figures: Mapping[str, Figure], name: str | None) -> Container[str] | None:
    """Return the tables that figures are drawn from: all figures, or the one called `name`; None if it may be any table."""
    wanted = [figure for called, figure in figures.items() if name in (None, called)]
    known = wanted and all(figure.table or figure.sql for figure in wanted)
    return {figure.table for figure in wanted} if known else None


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


def _about_rates(table: pa.Table, column: str, output: str, *, asked: bool) -> list[str]:
    """Return notes on the kind of interval if the values are 0 and 1. `asked`: whether the column is one of a rate."""
    if stats.is_rate(table):
        return [f"all values of {column} are 0 or 1: low and high are Wilson's 95 % interval of a rate"]
    if asked and any(n > 1 for n in table.column("n").to_pylist()):
        return [f"not all values of {column} are 0 or 1: low and high are Student's t interval, not that of a rate"]
    if not stats.may_be_rate(table):
        return []
    return [
        f"all values of {column} are 0 or 1, but it may be a count: low and high are Student's t interval"
        f' (for the interval of a rate, set rates = ["{column}"] in [outputs.{output}])'
    ]


def _check_reduction(measure: str | None, threshold: float | None, times: str | None) -> None:
    if measure is not None and measure not in MEASURES:
        raise UsageError(f"unknown measure {measure!r}; known are {', '.join(MEASURES)}, or None for statistics at each time")
    if (measure == "time_to") != (threshold is not None):
        raise UsageError("measure 'time_to' needs a threshold, for example threshold = 0.9; no other measure has one")
    if threshold is not None and not isfinite(threshold):
        raise UsageError(f"a threshold must be a finite number, not {threshold}")
    if measure is not None and times is not None and (measure, times) != ("time_to", "own"):
        raise UsageError(
            f"times {times!r} needs statistics at each time, but a measure ({measure!r}) gives one value for all times"
        )


def _with_axes(table: pa.Table, frame: Frame) -> pa.Table:
    """Return the statistics with the values of the axes after `experiment`."""
    import pyarrow as pa

    axes, cells = frame.axes(), frame.cells()
    table = table.rename_columns(column_names(table.column_names, taken=[axis.name for axis in axes]))
    ordinals = table.column(0).to_pylist()
    for place, axis in enumerate(axes):
        values = [cells[ordinal][axis.name] for ordinal in ordinals]
        table = table.add_column(1 + place, axis.name, pa.array(values))
    return table


class _Drawer:
    """The writer of figures' files, which records them. Without `again`, it skips figures that it would only write again."""

    def __init__(self, store: Store, root: Path, batch: str, *others: str, again: bool) -> None:
        """`others`: further batches that the figures show."""
        self._recorder = Recorder(store, root, batch)
        self._mark = ProjectPaths(root).drawn("-".join(map(short, (batch, *others))))
        self._again = again

    def draw(self, drawing: Drawing) -> tuple[Path, ...]:
        """Return the figure's files, drawn now or before."""
        content = drawing.content()
        files = None if self._again else self._recorder.made(content)
        if files is None:
            if not self._mark.exists():
                with disk_errors(self._mark.parent):
                    self._mark.parent.mkdir(parents=True, exist_ok=True)
                    write_whole(self._mark, b"Figures drawn by SIERRA: see the table deliverables.\n")
            files = draw(drawing, self._mark.parent)
            self._recorder.add(content, files)
        return files

    def close(self) -> list[str]:
        """Record what was drawn. Return a note if that is not possible."""
        try:
            self._recorder.close()
        except Missing as error:
            return [f"the figures are drawn, but not recorded: {error}"]
        return []


@dataclass(frozen=True, slots=True)
class _Output:
    """One output of a batch, as a source of figures."""

    frame: Frame
    output: OutputTable
    time: str
    where: str = ""

    def check(self, columns: Sequence[str], *, numeric: bool) -> None:
        for column in columns:
            if numeric and column in self.output.mixed:
                raise UsageError(
                    f"column {column!r} of output {self.output.name!r} {MIXED}; see {column + TEXT!r} in sierra sql"
                )
            known = self.output.columns if numeric else self.output.all_columns
            if column not in known:
                what = "numeric column" if numeric else "column"
                raise NotFound(f"output {self.output.name!r} has no {what} {column!r}; it has {', '.join(known)}")

    def samples(self, column: str) -> Column:
        return Column(self.frame, self.output.name, column, self.time, self.where)

    def coverage(self, column: str) -> stats.Coverage:
        """Return the amount of data that fulfils `where`. Raises SierraError if there is none."""
        (row,) = self.rows("SELECT count(*) AS count FROM data").to_pylist()
        if not row["count"]:
            raise SierraError(f"no row of output {self.output.name!r} fulfils where = {self.where!r}")
        return stats.coverage(self.samples(column), several=True)

    def rows(self, statement: str) -> pa.Table:
        self.frame.data(self.output.name, self.time, self.where)
        return self.frame.sql(statement)


class _Gallery:
    """The data that the figures of one batch share."""

    def __init__(
        self,
        project: LoadedProject,
        store: Store,
        frame: Frame,
        target: str | None = None,
        *,
        name: str | None = None,
        only: Container[str] | None = None,
    ) -> None:
        """`target`: the project is the one for this target; by default, it is that of the batch's last request.

        `name`: the only figure that is wanted. `only`: the outputs and derived tables that are needed; default: all.
        """
        own = target is not None
        target = target or (targets.recorded(store, frame.batch) if project.targets else None)
        self.target_notes = [f"target {target}"] if target else []
        """The target that the batch was requested for; its declarations are used."""
        self.declared_notes = () if own else targets.notes(project, store, frame.batch)
        """A note if the declarations are those of another target."""
        self._config = project.config if own else targets.of_batch(project, store, frame.batch).config
        self._store = store
        self._frame = frame
        self._outputs = {output.name: output for output in frame.outputs(only or _tables(self._config.figures, name))}
        self._shown: dict[str, Mapping[Value, Value]] = {}
        self._axes = tuple(map(self._labelled, frame.axes()))
        self._cells = {ordinal: self._with_labels(values) for ordinal, values in frame.cells().items()}
        self.planned = {ordinal: runs for ordinal, (_, runs) in frame.counts().items()}
        self._seen: dict[str, stats.Coverage] = {}
        self._times: dict[str, str] = {}
        self.time_notes: dict[str, str] = {}
        """Notes by output, if its time column is neither declared nor known by its name: what is used instead."""

    def wanted(self, name: str | None) -> tuple[Mapping[str, Figure], list[str]]:
        """Return the figures to draw, by name, and notes about them."""
        declared = self._config.figures
        figure_options.check(declared)
        found, notes = (dict(declared), []) if declared else self._default()
        if name is not None:
            everything = {**self._default()[0], **declared}
            if name not in everything:
                raise NotFound(f"this batch has no figure {name!r}; its figures: {', '.join(everything) or 'none'}")
            return {name: everything[name]}, []
        if not declared and len(found) > AT_MOST:
            kept = self._best(found)
            left = [name for name in found if name not in kept]
            return kept, [*notes, f"{len(left)} more figures can be drawn, for example: sierra figures HASH {left[0]}"]
        return found, notes

    def _best(self, figures: Mapping[str, Figure]) -> dict[str, Figure]:
        """Return as many figures as are drawn by default: those of columns that differ most between experiments."""
        columns: dict[str, dict[str, None]] = {}
        for figure in figures.values():
            columns.setdefault(figure.table, {}).update(dict.fromkeys(figure.columns))
        shares = {table: self._frame.differing(table, list(names)) for table, names in columns.items()}
        share = {
            name: max((shares[figure.table].get(column, 0.0) for column in figure.columns), default=0.0)
            for name, figure in figures.items()
        }
        best = set(sorted(figures, key=lambda name: -share[name])[:AT_MOST])
        return {name: figure for name, figure in figures.items() if name in best}

    def _default(self) -> tuple[dict[str, Figure], list[str]]:
        """Return the default figures that fit each output; and notes on outputs and columns without one, and why."""
        found: dict[str, Figure] = {}
        problems = self._frame.problems
        notes = [f"no figure of table {name!r}: {error}" for name, error in problems.items() if not isinstance(error, NoRuns)]
        notes += (
            []
            if self._outputs or problems
            else ["no run wrote a table, so there is no figure; see: sierra sql 'FROM artifacts'"]
        )
        for output in self._outputs.values():
            time = self.time(output)
            columns = [column for column in output.columns if column != time]
            notes += [f"no figure of column {one!r} of output {output.name!r}: it {MIXED}" for one in output.mixed]
            notes += suggest_tables.notes(self._frame, output)
            try:
                self._coverage(output)
            except SierraError as error:
                doubled = type(error) is UsageError and output.files < 2
                hint = suggest_tables.of_means(self._frame, output, self.time(output)) if doubled else ""
                notes.append(f"no figure of output {output.name!r}: {error}{hint}")
                continue
            series = output.rows > 1 and not self.takes_mean(output)
            proposed = stats.default_figures(output.name, columns, self._axes, series=series)
            found |= {_file_name(name, found): figure for name, figure in proposed.items()}
        return found, notes

    def _from_sql(self, statement: str) -> str:
        """Return the name of the derived table that the own statement of a figure makes."""
        table = f"sql {short(sha256(statement.encode()))}"
        if table not in self._frame.names:
            self._frame.derive(Definition(table, statement, "sql"))
            self._outputs |= {output.name: output for output in self._frame.outputs({table})}
        return table

    @property
    def cells(self) -> Mapping[int, Mapping[str, Value]]:
        """Return the values of the axes for each experiment, with the labels of controllers and scenarios."""
        return self._cells

    def only_column(self, output: OutputTable) -> str:
        """Return the only numeric column of an output that is not its time. Raises UsageError if there are several."""
        columns = [column for column in output.columns if column != self.time(output)]
        if len(columns) != 1:
            raise UsageError(f"name the column; output {output.name!r} has {', '.join(columns) or 'no numeric column'}")
        return columns[0]

    def unit(self, output: OutputTable, column: str) -> str:
        """Return the declared unit of a column; "" if there is none."""
        declared = self._config.declared(output.name)
        return declared.units.get(column, "") if declared else ""

    def column(self, figure: Figure) -> stats.Samples:
        """Return the samples of the one column that a figure names."""
        output = self.output(figure)
        (column,) = figure.columns
        source = _Output(self._frame, output, self.time(output))
        source.check(figure.columns, numeric=True)
        return stats.Samples(source.samples(column), self._coverage(output), column in self.rates(output))

    def rates(self, output: OutputTable) -> tuple[str, ...]:
        """Return the columns whose values 0 and 1 are a rate: those of flags, and those that are declared."""
        declared = self._config.declared(output.name)
        rates = declared.rates if isinstance(declared, Output) else ()
        if unknown := [column for column in rates if column not in output.all_columns]:
            where = f"[outputs.{output.name}] rates"
            raise NotFound(f"{where}: no column {unknown[0]!r}; {like(unknown[0], output.all_columns)}")
        return (*output.flags, *rates)

    def drawing(self, name: str, figure: Figure) -> Drawing:
        """Return the computed content of a figure."""
        output = self.output(figure)
        if "measure" not in figure.model_fields_set and figure.kind != "timeseries" and self.takes_mean(output):
            figure = figure.model_copy(update={"measure": "mean"})
        time = self.time(output)
        columns = figure.columns or tuple(column for column in output.columns if column != time)[:1]
        source = _Output(self._frame, output, time, figure.where)
        batch = Batch(self._axes, self._cells, self.planned, self._frame.batch)
        seen = self._coverage(output, several=True)
        if figure.where:
            asked = self._frame.experiments_with(output.name, figure.where)
            failed = asked.difference(seen.runs)
            seen = source.coverage(columns[0])
            planned = {ordinal: runs for ordinal, runs in self.planned.items() if ordinal in asked.union(seen.runs)}
            batch = replace(batch.of_experiments(failed.union(seen.runs)), planned=planned)
        made = gather(name, figure, columns, batch, source, seen, self.rates(output))
        declared = self._config.declared(output.name)
        units = dict(declared.units) if declared else {}
        tables, note = made.tables, made.note
        if (
            isinstance(declared, Output)
            and declared.ticks_per_second is not None
            and all("t" in table.column_names for table in tables.values())
        ):
            per_second = seconds.rates(declared.ticks_per_second, self._config, self._store, self._frame)
            tables = {column: seconds.in_seconds(table, per_second) for column, table in tables.items()}
            note = "; ".join(text for text in (note, seconds.note(time, per_second)) if text)
            units[time] = "s"
        note = "; ".join(filter(None, (*self.target_notes, note)))
        sql = "\n\n".join(filter(None, (self._frame.statements(output.name), made.sql)))
        return replace(made, tables=tables, note=note, sql=sql, time=time or "row", units=units)

    def time(self, output: OutputTable) -> str:
        """Return the name of the time column; "" if there is none.

        It is the declared column; else the first, if its name is that of a time; else one that increases alike in all runs.
        """
        if output.name not in self._times:
            self._times[output.name] = self._time(output)
        return self._times[output.name]

    def _time(self, output: OutputTable) -> str:
        declared = self._config.declared(output.name)
        if declared and declared.time:
            return declared.time
        first = output.all_columns[0] if output.all_columns else ""
        if names_time(first) and first in output.columns:
            return first
        found = self._frame.shared_axis(output.name, output.columns) if output.rows > 1 else None
        if found is None:
            if declared is None and output.rows > 1:
                self.time_notes[output.name] = (
                    f"output {output.name!r} has no time column: row numbers are used instead, because no column increases"
                    f' equally in all runs (to name one, set time = "COLUMN" in [outputs.{output.name}])'
                )
            return ""
        self.time_notes[output.name] = (
            f"{found!r} is used as the time of output {output.name!r}, because it increases equally in all runs"
            f' (to name another, set time = "COLUMN" in [outputs.{output.name}])'
        )
        return found

    def _coverage(self, output: OutputTable, *, several: bool = False) -> stats.Coverage:
        """Return the amount of data. Raises UsageError for several rows at the same time of a run, unless `several`."""
        if output.name not in self._seen:
            if not output.columns:
                raise NotFound("it has no numeric column")
            time = self.time(output)
            column = next((c for c in output.columns if c != time), output.columns[0])
            self._seen[output.name] = stats.coverage(Column(self._frame, output.name, column, time), several=True)
        if not several:
            try:
                stats.check_times(self._seen[output.name])
            except UsageError as error:
                if output.files < 2:
                    raise
                raise UsageError(
                    f"{error}. A run has {output.files} files of this output: {ONE_FILE.format(output.name)}"
                ) from error
        return self._seen[output.name]

    def takes_mean(self, output: OutputTable) -> bool:
        """Return whether runs count by the mean of an output's rows, and note it: it has no time, but a row for each event."""
        if (output.fewest == output.rows and not output.unordered) or output.rows < 2 or self.time(output):
            return False
        if output.unordered:
            self.time_notes[output.name] = (
                f"the mean of each run's rows of table {output.name!r} is taken: it has no time column, and its SQL does not "
                f"order the rows (set time in [tables.{output.name}], or add ORDER BY to its SQL)"
            )
            return True
        self.time_notes[output.name] = (
            f"output {output.name!r} has no time column, and its runs have {output.fewest} to {output.rows} rows: the mean "
            f"of each run's rows is taken, not the last row (set time in [outputs.{output.name}] if rows follow each other "
            "in time)"
        )
        return True

    def output(self, figure: Figure) -> OutputTable:
        """Return the output that a figure names, or the only one with its columns. Raises NotFound."""
        if name := self._from_sql(figure.sql) if figure.sql else figure.table:
            if name in self._frame.problems:
                raise self._frame.problems[name]
            if name not in self._outputs:
                raise NotFound(f"this batch has no output {name!r}; its outputs: {', '.join(self._frame.names) or 'none'}")
            return self._outputs[name]
        having = [o for o in self._outputs.values() if all(column in o.columns for column in figure.columns)]
        having = [o for o in having if o.name in self._frame.written] or having
        if self._outputs and not having:
            raise NotFound(
                f"no output has {' and '.join(map(repr, figure.columns))} as numeric columns (sierra sql 'SHOW TABLES')"
            )
        if len(having) != 1:
            raise NotFound(
                f"name the output of the figure: set table to one of {', '.join(self._outputs) or '(none was written)'}"
            )
        return having[0]

    def _labelled(self, axis: Axis) -> Axis:
        variable = self._config.variables.get(axis.name)
        if variable:
            return replace(axis, label=variable.label, unit=variable.unit)
        labels = self._labels(axis)
        self._shown[axis.name] = labels
        return replace(axis, values=tuple(labels.get(value, value) for value in axis.values))

    def _labels(self, axis: Axis) -> Mapping[Value, Value]:
        """Return the labels of controllers or scenarios, by their names; none for labels that do not tell the values apart."""
        groups = {"controller": self._config.controllers, "scenario": self._config.scenarios}.get(axis.name, {})
        labels: dict[Value, Value] = {}
        for value in axis.values:
            found = resolve(str(value), groups)
            labels[value] = (groups[found[0].declared[-1]].label if len(found) == 1 else "") or value
        shared = {label for label in labels.values() if list(labels.values()).count(label) > 1}
        return {value: label for value, label in labels.items() if label not in shared}

    def _with_labels(self, values: Mapping[str, Value]) -> Mapping[str, Value]:
        return {name: self._shown.get(name, {}).get(value, value) for name, value in values.items()}


def _file_name(name: str, taken: Mapping[str, Figure]) -> str:
    """Return a file name for a figure that is valid on all systems and not taken."""
    plain = re.sub(r"[^\w.-]+", "_", name).strip("_.") or "figure"
    return next(free for free in (plain, *(f"{plain}_{n}" for n in range(2, len(taken) + 3))) if free not in taken)
