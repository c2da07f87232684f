"""The number of runs is the smallest one whose interval is narrow enough."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sierra.stats import sample_size


@pytest.mark.parametrize(("sd", "half_width"), [(1, 0.5), (0.04, 0.02), (3, 0.1), (1, 100), (0, 1)])
def test_no_smaller_number_of_runs_is_enough(sd: float, half_width: float) -> None:
    n = sample_size.runs_needed(sd, half_width)
    assert n is not None
    assert n >= 2

    def width(n: int) -> float:
        return float(stats.t.ppf(0.975, n - 1)) * sd / n**0.5

    assert width(n) <= half_width
    assert n == 2 or width(n - 1) > half_width


def test_a_published_example() -> None:
    """For a half-width of half a standard deviation: 18, by Student's t; the normal distribution would give 16."""
    assert sample_size.runs_needed(1, 0.5) == 18


def test_an_interval_that_no_number_of_runs_gives_has_no_answer() -> None:
    assert sample_size.runs_needed(1e6, 1e-6) is None


@pytest.mark.parametrize("n", [3, 5, 20])
def test_the_upper_limit_of_the_standard_deviation_holds_in_80_percent_of_the_pilots(n: int) -> None:
    pilots = np.random.default_rng(n).normal(size=(4000, n)).std(axis=1, ddof=1)
    held = np.mean([sample_size.upper_sd(float(sd), n) >= 1 for sd in pilots])
    assert held == pytest.approx(0.8, abs=3 * (0.8 * 0.2 / 4000) ** 0.5)


@pytest.mark.parametrize("rate", [0.0, 0.2, 0.5, 0.93, 1.0])
@pytest.mark.parametrize("half_width", [0.3, 0.1, 0.02])
def test_the_runs_for_a_rate_are_the_smallest_number_with_that_interval_by_scipy(rate: float, half_width: float) -> None:
    def half(n: int) -> float:
        interval = stats.binomtest(round(rate * n), n).proportion_ci(method="wilson")
        return float(interval.high - interval.low) / 2

    n = sample_size.runs_for_rate(rate, half_width)
    assert n is not None
    if rate in (0.0, 1.0):
        assert half(n) <= half_width < half(n - 1) or n == 2
    else:
        assert half(n) <= half_width * 1.05  # a whole number of runs has another rate


def test_a_pilot_without_any_failure_still_needs_runs_for_the_interval_of_a_rate() -> None:
    assert sample_size.runs_for_rate(1.0, 0.1) == 16
    assert 0.5 < sample_size.doubtful_rate(1.0, 10) < 1
    assert sample_size.doubtful_rate(0.45, 10) == 0.5
