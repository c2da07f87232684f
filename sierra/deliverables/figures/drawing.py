"""Figures for a two-column paper, drawn from aggregates: the same data give the same bytes.

A `Drawing` is the complete content of a figure; `draw` writes it in each of its formats (see
`sierra.deliverables.figures.formats`).

The first `draw` loads matplotlib. Figures use its object interface and ignore the user's settings of it.
"""

from __future__ import annotations

import gc
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sierra.config.deliverable_tables import DEFAULT_FORMATS, Figure, Format
from sierra.deliverables.figures.base import Explorable, kind_of, made_by
from sierra.deliverables.record import Deliverable, origin_of
from sierra.errors import Missing, SierraError, UsageError
from sierra.model import Axis, Value
from sierra.store.data_hash import data_hash
from sierra.util.arrow_columns import numpy_of
from sierra.util.fs import fitting, write_whole
from sierra.util.hashing import digest
from sierra.util.json_types import JsonView
from sierra.util.text import visible
from sierra.util.version import __version__

if TYPE_CHECKING:
    import matplotlib.figure
    import pyarrow as pa

    from sierra.deliverables.html import Chart
    from sierra.deliverables.models.predicted import Predicted

LARGEST = 1e300
"""The largest number that can be drawn: above it, the distances that axes need overflow."""


@dataclass(frozen=True)
class Drawing:
    """The complete content of one figure.

    `tables` and `runs` are pyarrow tables as `sierra.stats.aggregate.compute` makes them. `units` are those of columns and,
    under the name of the time column, of time.
    """

    name: str
    """The files' name, without extension."""
    figure: Figure
    axes: tuple[Axis, ...]
    cells: Mapping[int, Mapping[str, Value]]
    """By ordinal of the experiment: the value of each axis."""
    tables: Mapping[str, pa.Table]
    runs: pa.Table | None = None
    """The values of runs: `experiment`, `run`, `value` of the first column, `value_2` of the second, and so on."""
    rows: Mapping[str, pa.Table] = field(default_factory=dict)
    """The results of the statements of `Needs.rows`, by name."""
    note: str = ""
    """Notes for the reader, in small print: n, the kind of interval, missing values."""
    sql: str = ""
    batch: str = ""
    time: str = "time"
    units: Mapping[str, str] = field(default_factory=dict)
    formats: tuple[Format, ...] = DEFAULT_FORMATS
    together: Mapping[str, str] = field(default_factory=dict)
    """The batches that the figure shows together, by target or label; `batch` is the first."""
    together_by: Literal["target", "batch"] = "target"
    models: tuple[Predicted, ...] = ()
    """The models that the figure shows."""
    failed_models: Mapping[str, str] = field(default_factory=dict)
    """The models that the figure should show, and the reason why it cannot."""
    claims: str = ""
    """The claims that the figure shows, for its caption."""
    charts: tuple[Chart, ...] = ()
    """The same data as charts that readers can explore; empty for kinds that have none."""

    @property
    def title(self) -> str:
        """Return the title of the figure; the name of its files, if it has none."""
        return visible(self.figure.title or self.name)

    @property
    def words(self) -> str:
        """Return all text that may be in the figure."""
        shown = (self.figure.model_dump(exclude_unset=True), self.axes, self.units, self.time, self.note)
        columns = [column for table in self.rows.values() for column in table.columns if str(column.type) == "string"]
        return "".join(map(str, (*shown, [model.label for model in self.models], *(column.unique() for column in columns))))

    @cached_property
    def data(self) -> str:
        """Return the hash of all values that the figure shows, and of the ids of their runs."""
        return self._data(self.runs)

    @property
    def shown(self) -> str:
        """Return the hash of all values that the figure shows; the ids of runs depend on code that may not matter."""
        if self.runs is None:
            return self.data
        return self._data(self.runs.select([name for name in self.runs.column_names if name != "run"]))

    def _data(self, of_runs: pa.Table | None) -> str:
        runs = {} if of_runs is None else {"": of_runs}
        kinds = {"tables": self.tables, "runs": runs, "rows": self.rows}
        hashes = {kind: {name: data_hash(table) for name, table in named.items()} for kind, named in kinds.items()}
        if self.models or self.failed_models:
            hashes["models"] = {model.name: data_hash(model.table) for model in self.models} | dict.fromkeys(
                self.failed_models, ""
            )
        cells = {str(ordinal): [[name, repr(value)] for name, value in at.items()] for ordinal, at in self.cells.items()}
        return digest("figure data", {**hashes, "cells": cells})

    def content(self) -> Deliverable:
        """Return everything that the figure's files depend on."""
        definition: dict[str, JsonView] = {
            "figure": self.figure.model_dump(mode="json", exclude_unset=True, by_alias=True),
            "axes": [{"name": axis.name, "label": axis.label, "unit": axis.unit, "values": axis.values} for axis in self.axes],
            "units": self.units,
            "time": self.time,
            "note": self.note,
            "formats": self.formats,
        }
        if self.models or self.failed_models:
            definition["models"] = {model.name: model.definition for model in self.models} | {
                name: {"problem": problem} for name, problem in self.failed_models.items()
            }
        if self.together:
            definition["targets" if self.together_by == "target" else "batches"] = list(self.together)
        batches = tuple(self.together.values()) or (self.batch,)
        libraries = (f"sierra-experiments=={__version__}", *made_by(self.figure.kind))
        return Deliverable("figure", self.name, batches, definition, self.sql, self.data, libraries)


