"""Notes about the robots of a batch: clocks that were set during a run, and firmware or calibrations that have changed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from sierra.store.store import Store
from sierra.util.text import counted

MOVED = """
WITH counting AS (SELECT execution FROM effective WHERE batch = $batch)
SELECT robot, count(*) AS runs, any_value(clock_remark ORDER BY execution) AS example
FROM robots SEMI JOIN counting USING (execution) WHERE clock_remark IS NOT NULL GROUP BY robot ORDER BY robot
"""
CHANGED = """
WITH counting AS (SELECT execution FROM effective WHERE batch = $batch)
SELECT robot, 'firmware' AS kind, list_sort(list(DISTINCT firmware)) AS versions
FROM robots SEMI JOIN counting USING (execution) GROUP BY robot HAVING count(DISTINCT firmware) > 1
UNION ALL
SELECT robot, 'calibration', list_sort(list(DISTINCT left(calibration_sha256, 12)))
FROM robots SEMI JOIN counting USING (execution) GROUP BY robot HAVING count(DISTINCT calibration_sha256) > 1
ORDER BY robot, kind
"""


class _Moved(NamedTuple):
    """A robot whose clock was set during runs."""

    robot: str
    runs: int
    example: str


class _Changed(NamedTuple):
    """A robot that was not the same in all runs."""

    robot: str
    kind: str
    versions: list[str]


def notes(store: Store, batch: str) -> Iterator[str]:
    """Yield what the user must know about the robots of a batch's effective executions."""
    for moved in store.select(_Moved, MOVED, batch=batch):
        runs = counted(moved.runs, "run")
        yield f"{moved.robot}: stamps of {runs} cannot be converted to one time axis (robot_clocks.remark): {moved.example}"
    for one in store.select(_Changed, CHANGED, batch=batch):
        yield f"{one.robot}: its {one.kind} differs between runs of this batch: {', '.join(one.versions)}"
