"""Figures of centers over the independent variable: points or bars with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.transforms import ScaledTranslation
from matplotlib.typing import ColorType

from sierra.deliverables.figures import axis_limits, bands, facets, models, style
from sierra.deliverables.figures.facets import Panel, Panels
from sierra.deliverables.figures.style import Floats, Look
from sierra.deliverables.figures.timeseries import value_of, with_n
from sierra.model import Axis
from sierra.util.lazy_definitions import dataclass, replace

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

APART = 1.6
"""The distance in points between the intervals of two groups at the same number; smaller for many groups."""
WIDEST = 40
"""The width in points over which the intervals at one number are spread."""
CAP = 4
"""The largest extent in points of a mark, or of an interval's end, to each side."""
WIDTH = 0.7 * 72 * style.COLUMN
"""The approximate width of a plot in points."""


def summary(drawing: Drawing) -> Figure:
    """Draw a measure over the first axis, with intervals, and a line for each combination of the others."""
    within = facets.panels(drawing)
    looks = models.beside(drawing, [Look(marker="o") | look for look in style.looks(within.groups)])
    shifts = _shifts(within.first, len(within.groups.values))
    (table,) = drawing.tables.values()
    center = style.drawable(style.column(table, bands.columns(drawing.figure)[0]), drawing)
    aside = max(map(abs, shifts)) + CAP
    margin = max(0.04, aside / (WIDTH - 2 * aside))
    for panel in within.panels:
        _points(panel, within, looks, shifts)
        style.scale_values(panel.plot, within.first, log=drawing.figure.log_x, margin=margin)
    frame(drawing, within, style.lines(looks), *style.span(center))
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
    for group, look in enumerate(looks):
        rows = np.flatnonzero(groups == group)
        x = _places(drawing, first, [ordinals[k] for k in rows], group, len(looks))
        censored = style.column(table, "never")[rows] > 0
        artists = _interval(panel.plot, x, center[rows], low[rows], high[rows], look, joined=first.numeric)
        hollow = look | Look(linestyle="none")
        artists += panel.plot.plot(x[censored], center[rows][censored], **hollow, markerfacecolor="white", zorder=3)
        artists += never(panel.plot, x[censored & (style.column(table, "n")[rows] == 0)], look["color"])
        artists += _models(panel, within, group, look["color"] if len(looks) > 1 else models.BLACK, len(looks))
        if first.numeric:
            _shift(artists, shifts[group])


def _models(panel: Panel, within: Panels, group: int, colour: ColorType, count: int) -> list[Artist]:
    """Draw the models of one group: lines over numbers, marks at names."""
    drawing, first = panel.drawing, within.first
    ordinals = [ordinal for ordinal in drawing.cells if within.group(drawing, ordinal) == group]
    if first.numeric:
        places = partial(_places, drawing, first, group=group, count=count)
        return models.over_numbers(panel.plot, drawing, ordinals, places, colour)
    for ordinal, x in zip(ordinals, _places(drawing, first, ordinals, group, count), strict=True):
        models.at(panel.plot, drawing, ordinal, float(x), 0.8 / count, colour)
    return []


def bar(drawing: Drawing) -> Figure:
    """Draw a bar up to the center with its interval for each experiment, side by side for the groups."""
    within = facets.panels(drawing)
    (table,) = drawing.tables.values()
    center = style.drawable(style.column(table, bands.columns(drawing.figure)[0]), drawing)
    groups = looks_of_groups(within)
    for panel in within.panels:
        _bars(panel, within, groups)
        style.side_by_side(panel.plot, within.first)
        panel.plot.set_xlim(-0.6, len(within.first.values) - 0.4)
        panel.plot.axhline(0, color="#333333", linewidth=0.6)
    frame(drawing, within, [group.patch(0.55) for group in groups], *style.span(center))
    return within.figure


def _bars(panel: Panel, within: Panels, groups: Sequence[Group]) -> None:
    (table,) = panel.drawing.tables.values()
    center, low, high = (style.column(table, name) for name in bands.columns(panel.drawing.figure))
    count = len(groups)
    for k, ordinal in enumerate(table.column("experiment").to_pylist()):
        group = within.group(panel.drawing, ordinal)
        x = within.place(panel.drawing, ordinal) + dodge(group, count)
        if not np.isfinite(center[k]):
            if "never" in table.column_names and table.column("never")[k].as_py():
                never(panel.plot, [x], groups[group].colour)
            continue
        panel.plot.bar(x, center[k], 0.8 / count, **groups[group].face(0.55))
        if np.isfinite(low[k]) and np.isfinite(high[k]):
            style.interval(panel.plot, [x], low[[k]], high[[k]], color="#333333", linewidth=0.8, cap=min(2, 8 / count))
    marks_of_models(panel, within, count)


