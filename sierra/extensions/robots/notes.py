"""Notes about the robots of runs: clocks that were set, changed firmware or calibrations, and the limits of replays."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import NamedTuple

from sierra.store.store import Store
from sierra.util.text import counted, few

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
NAMES = """
SELECT DISTINCT robot FROM robots r JOIN executions e USING (execution)
WHERE list_contains($runs, e.run) AND e.purpose = 'run' ORDER BY robot
"""
OPERATORS = """
SELECT DISTINCT operator FROM all_trials t JOIN executions e USING (execution)
WHERE list_contains($runs, e.run) AND operator IS NOT NULL ORDER BY operator
"""
SHOWN = 5


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


def of_batch(store: Store, batch: str) -> Iterator[str]:
    """Yield what the user must know about the robots of a batch's effective executions."""
    for moved in store.select(_Moved, MOVED, batch=batch):
        runs = counted(moved.runs, "run")
        yield f"{moved.robot}: stamps of {runs} cannot be converted to one time axis (robot_clocks.remark): {moved.example}"
    for one in store.select(_Changed, CHANGED, batch=batch):
        yield f"{one.robot}: its {one.kind} differs between runs of this batch: {', '.join(one.versions)}"


def of_replay(store: Store, runs: Collection[str], judged: bool) -> str:
    """Return a note on what a replay of runs shows. `judged`: metrics are compared statistically."""
    names, operators = (store.values(str, text, runs=list(runs)) for text in (NAMES, OPERATORS))
    robots = f"the robots ({few(names, SHOWN)})" if names else "the robots"
    people = f" and their operator ({few(operators, SHOWN)})" if operators else " and their operator"
    how = "" if judged else "; [equivalence] in sierra.toml says which metrics must be equivalent, and by which margin"
    return (
        f"{robots}{people}, their batteries, poses and surroundings cannot be replayed: the same code, commands and inputs are "
        f"executed again, so other numbers are to be expected{how}"
    )
