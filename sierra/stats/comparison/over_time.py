"""The difference of two groups over time: its mean and interval at each time.

The interval is Student's: of the differences of pairs, or of two samples with unequal variances (Welch 1947, Biometrika 34:
28-35). It holds at each time by itself. At 500 times, some of these intervals miss zero although there is no difference. They
are no tests. The test of a comparison over time is that of the mean of each run's rows, or of its time mean.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from sierra.model import Value
from sierra.stats.comparison.rank_tests import Floats
from sierra.util.lazy_definitions import dataclass

Series = Mapping[int, Floats]
"""The values of runs at common times, by seed; NaN where a run has none."""


@dataclass(frozen=True, slots=True)
class Band:
    """The difference `second` minus `first` in one cell at each time; NaN where fewer than two runs have a value."""

    point: Mapping[str, Value]
    first: str
    second: str
    times: Floats
    mean: Floats
    low: Floats
    high: Floats


def of_pairs(first: Series, second: Series, alpha: float) -> tuple[Floats, Floats, Floats]:
    """Return the mean and the ends of the interval of the differences of runs with the same seed."""
    from scipy import stats

    seeds = sorted(first.keys() & second.keys())
    mean, variance, n = _moments(np.array([second[seed] - first[seed] for seed in seeds]))
    half = stats.t.ppf(1 - alpha / 2, np.maximum(n - 1, 1)) * np.sqrt(variance / np.maximum(n, 1))
    return _known(mean, half, n)


def of_samples(first: Series, second: Series, alpha: float) -> tuple[Floats, Floats, Floats]:
    """Return the difference of the means, and the ends of its interval, without pairs."""
    from scipy import stats

    (mean, variance, n), (other, spread, m) = (_moments(np.array(list(one.values()))) for one in (first, second))
    errors = variance / np.maximum(n, 1), spread / np.maximum(m, 1)
    total = errors[0] + errors[1]
    parts = errors[0] ** 2 / np.maximum(n - 1, 1) + errors[1] ** 2 / np.maximum(m - 1, 1)
    df = np.where(parts > 0, total**2 / np.where(parts > 0, parts, 1), 1)
    return _known(other - mean, stats.t.ppf(1 - alpha / 2, df) * np.sqrt(total), np.minimum(n, m))


def _moments(values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return mean, variance and number of the finite values in each column."""
    finite = np.isfinite(values)
    n = finite.sum(axis=0).astype(float)
    some = np.maximum(n, 1)
    mean = np.where(finite, values, 0).sum(axis=0) / some
    squares = np.where(finite, values - mean, 0) ** 2
    return mean, squares.sum(axis=0) / np.maximum(n - 1, 1), n


def _known(mean: Floats, half: Floats, n: Floats) -> tuple[Floats, Floats, Floats]:
    enough = n >= 2
    center, spread = np.where(enough, mean, math.nan), np.where(enough, half, math.nan)
    return center, center - spread, center + spread
