"""Figures over the independent variable: points with intervals, boxes, violins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cbook import violin_stats
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation
from matplotlib.typing import ColorType

from sierra.deliverables.figures import axis_limits, bands, facets, style
from sierra.deliverables.figures.facets import Panel, Panels
from sierra.deliverables.figures.style import Floats, Look
from sierra.deliverables.figures.timeseries import value_of, with_n
from sierra.model import Axis
from sierra.util.arrow_columns import numpy_of

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

GOLDEN = 0.6180339887498949
APART = 1.6
"""The distance in points between the intervals of two groups at the same number; smaller for many groups."""
WIDEST = 40
"""The width in points over which the intervals at one number are spread."""
CAP = 4
"""The largest extent in points of a mark, or of an interval's end, to each side."""
WIDTH = 0.7 * 72 * style.COLUMN
"""The approximate width of a plot in points."""
HATCHES = ("", "///", "\\\\\\", "...", "xxx", "---", "+++", "ooo")
"""The patterns of bars side by side, so that they differ in grey too."""
DENSE = 5
"""The smallest number of runs for which a density is drawn."""


def summary(drawing: Drawing) -> Figure:
    """Draw a measure over the first axis, with intervals, and a line for each combination of the others."""
    within = facets.panels(drawing)
    looks = [Look(marker="o") | look for look in style.looks(within.groups)]
    shifts = _shifts(within.first, len(within.groups.values))
    (table,) = drawing.tables.values()
    center = style.drawable(style.column(table, bands.columns(drawing.figure)[0]), drawing)
    aside = max(map(abs, shifts)) + CAP
    margin = max(0.04, aside / (WIDTH - 2 * aside))
    for panel in within.panels:
        _points(panel, within, looks, shifts)
        style.scale_values(panel.plot, within.first, log=drawing.figure.log_x, margin=margin)
    _frame(drawing, within, looks, float(np.nanmin(center)), float(np.nanmax(center)))
    return within.figure


def _points(panel: Panel, within: Panels, looks: Sequence[Look], shifts: Sequence[float]) -> None:
    """Draw the points and intervals of one panel, group by group."""
    drawing, first = panel.drawing, within.first
    (table,) = drawing.tables.values()
    names = bands.columns(drawing.figure)
    center = style.drawable(style.column(table, names[0]), drawing)
    low, high = (style.column(table, name) for name in names[1:])
    ordinals = table.column("experiment").to_pylist()
    groups = np.array([within.group(drawing, ordinal) for ordinal in ordinals], dtype=int)
    for place, look in enumerate(looks):
        rows = np.flatnonzero(groups == place)
        x = _places(drawing, first, [ordinals[k] for k in rows], place, len(looks))
        censored = style.column(table, "never")[rows] > 0
        artists = _interval(panel.plot, x, center[rows], low[rows], high[rows], look, joined=first.numeric)
        hollow = look | Look(linestyle="none")
        artists += panel.plot.plot(x[censored], center[rows][censored], **hollow, markerfacecolor="white", zorder=3)
        artists += _never(panel.plot, x[censored & (style.column(table, "n")[rows] == 0)], look["color"])
        if first.numeric:
            _shift(artists, shifts[place])


def box(drawing: Drawing) -> Figure:
    """Draw median, quartiles and whiskers for each experiment, and the runs beyond the whiskers."""
    return _side_by_side(drawing, _box)


def violin(drawing: Drawing) -> Figure:
    """Draw the density of the runs for each experiment, with a dot for each run, the median and the quartiles."""
    return _side_by_side(drawing, _violin)


def strip(drawing: Drawing) -> Figure:
    """Draw a dot for each run, and a line at the median, for each experiment."""
    return _side_by_side(drawing, _strip)


def bar(drawing: Drawing) -> Figure:
    """Draw a bar up to the center with its interval for each experiment, side by side for the groups."""
    within = facets.panels(drawing)
    (table,) = drawing.tables.values()
    center = style.drawable(style.column(table, bands.columns(drawing.figure)[0]), drawing)
    looks: list[Look] = [{"color": colour, "linewidth": 4} for colour in _colours(within)]
    for panel in within.panels:
        _bars(panel, within, looks)
        style.side_by_side(panel.plot, within.first)
        panel.plot.set_xlim(-0.6, len(within.first.values) - 0.4)
        panel.plot.axhline(0, color="#333333", linewidth=0.6)
    _frame(drawing, within, looks, float(np.nanmin(center)), float(np.nanmax(center)))
    return within.figure


