"""Limits of the y axis, and notes on values outside them for the small print.

On a logarithmic axis, values that are not above 0 are left out. On any axis, intervals of few runs may be cut off if they
would leave no room for the rest.

An interval of two runs is an order of magnitude wider than one of ten. If runs end at different times, or fail, such
intervals would set the range, and all lines would look flat. Then the range is that of all centers, and of the intervals of
more than half the largest number of runs. Parts of intervals beyond it are cut off, and the small print reports it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from sierra.deliverables.figures import bands, models, style
from sierra.stats import words
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

WIDER = 1.5
"""The factor by which the range of all intervals must be wider before any is cut off."""
MARGIN = 0.05


@dataclass(frozen=True, slots=True)
class Cut:
    """A range that cuts intervals off, all of them of `most` runs or fewer."""

    low: float
    high: float
    most: int


def cut(drawing: Drawing) -> Cut | None:
    """Return the range of the y axis of centers with intervals, or None if everything fits or there are none."""
    (table,) = drawing.tables.values()
    if bands.columns(drawing.figure)[0] not in table.column_names:
        return None
    center, low, high = (_scaled(style.column(table, name), drawing) for name in bands.columns(drawing.figure))
    n = style.column(table, "n")
    few = 2 * n <= n.max(initial=0)
    lines = np.append(center, _scaled(models.values(drawing), drawing))
    outer = _span(lines, low, high)
    inner = _span(lines, np.where(few, np.nan, low), np.where(few, np.nan, high))
    if outer is None or inner is None or not 0 < (inner[1] - inner[0]) * WIDER < outer[1] - outer[0]:
        return None
    margin = (inner[1] - inner[0]) * MARGIN
    bottom, top = inner[0] - margin, inner[1] + margin
    beyond = few & ((low < bottom) | (high > top))
    if drawing.figure.log_y:
        bottom, top = 10**bottom, 10**top
    return Cut(bottom, top, int(n[beyond].max()))


def notes(drawing: Drawing) -> list[str]:
    """Return notes on all centers and intervals that the y axis cannot show."""
    limits = cut(drawing)
    few = [f"some intervals of n ≤ {limits.most} are cut off"] if limits else []
    return [*left_out_centers(drawing, ends=True), *few]


def left_out_centers(drawing: Drawing, *, ends: bool = False) -> list[str]:
    """Return notes on centers, and the ends of intervals, that a logarithmic scale cannot show."""
    (table,) = drawing.tables.values()
    values, *spread = (style.column(table, name) for name in bands.columns(drawing.figure)[: 3 if ends else 1])
    return _not_above_0(drawing, values, spread, words.plural(drawing.figure.center))


def left_out_runs(drawing: Drawing) -> list[str]:
    """Return notes on the runs that a logarithmic scale cannot show."""
    if drawing.runs is None:
        raise TypeError(f"a {drawing.figure.kind} figure needs the values of its runs")
    return _not_above_0(drawing, style.column(drawing.runs, "value"), [], "runs")


def apply(plot: Axes, drawing: Drawing) -> None:
    """Set the y axis to this range."""
    if limits := cut(drawing):
        plot.set_ylim(limits.low, limits.high)


def _not_above_0(drawing: Drawing, values: style.Floats, spread: Sequence[style.Floats], what: str) -> list[str]:
    if not drawing.figure.log_y:
        return []
    if bad := int((values <= 0).sum()):
        return [f"log scale: {bad} of {int(np.isfinite(values).sum())} {what} not above 0 left out"]
    return ["log scale: intervals that reach 0 are cut off"] if any((end <= 0).any() for end in spread) else []


def _scaled(values: style.Floats, drawing: Drawing) -> style.Floats:
    numbers = style.drawable(values, drawing)
    return np.log10(numbers) if drawing.figure.log_y else numbers


def _span(*ends: style.Floats) -> tuple[float, float] | None:
    values = np.concatenate(ends)
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if len(values) else None
