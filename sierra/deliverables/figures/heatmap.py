"""Figures over two independent variables: a map of colours, with its numbers if they fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sierra.deliverables.figures import bands, facets, models, style
from sierra.errors import UsageError
from sierra.model import Axis

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

BAR = 0.6
"""The width of the colour bar with its ticks and its label, about, in inches."""
LEGIBLE = 8
"""The largest number of columns of cells with numbers in them."""


def heatmap(drawing: Drawing) -> Figure:
    """Draw the center of a measure for each pair of values, with a panel for each value of `facet`, or for each model.

    Pairs without a value are hatched.
    """
    with_models = drawing.models and not drawing.figure.facet
    figure, plots, maps, (across, up) = _of_models(drawing) if with_models else _of_facets(drawing)
    _paint(figure, plots, maps, drawing)
    for plot in plots:
        _frame(plot, across, up)
    # The y axis is the second variable here, so that `ylabel` names the values, as in every other figure.
    style.outer_labels(plots, drawing.figure.xlabel or style.axis_label(across), style.axis_label(up))
    return figure


def without_models(drawing: Drawing) -> list[str]:
    """Return a note on models that are not drawn."""
    return ["models are not drawn beside facets"] if drawing.models and drawing.figure.facet else []


def unnamed(drawing: Drawing) -> list[str]:
    """Return notes on the axes that lack the names of some values."""
    up = facets.panels(drawing).panels[0].drawing.axes[1]
    return [*facets.unnamed(drawing, beside=BAR), *style.left_out("y", len(up.values), _height(up) - 0.8)]


def _of_facets(drawing: Drawing) -> tuple[Figure, list[Axes], list[style.Floats], tuple[Axis, ...]]:
    within = facets.panels(drawing)
    axes = within.panels[0].drawing.axes
    if len(within.panels) == 1:
        within.figure.set_figheight(_height(axes[1]))
    return within.figure, within.plots, [_cells(panel.drawing, _data(panel.drawing)) for panel in within.panels], axes


def _of_models(drawing: Drawing) -> tuple[Figure, list[Axes], list[style.Floats], tuple[Axis, ...]]:
    named = [("data", _data(drawing)), *((model.label, models.by_experiment(model)) for model in drawing.models)]
    figure, plots = style.maps(len(named), _height(drawing.axes[1]))
    for plot, (name, _) in zip(plots, named, strict=True):
        style.title(plot, name)
    return figure, plots, [_cells(drawing, values) for _, values in named], drawing.axes


def _height(up: Axis) -> float:
    return style.chosen().height or min(4.5, max(2.0, 0.8 + 0.32 * len(up.values)))


def _data(drawing: Drawing) -> Mapping[int, float]:
    """Return the center of each experiment."""
    (table,) = drawing.tables.values()
    center = style.column(table, bands.columns(drawing.figure)[0])
    return dict(zip(table.column("experiment").to_pylist(), center.tolist(), strict=True))


def _cells(drawing: Drawing, values: Mapping[int, float]) -> style.Floats:
    """Return the values: a row for each value of the second variable, a column for each of the first; NaN: none."""
    across, up = drawing.axes
    cells = np.full((len(up.values), len(across.values)), np.nan)
    for ordinal, value in values.items():
        at = drawing.cells[ordinal]
        cells[up.values.index(at[up.name]), across.values.index(at[across.name])] = value
    return style.drawable(cells, drawing)


def _frame(plot: Axes, across: Axis, up: Axis) -> None:
    style.side_by_side(plot, across, BAR)
    shown, size = style.readable(len(up.values), _height(up) - 0.8)
    names = style.names(up.values, 18)
    plot.set_yticks(shown, [names[k] for k in shown], fontsize=size)
    plot.set_xlim(-0.5, len(across.values) - 0.5)
    plot.set_ylim(-0.5, len(up.values) - 0.5)
    plot.tick_params(length=0)
    plot.spines[:].set_visible(False)
    plot.grid(visible=False)


def _paint(figure: Figure, plots: Sequence[Axes], maps: Sequence[style.Floats], drawing: Drawing) -> None:
    """Draw the maps of all panels with the same colours, and the colour bar."""
    norm_limits = _limits(np.concatenate([cells.ravel() for cells in maps]))
    norm = (LogNorm if drawing.figure.log_y else Normalize)(*norm_limits)
    columns = {plot.get_subplotspec().colspan.start for plot in plots}  # type: ignore[union-attr]
    for plot, cells in zip(plots, maps, strict=True):
        edges = (np.arange(size + 1) - 0.5 for size in reversed(cells.shape))
        edge = {"edgecolors": "white", "linewidth": 0.5} if max(cells.shape) <= 12 else {"linewidth": 0, "rasterized": True}
        mesh = plot.pcolormesh(*edges, np.ma.masked_invalid(cells), norm=norm, cmap=colormaps["viridis"], **edge)
        _numbers(plot, cells, norm, fits=len(columns) * cells.shape[1] <= LEGIBLE * (1 if len(columns) < 2 else 2))
    style.value_bar(figure, plots, mesh, style.value_label(drawing))


def _numbers(plot: Axes, cells: style.Floats, norm: Normalize, *, fits: bool) -> None:
    """Write the numbers into the cells if there is room, and hatch those without a number."""
    fits = fits and cells.shape[0] <= 16
    for (row, column), value in np.ndenumerate(cells):
        if np.isnan(value):
            plot.add_patch(
                Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor="#F2F2F2", edgecolor="#BBBBBB", hatch="////", linewidth=0)
            )
        elif fits:
            colour = "black" if float(norm(value)) > 0.6 else "white"
            plot.text(column, row, style.number(value, 3), ha="center", va="center", fontsize=6, color=colour)


def _limits(cells: style.Floats) -> tuple[float, float]:
    low, high = style.span(cells)
    if np.isnan(low):
        raise UsageError("log_y needs values above 0, but there are none")
    return (low, high) if low < high else (low - abs(low) * 0.1 - 1e-12, high + abs(high) * 0.1 + 1e-12)
