"""Figures of the densities of runs, one above the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D

from sierra.deliverables.figures import facets, sampled_runs, seaborn_plots, style
from sierra.deliverables.figures.distributions import DENSE, has_density, value_label
from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

RIDGES = 24
"""The largest number of ridges in a panel."""
OVERLAP = 1.6
"""The height of the highest ridge; the distance between two ridges is 1."""


def ridge(drawing: Drawing) -> Figure:
    """Draw the densities of the experiments one above the other, with the same scale."""
    within = facets.panels(drawing, over_first=False)
    count = len(within.groups.values)
    if count > RIDGES:
        raise UsageError(f"the figure needs {count} ridges, but at most {RIDGES} are possible; use where, facet, or kind ecdf")
    within.figure.set_figheight(max(within.figure.get_figheight(), 0.8 + 0.24 * count))
    every, shapes = sampled_runs.step(drawing), []
    colours = style.colours(within.groups) if count > 1 else [style.named_colours()[0]]
    for panel in within.panels:
        for ordinal, runs in sampled_runs.values(panel.drawing).items():
            group = within.group(panel.drawing, ordinal)
            base, colour, above = count - 1 - group, colours[group], 2 + group / count
            shown = runs[sampled_runs.places(len(runs), every)]
            if has_density(runs):
                shapes.append((seaborn_plots.density(panel.plot, shown, colour, above), panel.plot, base))
            panel.plot.plot(shown, np.full(len(shown), base), "|", color=colour, markersize=3, alpha=0.6, zorder=above)
            panel.plot.plot([np.median(runs)] * 2, [base, base + 0.35], color=colour, linewidth=1.4, zorder=above)
        panel.plot.set_yticks(range(count - 1, -1, -1), style.names(within.groups.values, 22))
        panel.plot.set_ylim(-0.25, count - 1 + OVERLAP + 0.15)
    _move(shapes)
    style.outer_labels(within.plots, value_label(drawing), drawing.figure.ylabel or style.axis_label(within.groups))
    return within.figure


def _move(shapes: Sequence[tuple[PolyCollection, Axes, int]]) -> None:
    """Move each density up to its line, after scaling all by the same factor: the highest one gets the height `OVERLAP`."""
    top = max((float(np.asarray(shape.get_paths()[0].vertices)[:, 1].max()) for shape, _, _ in shapes), default=1.0)
    for shape, plot, base in shapes:
        shape.set_transform(Affine2D().scale(1, OVERLAP / top).translate(0, base) + plot.transData)


def without_density(drawing: Drawing) -> list[str]:
    few = sum(not has_density(values) for values in sampled_runs.values(drawing).values())
    return [f"{few} without a density: fewer than {DENSE} runs, or all equal"] if few else []
