"""Rates: Wilson's interval of one, Newcombe's of the difference of two, and exact tests of whether rates differ.

With the rates p₁ = r₁/n₁ and p₂ = r₂/n₂ and their intervals [l₁, u₁] and [l₂, u₂] (Wilson 1927, J. Am. Stat. Assoc. 22:
209-212), the interval of p₂ − p₁ is (Newcombe 1998, Stat. Med. 17: 873-890, method 10)

    p₂ − p₁ − √((p₂ − l₂)² + (u₁ − p₁)²)   to   p₂ − p₁ + √((u₂ − p₂)² + (p₁ − l₁)²)

For n pairs, each sum of squares a² + b² becomes a² − 2φab + b² (Newcombe 1998, Stat. Med. 17: 2635-2650, method 10). φ is the
correlation of the two in the table of pairs, with a correction for continuity: its numerator is lessened by n/2, but not
below 0, if it is positive.

The tests are Fisher's (two groups), McNemar's (pairs), that of Freeman and Halton (several groups; Biometrika 1951, 38:
141-149), all exact, and Cochran's Q (several groups with common blocks; Biometrika 1950, 37: 256-266). Fisher's and that of
Freeman and Halton add the probabilities of all tables with the same sums that are at most that of the observed one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

RUNS = 1_000
"""The largest number of runs for which the test of Freeman and Halton may be exact: it needs longer for more."""
STATES = 30_000
"""The largest number of different tables for which the test of Freeman and Halton is exact."""
DRAWS = 100_000
SEED = 1
"""The number of tables that are drawn instead, and the seed."""
LARGEST_Z = 40.0
"""The quantile of the normal distribution above which no probability is left."""


class Interval(NamedTuple):
    """A value with its interval."""

    value: float
    low: float
    high: float


class Pairs(NamedTuple):
    """The numbers of pairs by what is true in them."""

    both: int
    first: int
    """Only the first one."""
    second: int
    """Only the second one."""
    neither: int

    @property
    def n(self) -> int:
        """Return the number of pairs."""
        return sum(self)


def center_and_half(rate: float, n: int, z: float) -> tuple[float, float]:
    """Return the center and the half-width of Wilson's interval."""
    scale = 1 + z * z / n
    return (rate + z * z / (2 * n)) / scale, z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n)) / scale


def wilson(successes: int, n: int, z: float) -> Interval:
    """Return a rate with Wilson's interval; `z` is the quantile of the normal distribution."""
    center, half = center_and_half(successes / n, n, z)
    low = 0.0 if successes == 0 else max(0.0, center - half)
    return Interval(successes / n, low, 1.0 if successes == n else min(1.0, center + half))


def square_and_add(first: Interval, second: Interval, phi: float = 0.0) -> Interval:
    """Return the difference `second` − `first` with its interval, from the intervals of both and their correlation."""
    difference = second.value - first.value
    below = _length(second.value - second.low, first.high - first.value, phi)
    above = _length(second.high - second.value, first.value - first.low, phi)
    return Interval(difference, difference - below, difference + above)


def of_samples(first: tuple[int, int], second: tuple[int, int], z: float) -> Interval:
    """Return the difference of two rates with Newcombe's interval; each is the number of successes and n."""
    return square_and_add(wilson(*first, z), wilson(*second, z))


def of_pairs(pairs: Pairs, z: float) -> Interval:
    """Return the difference of two rates of pairs with Newcombe's interval."""
    n = pairs.n
    first, second = wilson(pairs.both + pairs.first, n, z), wilson(pairs.both + pairs.second, n, z)
    return square_and_add(first, second, _phi(pairs))


def _length(a: float, b: float, phi: float) -> float:
    return math.sqrt(max(0.0, a * a - 2 * phi * a * b + b * b))


def _phi(pairs: Pairs) -> float:
    a, b, c, d = pairs
    scale = (a + b) * (c + d) * (a + c) * (b + d)
    numerator = a * d - b * c
    corrected = max(0.0, numerator - pairs.n / 2) if numerator > 0 else numerator
    return corrected / math.sqrt(scale) if scale else 0.0


