"""Two one-sided tests, against SciPy and against simulation."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sierra.analysis import equivalence, student_t

VALUES = st.lists(st.floats(-10, 10).map(lambda x: round(x, 3)), min_size=2, max_size=40)


@given(VALUES, st.floats(0.01, 20), st.sampled_from([0.01, 0.05, 0.1]))
def test_the_p_value_is_that_of_scipys_two_one_sided_tests(values: list[float], margin: float, alpha: float) -> None:
    tested = equivalence.test(values, margin, alpha)
    if len(set(values)) > 1:
        above = stats.ttest_1samp(values, -margin, alternative="greater").pvalue
        below = stats.ttest_1samp(values, margin, alternative="less").pvalue
        assert tested.p == pytest.approx(max(above, below), rel=1e-6, abs=1e-12)
        assert tested.equivalent is (tested.p < alpha) or tested.p == pytest.approx(alpha)
    assert tested.low <= tested.difference <= tested.high


@pytest.mark.parametrize(("n", "margin"), [(10, 1.0), (20, 0.7), (40, 0.5)])
def test_the_power_is_about_what_simulation_shows(n: int, margin: float) -> None:
    draw = random.Random(1)
    samples = [[draw.gauss(0, 1) for _ in range(n)] for _ in range(2000)]
    shown = sum(equivalence.test(sample, margin, 0.05).equivalent for sample in samples) / len(samples)
    told = sum(equivalence.test(sample, margin, 0.05).power for sample in samples) / len(samples)
    assert told == pytest.approx(shown, abs=0.06)


def test_what_is_a_margin_apart_is_rarely_taken_for_the_same() -> None:
    draw = random.Random(2)
    samples = [[draw.gauss(1, 1) for _ in range(20)] for _ in range(2000)]
    assert sum(equivalence.test(sample, 1.0, 0.05).equivalent for sample in samples) / len(samples) < 0.065


@pytest.mark.parametrize(
    ("values", "equivalent"), [([0.0, 0.0], True), ([0.5, 0.5], True), ([1.0, 1.0], False), ([2.0, 2.0], False)]
)
def test_differences_that_are_all_the_same_need_no_distribution(values: list[float], equivalent: bool) -> None:
    assert equivalence.test(values, 1.0, 0.05).equivalent is equivalent


@pytest.mark.parametrize(("values", "margin"), [([], 1.0), ([1.0], 1.0), ([1.0, 2.0], 0.0), ([1.0, 2.0], -1.0)])
def test_too_little_is_refused(values: list[float], margin: float) -> None:
    with pytest.raises(ValueError, match="are needed"):
        equivalence.test(values, margin, 0.05)


@given(st.floats(-50, 50), st.integers(1, 1000))
def test_the_tail_is_scipys(t: float, df: int) -> None:
    assert student_t.tail(t, df) == pytest.approx(stats.t.sf(t, df), rel=1e-9, abs=1e-300)