def draw(drawing: Drawing, folder: Path) -> tuple[Path, ...]:
    """Write `<name>.<format>` for each format into `folder`; each file appears complete or not at all. Return the paths.

    Raises SierraError if there is nothing to draw, UsageError if the data do not suit the kind of figure.
    """
    if drawing.name.startswith(".") or not drawing.name or Path(drawing.name).name != drawing.name:
        raise UsageError(f"{drawing.name!r} cannot be the name of a figure's files")
    check(drawing)
    return save(rendered(drawing), drawing, folder)


def save(files: Iterable[tuple[Format, bytes]], drawing: Drawing, folder: Path) -> tuple[Path, ...]:
    """Write files with the name of `drawing` into a folder, by format. Return the paths."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return tuple(write_whole(folder / f"{fitting(drawing.name)}.{ending}", data) for ending, data in files)
    except OSError as error:
        raise Missing(f"{folder}: cannot write figure {drawing.name}: {error.strerror}") from error


def check(drawing: Drawing) -> None:
    """Raise SierraError if there is nothing to draw, or a number is so large that no axis can be divided."""
    counted = [table for table in drawing.tables.values() if table.num_rows and numpy_of(table.column("n")).any()]
    if drawing.rows and not next(iter(drawing.rows.values())).num_rows:
        raise SierraError("there is no value to draw: no row is what the keys of the figure ask for")
    if not counted and not drawing.rows:
        raise SierraError("there is no value to draw")
    _check_size(drawing)


def _check_size(drawing: Drawing) -> None:
    import numpy as np

    tables = [*drawing.tables.values(), *([drawing.runs] if drawing.runs is not None else []), *drawing.rows.values()]
    columns = [numpy_of(column) for table in tables for column in table.columns]
    numbers = [np.abs(column[np.isfinite(column)]) for column in columns if column.dtype.kind == "f"]
    check_magnitude(max((float(column.max(initial=0.0)) for column in numbers), default=0.0))


def check_magnitude(largest: float) -> None:
    """Raise SierraError if the axes of this largest number, without its sign, would overflow."""
    if largest > LARGEST:
        raise SierraError(f"{largest:.3g} is too large to be drawn; let runs write it in a larger unit")


def rendered(drawing: Drawing) -> list[tuple[Format, bytes]]:
    """Return the content of the files, by format."""
    from sierra.deliverables.figures import style

    with style.applied(drawing.figure), _freed():
        return _rendered(drawing)


def _rendered(drawing: Drawing) -> list[tuple[Format, bytes]]:
    shown = noted(drawing)
    figure = painted(shown)
    return files_of(figure, charted(shown) if "html" in drawing.formats else shown, drawing.data)


def explorable(drawing: Drawing) -> tuple[Drawing, bytes]:
    """Return a drawing with its complete small print and its charts, and its SVG file. Raises the errors of `draw`."""
    from sierra.deliverables.figures import style

    check(drawing)
    with style.applied(drawing.figure), _freed():
        shown = noted(drawing)
        return charted(shown), svg(painted(shown), shown)


def explored(drawing: Drawing) -> tuple[Drawing, bytes]:
    """Return a drawing with its complete small print and its charts; and its SVG file, but only if its kind has no charts.

    Raises the errors of `draw`.
    """
    from sierra.deliverables.figures import style

    check(drawing)
    with style.applied(drawing.figure):
        shown = charted(noted(drawing))
        if shown.charts:
            return shown, b""
        with _freed():
            return shown, svg(painted(shown), shown)


def svg(figure: matplotlib.figure.Figure, drawing: Drawing) -> bytes:
    """Return the SVG file of a figure that is drawn already, with the metadata of `drawing`."""
    [(_, data)] = files_of(figure, replace(drawing, formats=("svg",)), drawing.data)
    return data


def charted(drawing: Drawing) -> Drawing:
    """Return the drawing with charts, if its kind has some. They do not show models."""
    kind = kind_of(drawing.figure)
    if not isinstance(kind, Explorable) or drawing.models or drawing.failed_models:
        return drawing
    return replace(drawing, charts=tuple(kind.charts(drawing)))


@contextmanager
def _freed() -> Iterator[None]:
    """Free what is made within. The parts of a figure refer to each other, so 16 figures would stay in memory, 5 MB each.

    Objects that exist before are not looked at, which would take longer.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.collect()
        gc.unfreeze()


def noted(drawing: Drawing) -> Drawing:
    """Return the drawing with what its kind adds to the small print."""
    from sierra.deliverables.figures import models, style

    letters = style.choose_fonts(drawing.words)
    notes = (*kind_of(drawing.figure).notes(drawing), *models.notes(drawing), *letters)
    return replace(drawing, note="; ".join(filter(None, (drawing.note, *notes))))


def painted(drawing: Drawing) -> matplotlib.figure.Figure:
    """Return the complete figure. To be called under `style.applied`."""
    from sierra.deliverables.figures import style

    figure = kind_of(drawing.figure).draw(drawing)
    style.settle(figure, drawing)
    return figure


def files_of(figure: matplotlib.figure.Figure, drawing: Drawing, data: str) -> list[tuple[Format, bytes]]:
    """Return the content of the files, by format; `data` is the hash of the drawing's data."""
    from sierra.deliverables.figures import formats

    origin = origin_of(drawing.batch, data, *(other for other in drawing.together.values() if other != drawing.batch))
    return [(ending, formats.FORMATS[ending](figure, drawing, origin)) for ending in drawing.formats]
