"""Thin long series for drawing, so that no peak is lost.

The x axis is divided into `PARTS` equal parts, about as many as a page has pixels. Of each part, the first and the last point,
and the smallest and the largest value of each line are drawn. So a thinned line covers the same pixels as the whole one. A part
with a gap keeps it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sierra.deliverables.figures.style import Floats
from sierra.util.arrow_columns import numpy_of

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

LONG = 2000
"""The largest number of points of a series that is drawn as it is."""
PARTS = 1000
Indices = npt.NDArray[np.int_]


def kept(t: Floats, *lines: Floats, log: bool | None = False) -> slice | Indices:
    """Return the places of the points to draw. `t` ascends; `lines` have a value for each `t`. `log`: x is log t."""
    if len(t) <= LONG:
        return slice(None)
    x = np.log(t) if log and t[0] > 0 else t
    part = np.minimum((x - x[0]) / (x[-1] - x[0]) * PARTS, PARTS - 1).astype(int)
    starts = np.flatnonzero(np.diff(part, prepend=-1))
    ends = np.append(starts[1:], len(t)) - 1
    indices = [starts, ends]
    for values in lines:
        missing = ~np.isfinite(values)
        low, high = np.where(missing, np.inf, values), np.where(missing, -np.inf, values)
        lowest, highest = np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)
        sizes = ends - starts + 1
        indices += [
            _firsts(low == np.repeat(lowest, sizes), part),
            _lasts(high == np.repeat(highest, sizes), part),
            _firsts(missing, part),
        ]
    return np.unique(np.concatenate(indices))


def notes(drawing: Drawing) -> list[str]:
    """Return the rule by which long series are thinned, if there are any."""
    longest = 0
    for table in drawing.tables.values():
        _, counts = np.unique(numpy_of(table.column("experiment")), return_counts=True)
        longest = max(longest, int(counts.max(initial=0)))
    if longest <= LONG:
        return []
    return [f"series of {longest} times thinned: of each 1/{PARTS} of the x axis, the extremes are drawn"]


def _firsts(chosen: npt.NDArray[np.bool_], part: Indices) -> Indices:
    """Return the first chosen place of each part that has one."""
    places = np.flatnonzero(chosen)
    _, first = np.unique(part[places], return_index=True)
    return places[first]


def _lasts(chosen: npt.NDArray[np.bool_], part: Indices) -> Indices:
    """Return the last chosen place of each part that has one."""
    places: Indices = len(part) - 1 - _firsts(chosen[::-1], part[::-1])
    return places
