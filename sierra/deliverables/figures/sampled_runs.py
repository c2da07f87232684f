"""The values of runs that a figure draws one by one: all of them, or of more than 100,000 a part, chosen by a rule.

Of more, the first, the last and every k-th run of each experiment are drawn, by value (of two columns: by id). So the drawn
runs have the same distribution as all runs, up to k runs. Numbers (centers, intervals, quartiles, counts, fits) are always
those of all runs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sierra.deliverables.figures import style
from sierra.deliverables.figures.style import Floats
from sierra.util.arrow_columns import numpy_of

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing

MOST = 100_000
"""The largest number of runs that are drawn one by one."""


def table(drawing: Drawing) -> pa.Table:
    """Return the values of all runs. Raises TypeError for a kind that does not need them."""
    if drawing.runs is None:
        raise TypeError(f"a {drawing.figure.kind} figure needs the values of its runs")
    return drawing.runs


def values(drawing: Drawing) -> dict[int, Floats]:
    """Return the values of all runs by experiment, in ascending order; experiments without a value are not in it."""
    runs = table(drawing)
    ordinals, found = numpy_of(runs.column("experiment")), style.column(runs, "value")
    order = np.lexsort((found, ordinals))
    known, begins = np.unique(ordinals[order], return_index=True)
    return dict(zip(known.tolist(), np.split(found[order], begins[1:]), strict=True))


def step(drawing: Drawing) -> int:
    """Return k: every k-th run is drawn; 1 if all are. It is that of the complete figure, not of a panel."""
    count = int(table(drawing).num_rows)
    if count <= MOST:
        return 1
    experiments = len(np.unique(numpy_of(table(drawing).column("experiment"))))
    return -(-count // max(1, MOST - 2 * experiments))


def places(count: int, every: int) -> npt.NDArray[np.int_]:
    """Return the places, of `count` runs in order, of those that are drawn: the first, every k-th, and the last."""
    return np.unique([0, *range(every - 1, count, every), count - 1])


def notes(drawing: Drawing, order: str = "by value") -> list[str]:
    """Return a note if not all runs are drawn."""
    every, count = step(drawing), table(drawing).num_rows
    note = f"of {count} runs, the first, the last and every k-th of each experiment, {order}, are drawn: k = {every}"
    return [note] if every > 1 else []
