"""The values of a model in a figure: at the times of the figure's data, at the model's own, or one for each experiment."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from sierra.deliverables.figures import bands
from sierra.deliverables.figures.base import kind_of
from sierra.deliverables.figures.drawing import LARGEST
from sierra.deliverables.models.predicted import Predicted
from sierra.deliverables.models.predictions import NoValue, Prediction
from sierra.errors import UsageError
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import few

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing


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