@dataclass(frozen=True, slots=True)
class Group:
    """The look of one of several groups side by side: in colour, and in grey too."""

    colour: ColorType
    hatch: str
    marker: str

    def face(self, alpha: float) -> dict[str, Any]:
        """Return the look of a surface, as matplotlib's keyword arguments."""
        return {"facecolor": to_rgba(self.colour, alpha), "edgecolor": self.colour, "hatch": self.hatch, "linewidth": 0.6}

    def patch(self, alpha: float) -> Artist:
        return Patch(**self.face(alpha))


def looks_of_groups(within: Panels) -> list[Group]:
    """Return the look of each group."""
    if len(within.groups.values) == 1:
        return [Group(style.named_colours()[0], "", "o")]
    kinds = len(style.HATCHES)
    return [
        Group(colour, style.HATCHES[index % kinds], style.MARKERS[index % kinds])
        for index, colour in enumerate(style.colours(within.groups))
    ]


def marks_of_models(panel: Panel, within: Panels, count: int) -> None:
    """Draw the models of all experiments of a panel as dashed marks."""
    for ordinal in panel.drawing.cells if panel.drawing.models else ():
        x = within.place(panel.drawing, ordinal) + dodge(within.group(panel.drawing, ordinal), count)
        models.at(panel.plot, panel.drawing, ordinal, x, 0.8 / count)


def _interval(plot: Axes, x: Floats, center: Floats, low: Floats, high: Floats, look: Look, *, joined: bool) -> list[Artist]:
    artists: list[Artist] = []
    if joined:
        known = np.isfinite(center)
        artists += plot.plot(x[known], center[known], **look | Look(marker="none"))
    some = np.isfinite(center) & np.isfinite(low) & np.isfinite(high)
    if some.any():
        artists += style.interval(plot, x[some], low[some], high[some], color=look["color"], linewidth=0.9)
    return [*artists, *plot.plot(x, center, **look | Look(linestyle="none"))]


def never(plot: Axes, x: Sequence[float] | Floats, colour: ColorType) -> Sequence[Artist]:
    """Draw triangles at the upper edge for experiments in which no run reached the threshold."""
    if not len(x):
        return []
    upper_edge, marks = plot.get_xaxis_transform(), Look(marker="^", linestyle="none", color=colour)
    ones = np.ones(len(x))
    return plot.plot(x, ones, **marks, markersize=4, markerfacecolor="white", transform=upper_edge, clip_on=False, zorder=4)


def _places(drawing: Drawing, first: Axis, ordinals: list[int], group: int, count: int) -> Floats:
    values = [value_of(drawing, ordinal) for ordinal in ordinals]
    if first.numeric:
        return np.array(values, dtype=float)
    return np.array([first.values.index(value) + dodge(group, count) for value in values])


def _shifts(first: Axis, count: int) -> list[float]:
    """Return the shift of each group in points: to both sides of a number, but never below 0."""
    apart = min(APART, WIDEST / count)
    return [(group - (0 if 0 in first.values else (count - 1) / 2)) * apart for group in range(count)]


def _shift(artists: Sequence[Artist], points: float) -> None:
    """Shift artists aside by this many points, so that the intervals of several groups at one number are all visible."""
    for artist in artists:
        artist.set_transform(artist.get_transform() + ScaledTranslation(points / 72, 0, artist.figure.dpi_scale_trans))


def dodge(group: int, count: int) -> float:
    return (group - (count - 1) / 2) * 0.8 / count


def frame(drawing: Drawing, within: Panels, handles: Sequence[Artist], lowest: float, highest: float) -> None:
    """Scale and label the axes of all panels, and add the legend."""
    (table,) = drawing.tables.values()
    for panel in within.panels:
        style.scale_y(panel.plot, drawing, lowest, highest)
        axis_limits.apply(panel.plot, drawing)
    style.outer_labels(within.plots, drawing.figure.xlabel or style.axis_label(within.first), style.value_label(drawing))
    counts = [0] * len(within.groups.values)
    whole = replace(drawing, axes=within.panels[0].drawing.axes)
    for ordinal, n in zip(table.column("experiment").to_pylist(), table.column("n").to_pylist(), strict=True):
        group = within.group(whole, ordinal)
        counts[group] = max(counts[group], n)
    entries = with_n(style.names(within.groups.values), counts)
    style.legend(within.figure, within.plots, within.groups, entries, handles, models.entries(drawing, handles))
