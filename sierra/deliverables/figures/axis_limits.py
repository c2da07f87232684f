"""What the y axis cannot hold, and is said in the small print.

On a logarithmic axis, that is what is not above 0. On any axis, it may be intervals of few runs, which would leave no room
for the rest.

An interval of two runs is an order of magnitude wider than one of ten. Where runs end at different times, or failed, such
intervals would set the range, so that all lines look flat. Then the range is that of all centers, and of the intervals of
more than half as many runs as the most have; what reaches beyond is cut off, and the small print says so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sierra.deliverables.figures import style

if TYPE_CHECKING:
    from sierra.deliverables.figures.base import Drawing

CENTERS = {"mean": ("mean", "low", "high"), "median": ("median", "q1", "q3"), "iqm": ("iqm", "iqm_low", "iqm_high")}
"""What a figure draws of its table: the center, and from where to where it spreads."""
WIDER = 1.5
"""How much wider the range of all intervals must be before any is cut off."""
MARGIN = 0.05


@dataclass(frozen=True, slots=True)
class Cut:
    """A range that cuts intervals off, all of them of `most` runs or fewer."""

    low: float
    high: float
    most: int


def cut(drawing: Drawing) -> Cut | None:
    """The range of the y axis, or None where all that is drawn has room."""
    if drawing.figure.kind not in ("timeseries", "summary"):
        return None
    (table,) = drawing.tables.values()
    center, low, high = (_scaled(style.column(table, name), drawing) for name in CENTERS[drawing.figure.center])
    n = style.column(table, "n")
    few = 2 * n <= n.max(initial=0)
    whole = _span(center, low, high)
    inner = _span(center, np.where(few, np.nan, low), np.where(few, np.nan, high))
    if whole is None or inner is None or not 0 < (inner[1] - inner[0]) * WIDER < whole[1] - whole[0]:
        return None
    margin = (inner[1] - inner[0]) * MARGIN
    bottom, top = inner[0] - margin, inner[1] + margin
    beyond = few & ((low < bottom) | (high > top))
    if drawing.figure.log_y:
        bottom, top = 10**bottom, 10**top
    return Cut(bottom, top, int(n[beyond].max()))


def said(drawing: Drawing) -> Drawing:
    """The same drawing, whose small print says what its y axis does not hold, if anything."""
    found = cut(drawing)
    few = f"some intervals of n ≤ {found.most} are cut off" if found else ""
    return replace(drawing, note="; ".join(filter(None, (drawing.note, _not_above_0(drawing), few))))


def apply(plot: Any, drawing: Drawing) -> None:
    """Give the y axis this range."""
    if found := cut(drawing):
        plot.set_ylim(found.low, found.high)


def _not_above_0(drawing: Drawing) -> str:
    """What a logarithmic axis has no place for."""
    if not drawing.figure.log_y or drawing.figure.kind == "stacked":
        return ""
    (table,) = drawing.tables.values()
    if drawing.runs is not None:
        values, spread, what = style.column(drawing.runs, "value"), [], "runs"
    else:
        names = CENTERS[drawing.figure.center][: 1 if drawing.figure.kind == "heatmap" else 3]
        values, *spread = (style.column(table, name) for name in names)
        what = {"mean": "means", "median": "medians", "iqm": "interquartile means"}[drawing.figure.center]
    if bad := int((values <= 0).sum()):
        return f"log scale: {bad} of {int(np.isfinite(values).sum())} {what} not above 0 left out"
    return "log scale: intervals that reach 0 are cut off" if any((end <= 0).any() for end in spread) else ""


def _scaled(values: Any, drawing: Drawing) -> Any:
    numbers = style.drawable(values, drawing)
    return np.log10(numbers) if drawing.figure.log_y else numbers


def _span(*ends: Any) -> tuple[float, float] | None:
    values = np.concatenate(ends)
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if len(values) else None
