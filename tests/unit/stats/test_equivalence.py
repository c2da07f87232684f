"""Two one-sided tests, compared with SciPy and with simulation."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate, stats

from sierra.stats import equivalence, student_t

VALUES = st.lists(st.floats(-10, 10).map(lambda x: round(x, 3)), min_size=2, max_size=40)


@pytest.mark.integration
@given(VALUES, st.floats(0.01, 20), st.sampled_from([0.01, 0.05, 0.1]))
def test_the_p_value_equals_that_of_two_one_sided_tests_in_scipy(values: list[float], margin: float, alpha: float) -> None:
    tested = equivalence.test(values, margin, alpha)
    if len(set(values)) > 1:
        above = stats.ttest_1samp(values, -margin, alternative="greater").pvalue
        below = stats.ttest_1samp(values, margin, alternative="less").pvalue
        assert tested.p == pytest.approx(max(above, below), rel=1e-6, abs=1e-12)
        assert tested.equivalent is (tested.p < alpha) or tested.p == pytest.approx(alpha)
    assert tested.low <= tested.difference <= tested.high


@pytest.mark.integration
@pytest.mark.parametrize(("n", "margin"), [(10, 1.0), (20, 0.7), (40, 0.5)])
def test_the_power_is_close_to_the_simulated_one(n: int, margin: float) -> None:
    draw = random.Random(1)
    samples = [[draw.gauss(0, 1) for _ in range(n)] for _ in range(2000)]
    shown = sum(equivalence.test(sample, margin, 0.05).equivalent for sample in samples) / len(samples)
    told = sum(equivalence.test(sample, margin, 0.05).power for sample in samples) / len(samples)
    assert told == pytest.approx(shown, abs=0.06)


@pytest.mark.parametrize("df", [1, 2, 3, 9, 40, 500])
@pytest.mark.parametrize("delta", [0.5, 3.0, 5.0, 50.0])
def test_the_power_equals_the_integral_over_all_standard_deviations(df: int, delta: float) -> None:
    """An independent computation over the ratio w of a sample's standard deviation to the true one."""
    t = student_t.quantile(0.95, df)

    def density(w: float) -> float:
        return float((2 * stats.norm.cdf(delta - t * w) - 1) * 2 * df * w * stats.chi2.pdf(df * w * w, df))

    end = min(delta / t, 20.0)
    near = [w for w in (0.5, 0.9, 1.0, 1.1, 2.0, 4.0) if w < end]
    expected, _ = integrate.quad(density, 0, end, points=near or None, limit=500)
    assert equivalence.power(delta, t, df) == pytest.approx(expected, abs=1e-8)


def test_the_power_of_three_pairs_is_exact_and_not_the_central_approximation() -> None:
    assert equivalence.power(3.0, student_t.quantile(0.95, 2), 2) == pytest.approx(0.436, abs=5e-4)


@pytest.mark.nightly
def test_simulated_equivalence_of_three_pairs_is_as_frequent_as_the_power() -> None:
    draw, t = random.Random(3), student_t.quantile(0.95, 2)
    samples = [[draw.gauss(0, 1) for _ in range(3)] for _ in range(4000)]
    shown = sum(equivalence.test(sample, 3.0 / math.sqrt(3), 0.05).equivalent for sample in samples) / len(samples)
    assert shown == pytest.approx(equivalence.power(3.0, t, 2), abs=0.03)


@pytest.mark.parametrize("scale", [1e-300, 1e-150, 1e150, 1e300])
def test_the_equivalence_test_is_invariant_to_scale(scale: float) -> None:
    values = [0.5, -0.25, 0.75, 0.125]
    one, other = equivalence.test(values, 1.0, 0.05), equivalence.test([x * scale for x in values], scale, 0.05)
    assert (other.p, other.power, other.equivalent) == pytest.approx((one.p, one.power, one.equivalent), rel=1e-9)
    assert (other.low / scale, other.high / scale) == pytest.approx((one.low, one.high), rel=1e-9)


def test_values_that_overflow_are_not_equivalent() -> None:
    tested = equivalence.test([1.7e308, 1.7e308, -1.7e308, 1.7e308], 1e308, 0.05)
    assert (tested.difference, tested.equivalent) == (pytest.approx(0.85e308), False)
    assert 0 <= tested.power < 0.05


@pytest.mark.integration
def test_samples_that_differ_by_the_margin_are_rarely_equivalent() -> None:
    draw = random.Random(2)
    samples = [[draw.gauss(1, 1) for _ in range(20)] for _ in range(2000)]
    assert sum(equivalence.test(sample, 1.0, 0.05).equivalent for sample in samples) / len(samples) < 0.065


@pytest.mark.parametrize(
    ("values", "equivalent"), [([0.0, 0.0], True), ([0.5, 0.5], True), ([1.0, 1.0], False), ([2.0, 2.0], False)]
)
def test_equal_differences_are_compared_with_the_margin_directly(values: list[float], equivalent: bool) -> None:
    assert equivalence.test(values, 1.0, 0.05).equivalent is equivalent


@pytest.mark.parametrize(
    ("values", "margin"),
    [([], 1.0), ([1.0], 1.0), ([1.0, math.inf], 1.0), ([1.0, math.nan], 1.0), ([1.0, 2.0], 0.0), ([1.0, 2.0], -1.0)],
)
def test_too_few_values_or_an_invalid_margin_are_refused(values: list[float], margin: float) -> None:
    with pytest.raises(ValueError, match="are needed"):
        equivalence.test(values, margin, 0.05)


@given(st.floats(-50, 50), st.integers(1, 1000))
def test_the_tail_of_students_distribution_equals_that_of_scipy(t: float, df: int) -> None:
    assert student_t.tail(t, df) == pytest.approx(stats.t.sf(t, df), rel=1e-9, abs=1e-300)
