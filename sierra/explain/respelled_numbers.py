"""Note on runs that are new only because a number is written differently than in a recorded batch, such as 0.0 for 0.

Numbers are kept as they are written, because a simulator may distinguish them (roslaunch takes 1 for an int, 1.0 for a
double).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import NamedTuple

from sierra.errors import SierraError
from sierra.execution.plan import Plan
from sierra.execution.session_records import batch_row
from sierra.model import Value
from sierra.query import grammar, ranges
from sierra.store.store import Store
from sierra.util.hashing import short

ALIKE = """
SELECT batch, query FROM batches
WHERE axes = $axes AND spec = $spec AND template_sha256 = $template_sha256 AND base_seed = $base_seed AND overrides = $overrides
    AND controller IS NOT DISTINCT FROM $controller AND scenario IS NOT DISTINCT FROM $scenario
    AND NOT EXISTS (SELECT 1 FROM batches WHERE batch = $batch)
ORDER BY lamport DESC, batch LIMIT $most
"""
SETTINGS = ("axes", "spec", "template_sha256", "base_seed", "overrides", "controller", "scenario", "batch")
SHARED = "SELECT run FROM batch_runs WHERE batch = $batch AND list_contains($runs, run) LIMIT 1"
LOOKED_AT = 100


class Alike(NamedTuple):
    """A recorded batch that differs from the plan at most in the values of its axes."""

    batch: str
    query: str


def respelled(plan: Plan, store: Store) -> Iterator[str]:
    """Yield a note if the runs of a plan are new only because a number is written differently than in a recorded batch."""
    if not any(isinstance(value, int | float) for axis in plan.batch.axes for value in axis.values):
        return
    row = batch_row(plan)
    for before in store.select(Alike, ALIKE, most=LOOKED_AT, **{name: getattr(row, name) for name in SETTINGS}):
        found = _spelled_otherwise(plan, before.query)
        if found is None:
            continue
        name, now, then = found
        runs = [one.runs[0].id for one in plan.batch.experiments if one.values[name] == now]
        if not store.values(str, SHARED, batch=before.batch, runs=runs):
            yield (
                f"{name}={now} is written {then} in batch {short(before.batch)} ({before.query}), "
                f"so the input has different bytes and runs are new; write {name}={then} to reuse the recorded runs"
            )
            return


def _spelled_otherwise(plan: Plan, before: str) -> tuple[str, Value, Value] | None:
    """Return an axis and one of its values, now and in another query, if the same number is written differently; else None."""
    with contextlib.suppress(SierraError):  # densities have values only with a template
        requested = {one.name: ranges.values(one.scale) for one in grammar.parse_all(before.split())}
        for axis in plan.batch.axes:
            theirs = {value: value for value in requested[axis.name]}
            for value in axis.values:
                if str(then := theirs.get(value, value)) != str(value):
                    return axis.name, value, then
    return None
