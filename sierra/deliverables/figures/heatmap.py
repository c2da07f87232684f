"""Figures over two independent variables: a map of colours, with its numbers if they fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sierra.deliverables.figures import bands, models, style

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

LEGIBLE = 8
"""The largest number of columns whose cells have room for numbers."""


def heatmap(drawing: Drawing) -> Figure:
    """Draw the center of a measure for each pair of values, and a panel for each model; pairs without a value are hatched."""
    (table,) = drawing.tables.values()
    across, up = drawing.axes
    center = style.drawable(style.column(table, bands.columns(drawing.figure)[0]), drawing)
    data = dict(zip(table.column("experiment").to_pylist(), center.tolist(), strict=True))
    maps = [("data", data), *((one.label, models.by_experiment(one)) for one in drawing.models)]
    cells = [_cells(drawing, values) for _, values in maps]
    height = min(4.5, max(2.0, 0.8 + 0.32 * len(up.values)))
    figure, plots = style.maps(len(maps), height)
    _paint(figure, plots, cells, drawing)
    for plot, (name, _) in zip(plots, maps, strict=True):
        style.side_by_side(plot, across, most=20 // min(2, len(plots)))
        shown = style.thinned(len(up.values), 20)
        plot.set_yticks(shown, [style.named(up.values[k], 18) for k in shown])
        plot.set_xlim(-0.5, len(across.values) - 0.5)
        plot.set_ylim(-0.5, len(up.values) - 0.5)
        plot.tick_params(length=0)
        plot.spines[:].set_visible(False)
        plot.grid(visible=False)
        style.title(plot, name)
    # The y axis is the second variable here, so that `ylabel` names the values, as in every other figure.
    style.outer_labels(plots, drawing.figure.xlabel or style.axis_label(across), style.axis_label(up))
    return figure


def _cells(drawing: Drawing, values: Mapping[int, float]) -> style.Floats:
    """Return a value for each pair of values of the variables; NaN if there is none."""
    across, up = drawing.axes
    cells = np.full((len(up.values), len(across.values)), np.nan)
    for ordinal, value in values.items():
        at = drawing.cells[ordinal]
        cells[up.values.index(at[up.name]), across.values.index(at[across.name])] = value
    return style.drawable(cells, drawing)


def _paint(figure: Figure, plots: Sequence[Axes], maps: Sequence[style.Floats], drawing: Drawing) -> None:
    norm_limits = _limits(np.concatenate(maps))
    norm = (LogNorm if drawing.figure.log_y else Normalize)(*norm_limits)
    meshes = [_map(plot, cells, norm, columns=min(2, len(plots))) for plot, cells in zip(plots, maps, strict=True)]
    bar = figure.colorbar(meshes[0], ax=list(plots), pad=0.02, aspect=24, fraction=0.06, use_gridspec=False)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=6, length=2)
    if drawing.figure.log_y:
        style.log_ticks(bar.ax.yaxis, *norm_limits)
    bar.set_label(style.shortened(style.value_label(drawing), 40))


def _map(plot: Axes, cells: style.Floats, norm: Normalize, *, columns: int) -> QuadMesh:
    """Draw one map with its numbers, if they fit into one of several columns of panels."""
    edges = (np.arange(size + 1) - 0.5 for size in reversed(cells.shape))
    edge = {"edgecolors": "white", "linewidth": 0.5} if max(cells.shape) <= 12 else {"linewidth": 0, "rasterized": True}
    mesh = plot.pcolormesh(*edges, np.ma.masked_invalid(cells), norm=norm, cmap=colormaps["viridis"], **edge)
    fits = cells.shape[1] * columns <= LEGIBLE and cells.shape[0] <= 16
    for (row, place), value in np.ndenumerate(cells):
        if np.isnan(value):
            plot.add_patch(
                Rectangle((place - 0.5, row - 0.5), 1, 1, facecolor="#F2F2F2", edgecolor="#BBBBBB", hatch="////", linewidth=0)
            )
        elif fits:
            colour = "black" if float(norm(value)) > 0.6 else "white"
            plot.text(place, row, style.number(value, 3), ha="center", va="center", fontsize=6, color=colour)
    return mesh


def _limits(cells: style.Floats) -> tuple[float, float]:
    low, high = float(np.nanmin(cells)), float(np.nanmax(cells))
    return (low, high) if low < high else (low - abs(low) * 0.1 - 1e-12, high + abs(high) * 0.1 + 1e-12)
