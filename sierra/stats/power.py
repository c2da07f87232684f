"""The number of runs that a comparison of two groups needs, by resampling a pilot with the tests of `sierra compare`.

For n runs of each group, runs (or pairs of runs with the same seed) are drawn from the pilot with replacement, many times. The
power is the part of these samples in which the test finds a difference: its p value is at most alpha. So no distribution is
assumed. The tests are those of `sierra.stats.comparison.rank_tests`. For more than `EXACT` runs, p values are those of the
normal approximation with a correction for continuity, which is faster, and whose power is lower by at most 0.02. Those of rates
are exact for any number: see `sierra.stats.rates`.

A wanted difference replaces that of the pilot: the second group is shifted. Whole numbers stay whole numbers, because ties
matter to a test by ranks: a part of the runs is shifted by one more. Of values that are 0 or 1, the second group gets another
rate: of pairs, a part of its values is turned into the other one.

Values that are drawn from m values have a variance that is (m − 1)/m of the right one. So the distances from the mean are
first multiplied by √(m/(m − 1)), unless values occur several times (Efron and Tibshirani 1993, An Introduction to the
Bootstrap, 5.3).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import stats

from sierra.errors import UsageError
from sierra.stats import rates
from sierra.stats.comparison import effect_sizes, rank_tests, ties

Floats = npt.NDArray[np.float64]
SEED = 1
RESAMPLES = 2000
"""The number of samples; a power of 0.8 has a standard error of 0.009."""
EXACT = 10
"""The largest number of runs of each group for which p values are exact."""
MOST = 2000
"""The largest number of runs that is answered."""
AT_ONCE = 500_000
"""The largest number of values that are tested at once."""


@dataclass(frozen=True)
class Pilot:
    """The values of two groups, of which the second gets a difference; pairs have the same places."""

    first: Floats
    second: Floats
    paired: bool
    shift: float = 0.0
    """The number that is added to values of the second group."""
    rates: tuple[float, float] | None = None
    """The rates of both groups, if the values are 0 or 1 and get another difference than that of the pilot."""
    rate: bool = False
    """True if the values are those of a rate, which are not compared by ranks."""
    _known: dict[tuple[int, float, bool], float] = field(default_factory=dict)

    @property
    def test(self) -> str:
        """Return the name of the test."""
        if self.rate:
            return "McNemar's exact test" if self.paired else "Fisher's exact test"
        return "Wilcoxon signed-rank test" if self.paired else "Mann-Whitney test"

    @cached_property
    def spread(self) -> float:
        """The size of differences; values are rounded relative to it."""
        every = [self.second - self.first] if self.paired else [self.first, self.second]
        return ties.spread(every) or float(np.abs(np.concatenate(every)).max())

    def power(self, n: int, alpha: float) -> float:
        """Return the probability that n runs of each group show a difference."""
        return self._power(n, alpha, exact=n <= EXACT)

    def runs(self, wanted: float, alpha: float) -> int | None:
        """Return the smallest number of runs of each group with this power; None if it is above `MOST`.

        It is searched by approximate p values, and then corrected by those of `power`.
        """
        low, high = 1, 2
        while self._power(high, alpha) < wanted:
            if high >= MOST:
                return None
            low, high = high, min(2 * high, MOST)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._power(middle, alpha) >= wanted else (middle, high)
        while self.power(high, alpha) < wanted:
            high += 1
        while high > 2 and self.power(high - 1, alpha) >= wanted:
            high -= 1
        return high

    def _power(self, n: int, alpha: float, *, exact: bool = False) -> float:
        key = n, alpha, exact
        if key not in self._known:
            first, second = self._draw(n)
            rows = range(0, RESAMPLES, max(1, AT_ONCE // n))
            parts = [self._p(first[row : row + rows.step], second[row : row + rows.step], exact=exact) for row in rows]
            self._known[key] = float(np.mean(np.concatenate(parts) <= alpha))
        return self._known[key]

    def _draw(self, n: int) -> tuple[Floats, Floats]:
        """Return samples of both groups: a row for each sample, a column for each run."""
        random = np.random.default_rng(SEED)
        if self.rates is not None and self.paired:
            places = random.integers(len(self.first), size=(RESAMPLES, n))
            return self.first[places], _turned(self.second[places], float(self.second.mean()), self.rates[1], random)
        if self.rates is not None:
            first, second = (random.random((RESAMPLES, n)) < rate for rate in self.rates)
            return first.astype(float), second.astype(float)
        places = random.integers(len(self.first), size=(RESAMPLES, n))
        others = places if self.paired else random.integers(len(self.second), size=(RESAMPLES, n))
        shift: float | Floats = self.shift
        if _whole(self.first) and _whole(self.second):
            shift = np.floor(self.shift) + (random.random((RESAMPLES, n)) < self.shift - np.floor(self.shift))
        return self.first[places], self.second[others] + shift

    def _p(self, first: Floats, second: Floats, *, exact: bool) -> Floats:
        """Return the p value of each sample."""
        if self.rate:
            return self._p_of_rates(first, second)
        if self.paired:
            differences = ties.rounded(second - first, self.spread)
            if exact:
                return np.array([rank_tests.signed_rank(row) for row in differences])
            with np.errstate(invalid="ignore"):  # all differences are 0
                return _valid(
                    stats.wilcoxon(differences, zero_method="pratt", correction=True, method="asymptotic", axis=1).pvalue
                )
        first, second = ties.rounded(first, self.spread), ties.rounded(second, self.spread)
        if exact:
            return np.array([rank_tests.rank_sum(x, y) for x, y in zip(first, second, strict=True)])
        with np.errstate(invalid="ignore"):  # all values are equal
            return _valid(stats.mannwhitneyu(second, first, axis=1, method="asymptotic").pvalue)

    def _p_of_rates(self, first: Floats, second: Floats) -> Floats:
        """Return the p value of each sample of rates; samples with the same numbers of successes have the same one."""
        n, one, other = first.shape[1], first > 0, second > 0
        parts = (one & ~other, other & ~one) if self.paired else (one, other)
        counts, places = np.unique(np.column_stack([part.sum(axis=1) for part in parts]), axis=0, return_inverse=True)
        return np.array([self._p_of_counts(left, right, n) for left, right in counts.tolist()])[places]

    def _p_of_counts(self, first: int, second: int, n: int) -> float:
        if self.paired:
            return rates.mcnemar(rates.Pairs(0, first, second, n - first - second))
        return rates.fisher((first, n), (second, n))


def of_groups(first: Floats, second: Floats, difference: float | None, *, paired: bool, rate: bool = False) -> Pilot:
    """Return the pilot of two groups with their own or a wanted difference. Raises UsageError for an impossible rate."""
    if difference is not None and _binary(first) and _binary(second):
        return _of_rates(first, second, float(first.mean()), difference, paired=paired and rate, rate=rate)
    if rate:
        return Pilot(first, second, paired, rate=True)
    shift = 0.0 if difference is None else difference - difference_of(first, second, paired=paired)
    if paired:
        first, second = np.zeros(len(first)), ties.differences(first, second)[0]
    else:
        first, second = _alike(first, second)
    return Pilot(*_widened(first, second, paired=paired), paired, shift)


def difference_of(first: Floats, second: Floats, *, paired: bool) -> float:
    """Return the difference of two groups as a comparison estimates it: that of the rates, if all values are 0 or 1."""
    if _binary(first) and _binary(second):
        return float(second.mean() - first.mean())
    if paired:
        return effect_sizes.of_pairs(ties.differences(first, second)[0], 0.05).value
    return effect_sizes.of_samples(*_alike(first, second), 0.05).value


def of_one_group(values: Floats, difference: float, *, rate: bool = False) -> Pilot:
    """Return the pilot of a group and of another one that differs only by this difference; their runs are no pairs."""
    if _binary(values):
        return _of_rates(values, values, float(values.mean()), difference, paired=False, rate=rate)
    (values,), _ = ties.alike([values])
    return Pilot(*_widened(values, values, paired=False), paired=False, shift=difference)


def _of_rates(first: Floats, second: Floats, before: float, difference: float, *, paired: bool, rate: bool) -> Pilot:
    if not 0 <= before + difference <= 1:
        raise UsageError(f"a rate of {before:.4g} cannot differ by {difference:g}: rates are from 0 to 1")
    return Pilot(first, second, paired, rates=(before, before + difference), rate=rate)


def _turned(values: Floats, rate: float, wanted: float, random: np.random.Generator) -> Floats:
    """Return values that are 0 or 1 with another rate, by turning a part of one of them."""
    more = wanted > rate
    part = (wanted - rate) / (1 - rate) if more else (rate - wanted) / rate if rate else 0.0
    return np.where((values != more) & (random.random(values.shape) < part), float(more), values)


def _alike(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    (first, second), _ = ties.alike([first, second])
    return first, second


def _widened(first: Floats, second: Floats, *, paired: bool) -> tuple[Floats, Floats]:
    """Return values of which samples have the right variance; of pairs, the differences have it."""
    if paired:
        return first, first + _wide(second - first)
    return _wide(first), _wide(second)


def _wide(values: Floats) -> Floats:
    m, mean = len(values), values.mean()
    if m < 2 or len(np.unique(values)) < m:
        return values
    wide: Floats = mean + (values - mean) * np.sqrt(m / (m - 1))
    return wide


def _binary(values: Floats) -> bool:
    return bool(np.isin(values, (0, 1)).all())


def _whole(values: Floats) -> bool:
    return bool((values == np.round(values)).all())


def _valid(p: Floats) -> Floats:
    """Return p values, with 1 where all values are equal and there is none."""
    return np.where(np.isnan(p), 1.0, p)
