"""Figures over time: a line with its band for each experiment, and stacked areas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import FillBetweenPolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.typing import ColorType

from sierra.deliverables.figures import axis_limits, bands, facets, models, style, thinning
from sierra.deliverables.figures.style import Floats, Look
from sierra.errors import UsageError
from sierra.model import Axis, Value
from sierra.util.arrow_columns import numpy_of

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing


def timeseries(drawing: Drawing) -> Figure:
    """Draw a line and its band for each value of the first axis, and a panel for each combination of the others."""
    (table,) = drawing.tables.values()
    first, rest = first_axis(drawing), others(drawing)
    slices = by_experiment(table)
    figure, plots = facets.multiples(drawing, drawing.axes[1:], rest)
    looks = models.beside(drawing, style.looks(first))
    for line in looks:
        if drawing.models and not first.numeric:
            line |= {"markevery": 0.12, "markersize": 2.5}  # solid lines of names also need marks, to differ in grey
        else:
            line.pop("marker", None)
    look = dict(zip(first.values, looks, strict=True))
    highest = [0] * len(first.values)
    for ordinal, rows in slices.items():
        value = value_of(drawing, ordinal)
        plot = plots[rest.index(rest_of(drawing, ordinal))]
        _line(plot, drawing, table.slice(rows.start, rows.stop - rows.start), look[value])
        models.over_time(plot, drawing, ordinal, look[value]["color"] if len(looks) > 1 else models.BLACK)
        index = first.values.index(value)
        highest[index] = max(highest[index], int(np.max(numpy_of(table.column("n"))[rows])))
    center = style.column(table, bands.columns(drawing.figure)[0])
    for plot in plots:
        style.scale_y(plot, drawing, *style.span(center))
        axis_limits.apply(plot, drawing)
        style.scale_time(plot, drawing, float(style.column(table, "t")[0]))
    style.outer_labels(plots, style.time_label(drawing), style.value_label(drawing))
    entries = with_n(style.names(first.values), highest)
    handles = style.lines(looks)
    style.legend(figure, plots, first, entries, handles, models.entries(drawing, handles))
    return figure


def stacked(drawing: Drawing) -> Figure:
    """Draw the columns on top of each other: over time in a panel for each experiment, or over the first axis."""
    center = bands.columns(drawing.figure)[0]
    if any(np.nanmin(style.column(table, center)) < 0 for table in drawing.tables.values()):
        raise UsageError("stacked areas need values of at least 0; draw lines instead")
    units = {name: drawing.units.get(name, "") for name in drawing.tables}
    if len(set(units.values())) > 1:
        columns = ", ".join(f"{name} [{unit}]" if unit else f"{name} (no unit)" for name, unit in units.items())
        raise UsageError(f"only columns with the same unit can be stacked, not {columns}; see units in [outputs]")
    if "t" in next(iter(drawing.tables.values())).column_names:
        return _stacked_over_time(drawing, center)
    return _stacked_over_axis(drawing, center)


def by_experiment(table: pa.Table) -> dict[int, slice]:
    """Return the slice of each experiment's rows in a table that is sorted by experiment."""
    ordinals, starts = np.unique(numpy_of(table.column("experiment")), return_index=True)
    stops = [*starts[1:], table.num_rows]
    return {int(o): slice(int(a), int(b)) for o, a, b in zip(ordinals, starts, stops, strict=True)}


def first_axis(drawing: Drawing) -> Axis:
    """Return the first independent variable; for a batch without any, an axis without a name."""
    return drawing.axes[0] if drawing.axes else Axis("", ("",))


def value_of(drawing: Drawing, ordinal: int) -> Value:
    """Return the value of the first axis in an experiment."""
    return drawing.cells[ordinal][drawing.axes[0].name] if drawing.axes else ""


def rest_of(drawing: Drawing, ordinal: int) -> tuple[Value, ...]:
    """Return the values of the other axes in an experiment."""
    return tuple(drawing.cells[ordinal][axis.name] for axis in drawing.axes[1:])


def others(drawing: Drawing) -> list[tuple[Value, ...]]:
    """Return all combinations of the other axes' values, in their order."""
    return facets.combinations(drawing, drawing.axes[1:])


def with_n(entries: list[str], counts: list[int]) -> list[str]:
    """Return the entries of a legend, with n if it is not the same for all."""
    if len(set(counts)) <= 1:
        return entries
    return [f"{entry} (n = {count})" for entry, count in zip(entries, counts, strict=True)]


