"""The deviations of models from the data of a batch as a table, with a row for each model and experiment."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import TYPE_CHECKING

from sierra.config.deliverable_tables import Figure
from sierra.config.project_file import LoadedProject
from sierra.deliverables.figures.drawing import Drawing
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.models import deviation
from sierra.deliverables.models.predicted import Predicted
from sierra.deliverables.models.predictions import NotVaried
from sierra.errors import DamagedFile, Missing, NotFound, SierraError
from sierra.store.batch_data import BatchData
from sierra.store.sql_names import column_names
from sierra.store.store import NOTE, Store
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import like

if TYPE_CHECKING:
    import pyarrow as pa

COLUMNS = ("model", "experiment", "n", "compared", "data", "predicted", "bias", "rmse", "largest", "at", "inside", "intervals")
WHOLE = ("experiment", "n", "compared", "inside", "intervals")


@dataclass(frozen=True, slots=True)
class ModelErrors:
    """The deviations of models from the data."""

    table: pa.Table
    """A row for each model and experiment: see `sierra.api.deliverables.Deliverables.model_errors`. The metadata have notes."""
    failed: Mapping[str, str]
    """The models without a prediction for the batch, and why in one line."""


def errors(project: LoadedProject, store: Store, batch: str, name: str | None = None) -> ModelErrors:
    """Return the deviations of all models, or of the one called `name`. Raises NotFound, or SierraError if that one fails."""
    with BatchData(store, batch) as frame:
        gallery = Gallery(project, store, frame, only=_tables(project, frame))
        models = gallery.models.declared
        if name not in (None, *models):
            raise NotFound(f"sierra.toml declares no [models.{name}]; {like(name or '', list(models), 'its models are')}")
        if not models:
            raise NotFound("sierra.toml declares no [models.NAME]")
        rows: list[dict[str, object]] = []
        failed, notes = {}, list[str]()
        for called in models if name is None else [name]:
            try:
                drawing = _drawing(gallery, called)
            except (DamagedFile, Missing):
                raise
            except SierraError as error:
                if name is not None:
                    raise
                if isinstance(error, NotVaried):
                    notes.append(f"model {called} is left out: {error}")
                else:
                    failed[called] = str(error)
                continue
            rows += _rows(drawing)
            notes += _notes(drawing)
        notes += gallery.models.notes()
        return ModelErrors(_table(rows, frame, "; ".join(dict.fromkeys(filter(None, notes)))), failed)


def _tables(project: LoadedProject, frame: BatchData) -> set[str]:
    """Return the outputs and derived tables that models predict."""
    models = project.config.models.values()
    return {table for model in models for table in ([model.table] if model.table else frame.outputs_with(model.column))}


def _drawing(gallery: Gallery, name: str) -> Drawing:
    """Return the data and the values of one model, as a figure of its column would show them."""
    model = gallery.models.declared[name]
    output = gallery.output(Figure(table=model.table, column=(model.column,)))
    common = {"table": output.name, "column": model.column}
    if gallery.models.prediction(name, gallery.time(output)).over_time:
        figure = Figure.model_validate({"kind": "timeseries", **common})
    else:
        chosen = {"measure": model.measure, "threshold": model.threshold}
        given = {key: value for key, value in chosen.items() if value is not None}
        figure = Figure.model_validate({"kind": "summary", **common, **given})
    return gallery.drawing(name, figure, model=name)


def _rows(drawing: Drawing) -> list[dict[str, object]]:
    (model,), (data,) = drawing.models, drawing.tables.values()
    points = deviation.points(model.table, data, "mean", ("mean_low", "mean_high"))
    runs: dict[int, int] = {}
    for ordinal, n in zip(data.column("experiment").to_pylist(), data.column("n").to_pylist(), strict=True):
        runs[ordinal] = max(runs.get(ordinal, 0), n)
    return [_row(model, ordinal, runs.get(ordinal, 0), points.of(ordinal)) for ordinal in sorted(drawing.cells)]


def _row(model: Predicted, ordinal: int, n: int, points: deviation.Points) -> dict[str, object]:
    row: dict[str, object] = {"model": model.name, "experiment": ordinal, "n": n, "compared": 0}
    if (deviations := deviation.deviation(points)) is None:
        return row
    return row | {
        "compared": deviations.compared,
        "data": float(points.data.mean()),
        "predicted": float(points.predicted.mean()),
        "bias": deviations.bias,
        "rmse": deviations.rmse,
        "largest": deviations.largest,
        "at": deviations.at if isfinite(deviations.at) else None,
        "inside": deviations.inside,
        "intervals": deviations.intervals,
    }


def _notes(drawing: Drawing) -> list[str]:
    (model,) = drawing.models
    return [f"{model.name} over all experiments: {model.summary}", model.problem]


def _table(rows: list[dict[str, object]], frame: BatchData, note: str) -> pa.Table:
    import pyarrow as pa

    axes, cells = [axis.name for axis in frame.axes()], frame.cells()
    columns: dict[str, pa.Array] = {}
    for column, shown in zip(COLUMNS, column_names(COLUMNS, taken=axes), strict=True):
        kind = pa.string() if column == "model" else pa.int64() if column in WHOLE else pa.float64()
        columns[shown] = pa.array([row.get(column) for row in rows], kind)
        if column == "experiment":
            columns |= {name: pa.array([cells[int(str(row["experiment"]))][name] for row in rows]) for name in axes}
    return pa.table(columns).replace_schema_metadata({NOTE: note})
