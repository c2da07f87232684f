"""Rank tests give the values of other programs, also with ties, where SciPy's exact tests do not hold."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from sierra.stats.comparison import rank_tests
from sierra.stats.comparison.model import RunValue

GROUPS = [np.array(group, dtype=float) for group in ([27, 2, 4, 18, 7, 9], [20, 8, 14, 36, 21, 22], [34, 31, 3, 23, 30, 6])]
TIES = [np.array(group, dtype=float) for group in ([1, 1, 2, 2, 3], [2, 3, 3, 4], [4, 4, 5, 5, 5, 6])]
PAIRS = ((0, 1), (0, 2), (1, 2))


@pytest.mark.parametrize("n", [3, 8, 13, 40])
def test_exact_tests_without_ties_are_those_of_scipy(n: int) -> None:
    rng = np.random.default_rng(n)
    differences, first, second = rng.normal(size=n), rng.normal(size=n - 1), rng.normal(1, size=n)
    for side in ("two-sided", "less", "greater"):
        wilcoxon = stats.wilcoxon(differences, alternative=side, method="exact").pvalue
        whitney = stats.mannwhitneyu(second, first, alternative=side, method="exact").pvalue
        assert rank_tests.signed_rank(differences, side) == pytest.approx(wilcoxon, rel=1e-9)
        assert rank_tests.rank_sum(first, second, side) == pytest.approx(whitney, rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_exact_tests_with_ties_count_all_arrangements(seed: int) -> None:
    rng = np.random.default_rng(seed)
    differences, first, second = (np.round(rng.normal(0.5, size=n)) for n in (7, 5, 4))
    every = stats.PermutationMethod()
    wilcoxon = stats.wilcoxon(differences, zero_method="pratt", method=every).pvalue
    whitney = stats.mannwhitneyu(first, second, method=every).pvalue
    assert rank_tests.signed_rank(differences) == pytest.approx(wilcoxon, rel=1e-9)
    assert rank_tests.rank_sum(first, second) == pytest.approx(whitney, rel=1e-9)


def test_published_examples_of_hollander_and_wolfe() -> None:
    """Nonparametric Statistical Methods (1973), examples 3.1 and 4.1, as in the manual of R's wilcox.test."""
    before = np.array([1.83, 0.50, 1.62, 2.48, 1.68, 1.88, 1.55, 3.06, 1.30])
    after = np.array([0.878, 0.647, 0.598, 2.05, 1.06, 1.29, 1.06, 3.14, 1.29])
    assert rank_tests.signed_rank(after - before, "less") == pytest.approx(0.01953, abs=5e-6)
    term = np.array([0.80, 0.83, 1.89, 1.04, 1.45, 1.38, 1.91, 1.64, 0.73, 1.46])
    early = np.array([1.15, 0.88, 0.90, 0.74, 1.21])
    assert rank_tests.rank_sum(early, term, "greater") == pytest.approx(0.1272, abs=5e-5)


def test_equal_values_show_nothing() -> None:
    same = np.full(6, 0.7)
    assert rank_tests.signed_rank(same - same) == 1.0
    assert rank_tests.rank_sum(same, same) == 1.0
    assert rank_tests.kruskal([same, same, same]) == (0.0, 1.0)
    assert rank_tests.friedman(np.column_stack([same] * 3)) == (0.0, 1.0)
    assert rank_tests.dunn([same, same, same], 0, 1) == 1.0


@pytest.mark.parametrize("n", [2, 5, 9])
def test_no_data_give_less_than_the_smallest_p_value(n: int) -> None:
    values = np.arange(1.0, n + 1)
    assert rank_tests.signed_rank(values) == pytest.approx(rank_tests.smallest_signed_rank(n))
    assert rank_tests.rank_sum(values, values + n) == pytest.approx(rank_tests.smallest_rank_sum(n, n))


def test_dunn_agrees_with_scikit_posthocs() -> None:
    """Values of scikit-posthocs 0.17.1, posthoc_dunn(GROUPS) and posthoc_dunn(TIES)."""
    found = [rank_tests.dunn(GROUPS, *pair) for pair in PAIRS]
    assert found == pytest.approx([0.15974818, 0.13000895, 0.9138786], abs=1e-8)
    assert [rank_tests.dunn(TIES, *pair) for pair in PAIRS] == pytest.approx([0.24975793, 0.00105628, 0.06062526], abs=1e-8)


def test_holm_agrees_with_statsmodels() -> None:
    """Values of statsmodels 0.15.0, multipletests(method="holm")."""
    assert rank_tests.holm([0.01, 0.04, 0.03, 0.005, 0.2]) == pytest.approx([0.04, 0.09, 0.09, 0.025, 0.2])
    assert rank_tests.holm([]) == []


def test_critical_differences_are_those_of_the_published_table() -> None:
    """Demšar (2006), table 5 (a): q for alpha = 0.05 and 2 to 10 groups."""
    published = {2: 1.960, 3: 2.343, 4: 2.569, 5: 2.728, 6: 2.850, 7: 2.949, 8: 3.031, 9: 3.102, 10: 3.164}
    for groups, q in published.items():
        scale = (groups * (groups + 1) / (6 * 14)) ** 0.5
        assert rank_tests.critical_difference(groups, 14, 0.05) == pytest.approx(q * scale, abs=1e-3)


def test_log_rank_agrees_with_statsmodels() -> None:
    """The p value of statsmodels 0.15.0, survdiff."""
    times = [6, 7, 10, 15, 19, 25, 5, 8, 10, 12, 13, 14]
    reached = [1, 0, 1, 1, 0, 1, 1, 1, 1, 0, 1, 1]
    runs = [RunValue(seed, float(time), bool(done)) for seed, (time, done) in enumerate(zip(times, reached, strict=True))]
    statistic, p = rank_tests.log_rank(runs[:6], runs[6:])
    assert p == pytest.approx(0.14590462321317, abs=1e-12)
    assert statistic < 0, "the second group is earlier"
    assert rank_tests.median_time(runs[:6]) == 15


def test_the_median_time_is_unknown_if_fewer_than_half_of_the_runs_reached_the_threshold() -> None:
    runs = [RunValue(seed, 10.0, seed < 2) for seed in range(5)]
    assert rank_tests.median_time(runs) is None
    assert rank_tests.log_rank(runs[2:], runs[2:]) == (0.0, 1.0)


def test_the_median_of_an_even_number_of_times_is_the_middle_of_two_as_in_statistics() -> None:
    assert rank_tests.median_time([RunValue(seed, float(seed), True) for seed in (1, 2, 4, 9)]) == 3


def test_holm_never_decreases_with_p() -> None:
    p = np.random.default_rng(0).random(20).tolist()
    adjusted = rank_tests.holm(p)
    assert all((p[i] < p[j]) <= (adjusted[i] <= adjusted[j]) for i, j in combinations(range(20), 2))
