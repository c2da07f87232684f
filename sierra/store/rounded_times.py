"""Times that differ by rounding only are one time: i · 0.1, a running sum of 0.1, and the same numbers as float32.

Two times of different runs of a batch are one time if they differ by at most `PART` of the smallest step of either run. So no
two times of one run ever become one. The time that is shown is the shortest decimal among them. SQL shows the times as written.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Floats = npt.NDArray[np.float64]

PART = 1e-3
ROUNDING = 1e-9
"""The largest difference between a time and the same time as a person writes it, as a part of the time."""

SHARED = """
SELECT (SELECT count(DISTINCT t) FROM ({rows}))
    <= (SELECT max(rows) FROM (SELECT count(DISTINCT t) AS rows FROM ({rows}) GROUP BY experiment, run, robot))
"""
"""True if the longest run has all times of all runs; then no two times need to be compared."""
STEPS = """
WITH times AS (SELECT DISTINCT run, robot, t FROM ({rows}) WHERE t IS NOT NULL),
steps AS (
    SELECT run, robot, min(step) AS step FROM (
        SELECT run, robot, t - lag(t) OVER (PARTITION BY run, robot ORDER BY t) AS step FROM times
    ) GROUP BY run, robot
)
SELECT t, min(step) AS step FROM times JOIN steps ON times.run = steps.run AND times.robot IS NOT DISTINCT FROM steps.robot
GROUP BY t ORDER BY t
"""
"""Each time with the smallest step of the runs that have it."""


def rows(data: str, time: str, robot: str) -> str:
    """Return the query for the times of each run; `robot` is the column of its robots, or "".

    `time` is an SQL expression.
    """
    keys = f'"# experiment" AS experiment, run, {robot or "NULL::INTEGER"} AS robot'
    return f"SELECT {keys}, CASE WHEN isfinite({time}) THEN {time} END AS t FROM {data}"


def at_time(time: float) -> str:
    """Return the SQL condition that a row has a time that a person wrote."""
    return f'abs("# t" - {time!r}) <= {abs(time) * ROUNDING!r}'


def same(times: Floats, steps: Floats) -> Iterator[tuple[float, float]]:
    """Yield each time that differs from another by rounding only, with the time that is shown instead of both.

    `times` ascend; `steps` are the smallest steps of their runs, NaN for runs of a single time, which may differ by `ROUNDING`.
    """
    import numpy as np

    limits = np.where(np.isnan(steps), ROUNDING * np.abs(times), PART * steps)
    near = np.diff(times) <= np.fmin(limits[:-1], limits[1:])
    next_index = 0
    for first in np.flatnonzero(near).tolist():
        if first < next_index:
            continue
        last, limit = first, limits[first]
        while last < len(near) and near[last] and times[last + 1] - times[first] <= np.fmin(limit, limits[last + 1]):
            last += 1
            limit = np.fmin(limit, limits[last])
        next_index = max(last, first + 1)
        group = times[first : last + 1].tolist()
        shown = min(group, key=lambda time: (len(repr(time)), time))
        yield from ((time, shown) for time in group if time != shown)
