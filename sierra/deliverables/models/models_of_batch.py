"""The models of one batch: which figures each joins, and its values there.

A model joins the figures of its column whose kind draws models: a model over time those over time, and summaries of the last
value; another one the figures of its measure. `figures` of a model names some of them.

Also: the values of a model in a figure: at the times of the figure's data, at the model's own, or one for each experiment.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from sierra.config.model_table import Model
from sierra.config.project_file import LoadedProject
from sierra.deliverables.figures import bands
from sierra.deliverables.figures.base import MODELS, kind_of
from sierra.deliverables.figures.drawing import LARGEST
from sierra.deliverables.models import predictions
from sierra.deliverables.models.predicted import Predicted
from sierra.deliverables.models.predictions import Listed, NotVaried, NoValue, Prediction
from sierra.design.factorial_design import GROUPED
from sierra.errors import DamagedFile, Missing, SierraError, UsageError
from sierra.store.batch_data import BatchData
from sierra.store.store import Store
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import few, like

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing
    from sierra.deliverables.figures.gather import OutputRows


def predicted(name: str, label: str, prediction: Prediction, drawing: Drawing, ends: Mapping[int, float | None]) -> Predicted:
    """Return the values of a model in a figure, with its deviation from the figure's data.

    `ends` has the time at which the runs of each experiment end, if a model over time is shown by its last value. Raises
    UsageError if there is no value.
    """
    from sierra.deliverables.models import deviation

    (table,) = drawing.tables.values()
    timed = over_time(drawing)
    rows = _Rows()
    for ordinal in sorted(drawing.cells):
        known = _times(table, ordinal) if timed else ()
        rows.add(ordinal, prediction, prediction.times(ordinal, known) if timed else [ends.get(ordinal)], known)
    if not rows.values:
        reasons = few([*rows.lacking], 3) or "the data have no times"
        raise UsageError(f"it has no value for any experiment of the batch: {reasons}")
    rows_of_model = rows.table(over_time=timed)
    center, interval = _compared(drawing)
    return Predicted(
        name=name,
        label=label,
        table=rows_of_model,
        text=prediction.text,
        facts=prediction.facts,
        deviation=deviation.deviation(deviation.points(rows_of_model, table, center, interval)),
        lacking=rows.lacking,
        points=rows.points,
    )


def over_time(drawing: Drawing) -> bool:
    """Return whether a figure shows values over time."""
    return any("t" in table.column_names for table in drawing.tables.values())


@dataclass(slots=True)
class _Rows:
    """The values of a model, as they are collected, and the reasons for those that it lacks."""

    experiments: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    lacking: Counter[str] = field(default_factory=Counter)
    points: int = 0

    def add(self, ordinal: int, prediction: Prediction, times: Sequence[float | None], known: Sequence[float]) -> None:
        """Add the values of an experiment; `known` has the times of the data."""
        self.points += len(known) or 1
        if not times and known:
            self.lacking["no row"] += len(known)
        for time in times:
            try:
                if time is None and prediction.over_time:
                    raise NoValue("runs end at different times, or have no time")
                value = prediction.value(ordinal, time)
                if abs(value) > LARGEST:
                    raise NoValue(f"above {LARGEST:g}, which is too large to be drawn")
            except NoValue as error:
                self.lacking[str(error)] += 1
                continue
            self.experiments.append(ordinal)
            self.times.append(time or 0.0)
            self.values.append(value)

    def table(self, *, over_time: bool) -> pa.Table:
        import pyarrow as pa

        columns = {"experiment": pa.array(self.experiments, pa.int32())}
        if over_time:
            columns["t"] = pa.array(self.times, pa.float64())
        return pa.table({**columns, "value": pa.array(self.values, pa.float64())})


def _times(table: pa.Table, ordinal: int) -> list[float]:
    """Return the times of an experiment's data."""
    times: list[float] = numpy_of(table.column("t"))[numpy_of(table.column("experiment")) == ordinal].tolist()
    return times


