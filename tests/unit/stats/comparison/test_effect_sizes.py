"""Estimates and intervals are those of published examples, and do not depend on how they are computed."""

from __future__ import annotations

import numpy as np
import pytest

from sierra.stats.comparison import effect_sizes, wording

BEFORE = np.array([1.83, 0.50, 1.62, 2.48, 1.68, 1.88, 1.55, 3.06, 1.30])
AFTER = np.array([0.878, 0.647, 0.598, 2.05, 1.06, 1.29, 1.06, 3.14, 1.29])
TERM = np.array([0.80, 0.83, 1.89, 1.04, 1.45, 1.38, 1.91, 1.64, 0.73, 1.46])
EARLY = np.array([1.15, 0.88, 0.90, 0.74, 1.21])


def test_pairs_of_hollander_and_wolfe() -> None:
    """Nonparametric Statistical Methods (1973), examples 3.3 and 3.4: estimate -0.46, interval from -0.786 to -0.010."""
    found = effect_sizes.of_pairs(AFTER - BEFORE, 0.05)
    assert (found.value, found.low, found.high) == pytest.approx((-0.46, -0.786, -0.010))


def test_samples_of_hollander_and_wolfe() -> None:
    """Ibid., examples 4.3 and 4.4, as R's wilcox.test(conf.int = TRUE) computes them."""
    found = effect_sizes.of_samples(EARLY, TERM, 0.05)
    assert (found.value, found.low, found.high) == pytest.approx((0.305, -0.15, 0.76))


def test_small_samples_have_an_estimate_but_no_interval() -> None:
    assert effect_sizes.of_pairs(np.array([1.0, 2.0, 3.0, 4.0, 5.0]), 0.05) == effect_sizes.Estimate(3.0, None, None)
    assert effect_sizes.of_pairs(np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), 0.05) == effect_sizes.Estimate(3.5, 1.0, 6.0)
    assert effect_sizes.of_samples(np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]), 0.05).low is None


def test_a12_of_groups() -> None:
    assert effect_sizes.a12(np.array([1.0, 2.0]), np.array([3.0, 4.0])) == 1.0
    assert effect_sizes.a12(np.array([3.0, 4.0]), np.array([1.0, 2.0])) == 0.0
    assert effect_sizes.a12(np.array([1.0, 2.0]), np.array([1.0, 2.0])) == 0.5
    assert [wording.magnitude(value) for value in (0.5, 0.56, 0.36, 0.71, 0.0)] == [
        *("negligible", "small", "medium", "large", "large")
    ]


def test_large_samples_need_no_list_of_all_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    first, second = rng.normal(size=90), np.round(rng.normal(size=70), 1)
    listed = effect_sizes.of_pairs(first, 0.05), effect_sizes.of_samples(first, second, 0.05)
    monkeypatch.setattr(effect_sizes, "LISTED", 0)
    searched = effect_sizes.of_pairs(first, 0.05), effect_sizes.of_samples(first, second, 0.05)
    for one, other in zip(listed, searched, strict=True):
        assert (other.value, other.low, other.high) == pytest.approx((one.value, one.low, one.high), abs=1e-12)


def test_the_counted_and_the_normal_distribution_agree_where_they_meet() -> None:
    for n in (100, 200):
        counted = effect_sizes._cut_of_pairs(n, 0.05)
        normal = effect_sizes._normal_cut(n * (n + 1) / 4, (n * (n + 1) * (2 * n + 1) / 24) ** 0.5, 0.05)
        assert abs(counted - normal) <= 2
    counted = effect_sizes._cut_of_samples(40, 40, 0.05)
    assert abs(counted - effect_sizes._normal_cut(800, (1600 * 81 / 12) ** 0.5, 0.05)) <= 1


def test_intervals_cover_the_true_difference() -> None:
    """With the true difference 1, at most 5 % of the intervals may miss it, up to the error of 400 simulations."""
    rng = np.random.default_rng(11)
    missed = [0, 0]
    for _ in range(400):
        pairs = effect_sizes.of_pairs(rng.standard_t(3, size=12) + 1, 0.05)
        samples = effect_sizes.of_samples(rng.exponential(size=10), rng.exponential(size=9) + 1, 0.05)
        for place, found in enumerate((pairs, samples)):
            assert found.low is not None
            assert found.high is not None
            missed[place] += not found.low <= 1 <= found.high
    assert max(missed) <= 400 * 0.05 + 3 * (400 * 0.05 * 0.95) ** 0.5
    assert min(missed) > 0, "intervals that never miss are too wide"
