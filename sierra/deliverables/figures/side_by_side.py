"""Figures of the runs over the independent variable: boxes, densities, or dots, side by side for the other variables.

seaborn paints them. The medians, quartiles and whiskers are those that SQL computed of all runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.artist import Artist
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from sierra.deliverables.figures import facets, sampled_runs, seaborn_plots, style, summary
from sierra.deliverables.figures.distributions import has_density
from sierra.deliverables.figures.facets import Panel, Panels
from sierra.deliverables.figures.seaborn_plots import GroupAxes, Grouped
from sierra.deliverables.figures.style import Floats
from sierra.deliverables.figures.summary import Group

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

SUMMARY = ("whisker_low", "q1", "median", "q3", "whisker_high")
JITTER = 0.24
"""The largest distance of dots from the middle of their group, if there is one group."""


def box(drawing: Drawing) -> Figure:
    """Draw median, quartiles and whiskers for each experiment, and the runs beyond the whiskers."""
    return _figure(drawing, _boxes)


def violin(drawing: Drawing) -> Figure:
    """Draw the density of the runs for each experiment, with a dot for each run, the median and the quartiles."""
    return _figure(drawing, _violins)


def strip(drawing: Drawing) -> Figure:
    """Draw a dot for each run, and a line at the median, for each experiment."""
    return _figure(drawing, _strips)


class _Content:
    """The content of a panel: its experiments with their statistics, the places where they are drawn, and their runs."""

    def __init__(self, panel: Panel, within: Panels, runs: Mapping[int, Floats]) -> None:
        (table,) = panel.drawing.tables.values()
        self.rows = [row for row in table.to_pylist() if row["n"]]
        self.never = [row for row in table.to_pylist() if row["never"] and not row["n"]]
        self.runs = [runs[row["experiment"]] for row in self.rows]
        self._panel, self._within = panel, within
        self.groups = summary.looks_of_groups(within)
        self.colours = [group.colour for group in self.groups]
        self.axes = GroupAxes(panel.plot, len(within.first.values), self.colours)
        self.width = seaborn_plots.WIDTH * (1 - seaborn_plots.GAP) / len(self.colours)

    def at(self, row: Mapping[str, int]) -> tuple[float, int]:
        """Return where an experiment is drawn, and its group."""
        group = self._within.group(self._panel.drawing, row["experiment"])
        return self._within.place(self._panel.drawing, row["experiment"]) + summary.dodge(group, len(self.colours)), group

    def grouped(self, values: Callable[[Mapping[str, float], Floats], Floats]) -> Grouped:
        """Return some values of each experiment, which are chosen or made from its statistics and its runs."""
        chosen = [values(row, runs) for row, runs in zip(self.rows, self.runs, strict=True)]
        drawing, within = self._panel.drawing, self._within
        each = [
            (within.place(drawing, row["experiment"]), within.group(drawing, row["experiment"]), len(some))
            for row, some in zip(self.rows, chosen, strict=True)
        ]
        x, group, count = np.array(each, dtype=int).reshape(-1, 3).T
        return Grouped(np.repeat(x, count), np.repeat(group, count), np.concatenate([np.empty(0), *chosen]))


def _figure(drawing: Drawing, paint: Callable[[_Content, Drawing], None]) -> Figure:
    within = facets.panels(drawing)
    every, runs = sampled_runs.step(drawing), sampled_runs.values(drawing)
    shown = {
        ordinal: style.drawable(numbers[sampled_runs.places(len(numbers), every)], drawing) for ordinal, numbers in runs.items()
    }
    shown = {ordinal: numbers[np.isfinite(numbers)] for ordinal, numbers in shown.items()}
    for panel in within.panels:
        content = _Content(panel, within, shown)
        if content.rows:
            paint(content, drawing)
        for row in content.never:
            x, group = content.at(row)
            summary.never(panel.plot, [x], content.colours[group])
        summary.marks_of_models(panel, within, len(content.colours))
        style.side_by_side(panel.plot, within.first)
    values = np.concatenate(list(runs.values()))
    groups = summary.looks_of_groups(within)
    handles = [_dot(group) if paint is _strips else group.patch(0.3) for group in groups]
    summary.frame(drawing, within, handles, float(values.min()), float(values.max()))
    return within.figure


def _dot(group: Group) -> Artist:
    return Line2D([], [], color=group.colour, marker=group.marker, linestyle="none")


def _hatch(content: _Content, surfaces: Sequence[Patch | PolyCollection], strength: float) -> None:
    """Give the surfaces of each group its pattern; seaborn says by their colour which group they belong to."""
    tints = np.array([seaborn_plots.tinted(colour, strength) for colour in content.colours])
    for surface in surfaces:
        colour = np.ravel(surface.get_facecolor())[:3]
        group = content.groups[int(np.abs(tints - colour).sum(axis=1).argmin())]
        if group.hatch:
            surface.set_hatch(group.hatch)
            surface.set_edgecolor(group.colour)


def _boxes(content: _Content, drawing: Drawing) -> None:
    # Before the axis is logarithmic, because seaborn would leave out the ends of boxes that are not above 0.
    seaborn_plots.boxes(content.axes, content.grouped(_five_numbers))
    _hatch(content, content.axes.plot.patches, seaborn_plots.BOX)
    beyond = content.grouped(lambda row, runs: runs[(runs < row["whisker_low"]) | (runs > row["whisker_high"])])
    seaborn_plots.dots(content.axes, beyond, size=2.2, jitter=0)


def _five_numbers(row: Mapping[str, float], runs: Floats) -> Floats:
    """Return the numbers of a box in ascending order: of few runs, a quartile may be beyond the run where a whisker ends."""
    del runs
    low, q1, median, q3, high = (row[name] for name in SUMMARY)
    return np.array([min(low, q1), q1, median, q3, max(q3, high)])


def _violins(content: _Content, drawing: Drawing) -> None:
    plot = content.axes.plot
    if drawing.figure.log_y:
        plot.set_yscale("log")
    dense = content.grouped(lambda row, runs: runs if has_density(runs) else runs[:0])
    seaborn_plots.violins(content.axes, dense)
    _hatch(
        content, [collection for collection in plot.collections if isinstance(collection, PolyCollection)], seaborn_plots.VIOLIN
    )
    dots = content.grouped(lambda row, runs: runs)
    seaborn_plots.dots(content.axes, dots, size=1.6, jitter=JITTER * 0.6)
    for row in content.rows:
        x, group = content.at(row)
        colour = content.colours[group]
        plot.plot([x, x], [row["q1"], row["q3"]], color=colour, linewidth=2.2, solid_capstyle="butt")
        size = min(3.0, 20 * content.width)
        plot.plot([x], [row["median"]], "o", color="white", markeredgecolor=colour, markersize=size, markeredgewidth=0.8)


def _strips(content: _Content, drawing: Drawing) -> None:
    most = max(map(len, content.runs))
    dots, size = content.grouped(lambda row, runs: runs), 2.4 if most <= 50 else 1.2
    for marker, some in _by_marker(content, dots):
        seaborn_plots.dots(content.axes, some, size=size, jitter=JITTER, marker=marker)
    for row in content.rows:
        x, group = content.at(row)
        ends = x - content.width / 2, x + content.width / 2
        content.axes.plot.hlines(row["median"], *ends, color=content.colours[group], linewidth=1.4, capstyle="butt", zorder=3)


def _by_marker(content: _Content, dots: Grouped) -> Iterator[tuple[str, Grouped]]:
    """Yield the dots of all groups that have the same marker."""
    markers = np.array([content.groups[group].marker for group in dots.group])
    for marker in dict.fromkeys(group.marker for group in content.groups):
        mine = markers == marker
        yield marker, Grouped(dots.place[mine], dots.group[mine], dots.value[mine])
