"""Times until a threshold, of which some are censored: the Kaplan-Meier curve, its median, and the restricted mean.

A run that never reaches the threshold is censored at its last time: its own time is unknown, but later. To leave such runs
out would make times look shorter than they are. At the times tᵢ, dᵢ runs reach the threshold, out of nᵢ that have not reached
it before and are not censored before. The part of the runs that has not reached it is (Kaplan and Meier 1958, J. Am. Stat.
Assoc. 53: 457-481)

    S(t) = Π (1 − dᵢ / nᵢ) over tᵢ ≤ t

Its interval is S^exp(± z · √V / log S) with Greenwood's V = Σ dᵢ / (nᵢ · (nᵢ − dᵢ)), which stays within 0 … 1 (Kalbfleisch and
Prentice 1980). It is undefined where S is 0 or 1.

The median is the first time at which S ≤ ½; if S is exactly ½ until the next tᵢ, it is the middle of both, as for a sample
without censored times. Its interval is from the first time at which the lower end is ≤ ½ to the first at which the upper end
is ≤ ½ (Brookmeyer and Crowley 1982, Biometrics 38: 29-41). It may have no upper end.

The restricted mean is the mean of min(T, τ), the time that a run takes, but τ at most. It is the area under S up to τ. Its
variance is n / (n − 1) · Σ (area from tᵢ to τ)² · dᵢ / (nᵢ · (nᵢ − dᵢ)), and its interval is Student's t interval with n − 1
degrees of freedom. If no run is censored before τ, both are exactly those of the mean of min(T, τ).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from statistics import NormalDist
from typing import TYPE_CHECKING

from sierra.stats import student_t
from sierra.stats.aggregate import HERE, Column
from sierra.stats.base import LEVEL, Estimate
from sierra.stats.selection import with_estimates
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    import pyarrow as pa

STATISTICS: Mapping[str, str] = {"km_median": "log-log", "restricted_mean": "t"}
"""The statistics of times with censored ones, and the methods of their intervals."""
HALF = 0.5
ROUNDING = 1e-12
"""The largest difference of S from ½ that is due to rounding."""


@dataclass(frozen=True, slots=True)
class Time:
    """The time of one run: at which it reached the threshold, or after which nothing is known of it."""

    time: float
    reached: bool


@dataclass(frozen=True, slots=True)
class Step:
    """The curve from one time on, until the next step."""

    time: float
    at_risk: int
    """The number of runs that had not reached the threshold before, and were not censored before."""
    reached: int
    """The number of runs that reached it at this time."""
    censored: int
    """The number of runs of which nothing is known after this time."""
    remaining: float
    """S: the part of the runs that has not reached the threshold."""
    low: float | None
    high: float | None


def statement() -> str:
    """Return the statement that selects the times of the runs."""
    return (HERE / "censored_times.sql").read_text(encoding="utf-8")


def times(column: Column, threshold: float) -> dict[int, tuple[Time, ...]]:
    """Return the times of all runs that have a value, by experiment, in ascending order."""
    rows = column.sql(statement(), threshold=threshold).to_pylist()
    by_experiment = groupby(rows, key=lambda row: int(row["experiment"]))
    return {experiment: tuple(Time(row["time"], row["reached"]) for row in runs) for experiment, runs in by_experiment}


def curve(runs: Iterable[Time]) -> tuple[Step, ...]:
    """Return the Kaplan-Meier curve: a step for each time at which runs reach the threshold, or are censored."""
    ordered = sorted(runs, key=lambda run: run.time)
    left, remaining, variance = len(ordered), 1.0, 0.0
    steps = []
    for time, group in groupby(ordered, key=lambda run: run.time):
        at = list(group)
        reached = sum(run.reached for run in at)
        remaining *= (left - reached) / left
        variance += reached / (left * (left - reached)) if reached < left else 0.0
        low, high = _interval(remaining, variance)
        steps.append(Step(time, left, reached, len(at) - reached, remaining, low, high))
        left -= len(at)
    return tuple(steps)


def _interval(remaining: float, variance: float) -> tuple[float | None, float | None]:
    if not 0 < remaining < 1:
        return None, None
    wide = NormalDist().inv_cdf((1 + LEVEL) / 2) * math.sqrt(variance) / -math.log(remaining)
    return remaining ** math.exp(wide), remaining ** math.exp(-wide)


def median(steps: Sequence[Step]) -> Estimate:
    """Return the median time with its interval; None if fewer than half of the runs reach the threshold."""
    events = [step for step in steps if step.reached]
    value = None
    for index, step in enumerate(events):
        if step.remaining <= HALF + ROUNDING:
            flat = step.remaining > HALF - ROUNDING and index + 1 < len(events)
            value = (step.time + events[index + 1].time) / 2 if flat else step.time
            break
    low, high = (_first(step.time for step in events if _at_most_half(end(step))) for end in (_low, _high))
    return Estimate(value, low if value is not None else None, high if value is not None else None)


def _low(step: Step) -> float | None:
    return step.low


def _high(step: Step) -> float | None:
    return step.high


def _at_most_half(end: float | None) -> bool:
    return end is not None and end <= HALF


def _first(ascending: Iterable[float]) -> float | None:
    return next(iter(ascending), None)


def horizon(curves: Iterable[Sequence[Step]]) -> float:
    """Return the largest τ up to which all curves are known. A curve that is 0 is known forever. There must be a step."""
    ends = [(steps[-1].time, steps[-1].remaining > 0) for steps in curves if steps]
    return min((time for time, more in ends if more), default=max(time for time, _ in ends))


def restricted_mean(steps: Sequence[Step], until: float, origin: float = 0.0) -> Estimate:
    """Return the mean of min(time, `until`) since `origin`, with its interval; none if all runs have the same time."""
    if not steps:
        return Estimate(None)
    n = steps[0].at_risk
    shown = [step for step in steps if step.time <= until]
    starts = [origin, *(step.time for step in shown)]
    heights = [1.0, *(step.remaining for step in shown)]
    pieces = [
        height * (stop - start)
        for height, start, stop in zip(heights, starts, [*starts[1:], max(until, starts[-1])], strict=True)
    ]
    value = math.fsum(pieces)
    after = [math.fsum(pieces[index + 1 :]) for index in range(len(shown))]
    variance = math.fsum(
        area * area * step.reached / (step.at_risk * (step.at_risk - step.reached))
        for area, step in zip(after, shown, strict=True)
        if step.reached < step.at_risk
    )
    if n < 2 or variance == 0:
        return Estimate(value)
    half = student_t.quantile((1 + LEVEL) / 2, n - 1) * math.sqrt(variance * n / (n - 1))
    return Estimate(value, max(min(origin, value), value - half), min(max(until, value), value + half))


def estimates(curves: Mapping[int, Sequence[Step]], name: str) -> dict[int, Estimate]:
    """Return one of `STATISTICS` for each curve. The restricted means have the same τ, that of `horizon`."""
    if name == "km_median":
        return {experiment: median(steps) for experiment, steps in curves.items()}
    until = horizon(curves.values())
    origin = min(0.0, *(steps[0].time for steps in curves.values()))
    return {experiment: restricted_mean(steps, until, origin) for experiment, steps in curves.items()}


def with_statistics(table: pa.Table, curves: Mapping[int, Sequence[Step]], names: Iterable[str]) -> pa.Table:
    """Return a table of experiments with the columns of these statistics."""
    for name in names:
        of_experiments = estimates(curves, name) if curves else {}
        rows = [of_experiments.get(experiment, Estimate(None)) for experiment in table.column("experiment").to_pylist()]
        table = with_estimates(table, name, rows, STATISTICS[name])
    return table


def curves_table(curves: Mapping[int, Sequence[Step]]) -> pa.Table:
    """Return all curves: `experiment`, `t`, and the fields of `Step`."""
    import pyarrow as pa

    rows = [(experiment, step) for experiment, steps in sorted(curves.items()) for step in steps]
    counts = {
        name: pa.array([getattr(step, name) for _, step in rows], pa.int64()) for name in ("at_risk", "reached", "censored")
    }
    parts = {name: pa.array([getattr(step, name) for _, step in rows], pa.float64()) for name in ("remaining", "low", "high")}
    keys = {
        "experiment": pa.array([experiment for experiment, _ in rows], pa.int32()),
        "t": pa.array([step.time for _, step in rows], pa.float64()),
    }
    return pa.table({**keys, **counts, **parts})
