"""The data of one batch for its deliverables: outputs with their times, labels of axes, default figures.

The project adds labels and units to what SQL computes.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING

from sierra.config.deliverable_tables import Figure
from sierra.config.output_tables import Output, volatile_and_rates
from sierra.config.project_file import LoadedProject
from sierra.deliverables import bound, seconds, suggest_tables
from sierra.deliverables.figures.base import kind_of
from sierra.deliverables.figures.drawing import Drawing
from sierra.deliverables.figures.gather import Batch, OutputRows, gather
from sierra.deliverables.models.models_of_batch import Models
from sierra.errors import NotFound, UsageError
from sierra.execution import targets
from sierra.execution.batches_of_queries import BatchesOfQueries
from sierra.ingest.base import with_files
from sierra.model import Axis, Value
from sierra.stats import aggregate as stats
from sierra.store import clock_times, equal_runs
from sierra.store.batch_data import AllFailed, BatchData, OutputTable, RecordedColumn
from sierra.store.clock_times import TimeKind
from sierra.store.derived_tables import Definition
from sierra.store.sql_names import identifier, quote, stored_name
from sierra.store.store import Store
from sierra.store.time_axis import names_time
from sierra.util.hashing import sha256, short
from sierra.util.lazy_definitions import replace
from sierra.util.text import counted, like

if TYPE_CHECKING:
    import pyarrow as pa

ONE_FILE = "file in [outputs.{}] can name one of them"


def _tables(figures: Mapping[str, Figure], name: str | None) -> Container[str] | None:
    """Return the tables that figures are drawn from: all figures, or the one called `name`; None if it may be any table."""
    wanted = [figure for called, figure in figures.items() if name in (None, called)]
    known = wanted and all(figure.table or figure.sql for figure in wanted)
    return {figure.table for figure in wanted} if known else None


class Gallery:
    """The data that the figures of one batch share."""

    def __init__(
        self,
        project: LoadedProject,
        store: Store,
        frame: BatchData,
        target: str | None = None,
        *,
        name: str | None = None,
        only: Container[str] | None = None,
    ) -> None:
        """`target`: the project is the one for this target; by default, it is that of the batch's last request.

        `name`: the only figure that is wanted. `only`: the outputs and derived tables that are needed; default: all.
        """
        self.queries = BatchesOfQueries(project, store)
        own = target is not None
        target = target or (targets.recorded(store, frame.batch) if project.targets else None)
        self.target_notes = [f"target {target}"] if target else []
        """The target that the batch was requested for; its declarations are used."""
        self.declared_notes = () if own else targets.notes(project, store, frame.batch)
        """A note if the declarations are those of another target."""
        project = project if own else targets.of_batch(project, store, frame.batch)
        self.config, self._root = project.config, project.root
        self.models = Models(project, store, frame)
        """The models that figures show with the data."""
        self._store = store
        self.frame = frame
        self.outputs = {output.name: output for output in frame.outputs(only or _tables(self.config.figures, name))}
        self._shown: dict[str, Mapping[Value, Value]] = {}
        self.axes = tuple(map(self._labelled, frame.axes()))
        """The variables, with their labels and units."""
        self.cells = {ordinal: self._with_labels(values) for ordinal, values in frame.cells().items()}
        """The values of the axes for each experiment, with the labels of controllers and scenarios."""
        self.planned = {ordinal: runs for ordinal, (_, runs) in frame.counts().items()}
        self._seen: dict[str, stats.Coverage] = {}
        self._times: dict[str, str] = {}
        self.row_notes: dict[str, list[str]] = {}
        """Notes by output on how the rows of a run become its values; captions have them too."""
        self.time_notes: dict[str, str] = {}
        """Notes by output, if its time column is neither declared nor known by its name: what is used instead."""

    def is_of_others(self, figure: Figure) -> bool:
        """Check if a figure without a query is about a variable or an output that only other batches have."""
        variables = (figure.x, figure.series, figure.facet)
        return not figure.query and bound.is_of_others(variables, figure.table, self.config, self._store, self.frame)

    def _from_sql(self, statement: str) -> str:
        """Return the name of the derived table that the own statement of a figure makes."""
        table = f"sql {short(sha256(statement.encode()))}"
        if table not in self.frame.names:
            self.frame.derive(Definition(table, statement, "sql"))
        if table not in self.outputs:  # another gallery may have made the table in this frame
            self.outputs |= {output.name: output for output in self.frame.outputs({table})}
        return table

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the reader on the target, the declarations and the times that are used."""
        return (
            *self.target_notes,
            *self.declared_notes,
            *dict.fromkeys(chain.from_iterable(self.row_notes.values())),
            *self.time_notes.values(),
        )

    def only_column(self, output: OutputTable) -> str:
        """Return the only numeric column of an output that is not its time. Raises UsageError if there are several."""
        columns = [column for column in output.columns if column != self.time(output)]
        if len(columns) != 1:
            raise UsageError(f"name the column; output {output.name!r} has {', '.join(columns) or 'no numeric column'}")
        return columns[0]

    def unit(self, output: OutputTable, column: str) -> str:
        """Return the unit of a column; "" if there is none."""
        return self.units(output).get(column, "")

    def units(self, output: OutputTable) -> dict[str, str]:
        """Return the units of columns: those that are declared, and that of durations."""
        declared = self.config.declared(output.name)
        units = {stored_name(name, output.all_columns): unit for name, unit in (declared.units if declared else {}).items()}
        time = self.time(output)
        read = {time: clock_times.UNIT} if self._time_kind(output, time) else {}
        return {**read, **units, **dict.fromkeys(self.frame.durations(output.name), "ns")}

    def declared_output(self, name: str) -> Output:
        """Return the declaration of an output, with the content of files that it names. Raises NotFound, ConfigError."""
        declared = self.config.outputs.get(name)
        if declared is None:
            raise NotFound(f"sierra.toml has no [outputs.{name}]; {like(name, list(self.config.outputs), 'it has')}")
        return with_files({name: declared}, self._root)[name]

    def ticks_per_second(self, output: str) -> Mapping[int, float]:
        """Return the ticks per second of each experiment, by its position; nothing if the time of the output is no ticks."""
        declared = self.config.declared(output)
        if not isinstance(declared, Output) or declared.ticks_per_second is None:
            return {}
        return seconds.rates(declared.ticks_per_second, self.config, self._store, self.frame)

    def column(self, figure: Figure, offset: int = 0, measure: str = "final") -> stats.ColumnStatistics:
        """Return the samples of the one column that a figure names, in the rows of its `where`, minus a whole number.

        `measure` is what runs are reduced to, for notes.
        """
        output = self.output(figure)
        (column,) = figure.columns
        source = OutputRows(self.frame, output, self.time(output), figure.where)
        source.check(figure.columns, numeric=True)
        seen = self.coverage(output, several=bool(figure.where))
        if figure.where:
            seen = self._in_order(output, source.coverage(column))
            self.check_times(output, seen)
        self.note_rows(output, seen, measure)
        return stats.ColumnStatistics(source.samples(column, offset), seen, column in self.rates(output))

    def rates(self, output: OutputTable) -> tuple[str, ...]:
        """Return the columns whose values 0 and 1 are a rate: those of flags, and those that are declared."""
        declared = self.config.declared(output.name)
        rates = declared.rates if isinstance(declared, Output) else ()
        rates = tuple(stored_name(column, output.all_columns) for column in rates)
        if unknown := [column for column in rates if column not in output.all_columns]:
            where = f"[outputs.{output.name}] rates"
            raise NotFound(f"{where}: no column {unknown[0]!r}; {like(unknown[0], output.all_columns)}")
        return (*output.flags, *rates)

    def key_of_rates(self, output: str, column: str) -> str:
        """Return what to declare so that the values 0 and 1 of a column are a rate."""
        if output in self.frame.written:
            return f'set rates = ["{column}"] in [outputs.{output}]'
        return f"let the SQL of [tables.{output}] return {column} as true and false"

    def about_rates(self, samples: stats.ColumnStatistics, table: pa.Table, measure: str | None) -> list[str]:
        """Return a note on the interval of the mean in computed statistics, if the values are 0 and 1, or should be."""
        if not isinstance(samples.column, RecordedColumn) or not (methods := stats.methods_of_mean(table)):
            return []
        column, output = samples.column.column, samples.column.table
        if stats.is_rate(table):
            return [f"all values of {column} are 0 or 1: low and high are Wilson's 95 % interval of a rate"]
        if measure == "time_to" or "t" not in methods:
            return []
        if samples.rate:
            return [f"not all values of {column} are 0 or 1: low and high are Student's t interval, not that of a rate"]
        if not stats.may_be_rate(samples.column, measure, table):
            return []
        return [
            f"all values of {column} are 0 or 1, but it may be a count: low and high are Student's t interval"
            f" (for the interval of a rate, {self.key_of_rates(output, column)})"
        ]

    def about_digits(self, output: str, columns: Iterable[str]) -> list[str]:
        """Return a note for each of these columns whose numbers have more digits than floats hold."""
        return [
            f"{column} has numbers of more than 15 digits: statistics are those of the nearest numbers of the type DOUBLE"
            for column in columns
            if self.frame.offset(output, column)
        ]

    def _rates_in(self, drawing: Drawing, source: OutputRows, seen: stats.Coverage, rates: Container[str]) -> Iterator[str]:
        """Yield notes on the intervals of means in a figure whose values are 0 and 1, but no declared rate."""
        for column, table in drawing.tables.items():
            timed = "t" in table.column_names
            if column not in rates:
                samples = stats.ColumnStatistics(source.samples(column), seen)
                yield from self.about_rates(samples, table, None if timed else drawing.figure.measure)

    def drawing(self, name: str, figure: Figure, *, model: str = "") -> Drawing:
        """Return the computed content of a figure, with the models that join it, or with one model."""
        output = self.output(figure)
        reduces = "measure" in kind_of(figure).uses and "measure" not in figure.model_fields_set
        by_mean = reduces and self.takes_mean(output)
        if by_mean:
            figure = figure.model_copy(update={"measure": "mean"})
        time = self.time(output)
        columns = figure.columns or tuple(column for column in output.columns if column != time)[:1]
        batch = Batch(self.axes, self.cells, self.planned, self.frame.batch)
        seen = self.coverage(output, several=True)
        source, order = OutputRows(self.frame, output, time, figure.where, by_mean), self._chosen_groups(figure)
        if order:
            if figure.where:
                self.frame.experiments_with(output.name, figure.where)  # complains of `where` as it is written
            source = replace(source, experiments=self._experiments_of(order))
        if source.condition:
            asked = self.frame.experiments_with(output.name, source.condition)
            failed = asked.difference(seen.runs)
            chosen = self._in_order(output, source.coverage(columns[0]))
            seen = replace(chosen, selected=seen.selected or bool(figure.where))
            planned = {ordinal: runs for ordinal, runs in self.planned.items() if ordinal in asked.union(seen.runs)}
            batch = replace(batch.of_experiments(failed.union(seen.runs)), planned=planned)
            batch = batch.in_order({name: [self._label(name, value) for value in order[name]] for name in order})
        self.note_rows(output, seen, figure.measure)
        rates = self.rates(output)
        drawing = gather(name, figure, columns, batch, source, seen, rates, self.config.statistics)
        of_values = (*self._rates_in(drawing, source, seen, rates), *self.about_digits(output.name, drawing.tables))
        drawing = self.models.alone(model, drawing, source) if model else self.models.added(name, drawing, source)
        units = self.units(output)
        tables, models, note = drawing.tables, drawing.models, drawing.note
        per_second = (
            self.ticks_per_second(output.name) if tables and all("t" in table.column_names for table in tables.values()) else {}
        )
        if per_second:
            tables = {column: seconds.in_seconds(table, per_second) for column, table in tables.items()}
            models = tuple(
                replace(predicted, table=seconds.in_seconds(predicted.table, per_second)) for predicted in drawing.models
            )
            note = "; ".join(text for text in (note, seconds.note(time, per_second)) if text)
            units[time] = "s"
        note = "; ".join(filter(None, (*self.target_notes, *self.row_notes.get(output.name, ()), note, *of_values)))
        sql = "\n\n".join(filter(None, (self.frame.statements(output.name), drawing.sql)))
        return replace(drawing, tables=tables, models=models, note=note, sql=sql, time=time or "row", units=units)

    def _chosen_groups(self, figure: Figure) -> dict[str, tuple[Value, ...]]:
        """Return the controllers and scenarios that a figure shows, in its order, by the name of the variable.

        Raises NotFound for one that this batch does not have.
        """
        raw = {axis.name: axis.values for axis in self.frame.axes()}
        groups: dict[str, tuple[Value, ...]] = {}
        for name, words in (("controller", figure.controllers), ("scenario", figure.scenarios)):
            if words:
                known = raw.get(name) or self._only(name)
                chosen = _chosen_values(name, words, {value: self._label(name, value) for value in known})
                groups |= {name: chosen} if name in raw else {}
        return groups

    def _only(self, name: str) -> tuple[Value, ...]:
        """Return the one controller or scenario of all runs of the batch; none if it has none."""
        [(value,)] = self.frame.run(f"SELECT {identifier(name)} FROM batches WHERE batch = {quote(self.frame.batch)}")  # noqa: S608
        return (value,) if value else ()

    def _experiments_of(self, groups: Mapping[str, Sequence[Value]]) -> tuple[int, ...]:
        """Return the positions of the experiments with these values of variables."""
        cells = self.frame.cells().items()
        ordinals = tuple(ordinal for ordinal, cell in cells if all(cell[name] in values for name, values in groups.items()))
        if not ordinals:
            raise NotFound(f"no experiment of this batch has {' and '.join(f'one of the chosen {name}s' for name in groups)}")
        return ordinals

    def time(self, output: OutputTable) -> str:
        """Return the name of the time column; "" if there is none.

        It is the declared column; else the first, if its name is that of a time; else one that increases alike in all runs.
        """
        if output.name not in self._times:
            self._times[output.name] = self._time(output)
        return self._times[output.name]

    def _time(self, output: OutputTable) -> str:
        declared = self.config.declared(output.name)
        named = stored_name(declared.time, output.all_columns) if declared and declared.time else ""
        first = output.all_columns[0] if output.all_columns else ""
        if named or (names_time(first) and (first in output.columns or self._time_kind(output, first) is TimeKind.CLOCK)):
            if self._time_kind(output, named or first):
                self.time_notes[output.name] = clock_times.NOTE.format(time=named or first, table=output.name)
            return named or first
        axis = self.frame.shared_axis(output.name, output.columns) if output.rows > 1 else None
        if axis is None:
            return ""
        self.time_notes[output.name] = (
            f"{axis!r} is used as the time of output {output.name!r}, because it increases equally in all runs"
            f' (to name another, set time = "COLUMN" in [outputs.{output.name}])'
        )
        return axis

    def note_rows(self, output: OutputTable, seen: stats.Coverage, measure: str = "final") -> None:
        """Note that row numbers are the time of an output with several rows in a run. SQL orders those of derived tables."""
        if seen.most > 1 and measure != "mean" and output.name in self.frame.written and not self.time(output):
            self.time_notes.setdefault(
                output.name,
                f"output {output.name!r} has no time column: row numbers are used instead, because no column increases equally"
                f" in all runs, and final is the last of a run's {seen.most} rows (if a column is the time, set time ="
                f' "COLUMN" in [outputs.{output.name}]; if rows do not follow each other in time, choose one by where, or'
                " use the measure mean)",
            )

    def _time_kind(self, output: OutputTable, column: str) -> TimeKind | None:
        """Return the form of the times in a column, if they are no numbers; None for numbers, and for other values."""
        if column not in output.others:
            return None
        try:
            return self.frame.time_kind(output.name, column)
        except NotFound:
            return None

    def coverage(self, output: OutputTable, *, several: bool = False) -> stats.Coverage:
        """Return the amount of data. Raises UsageError for several rows at the same time of a run, unless `several`."""
        if output.name not in self._seen:
            if not output.columns:
                raise NotFound("it has no numeric column")
            time = self.time(output)
            column = next((c for c in output.columns if c != time), output.columns[0])
            robots = self.frame.robots_note(output.name, time)
            read = partial(stats.coverage, RecordedColumn(self.frame, output.name, column, time), several=True)
            seen = self.frame.once(("coverage", output.name, column, time), read)
            equal = equal_runs.note(self.frame, *volatile_and_rates(self.config.outputs))
            self.row_notes[output.name] = [note for note in (robots, self._order_note(output, seen), equal) if note]
            seen = self._in_order(output, seen)
            doubled = sum(seen.runs.values()) if self._series(output)[0] > 1 else seen.doubled
            selected = output.name not in self.frame.written
            accepted = self.frame.accepted_beside(output.name)
            self._seen[output.name] = replace(seen, selected=selected, doubled=doubled, accepted=accepted)
        if not several:
            number, column = self._series(output)
            if number > 1:
                raise UsageError(
                    f"a run has rows of {number} {column}s, each at times of its own: "
                    f"choose one {column} by `where`, or make one row for each time by a derived table"
                )
            self.check_times(output, self._seen[output.name])
        return self._seen[output.name]

    def check_times(self, output: OutputTable, seen: stats.Coverage) -> None:
        """Raise UsageError for several rows at the same time of a run, with a proposal, and for a time that goes back."""
        try:
            stats.check_times(seen)
        except UsageError as error:
            if output.files > 1:
                hint = f". A run has {output.files} files of this output: {ONE_FILE.format(output.name)}"
            else:
                time = self.time(output)
                passes = not seen.doubled and self._time_kind(output, time) in clock_times.WITHOUT_DAYS
                hint = suggest_tables.of_single_rows(self.frame, output, time) if seen.doubled else clock_times.DAYS * passes
            if not hint:
                raise
            raise UsageError(f"{error}{hint}") from error

    def _any_order(self, output: OutputTable) -> bool:
        """Return whether the time of an output may go back within a run."""
        declared = self.config.declared(output.name)
        return isinstance(declared, Output) and declared.time_order == "any"

    def _in_order(self, output: OutputTable, seen: stats.Coverage) -> stats.Coverage:
        """Return the coverage of an output without the runs whose time may go back."""
        return replace(seen, backward=0) if self._any_order(output) else seen

    def _order_note(self, output: OutputTable, seen: stats.Coverage) -> str:
        """Return a note on the runs whose time goes back, if it may; else ""."""
        if not (seen.backward and self._any_order(output)):
            return ""
        return (
            f"the time of output {output.name!r} goes back in {counted(seen.backward, 'run')}: rows are taken in the order of "
            "their times, and final is the row of the greatest time"
        )

    def _series(self, output: OutputTable) -> tuple[int, str]:
        """Return the largest number of series of rows in a run, such as topics of a bag, and the column with their names."""
        declared = self.config.declared(output.name)
        if not isinstance(declared, Output) or not declared.series:
            return 1, ""
        source = OutputRows(self.frame, output, self.time(output))
        rows = source.rows(f"SELECT count(DISTINCT {declared.series}) AS series FROM data GROUP BY run").to_pylist()  # noqa: S608
        return max((int(row["series"]) for row in rows), default=1), declared.series

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

    def output(self, figure: Figure, key: str = "table") -> OutputTable:
        """Return the output that a figure names, or the only one with its columns. Raises NotFound, which names the `key`."""
        if why := self.frame.failure():
            raise AllFailed(why)
        if name := self._from_sql(figure.sql) if figure.sql else figure.table:
            if name in self.frame.problems:
                raise self.frame.problems[name]
            if name not in self.outputs:
                raise NotFound(f"this batch has no output {name!r}; its outputs: {', '.join(self.frame.names) or 'none'}")
            return self.outputs[name]
        every = [o for o in self.outputs.values() if all(column in o.columns for column in figure.columns)]
        having = [o for o in every if not self.frame.is_of_accepted(o.name)]
        having = [o for o in having if o.name in self.frame.written] or having
        if self.outputs and not having:
            others = "".join(f"; {o.name} has the rows of accepted ends, and must be named" for o in every)
            raise NotFound(
                f"no output has {' and '.join(map(repr, figure.columns))} as numeric columns (sierra sql 'SHOW TABLES'){others}"
            )
        if len(having) != 1:
            names = [name for name in self.outputs if not self.frame.is_of_accepted(name)]
            raise NotFound(f"name the output: set {key} to one of {', '.join(names) or '(none was written)'}")
        return having[0]

    def _labelled(self, axis: Axis) -> Axis:
        variable = self.config.variables.get(axis.name)
        if variable:
            axis = replace(axis, label=variable.label or axis.label, unit=variable.unit)
        labels = self.config.labels(axis)
        self._shown[axis.name] = labels
        return replace(axis, values=tuple(labels.get(value, value) for value in axis.values))

    def _label(self, axis: str, value: Value) -> Value:
        return self._shown.get(axis, {}).get(value, value)

    def _with_labels(self, values: Mapping[str, Value]) -> Mapping[str, Value]:
        return {name: self._label(name, value) for name, value in values.items()}


def _chosen_values(variable: str, words: Sequence[str], labels: Mapping[Value, Value]) -> tuple[Value, ...]:
    """Return the controllers or scenarios that words stand for, in the order of the words, each once.

    A word is a name, a label, or a category: `depth0` stands for all names that begin with `depth0.`. `labels` has the label of
    each value. Raises NotFound for a word that stands for no value.
    """
    if not labels:
        raise NotFound(f"{variable}s: this batch has no {variable}s")
    chosen: dict[Value, None] = {}
    for word in words:
        if not (named := _named(word, labels)):
            known = list(dict.fromkeys(str(text) for pair in labels.items() for text in pair))
            raise NotFound(f"{variable}s: this batch has no {variable} {word!r}; {like(word, known)}")
        chosen |= dict.fromkeys(named)
    return tuple(chosen)


def _named(word: str, labels: Mapping[Value, Value]) -> list[Value]:
    if word in labels:
        return [word]
    of_label = [value for value, label in labels.items() if label == word]
    return of_label or [value for value in labels if str(value).startswith(f"{word}.")]
