"""Sizes of differences: the Hodges-Lehmann estimate with its interval, and Vargha and Delaney's A12.

For n pairs with the differences d, the estimate is the median of the n(n + 1)/2 Walsh averages (dᵢ + dⱼ)/2, i ≤ j. For two
samples without pairs it is the median of all n·m differences yⱼ − xᵢ. The interval has the values that the test does not reject
(Hodges and Lehmann 1963, Ann. Math. Stat. 34: 598-611): from the k-th smallest to the k-th largest of these numbers, with the
largest k for which

    P(T ≤ k − 1) ≤ alpha / 2,    T: the statistic of the test, if there is no difference

The distribution of T is counted for small samples, and normal for others. Without such a k, n is too small for an interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sierra.stats.comparison import rank_distributions
from sierra.stats.comparison.rank_distributions import Floats
from sierra.util.lazy_definitions import dataclass

LISTED = 2_000_000
"""The largest number of averages or differences that are listed; of more, the wanted ones are found by bisection."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """An estimate with the interval of confidence 1 − alpha; without ends if n is too small."""

    value: float
    low: float | None
    high: float | None


def of_pairs(differences: Floats, alpha: float) -> Estimate:
    """Return the estimate from the differences of pairs."""
    d = np.sort(differences)
    n = len(d)
    total = n * (n + 1) // 2
    if total <= LISTED:
        rows, columns = np.triu_indices(n)
        averages = np.sort((d[rows] + d[columns]) / 2)
        return _estimate(lambda k: float(averages[k - 1]), total, _cut_of_pairs(n, alpha))
    places = np.arange(n)

    def up_to(x: float) -> int:
        return int(np.maximum(np.searchsorted(d, 2 * x - d, side="right") - places, 0).sum())

    return _estimate(lambda k: _bisect(up_to, k, float(d[0]), float(d[-1])), total, _cut_of_pairs(n, alpha))


def of_samples(first: Floats, second: Floats, alpha: float) -> Estimate:
    """Return the estimate of how much greater the values of `second` are, without pairs."""
    total = len(first) * len(second)
    cut = _cut_of_samples(len(first), len(second), alpha)
    if total <= LISTED:
        differences = np.sort(np.subtract.outer(second, first), axis=None)
        return _estimate(lambda k: float(differences[k - 1]), total, cut)
    x, y = np.sort(first), np.sort(second)

    def up_to(limit: float) -> int:
        return int(np.searchsorted(y, x + limit, side="right").sum())

    return _estimate(lambda k: _bisect(up_to, k, float(y[0] - x[-1]), float(y[-1] - x[0])), total, cut)


def a12(first: Floats, second: Floats) -> float:
    """Return P(second > first) + P(second = first) / 2 (Vargha and Delaney 2000, J. Educ. Behav. Stat. 25: 101-132)."""
    ranks = rank_distributions.ranked(np.concatenate((first, second)))[len(first) :]
    n, m = len(first), len(second)
    return float((ranks.sum() - m * (m + 1) / 2) / (n * m))


def _estimate(ranked: Callable[[int], float], total: int, cut: int) -> Estimate:
    """Return the median of `total` ordered numbers, and the `cut`-th number from both ends."""
    middle = (ranked((total + 1) // 2) + ranked(total // 2 + 1)) / 2
    return Estimate(middle, ranked(cut), ranked(total + 1 - cut)) if cut else Estimate(middle, None, None)


def _cut_of_pairs(n: int, alpha: float) -> int:
    if n > rank_distributions.PAIRS:
        return _normal_cut(n * (n + 1) / 4, math.sqrt(n * (n + 1) * (2 * n + 1) / 24), alpha)
    return _counted_cut(rank_distributions.of_signs(np.arange(1, n + 1)), alpha)


def _cut_of_samples(n: int, m: int, alpha: float) -> int:
    if n + m > rank_distributions.VALUES:
        return _normal_cut(n * m / 2, math.sqrt(n * m * (n + m + 1) / 12), alpha)
    lowest = m * (m + 1) // 2
    return _counted_cut(rank_distributions.of_choices(np.arange(1, n + m + 1), m)[lowest:], alpha)


def _counted_cut(probabilities: Floats, alpha: float) -> int:
    return int(np.searchsorted(np.cumsum(probabilities), alpha / 2 * (1 + 1e-12), side="right"))


def _normal_cut(mean: float, sd: float, alpha: float) -> int:
    """Return the largest k with P(T ≤ k − 1) ≤ alpha / 2, with a correction for continuity."""
    from scipy import stats

    return max(0, math.floor(mean + float(stats.norm.ppf(alpha / 2)) * sd + 0.5))


def _bisect(up_to: Callable[[float], int], k: int, low: float, high: float) -> float:
    """Return the k-th smallest number between `low` and `high`, if `up_to` counts those that are not greater than a number."""
    while (middle := low + (high - low) / 2) not in (low, high):
        low, high = (low, middle) if up_to(middle) >= k else (middle, high)
    return low if up_to(low) >= k else high