def _line(plot: Axes, drawing: Drawing, table: pa.Table, look: Look) -> None:
    colour = look["color"]
    names = ("t", *bands.columns(drawing.figure))
    t, *lines = (style.column(table, name) for name in names)
    lines[0] = style.drawable(lines[0], drawing)
    shown = thinning.kept(t, *lines, log=drawing.figure.log_x)
    t, (center, low, high) = t[shown], (line[shown] for line in lines)
    known = np.isfinite(center)
    padded = np.concatenate(([False], known, [False]))
    alone = known & ~padded[:-2] & ~padded[2:]
    plot.plot(t, center, **look)
    if alone.any():
        plot.plot(t[alone], center[alone], "o", color=colour, markersize=3.5 if len(t) == 1 else 1.2)
    some = np.isfinite(low) & np.isfinite(high)
    if len(t) == 1 and some.any():
        style.interval(plot, t[some], low[some], high[some], color=colour, linewidth=1.2)
    elif some.any():
        band = FillBetweenPolyCollection("x", t, low, high, where=some.tolist(), facecolor=colour, alpha=0.2, linewidth=0)
        plot.add_collection(band)
        plot.autoscale_view()


def _stacked_over_time(drawing: Drawing, center: str) -> Figure:
    slices = {name: by_experiment(table) for name, table in drawing.tables.items()}
    ordinals = sorted(set.intersection(*(set(by_ordinal) for by_ordinal in slices.values())))
    figure, plots = facets.experiments(drawing, ordinals)
    for ordinal, plot in plots.items():
        rows = [
            table.slice(s.start, s.stop - s.start) for table, s in ((drawing.tables[n], slices[n][ordinal]) for n in slices)
        ]
        t, lines = style.column(rows[0], "t"), [style.column(row, center) for row in rows]
        shown = thinning.kept(t, *lines, log=drawing.figure.log_x)
        _areas(plot, drawing, t[shown], [line[shown] for line in lines])
    return _labelled(figure, list(plots.values()), drawing, style.time_label(drawing))


def _stacked_over_axis(drawing: Drawing, center: str) -> Figure:
    first, rest = first_axis(drawing), others(drawing)
    figure, plots = facets.multiples(drawing, drawing.axes[1:], rest)
    ordinals = next(iter(drawing.tables.values())).column("experiment").to_pylist()
    for plot, combination in zip(plots, rest, strict=True):
        rows = [k for k, ordinal in enumerate(ordinals) if rest_of(drawing, ordinal) == combination]
        values = [value_of(drawing, ordinals[k]) for k in rows]
        places = [float(v) if first.numeric else first.values.index(v) for v in values]
        heights = [style.column(table, center)[rows] for table in drawing.tables.values()]
        if first.numeric:
            _areas(plot, drawing, places, heights)
        else:
            _bars(plot, places, heights)
        style.scale_values(plot, first, log=drawing.figure.log_x, margin=0)
    return _labelled(figure, plots, drawing, drawing.figure.xlabel or style.axis_label(first))


def _areas(plot: Axes, drawing: Drawing, places: npt.ArrayLike, heights: list[Floats]) -> None:
    known = [np.nan_to_num(height) for height in heights]
    hatches = [style.HATCHES[k % len(style.HATCHES)] for k in range(len(heights))]
    plot.stackplot(places, known, colors=_stack_colours(len(heights)), hatch=hatches, linewidth=0.4, edgecolor="white")
    plot.margins(x=0)


def _bars(plot: Axes, places: Sequence[float], heights: list[Floats]) -> None:
    base = np.zeros(len(places))
    for height, look in zip(heights, _stack_looks(len(heights)), strict=True):
        plot.bar(places, np.nan_to_num(height), 0.7, base, **look)
        base = base + np.nan_to_num(height)


def _stack_looks(count: int) -> list[dict[str, Any]]:
    """Return the look of each column, as matplotlib's keyword arguments of a surface."""
    return [
        {"facecolor": colour, "edgecolor": "white", "hatch": style.HATCHES[k % len(style.HATCHES)], "linewidth": 0.4}
        for k, colour in enumerate(_stack_colours(count))
    ]


def _stack_colours(count: int) -> list[ColorType]:
    return style.colours(Axis("column", tuple(f"{k:03}" for k in range(count))))


def _labelled(figure: Figure, plots: Sequence[Axes], drawing: Drawing, xlabel: str) -> Figure:
    """Return the figure of stacked columns with its labels and its legend."""
    plots[0].set_ylim(bottom=0)
    total = style.label("sum", drawing.units.get(next(iter(drawing.tables)), ""))
    style.outer_labels(plots, xlabel, drawing.figure.ylabel or total)
    names = style.names([name.replace("_", " ") for name in drawing.tables])
    style.place_legend(figure, [Patch(**look) for look in _stack_looks(len(names))], names)
    return figure
