"""Figures in space: paths, densities of presence, and matrices; a panel for each experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from sierra.deliverables.figures import facets, style
from sierra.deliverables.figures.style import Look
from sierra.errors import SierraError, UsageError
from sierra.model import Axis
from sierra.util.arrow_columns import numpy_of
from sierra.util.text import counted

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing

FAR = 3
"""The multiple of the 98 % quantile of all cells, above which a cell does not take the whole scale of colours."""
PATHS = 8
"""The largest number of robots that are told apart by colour and have an entry in the legend."""


def trajectories(drawing: Drawing) -> Figure:
    """Draw the path of each robot."""
    table = drawing.rows["paths"]
    names = list(dict.fromkeys(table.column("robot").to_pylist()))
    known = style.named_colours()
    parts = _by_experiment(table)
    figure, plots = facets.experiments(drawing, parts)
    for ordinal, plot in plots.items():
        rows = parts[ordinal]
        robots = np.array(rows.column("robot").to_pylist())
        x, y = style.column(rows, "x"), style.column(rows, "y")
        for robot in dict.fromkeys(robots.tolist()):
            index, mine = names.index(robot), robots == robot
            colour, dashes = known[index % len(known)], style.DASHES[index % len(style.DASHES)]
            plot.plot(x[mine], y[mine], color=colour, linestyle=dashes, linewidth=0.7, alpha=0.85)
            seen = np.flatnonzero(mine & np.isfinite(x) & np.isfinite(y))
            for at, mark in zip(seen[[0, -1]] if len(seen) else (), "os", strict=False):
                plot.plot(x[at], y[at], mark, color=colour, markersize=3, markerfacecolor="white", markeredgewidth=0.8)
        plot.set_aspect("equal")
    _label(drawing, list(plots.values()))
    if 1 < len(names) <= min(PATHS, len(known)):
        looks: list[Look] = [{"color": known[k], "linestyle": style.DASHES[k]} for k in range(len(names))]
        style.place_legend(figure, style.lines(looks), list(map(style.named, names)))
    return figure


def density(drawing: Drawing) -> Figure:
    """Draw the part of the rows in each cell, with the same colours for all experiments."""
    table = drawing.rows["cells"]
    first = table.slice(0, 1).to_pylist()[0]
    cell = first["cell"]
    wide, high = (max(1, int(np.ceil((first[f"{k}1"] - first[f"{k}0"]) / cell))) for k in "xy")
    maps = {}
    for ordinal, rows in _by_experiment(table).items():
        counts = np.zeros((high, wide))
        counts[numpy_of(rows.column("j")), numpy_of(rows.column("i"))] = numpy_of(rows.column("count"))
        maps[ordinal] = np.where(counts > 0, counts / counts.sum() * 100, np.nan)
    edges = first["x0"] + np.arange(wide + 1.0) * cell, first["y0"] + np.arange(high + 1.0) * cell
    figure, _ = _maps(drawing, maps, edges, "rows in a cell [%]", aspect=1.0, most=_most(drawing))
    return figure


def _most(drawing: Drawing) -> float | None:
    """Return the part in percent at which the colours end, if a few cells have far more rows than all others; else None."""
    table = drawing.rows["cells"]
    counts, ordinals = style.column(table, "count"), numpy_of(table.column("experiment"))
    parts = counts / np.bincount(ordinals, counts)[ordinals] * 100
    usual = float(np.quantile(parts, 0.98))
    return usual if not drawing.figure.log_y and parts.max() > FAR * usual else None


def matrix(drawing: Drawing, aspect: float, *, upwards: bool) -> Figure:
    """Draw the cells of a matrix, with row 0 above, or `upwards` with the second column of the figure as y."""
    drawing = _over_times(drawing)
    table = drawing.rows["cells"]
    rows, places = (np.unique(style.column(table, name)) for name in ("i", "j"))
    maps = {}
    for ordinal, part in _by_experiment(table).items():
        values = np.full((len(rows), len(places)), np.nan)
        at = np.searchsorted(rows, style.column(part, "i")), np.searchsorted(places, style.column(part, "j"))
        values[at] = style.drawable(style.column(part, "value"), drawing)
        maps[ordinal] = values
    edges = np.arange(len(places) + 1) - 0.5, np.arange(len(rows) + 1) - 0.5
    column = drawing.figure.columns[2]
    named = style.label(column, drawing.units.get(column, ""))
    figure, plots = _maps(drawing, maps, edges, drawing.figure.ylabel or named, aspect=aspect, turned=not upwards)
    for plot in plots:
        plot.set_ylim(*((-0.5, len(rows) - 0.5) if upwards else (len(rows) - 0.5, -0.5)))
        _ticks(plot, places, rows)
    return figure


def notes_on_paths(drawing: Drawing, run: int) -> list[str]:
    """Return notes on points that are not drawn."""
    table = drawing.rows["paths"]
    every = int(table.column("every")[0].as_py())
    bad = int((~(np.isfinite(style.column(table, "x")) & np.isfinite(style.column(table, "y")))).sum())
    if bad == table.num_rows:
        raise SierraError("there is no value to draw")
    lost = len(drawing.cells) - len(np.unique(numpy_of(table.column("experiment"))))
    return [
        *([f"each {every}th point and the last"] if every > 1 else []),
        *([f"{bad} of {table.num_rows} points without a place left out"] if bad else []),
        *([f"{lost} of {counted(len(drawing.cells), 'experiment')} without run {run}"] if lost else []),
    ]


def notes_on_cells(drawing: Drawing) -> list[str]:
    """Return notes on rows that are not in a cell."""
    (counts,) = drawing.rows["counts"].to_pylist()
    inside = int(numpy_of(drawing.rows["cells"].column("count")).sum())
    most = _most(drawing)
    return [
        f"{drawing.rows['cells'].column('cell')[0].as_py():.3g} wide cells",
        *([] if most is None else [f"colours end at {style.number(most, 3)} %, above which are at most 2 % of the cells"]),
        *(["log scale: cells without a row are white"] if drawing.figure.log_y else []),
        *([f"{counts['rows'] - counts['finite']} rows without a place left out"] if counts["finite"] < counts["rows"] else []),
        *([f"{counts['finite'] - inside} rows beyond the limits left out"] if inside < counts["finite"] else []),
    ]


def notes_on_matrix(drawing: Drawing, times: Sequence[float]) -> list[str]:
    """Return notes on values that are not in the matrix."""
    table = drawing.rows["cells"]
    (counts,) = drawing.rows["counts"].to_pylist()
    values = style.column(table, "value")
    low = int((values <= 0).sum()) if drawing.figure.log_y else 0
    bad = counts["rows"] - counts["finite"]
    absent = len(set(times)) - len(table.column("t").unique()) if len(times) > 1 else 0
    return [
        *([f"{absent} of {counted(len(set(times)), 'time')} without a row"] if absent else []),
        *([f"{bad} missing or infinite values left out"] if bad else []),
        *([f"log scale: {low} of {len(values)} cells not above 0 left out"] if low else []),
    ]


def _maps(
    drawing: Drawing,
    maps: dict[int, style.Floats],
    edges: Sequence[npt.ArrayLike],
    label: str,
    aspect: float,
    most: float | None = None,
    turned: bool = False,
) -> tuple[Figure, list[Axes]]:
    figure, panels = facets.experiments(drawing, maps)
    plots = list(panels.values())
    every = np.concatenate([cells.ravel() for cells in maps.values()])
    every = every[np.isfinite(every)]
    if not len(every):
        raise UsageError("log_y needs values above 0, but there are none")
    low, high = float(every.min()), float(every.max()) if most is None else most
    if not low < high:
        low, high = low - abs(low) * 0.1 - 1e-12, high + abs(high) * 0.1 + 1e-12
    norm = (LogNorm if drawing.figure.log_y else Normalize)(low, high)
    for ordinal, plot in panels.items():
        shown = np.ma.masked_invalid(maps[ordinal])
        mesh = plot.pcolormesh(*edges, shown, norm=norm, cmap=colormaps["viridis"], linewidth=0, rasterized=True)
        plot.set_aspect(aspect)
        plot.grid(visible=False)
    style.value_bar(figure, plots, mesh, label, "neither" if most is None else "max")
    _label(drawing, plots, turned=turned)
    return figure, plots


def _over_times(drawing: Drawing) -> Drawing:
    """Return a drawing of matrices at several times as one with the time as a variable, for the columns of panels."""
    table = drawing.rows["cells"]
    if "t" not in table.column_names:
        return drawing
    times, time_indices = np.unique(style.column(table, "t"), return_inverse=True)
    unit, label = drawing.units.get(drawing.time, ""), drawing.time.replace("_", " ")
    axis = Axis(f"# {drawing.time}", tuple(times.tolist()), label=label, unit=unit)
    ordinals = numpy_of(table.column("experiment")) * len(times) + time_indices
    cells = {
        ordinal * len(times) + k: {**cell, axis.name: time}
        for ordinal, cell in drawing.cells.items()
        for k, time in enumerate(axis.values)
    }
    return replace(
        drawing,
        figure=drawing.figure if drawing.figure.facet else drawing.figure.model_copy(update={"facet": axis.name}),
        axes=(*drawing.axes, axis),
        cells=cells,
        rows={"cells": table.set_column(table.column_names.index("experiment"), "experiment", [ordinals])},
    )


def _ticks(plot: Axes, places: style.Floats, rows: style.Floats) -> None:
    for set_ticks, values, most in ((plot.set_xticks, places, 8), (plot.set_yticks, rows, 8)):
        shown = style.thinned(len(values), most)
        set_ticks(shown, [style.number(float(values[k])) for k in shown])


def _label(drawing: Drawing, plots: list[Axes], *, turned: bool = False) -> None:
    """Name the axes by the first two columns: x and y, or if `turned`, y and x."""
    first, second, *_ = drawing.figure.columns
    names = [style.label(name, drawing.units.get(name, "")) for name in (first, second)]
    across, up = reversed(names) if turned else names
    of_values = drawing.figure.kind == "matrix"  # whose `ylabel` is that of its colours
    style.outer_labels(plots, drawing.figure.xlabel or across, up if of_values else drawing.figure.ylabel or up)


def _by_experiment(table: pa.Table) -> dict[int, pa.Table]:
    ordinals = numpy_of(table.column("experiment"))
    return {int(ordinal): table.filter(ordinals == ordinal) for ordinal in np.unique(ordinals)}