def _bars(panel: Panel, within: Panels, looks: Sequence[Look]) -> None:
    (table,) = panel.drawing.tables.values()
    center, low, high = (style.column(table, name) for name in bands.columns(panel.drawing.figure))
    count = len(looks)
    for k, ordinal in enumerate(table.column("experiment").to_pylist()):
        place = within.group(panel.drawing, ordinal)
        x = within.place(panel.drawing, ordinal) + _dodge(place, count)
        if not np.isfinite(center[k]):
            continue
        hatch = HATCHES[place % len(HATCHES)] if count > 1 else ""
        colour = looks[place]["color"]
        panel.plot.bar(x, center[k], 0.8 / count, color=to_rgba(colour, 0.55), edgecolor=colour, hatch=hatch, linewidth=0.6)
        if np.isfinite(low[k]) and np.isfinite(high[k]):
            reach = [[center[k] - low[k]], [high[k] - center[k]]]
            panel.plot.errorbar(x, center[k], reach, fmt="none", ecolor="#333333", elinewidth=0.8, capsize=min(2, 8 / count))


def _strip(plot: Axes, x: float, width: float, row: Mapping[str, float], runs: Floats, colour: ColorType) -> None:
    offsets = ((np.arange(len(runs)) + 1) * GOLDEN % 1 - 0.5) * 0.7 * width
    size = 2.4 if len(runs) <= 50 else 1.2
    plot.plot(x + offsets, runs, "o", color=colour, markersize=size, markeredgewidth=0, alpha=0.7)
    plot.plot([x - width / 2, x + width / 2], [row["median"]] * 2, color=colour, linewidth=1.4, solid_capstyle="butt")


def _colours(within: Panels) -> list[ColorType]:
    """Return a colour for each group."""
    return style.colours(within.groups) if len(within.groups.values) > 1 else [style.named_colours()[0]]


def _side_by_side(drawing: Drawing, paint: Callable[..., None]) -> Figure:
    within = facets.panels(drawing)
    colours = _colours(within)
    for panel in within.panels:
        _marks(panel, within, colours, paint)
        style.side_by_side(panel.plot, within.first)
        panel.plot.set_xlim(-0.6, len(within.first.values) - 0.4)
    values = np.concatenate(list(_runs(drawing).values()))
    looks = [Look(color=colour, linewidth=4) for colour in colours]
    _frame(drawing, within, looks, float(values.min()), float(values.max()))
    return within.figure


def _marks(panel: Panel, within: Panels, colours: Sequence[ColorType], paint: Callable[..., None]) -> None:
    """Draw a box, a violin or the like for each experiment of a panel."""
    (table,) = panel.drawing.tables.values()
    count, runs = len(within.groups.values), _runs(panel.drawing)
    for row in table.to_pylist():
        place = within.group(panel.drawing, row["experiment"])
        x = within.place(panel.drawing, row["experiment"]) + _dodge(place, count)
        if not row["n"]:
            _never(panel.plot, [x] if row["never"] else [], colours[place])
            continue
        shown = style.drawable(runs[row["experiment"]], panel.drawing)
        paint(panel.plot, x, 0.7 / count, row, shown[np.isfinite(shown)], colours[place])


def _box(plot: Axes, x: float, width: float, row: Mapping[str, float], runs: Floats, colour: ColorType) -> None:
    low, high = row["whisker_low"], row["whisker_high"]
    beyond = runs[(runs < low) | (runs > high)]
    stats = {"med": row["median"], "q1": row["q1"], "q3": row["q3"], "whislo": low, "whishi": high, "fliers": beyond}
    fliers = {"marker": "o", "markersize": 2.2, "markerfacecolor": "none", "markeredgecolor": colour, "markeredgewidth": 0.6}
    thin = {"color": colour, "linewidth": 0.8}
    plot.bxp(
        [stats],
        positions=[x],
        widths=[width],
        manage_ticks=False,
        patch_artist=True,
        boxprops={"facecolor": to_rgba(colour, 0.25), "edgecolor": colour, "linewidth": 0.8},
        medianprops={"color": colour, "linewidth": 1.6, "solid_capstyle": "butt"},
        whiskerprops=thin,
        capprops=thin,
        flierprops=fliers,
    )


