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
