"""The power of a comparison, found by resampling, is that of formulas and of simulations with a known truth."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from sierra.errors import UsageError
from sierra.stats import power, rates
from sierra.stats.comparison.analyse import analyse
from sierra.stats.comparison.model import Cell, Question, RunValue, Sample

NORMAL = stats.norm.ppf((np.arange(1000) + 0.5) / 1000)
"""A pilot with the quantiles of the normal distribution."""
EFFICIENCY = 3 / np.pi
"""The efficiency of tests by ranks relative to those by t, for normal values (Hodges and Lehmann 1956)."""
ERROR = 4 * (0.8 * 0.2 / power.RESAMPLES) ** 0.5


@pytest.mark.integration
def test_normal_values_need_the_runs_of_a_t_test_divided_by_the_efficiency() -> None:
    """statsmodels 0.15: TTestPower().solve_power(0.5, power=0.8, alpha=0.05) = 33.367, TTestIndPower likewise 63.766."""
    alone = power.of_one_group(NORMAL, 0.5)
    assert alone.runs(0.8, 0.05) == pytest.approx(63.766 / EFFICIENCY, rel=0.05)
    random = np.random.default_rng(2).permutation(NORMAL)
    pairs = power.of_groups(random, random + NORMAL, 0.5, paired=True)
    assert pairs.runs(0.8, 0.05) == pytest.approx(33.367 / EFFICIENCY, rel=0.05)
    assert pairs.power(34, 0.05) == pytest.approx(stats.nct.sf(stats.t.ppf(0.975, 33), 33, 0.5 * 34**0.5), abs=ERROR)


@pytest.mark.parametrize("n", [8, 30])
def test_the_power_is_that_of_new_samples_of_the_truth(n: int) -> None:
    """Values of an exponential distribution, of which the pilot has the quantiles; an exact test and an approximate one."""
    pilot = power.of_one_group(stats.expon.ppf((np.arange(1000) + 0.5) / 1000), 0.8)
    random = np.random.default_rng(5)
    first, second = random.exponential(size=(4000, n)), random.exponential(size=(4000, n)) + 0.8
    truth = np.mean(stats.mannwhitneyu(first, second, axis=1, method="exact").pvalue <= 0.05)
    assert pilot.power(n, 0.05) == pytest.approx(truth, abs=ERROR)


def test_rates_are_compared_as_rates_and_whole_numbers_stay_whole() -> None:
    coin = np.array([0.0, 1.0] * 10)
    random = np.random.default_rng(6)
    first, second = random.random((4000, 100)) < 0.5, random.random((4000, 100)) < 0.7
    truth = np.mean(stats.mannwhitneyu(first, second, axis=1, method="asymptotic").pvalue <= 0.05)
    assert power.of_one_group(coin, 0.2).power(100, 0.05) == pytest.approx(truth, abs=ERROR)
    with pytest.raises(UsageError, match=r"a rate of 0\.5 cannot differ by 0\.6"):
        power.of_one_group(coin, 0.6)
    counts = np.arange(4.0)
    drawn = random.integers(4, size=(2, 4000, 60))
    drawn[1] += random.random((4000, 60)) < 0.5
    truth = np.mean(stats.mannwhitneyu(*drawn, axis=1, method="asymptotic").pvalue <= 0.05)
    wide = power.Pilot(counts, counts, paired=False, shift=0.5)
    assert wide.power(60, 0.05) == pytest.approx(truth, abs=ERROR)


@pytest.mark.integration
def test_rates_are_tested_by_exact_tests() -> None:
    coin = np.array([0.0, 1.0] * 10)
    pilot = power.of_one_group(coin, 0.4, rate=True)
    chance = np.outer(stats.binom.pmf(range(13), 12, 0.5), stats.binom.pmf(range(13), 12, 0.9))
    shown = [[rates.fisher((one, 12), (other, 12)) <= 0.05 for other in range(13)] for one in range(13)]
    assert (pilot.test, pilot.power(12, 0.05)) == ("Fisher's exact test", pytest.approx((chance * shown).sum(), abs=ERROR))
    first, second = np.array([1.0] * 48 + [0.0] * 2), np.array([1.0] * 36 + [0.0] * 12 + [1.0] * 2)
    for difference, only_first, only_second in ((None, 0.24, 0.04), (-0.38, 0.24 + 0.18 * 36 / 38, 0.04 - 0.18 * 2 / 38)):
        pairs = power.of_groups(first, second, difference, paired=True, rate=True)
        drawn = np.random.default_rng(3).multinomial(30, (only_first, only_second, 1 - only_first - only_second), size=4000)
        truth = np.mean([rates.mcnemar(rates.Pairs(0, one, other, rest)) <= 0.05 for one, other, rest in drawn.tolist()])
        assert (pairs.test, pairs.power(30, 0.05)) == ("McNemar's exact test", pytest.approx(truth, abs=ERROR))


def samples(values: npt.NDArray[np.float64], group: str) -> Sample:
    return Sample(group, tuple(RunValue(seed, float(value), reached=True) for seed, value in enumerate(values)), len(values), 0)


@pytest.mark.parametrize("paired", [True, False])
def test_the_p_values_are_those_of_the_comparison(paired: bool) -> None:
    random = np.random.default_rng(8)
    first, second = random.normal(size=9), random.normal(size=9) + 1
    pilot = power.Pilot(first, second, paired)
    (found,) = pilot._p(first[None], second[None], exact=True)
    (pair,) = analyse([Cell({}, (samples(first, "a"), samples(second, "b")))], Question(paired=paired)).pairs
    assert (pilot.test, found) == (pair.test, pytest.approx(pair.p))


@pytest.mark.nightly
def test_what_cannot_be_found_has_no_number_of_runs() -> None:
    assert power.of_one_group(NORMAL, 1e-6).runs(0.8, 0.05) is None
    same = np.full(5, 3.0)
    assert power.of_groups(same, same, None, paired=True).power(50, 0.05) == 0
    few = power.of_one_group(NORMAL, 100)
    assert (few.runs(0.8, 0.05), few.runs(0.8, 0.05 / 10)) == (4, 6)  # 2 / C(2n, n), the smallest p value, is at most alpha
