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
from sierra.deliverables.figures.base import DrawnBy
from sierra.deliverables.figures.style import Floats
from sierra.errors import SierraError, UsageError
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import replace
from sierra.util.text import counted

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing

MOST = 100_000
"""The largest number of runs that are drawn one by one."""


ROWS = 10_000_000
"""The largest number of rows in a figure of rows."""


def of_rows(drawn: DrawnBy) -> DrawnBy:
    """Return functions that draw the rows of the statement `rows` of a kind in the place of its runs."""

    def as_runs(drawing: Drawing) -> Drawing:
        rows = drawing.rows["rows"]
        if not rows.num_rows:
            raise SierraError("there is no value to draw")
        if rows.num_rows > ROWS:
            raise UsageError(f"there are {rows.num_rows:,} rows, but at most {ROWS:,} can be drawn one by one; use where")
        return replace(drawing, runs=rows)

    def notes(drawing: Drawing) -> list[str]:
        rows, of = drawing.rows["rows"].num_rows, drawing.rows["all"].column("count")[0].as_py()
        lost = [f"{of - rows} rows without a value left out"] if rows < of else []
        return [counted(rows, "row"), *lost, *(note for notes_of in drawn.notes for note in notes_of(as_runs(drawing)))]

    return DrawnBy(lambda drawing: drawn.draw(as_runs(drawing)), (notes,))


def is_of_rows(drawing: Drawing) -> bool:
    """Return whether a figure shows rows in the place of runs."""
    return "rows" in drawing.rows


def noun(drawing: Drawing) -> str:
    """Return the word for what is drawn one by one."""
    return "row" if is_of_rows(drawing) else "run"


def table(drawing: Drawing) -> pa.Table:
    """Return the values of all runs. Raises TypeError for a kind that does not need them."""
    if drawing.runs is None:
        raise TypeError(f"a {drawing.figure.kind} figure needs the values of its runs")
    return drawing.runs


def values(drawing: Drawing) -> dict[int, Floats]:
    """Return the values of all runs by experiment, in ascending order; experiments without a value are not in it."""
    runs = table(drawing)
    ordinals, numbers = numpy_of(runs.column("experiment")), style.column(runs, "value")
    order = np.lexsort((numbers, ordinals))
    known, begins = np.unique(ordinals[order], return_index=True)
    return dict(zip(known.tolist(), np.split(numbers[order], begins[1:]), strict=True))


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
    note = (
        f"of {count} {noun(drawing)}s, the first, the last and every k-th of each experiment, {order}, are drawn: k = {every}"
    )
    return [note] if every > 1 else []
