"""Models in figures: dashed lines in the colours of their series, dashed marks beside bars and boxes, and panels of maps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.typing import ColorType, LineStyleType

from sierra.deliverables.figures import style, thinning
from sierra.deliverables.figures.style import Floats, Look
from sierra.util.arrow_columns import numpy_of

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing
    from sierra.deliverables.models.predicted import Predicted

DASHES: tuple[LineStyleType, ...] = ((0, (3.5, 1.8)), (0, (1, 1.4)), (0, (5, 1.5, 1, 1.5)), (0, (7, 1.5)))
"""The line styles of models, in their order; the data's lines are solid beside them."""
WIDTH = 1.1
BLACK = "#000000"


def beside(drawing: Drawing, looks: Sequence[Look]) -> list[Look]:
    """Return the looks of the data's lines: solid if there are models, which are dashed."""
    return [look | Look(linestyle="-") for look in looks] if drawing.models else list(looks)


def entries(drawing: Drawing, handles: Sequence[Artist]) -> list[tuple[Artist, str]]:
    """Return the entries of models in a legend; `handles` are those of the data."""
    added: list[tuple[Artist, str]] = [
        (Line2D([], [], color=BLACK, linestyle=dash, linewidth=WIDTH), style.shortened(model.label, 40))
        for model, dash in zip(drawing.models, cycle(DASHES), strict=False)
    ]
    return [(handles[0], "data"), *added] if added and len(handles) == 1 else added


def over_time(plot: Axes, drawing: Drawing, ordinal: int, colour: ColorType) -> None:
    """Draw the models of one experiment over time."""
    for model, dash in zip(drawing.models, cycle(DASHES), strict=False):
        rows = _rows(model, [ordinal])
        t, values = style.column(model.table, "t")[rows], style.drawable(_values(model)[rows], drawing)
        some = thinning.kept(t, values, log=drawing.figure.log_x)
        (line,) = plot.plot(t[some], values[some], color=colour, linestyle=dash, linewidth=WIDTH, zorder=3)
        if len(t) == 1:
            line.set(marker="_", markersize=8)


def over_numbers(
    plot: Axes, drawing: Drawing, ordinals: Sequence[int], places: Callable[[list[int]], Floats], colour: ColorType
) -> list[Artist]:
    """Draw the models of one series over the numbers of a variable; `places` returns those of experiments."""
    artists: list[Artist] = []
    for model, dash in zip(drawing.models, cycle(DASHES), strict=False):
        rows = _rows(model, ordinals)
        x = places(_experiments(model)[rows].tolist())
        order = np.argsort(x)
        values = style.drawable(_values(model)[rows], drawing)
        marks = Look(marker="_") if len(x) == 1 else Look()
        artists += plot.plot(x[order], values[order], color=colour, linestyle=dash, linewidth=WIDTH, zorder=3, **marks)
    return artists


def at(plot: Axes, drawing: Drawing, ordinal: int, x: float, width: float, colour: ColorType = BLACK) -> None:
    """Draw the models of one experiment as dashed marks of a width around a place."""
    for model, dash in zip(drawing.models, cycle(DASHES), strict=False):
        for value in style.drawable(_values(model)[_rows(model, [ordinal])], drawing):
            ends = [x - width / 2, x + width / 2]
            plot.plot(ends, [value, value], color=colour, linestyle=dash, linewidth=WIDTH, zorder=4)


def values(drawing: Drawing) -> Floats:
    """Return the values of all models."""
    return np.concatenate([np.empty(0), *map(_values, drawing.models)])


def by_experiment(model: Predicted) -> dict[int, float]:
    """Return the value of a model for each experiment."""
    return dict(zip(_experiments(model).tolist(), _values(model).tolist(), strict=True))


def notes(drawing: Drawing) -> list[str]:
    """Return notes on values of models that a logarithmic scale cannot show."""
    if not drawing.figure.log_y:
        return []
    counts = {model.label: int((_values(model) <= 0).sum()) for model in drawing.models}
    return [f"log scale: {count} values of {name} not above 0 left out" for name, count in counts.items() if count]


def _values(model: Predicted) -> Floats:
    return style.column(model.table, "value")


def _experiments(model: Predicted) -> npt.NDArray[np.int_]:
    ordinals: npt.NDArray[np.int_] = numpy_of(model.table.column("experiment"))
    return ordinals


def _rows(model: Predicted, ordinals: Sequence[int]) -> npt.NDArray[np.int_]:
    """Return the places of the rows of some experiments."""
    return np.flatnonzero(np.isin(_experiments(model), ordinals))