def _violin(plot: Axes, x: float, width: float, row: Mapping[str, float], runs: Floats, colour: ColorType) -> None:
    spread = np.full(len(runs), 0.25)
    if len(runs) >= DENSE and runs.min() < runs.max():
        (stats,) = violin_stats(runs, points=80)
        shape = stats["vals"] / stats["vals"].max() * width / 2
        plot.fill_betweenx(stats["coords"], x - shape, x + shape, facecolor=colour, alpha=0.25, linewidth=0)
        spread = np.interp(runs, stats["coords"], shape) / width
    offsets = ((np.arange(len(runs)) + 1) * GOLDEN % 1 - 0.5) * 1.4 * spread * width
    plot.plot(x + offsets, runs, "o", color=colour, markersize=1.6, markeredgewidth=0, alpha=0.7)
    plot.plot([x, x], [row["q1"], row["q3"]], color=colour, linewidth=2.2, solid_capstyle="butt")
    size = min(3.0, 20 * width)
    plot.plot([x], [row["median"]], "o", color="white", markeredgecolor=colour, markersize=size, markeredgewidth=0.8)


def _interval(plot: Axes, x: Floats, center: Floats, low: Floats, high: Floats, look: Look, *, joined: bool) -> list[Artist]:
    artists: list[Artist] = []
    if joined:
        known = np.isfinite(center)
        artists += plot.plot(x[known], center[known], **look | Look(marker="none"))
    some = np.isfinite(center) & np.isfinite(low) & np.isfinite(high)
    if some.any():
        reach = [(center - low)[some], (high - center)[some]]
        bars = plot.errorbar(
            x[some], center[some], reach, fmt="none", ecolor=look["color"], elinewidth=0.9, capsize=2, capthick=0.9
        )
        artists += [*bars[1], *bars[2]]
    return [*artists, *plot.plot(x, center, **look | Look(linestyle="none"))]


def _never(plot: Axes, x: Sequence[float] | Floats, colour: ColorType) -> Sequence[Artist]:
    """Draw triangles at the upper edge for experiments in which no run reached the threshold."""
    if not len(x):
        return []
    upper_edge, marks = plot.get_xaxis_transform(), Look(marker="^", linestyle="none", color=colour)
    ones = np.ones(len(x))
    return plot.plot(x, ones, **marks, markersize=4, markerfacecolor="white", transform=upper_edge, clip_on=False, zorder=4)


def _places(drawing: Drawing, first: Axis, ordinals: list[int], place: int, count: int) -> Floats:
    values = [value_of(drawing, ordinal) for ordinal in ordinals]
    if first.numeric:
        return np.array(values, dtype=float)
    return np.array([first.values.index(value) + _dodge(place, count) for value in values])


def _shifts(first: Axis, count: int) -> list[float]:
    """Return the shift of each group in points: to both sides of a number, but never below 0."""
    apart = min(APART, WIDEST / count)
    return [(place - (0 if 0 in first.values else (count - 1) / 2)) * apart for place in range(count)]


def _shift(artists: Sequence[Artist], points: float) -> None:
    """Shift artists aside by this many points, so that the intervals of several groups at one number are all visible."""
    for artist in artists:
        artist.set_transform(artist.get_transform() + ScaledTranslation(points / 72, 0, artist.figure.dpi_scale_trans))


def _dodge(place: int, count: int) -> float:
    return (place - (count - 1) / 2) * 0.8 / count


def _runs(drawing: Drawing) -> dict[int, Floats]:
    if drawing.runs is None:
        raise TypeError(f"a {drawing.figure.kind} figure needs the values of its runs")
    ordinals = numpy_of(drawing.runs.column("experiment"))
    values = style.column(drawing.runs, "value")
    return {int(ordinal): values[ordinals == ordinal] for ordinal in np.unique(ordinals)}


def _frame(drawing: Drawing, within: Panels, looks: list[Look], lowest: float, highest: float) -> None:
    """Scale and label the axes of all panels, and add the legend."""
    (table,) = drawing.tables.values()
    for panel in within.panels:
        style.scale_y(panel.plot, drawing, lowest, highest)
        axis_limits.apply(panel.plot, drawing)
    style.outer_labels(within.plots, drawing.figure.xlabel or style.axis_label(within.first), style.value_label(drawing))
    counts = [0] * len(within.groups.values)
    whole = replace(drawing, axes=within.panels[0].drawing.axes)
    for ordinal, n in zip(table.column("experiment").to_pylist(), table.column("n").to_pylist(), strict=True):
        place = within.group(whole, ordinal)
        counts[place] = max(counts[place], n)
    entries = with_n(style.names(within.groups.values), counts)
    style.legend(within.figure, within.plots, within.groups, entries, looks)
