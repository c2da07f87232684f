"""Bands over time are those of the t intervals at each time, and have gaps where runs have no value."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sierra.stats.comparison import over_time


def series(seed: int, n: int, *, shift: float = 0.0) -> dict[int, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {run: rng.normal(shift, 1 + seed, size=3) for run in range(n)}


def test_pairs_have_the_interval_of_scipy_at_each_time() -> None:
    first, second = series(0, 8), series(1, 9, shift=2)
    mean, low, high = over_time.of_pairs(first, second, 0.05)
    for time in range(3):
        expected = stats.ttest_rel([second[run][time] for run in range(8)], [first[run][time] for run in range(8)])
        interval = expected.confidence_interval(0.95)
        assert (low[time], high[time]) == pytest.approx((interval.low, interval.high))
        assert mean[time] == pytest.approx((low[time] + high[time]) / 2)


def test_samples_have_the_interval_of_welch_at_each_time() -> None:
    first, second = series(0, 8), series(1, 9, shift=2)
    _, low, high = over_time.of_samples(first, second, 0.1)
    for time in range(3):
        values = [[one[time] for one in runs.values()] for runs in (second, first)]
        interval = stats.ttest_ind(*values, equal_var=False).confidence_interval(0.9)
        assert (low[time], high[time]) == pytest.approx((interval.low, interval.high))


def test_times_with_fewer_than_two_runs_have_no_interval() -> None:
    first, second = series(0, 3), series(1, 3)
    for run in (0, 1):
        first[run][2] = np.nan
    for numbers in (*over_time.of_pairs(first, second, 0.05), *over_time.of_samples(first, second, 0.05)):
        assert np.isfinite(numbers[:2]).all()
        assert np.isnan(numbers[2])


def test_equal_runs_have_an_interval_of_no_width() -> None:
    runs = series(0, 4)
    for compute in (over_time.of_pairs, over_time.of_samples):
        constant = {run: np.ones(3) for run in runs}
        assert [numbers.tolist() for numbers in compute(constant, constant, 0.05)] == [[0.0] * 3] * 3
