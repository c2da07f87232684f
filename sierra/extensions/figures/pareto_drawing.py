"""Figures of two columns of experiments, with their Pareto front."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from matplotlib.figure import Figure

from sierra.deliverables.figures import bands, facets, style
from sierra.deliverables.figures.pairs import frame
from sierra.deliverables.figures.style import Floats, Look

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing


def notes(drawing: Drawing, better: Sequence[str]) -> list[str]:
    """Return a note on the line."""
    first, second = drawing.tables
    return [f"line: front of the experiments, where {better[0]} {first} and {better[1]} {second} are better"]


def pareto(drawing: Drawing, better: Sequence[str]) -> Figure:
    """Draw each experiment with its intervals, and the front as steps."""
    within = facets.panels(drawing, over_first=False)
    looks: list[Look] = [Look(marker="o") | look for look in style.looks(within.groups)]
    names = bands.columns(drawing.figure)
    for panel in within.panels:
        first, second = panel.drawing.tables.values()
        ordinals = first.column("experiment").to_pylist()
        (x, *x_ends), (y, *y_ends) = ([style.column(table, name) for name in names] for table in (first, second))
        for k, ordinal in enumerate(ordinals):
            look = looks[within.group(panel.drawing, ordinal)]
            colour = look["color"]
            panel.plot.plot([x_ends[0][k], x_ends[1][k]], [y[k], y[k]], color=colour, linewidth=0.7)
            panel.plot.plot([x[k], x[k]], [y_ends[0][k], y_ends[1][k]], color=colour, linewidth=0.7)
            panel.plot.plot(x[k], y[k], **look | Look(linestyle="none"))
        front = _front(x, y, better)
        # between two experiments of the front, only what is worse than both is reached for sure
        where: Literal["pre", "post"] = "pre" if better[0] == "high" else "post"
        panel.plot.step(x[front], y[front], where=where, color="#333333", linewidth=0.8, zorder=1)
    frame(drawing, within, looks)
    return within.figure


def _front(x: Floats, y: Floats, better: Sequence[str]) -> list[int]:
    """Return the places of the experiments that no other one dominates, by ascending x."""
    signs = [1 if one == "high" else -1 for one in better]
    points = np.column_stack((x * signs[0], y * signs[1]))
    known = [k for k in range(len(points)) if np.isfinite(points[k]).all()]
    best = [k for k in known if not any((points[o] >= points[k]).all() and (points[o] > points[k]).any() for o in known)]
    return sorted(best, key=lambda k: (x[k], y[k]))