def _compared(drawing: Drawing) -> tuple[str, tuple[str, str] | None]:
    """Return the columns of the center that a model is compared with, and of its 95 % interval if the figure has one."""
    (table,) = drawing.tables.values()
    center, *ends = bands.columns(drawing.figure)
    if center not in table.column_names:
        return "median", None
    confident = "band" in kind_of(drawing.figure).uses and bands.band_of(drawing.figure) == "ci"
    return center, (ends[0], ends[1]) if confident and set(ends) <= {*table.column_names} else None


ENDS = """
SELECT experiment, min(last) AS low, max(last) AS high
FROM (SELECT experiment, run, max(t) AS last FROM samples WHERE isfinite(t) GROUP BY ALL) GROUP BY experiment
"""
"""The times at which the runs of each experiment end: the first and the last of them."""


class Models:
    """The models of a project for one batch."""

    def __init__(self, project: LoadedProject, store: Store, frame: BatchData) -> None:
        self._project, self._store, self._frame = project, store, frame
        self._made: dict[tuple[str, str], Prediction | SierraError] = {}
        self._joined: set[str] = set()
        self._notes: dict[str, None] = {}
        self.failed: dict[str, str] = {}
        """The models that a figure should show but cannot, and why."""

    def added(self, name: str, drawing: Drawing, data: OutputRows) -> Drawing:
        """Return the drawing of a figure with the models that join it, before its times become seconds."""
        shown, problems = self._of_figure(name, drawing, data)
        if not shown and not problems:
            return drawing
        self.failed |= problems
        self._notes |= dict.fromkeys(filter(None, (model.problem for model in shown)))
        lost = [f"without model {called}, which failed" for called in problems]
        texts = [f"-- model {model.name}\n{model.text}" for model in shown]
        return replace(
            drawing,
            models=tuple(shown),
            failed_models=problems,
            note="; ".join(filter(None, (drawing.note, *(model.note for model in shown), *lost))),
            sql="\n\n".join(filter(None, (drawing.sql, *texts))),
        )

    def _of_figure(self, name: str, drawing: Drawing, data: OutputRows) -> tuple[list[Predicted], dict[str, str]]:
        """Return the models that join a figure, and why others cannot."""
        shown: list[Predicted] = []
        problems: dict[str, str] = {}
        for called, model in self.declared.items():
            try:
                if not self._joins(called, model, name, drawing, data):
                    continue
                shown.append(self._predicted(called, model, drawing, data))
            except (DamagedFile, Missing):
                raise
            except SierraError as error:
                self._notes[f"model {called} is left out: {error}"] = None
                if not isinstance(error, NotVaried):
                    problems[called] = str(error)
            self._joined.add(called)
        return shown, problems

    @property
    def declared(self) -> Mapping[str, Model]:
        """Return the declared models by name."""
        return self._project.config.models

    def alone(self, name: str, drawing: Drawing, data: OutputRows) -> Drawing:
        """Return a drawing of its column with one model. Raises SierraError."""
        return replace(drawing, models=(self._predicted(name, self.declared[name], drawing, data),))

    def notes(self, figures: Collection[str] = ()) -> list[str]:
        """Return notes for messages. `figures` has the names of all figures, if all were drawn: then also on unused models."""
        unknown = [
            f"model {name}: there is no figure {figure!r}; {like(figure, [*figures])}"
            for name, model in self.declared.items()
            for figure in model.figures
            if figures and figure not in figures
        ]
        unused = [name for name in self.declared if figures and name not in self._joined and not self.declared[name].figures]
        return [*self._notes, *unknown, *(f"model {name} is in no figure: {self._reason(name)}" for name in unused)]

    def prediction(self, name: str, time: str) -> Prediction:
        """Return what a model predicts for the batch. `time` is the name of the time column. Raises SierraError."""
        if (name, time) not in self._made:
            try:
                self._made[name, time] = self._make(name, self.declared[name], time)
            except SierraError as error:
                self._made[name, time] = error
        prediction = self._made[name, time]
        if isinstance(prediction, SierraError):
            raise prediction
        return prediction

    def _make(self, name: str, model: Model, time: str) -> Prediction:
        from sierra.deliverables.models import command

        cells, variables = self._frame.cells(), {*self._project.config.variables, *GROUPED}
        if model.expression:
            return predictions.formula(model.expression, cells, time, variables)
        if model.command:
            table, facts = command.predict(model, self._project, self._store, self._frame, f"[models.{name}] command")
            text = f"-- command: {' '.join(map(repr, model.command))}"
        else:
            definition = self._project.definition(f"model {name}", model, f"[models.{name}]")
            rows = self._frame.table_of(definition)
            if not rows.num_rows:
                raise UsageError(f"{definition.origin}: its statement returns no rows")
            table = {column: rows.column(column).to_pylist() for column in rows.column_names}
            text = self._frame.statements(definition.name)
            facts = {"sql": definition.sql}
        listed, over_time, notes = predictions.listed(table, model.column, cells, time, variables)
        self._notes |= dict.fromkeys(f"model {name}: {note}" for note in notes)
        return Listed(listed, over_time, text, facts)

    def _joins(self, name: str, model: Model, figure_name: str, drawing: Drawing, data: OutputRows) -> bool:
        """Return whether a model joins a figure. Raises UsageError if it names the figure, but cannot be drawn in it."""
        named = figure_name in model.figures
        if model.figures and not named:
            return False
        obstacle = self._obstacle(name, model, drawing, data, named=named)
        if obstacle and named:
            raise UsageError(f"figure {figure_name} cannot show it: {obstacle}")
        return not obstacle

    def _obstacle(self, name: str, model: Model, drawing: Drawing, data: OutputRows, *, named: bool) -> str:
        """Return why a figure cannot show a model; "" if it can. Its values are computed only if nothing else is in the way."""
        figure = drawing.figure
        if figure.columns != (model.column,):
            return f"it shows {' and '.join(figure.columns)}, not {model.column}"
        if MODELS not in kind_of(figure).uses:
            return f"kind {figure.kind!r} shows no models"
        if not (named and figure.sql) and self._table(model) != data.name:
            return f"it shows table {data.name!r}"
        if self.prediction(name, data.time).over_time:
            is_final = figure.measure == "final" and model.measure is None
            return "" if over_time(drawing) or is_final else "it predicts values over time"
        measure = model.measure or ("mean" if data.by_mean else "final")
        fits = not over_time(drawing) and (figure.measure, figure.threshold) == (measure, model.threshold)
        return "" if fits else f"it predicts one number for each experiment, the measure {measure!r}"

    def _table(self, model: Model) -> str:
        """Return the name of the output that a model predicts. Raises UsageError if it may be one of several."""
        if model.table:
            return model.table
        having = self._frame.outputs_with(model.column)
        if len(having) > 1:
            raise UsageError(f"set its table to one of {', '.join(having)}, which all have column {model.column!r}")
        return having[0] if having else ""

    def _reason(self, name: str) -> str:
        """Return why no figure shows a model, as far as its table and column are the reason."""
        model = self.declared[name]
        if why := self._frame.failure():
            return why
        if model.table and model.table not in self._frame.names:
            return f"the batch has no output {model.table!r}; {like(model.table, self._frame.names)}"
        if not model.table and not self._frame.outputs_with(model.column):
            return f"no output has column {model.column!r}; a derived table must be named (table)"
        return f"none shows {model.column!r} as it predicts it; see its measure"

    def _predicted(self, name: str, model: Model, drawing: Drawing, data: OutputRows) -> Predicted:
        prediction = self.prediction(name, data.time)
        ends = self._ends(model, data) if prediction.over_time and not over_time(drawing) else {}
        return predicted(name, model.label or name.replace("_", " "), prediction, drawing, ends)

    def _ends(self, model: Model, data: OutputRows) -> Mapping[int, float | None]:
        """Return the time at which the runs of each experiment end; None if they end at different times."""
        rows = data.samples(model.column).sql(ENDS).to_pylist()
        return {row["experiment"]: row["low"] if row["low"] == row["high"] else None for row in rows}
