"""Figures over two independent variables: a map of colours, with its numbers if they fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sierra.deliverables.figures import bands, style

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

LEGIBLE = 8
"""The largest number of columns whose cells have room for numbers."""


def heatmap(drawing: Drawing) -> Figure:
    """Draw the center of a measure for each pair of values; pairs without a value are hatched."""
    (table,) = drawing.tables.values()
    across, up = drawing.axes
    cells = np.full((len(up.values), len(across.values)), np.nan)
    center = style.drawable(style.column(table, bands.columns(drawing.figure)[0]), drawing)
    for ordinal, value in zip(table.column("experiment").to_pylist(), center, strict=True):
        at = drawing.cells[ordinal]
        cells[up.values.index(at[up.name]), across.values.index(at[across.name])] = value
    figure = style.blank(style.COLUMN, min(4.5, max(2.0, 0.8 + 0.32 * len(up.values))))
    plot = figure.add_subplot()
    _paint(figure, plot, cells, drawing)
    style.side_by_side(plot, across)
    shown = style.thinned(len(up.values), 20)
    names = style.names(up.values, 18)
    plot.set_yticks(shown, [names[k] for k in shown])
    plot.set_xlim(-0.5, len(across.values) - 0.5)
    plot.set_ylim(-0.5, len(up.values) - 0.5)
    plot.tick_params(length=0)
    plot.spines[:].set_visible(False)
    plot.grid(visible=False)
    # The y axis is the second variable here, so that `ylabel` names the values, as in every other figure.
    style.outer_labels([plot], drawing.figure.xlabel or style.axis_label(across), style.axis_label(up))
    return figure


def _paint(figure: Figure, plot: Axes, cells: style.Floats, drawing: Drawing) -> None:
    norm_limits = _limits(cells)
    norm = (LogNorm if drawing.figure.log_y else Normalize)(*norm_limits)
    edges = (np.arange(size + 1) - 0.5 for size in reversed(cells.shape))
    edge = {"edgecolors": "white", "linewidth": 0.5} if max(cells.shape) <= 12 else {"linewidth": 0, "rasterized": True}
    mesh = plot.pcolormesh(*edges, np.ma.masked_invalid(cells), norm=norm, cmap=colormaps["viridis"], **edge)
    bar = figure.colorbar(mesh, ax=plot, pad=0.02, aspect=24, fraction=0.06, use_gridspec=False)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=6, length=2)
    if drawing.figure.log_y:
        style.log_ticks(bar.ax.yaxis, *norm_limits)
    bar.set_label(style.shortened(style.value_label(drawing), 40))
    fits = cells.shape[1] <= LEGIBLE and cells.shape[0] <= 16
    for (row, place), value in np.ndenumerate(cells):
        if np.isnan(value):
            plot.add_patch(
                Rectangle((place - 0.5, row - 0.5), 1, 1, facecolor="#F2F2F2", edgecolor="#BBBBBB", hatch="////", linewidth=0)
            )
        elif fits:
            colour = "black" if float(norm(value)) > 0.6 else "white"
            plot.text(place, row, style.number(value, 3), ha="center", va="center", fontsize=6, color=colour)


def _limits(cells: style.Floats) -> tuple[float, float]:
    low, high = float(np.nanmin(cells)), float(np.nanmax(cells))
    return (low, high) if low < high else (low - abs(low) * 0.1 - 1e-12, high + abs(high) * 0.1 + 1e-12)
