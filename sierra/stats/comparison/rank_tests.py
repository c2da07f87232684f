"""Tests by ranks: SciPy's, and those that SciPy lacks.

- Wilcoxon's signed-rank test, with Pratt's treatment of pairs that are equal; exact for up to 200 pairs, with ties too.
- The test of Mann and Whitney; exact for up to 80 values of both samples together, with ties too.
- The tests of Friedman, and of Kruskal and Wallis, for more than two groups.
- Dunn's test after that of Kruskal and Wallis (Dunn 1964, Technometrics 6: 241-252).
- Nemenyi's critical difference of mean ranks (Demšar 2006, J. Mach. Learn. Res. 7: 1-30).
- The log-rank test, for censored times.
- Holm's correction for several tests (Holm 1979, Scand. J. Stat. 6: 65-70).

Values that differ by rounding only must be made ties before: see `sierra.stats.comparison.ties`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from sierra.stats import survival
from sierra.stats.comparison import rank_distributions
from sierra.stats.comparison.model import RunValue
from sierra.stats.comparison.rank_distributions import ranked

if TYPE_CHECKING:
    from scipy import stats

Floats = npt.NDArray[np.float64]
Side = Literal["two-sided", "less", "greater"]


def signed_rank(differences: Floats, side: Side = "two-sided") -> float:
    """Return the p value of Wilcoxon's signed-rank test of n differences of pairs."""
    some = differences != 0
    if not some.any():
        return 1.0
    if len(differences) > rank_distributions.PAIRS:
        from scipy import stats

        return float(stats.wilcoxon(differences, zero_method="pratt", alternative=side, method="asymptotic").pvalue)
    ranks = rank_distributions.doubled(ranked(np.abs(differences)))
    return _tail(rank_distributions.of_signs(ranks[some]), int(ranks[differences > 0].sum()), side)


def rank_sum(first: Floats, second: Floats, side: Side = "two-sided") -> float:
    """Return the p value of the test of Mann and Whitney; with `greater`, of whether the values of `second` are greater."""
    if np.ptp(np.concatenate((first, second))) == 0:
        return 1.0
    if len(first) + len(second) > rank_distributions.VALUES:
        from scipy import stats

        return float(stats.mannwhitneyu(second, first, alternative=side, method="asymptotic").pvalue)
    ranks = rank_distributions.doubled(ranked(np.concatenate((first, second))))
    return _tail(rank_distributions.of_choices(ranks, len(second)), int(ranks[len(first) :].sum()), side)


def _tail(sums: Floats, observed: int, side: Side) -> float:
    """Return the probability of the observed sum and of all that are more extreme."""
    less, greater = float(sums[: observed + 1].sum()), float(sums[observed:].sum())
    return min(1.0, {"less": less, "greater": greater, "two-sided": 2 * min(less, greater)}[side])


def smallest_signed_rank(n: int) -> float:
    """Return the smallest two-sided p value that n pairs can give."""
    return min(1.0, 2.0 ** (1 - n))


def smallest_rank_sum(first: int, second: int) -> float:
    """Return the smallest two-sided p value that two samples of these sizes can give."""
    return min(1.0, 2 / math.comb(first + second, first))


def friedman(blocks: Floats) -> tuple[float, float]:
    """Return the statistic and the p value of Friedman's test; a row for each block, a column for each group."""
    from scipy import stats

    if np.all(blocks == blocks[:, :1]):
        return 0.0, 1.0
    result = stats.friedmanchisquare(*blocks.T)
    return float(result.statistic), float(result.pvalue)


def kruskal(groups: Sequence[Floats]) -> tuple[float, float]:
    """Return the statistic and the p value of the test of Kruskal and Wallis."""
    from scipy import stats

    if np.ptp(np.concatenate(groups)) == 0:
        return 0.0, 1.0
    result = stats.kruskal(*groups)
    return float(result.statistic), float(result.pvalue)


def mean_ranks(groups: Sequence[Floats]) -> list[float]:
    """Return the mean rank of each group among the values of all groups."""
    ranks = ranked(np.concatenate(groups))
    return [float(part.mean()) for part in np.split(ranks, np.cumsum([len(group) for group in groups])[:-1])]


def mean_ranks_in_blocks(blocks: Floats) -> list[float]:
    """Return the mean of the ranks of each group within its blocks."""
    means: list[float] = np.array([ranked(row) for row in blocks]).mean(axis=0).tolist()
    return means


def dunn(groups: Sequence[Floats], i: int, j: int) -> float:
    """Return the p value of Dunn's test of two of the groups; it is not corrected for other tests."""
    from scipy import stats

    values = np.concatenate(groups)
    n = len(values)
    _, ties = np.unique(values, return_counts=True)
    variance = n * (n + 1) / 12 - float((ties.astype(float) ** 3 - ties).sum()) / (12 * (n - 1))
    if variance <= 0:
        return 1.0
    means = mean_ranks(groups)
    error = math.sqrt(variance * (1 / len(groups[i]) + 1 / len(groups[j])))
    return float(2 * stats.norm.sf(abs(means[i] - means[j]) / error))


@cache
def critical_difference(groups: int, blocks: int, alpha: float) -> float:
    """Return the difference of mean ranks from which on Nemenyi's test finds groups different."""
    from scipy import stats

    return float(stats.studentized_range.ppf(1 - alpha, groups, np.inf)) * math.sqrt(groups * (groups + 1) / (12 * blocks))


def log_rank(first: Sequence[RunValue], second: Sequence[RunValue]) -> tuple[float, float]:
    """Return the statistic (above 0: `first` is earlier) and the p value of the log-rank test of censored times.

    They are 0 and 1 if the times cannot differ, for example because no run of either group reached the threshold.
    """
    from scipy import stats

    if not any(run.reached for run in (*first, *second)):
        return 0.0, 1.0
    with np.errstate(invalid="ignore", divide="ignore"):  # no variance: at each time all runs that are left ended
        result = stats.logrank(_censored(first), _censored(second))
    return (float(result.statistic), float(result.pvalue)) if np.isfinite(result.statistic) else (0.0, 1.0)


def median_time(runs: Sequence[RunValue]) -> float | None:
    """Return the Kaplan-Meier median of censored times; None if fewer than half of the runs reached the threshold."""
    return survival.median(survival.curve(survival.Time(run.value, run.reached) for run in runs)).value


def holm(p: Sequence[float]) -> list[float]:
    """Return p values that are corrected for the number of tests, in the order of `p`."""
    order = sorted(range(len(p)), key=lambda index: p[index])
    adjusted, worst = [1.0] * len(p), 0.0
    for rank, index in enumerate(order):
        worst = max(worst, min(1.0, p[index] * (len(p) - rank)))
        adjusted[index] = worst
    return adjusted


def _censored(runs: Sequence[RunValue]) -> stats.CensoredData:
    from scipy import stats

    reached = [run.value for run in runs if run.reached]
    return stats.CensoredData(uncensored=reached, right=[run.value for run in runs if not run.reached])