def within(interval: Callable[[float], Interval], margin: float) -> float:
    """Return the p value of the claim that a difference is within ±margin: half of alpha of the narrowest interval outside.

    `interval` returns the interval for a quantile of the normal distribution.
    """
    if abs(interval(0.0).value) >= margin:
        return 1.0
    low, high = 0.0, LARGEST_Z
    for _ in range(60):
        z = (low + high) / 2
        estimate = interval(z)
        low, high = (z, high) if -margin < estimate.low and estimate.high < margin else (low, z)
    return math.erfc(low / math.sqrt(2)) / 2 if low < LARGEST_Z * (1 - 1e-9) else 0.0


def fisher(first: tuple[int, int], second: tuple[int, int]) -> float:
    """Return the two-sided p value of Fisher's exact test; each is the number of successes and n."""
    from scipy import stats

    return min(1.0, float(stats.fisher_exact([[k, n - k] for k, n in (first, second)]).pvalue))


def smallest_fisher(first: int, second: int) -> float:
    """Return the smallest p value that Fisher's test can have with these numbers of runs."""
    return min(1.0, (2 if first == second else 1) / math.comb(first + second, first))


def mcnemar(pairs: Pairs) -> float:
    """Return the two-sided p value of McNemar's exact test."""
    from scipy import stats

    few, discordant = min(pairs.first, pairs.second), pairs.first + pairs.second
    return min(1.0, 2 * float(stats.binom.cdf(few, discordant, 0.5))) if discordant else 1.0


def freeman_halton(groups: Sequence[tuple[int, int]]) -> tuple[float, bool]:
    """Return the p value of the test of Freeman and Halton, and whether it is exact; else, it is one of drawn tables.

    Each group is the number of successes and n.
    """
    if sum(n for _, n in groups) > RUNS:
        return _drawn(groups), False
    successes = sum(k for k, _ in groups)
    observed = math.prod(math.comb(n, k) for k, n in groups)
    states = {(0, 1): 1}
    """The number of tables by their successes and their product of binomial coefficients, group after group."""
    left = sum(n for _, n in groups)
    for _, n in groups:
        left -= n
        grown: dict[tuple[int, int], int] = {}
        ways = [math.comb(n, own) for own in range(n + 1)]
        for (before, product), count in states.items():
            if len(grown) > STATES:
                return _drawn(groups), False
            for own in range(max(0, successes - before - left), min(n, successes - before) + 1):
                key = (before + own, product * ways[own])
                grown[key] = grown.get(key, 0) + count
        states = grown
    every = math.comb(sum(n for _, n in groups), successes)
    return sum(product * count for (_, product), count in states.items() if product <= observed) / every, True


def _drawn(groups: Sequence[tuple[int, int]]) -> float:
    """Return the part of drawn tables, and of the observed one, whose probability is at most that of the observed one."""
    import numpy as np
    from scipy import special

    observed, n = (np.array(numbers) for numbers in zip(*groups, strict=True))
    tables = np.random.default_rng(SEED).multivariate_hypergeometric(n, int(observed.sum()), DRAWS)
    every = np.vstack([observed, tables])
    logarithms = -(special.gammaln(every + 1) + special.gammaln(n - every + 1)).sum(axis=1)
    return float(np.mean(logarithms <= logarithms[0] + 1e-9))


def cochran(blocks: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the statistic and the p value of Cochran's Q; a row of 0 and 1 for each block, a column for each group."""
    from scipy import special

    k = len(blocks[0])
    columns, rows = [sum(column) for column in zip(*blocks, strict=True)], [sum(row) for row in blocks]
    total = sum(rows)
    spread = k * total - sum(row * row for row in rows)
    if spread == 0:
        return 0.0, 1.0
    q = (k - 1) * (k * sum(column * column for column in columns) - total * total) / spread
    return q, float(special.chdtrc(k - 1, q))
