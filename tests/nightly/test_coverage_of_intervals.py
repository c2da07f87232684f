"""Intervals contain the true value as often as they say, in simulated experiments whose true value is known.

The exact coverage of order statistics is computed; that of the others was found here, and is the smallest that is accepted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import scipy.stats

from sierra.stats.order_statistics import ranks
from sierra.stats.selection import Selection
from tests.samples import Memory, samples

SEED = 7
Floats = npt.NDArray[np.float64]
Draw = Callable[[np.random.Generator, tuple[int, int]], Floats]

NORMAL: Any = scipy.stats.norm()
EXPONENTIAL: Any = scipy.stats.expon()
UNIFORM: Any = scipy.stats.uniform()


def coverage(name: str, truth: float, values: Floats, *, rate: bool = False) -> float:
    """Return how often the interval contains the true value; a row of values is an experiment."""
    rows = ((e, run, 0.0, value) for e, row in enumerate(values.tolist()) for run, value in enumerate(row))
    table, _ = samples(Memory(rows), rate=rate).by_experiment("final", Selection.of([name], {}))
    low, high = (table.column(f"{name}_{end}").to_numpy() for end in ("low", "high"))
    assert np.isfinite(low).all()
    return float(np.mean((low <= truth) & (truth <= high)))


def drawn(distribution: Any, experiments: int, n: int) -> Floats:
    found: Floats = distribution.rvs(size=(experiments, n), random_state=np.random.default_rng(SEED))
    return found


def error(p: float, experiments: int) -> float:
    """Return four standard errors of a simulated coverage."""
    return 4 * math.sqrt(p * (1 - p) / experiments)


@pytest.mark.parametrize("n", [2, 5, 10, 50])
def test_students_interval_covers_the_mean_of_normal_values(n: int) -> None:
    assert coverage("mean", 0.0, drawn(NORMAL, 4000, n)) == pytest.approx(0.95, abs=error(0.95, 4000))


@pytest.mark.parametrize(("n", "least"), [(5, 0.86), (10, 0.88), (30, 0.91), (100, 0.93)])
def test_students_interval_of_skewed_values_is_a_little_too_narrow(n: int, least: float) -> None:
    found = coverage("mean", 1.0, drawn(EXPONENTIAL, 4000, n))
    assert least <= found <= 0.95 + error(0.95, 4000)


@pytest.mark.parametrize("distribution", [NORMAL, EXPONENTIAL, UNIFORM])
@pytest.mark.parametrize(("name", "n"), [("median", 6), ("median", 10), ("median", 51), ("q90", 36), ("q90", 100), ("q25", 20)])
def test_order_statistics_cover_quantiles_of_any_distribution(name: str, n: int, distribution: Any) -> None:
    p = {"median": 0.5, "q90": 0.9, "q25": 0.25}[name]
    lower, upper = ranks(p, n, 0.05)
    low, high = lower[-1], upper[-1]
    assert low is not None
    assert high is not None
    exact = float(scipy.stats.binom.cdf(high - 1, n, p) - scipy.stats.binom.cdf(low - 1, n, p))
    assert exact >= 0.95
    assert coverage(name, distribution.ppf(p), drawn(distribution, 4000, n)) == pytest.approx(exact, abs=error(exact, 4000))


@pytest.mark.parametrize(("p", "n"), [(0.1, 10), (0.5, 10), (0.3, 40), (0.02, 100)])
def test_wilsons_interval_covers_a_rate_as_often_as_its_formula_says(p: float, n: int) -> None:
    good = np.arange(n + 1)
    inside = [
        interval.low <= p <= interval.high
        for interval in (scipy.stats.binomtest(k, n).proportion_ci(0.95, method="wilson") for k in good.tolist())
    ]
    exact = float(scipy.stats.binom.pmf(good, n, p)[inside].sum())
    values = (np.random.default_rng(SEED).random((4000, n)) < p).astype(float)
    assert coverage("mean", p, values, rate=True) == pytest.approx(exact, abs=error(exact, 4000))


@pytest.mark.parametrize(("n", "least"), [(4, 0.89), (8, 0.92), (20, 0.93), (100, 0.935)])
def test_the_interval_of_a_trimmed_mean_covers_that_of_normal_values(n: int, least: float) -> None:
    assert coverage("iqm", 0.0, drawn(NORMAL, 4000, n)) >= least


@pytest.mark.parametrize(
    ("distribution", "n", "least"),
    [
        (NORMAL, 5, 0.94),
        (NORMAL, 10, 0.94),
        (NORMAL, 50, 0.93),
        (UNIFORM, 10, 0.94),
        (EXPONENTIAL, 10, 0.86),
        (EXPONENTIAL, 50, 0.87),
    ],
)
def test_bonetts_interval_covers_the_standard_deviation(distribution: Any, n: int, least: float) -> None:
    assert coverage("sd", distribution.std(), drawn(distribution, 4000, n)) >= least


def deviation(distribution: Any) -> float:
    """Return the true median absolute deviation from the median."""
    center = distribution.ppf(0.5)

    def inside(d: float) -> float:
        return float(distribution.cdf(center + d) - distribution.cdf(center - d) - 0.5)

    low, high = 0.0, 10.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if inside(middle) < 0 else (low, middle)
    return low


@pytest.mark.parametrize("distribution", [NORMAL, EXPONENTIAL, UNIFORM])
@pytest.mark.parametrize(("n", "least"), [(10, 0.84), (20, 0.89), (50, 0.9)])
def test_the_bootstrap_covers_the_interquartile_range_and_the_deviation_from_the_median(
    distribution: Any, n: int, least: float
) -> None:
    values = drawn(distribution, 400, n)
    assert coverage("iqr", distribution.ppf(0.75) - distribution.ppf(0.25), values) >= least
    assert coverage("mad", deviation(distribution), values) >= least
