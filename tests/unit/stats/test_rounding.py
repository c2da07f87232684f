"""Numbers are rounded to two significant digits of their uncertainty."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.stats.rounding import Rounded, rounded


@pytest.mark.parametrize(
    ("value", "half", "expected"),
    [
        (0.71362, 0.02149, Rounded("0.714", "0.021")),
        (0.71362, 0.0996, Rounded("0.71", "0.10")),
        (0.71362, 0.0994, Rounded("0.714", "0.099")),
        (12.0, 3.0, Rounded("12.0", "3.0")),
        (1234.0, 217.0, Rounded("1230", "220")),
        (-0.001, 0.5, Rounded("0.00", "0.50")),
        (-2.5, 0.25, Rounded("−2.50", "0.25")),
        (0.5, 0.0, Rounded("0.5", "0")),
        (0.0, 0.0, Rounded("0", "0")),
        (1234567.0, 8900.0, Rounded("1.2346", "0.0089", exponent=6)),
        (1.234e-7, 2.1e-9, Rounded("1.234", "0.021", exponent=-7)),
        (3.0, 5e7, Rounded("0.0", "5.0", exponent=7)),
    ],
)
def test_a_number_has_two_significant_digits_of_its_uncertainty(value: float, half: float, expected: Rounded) -> None:
    assert rounded(value, value - half, value + half) == expected


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ((0.71362, 0.65111, 0.70999), Rounded("0.714", ends=("0.651", "0.710"))),
        ((1.0, 0.7575, 1.0), Rounded("1.00", ends=("0.76", "1.00"))),
        ((23.0, 13.0, None), Rounded("23", ends=("13", "∞"))),
        ((2.0, 2.0, None), Rounded("2", ends=("2", "∞"))),
        ((0.123456, None, None), Rounded("0.1235")),
        ((5.0, None, None), Rounded("5")),
        ((123456.0, None, None), Rounded("123500")),
        ((1234567.0, None, None), Rounded("1.235", exponent=6)),
        ((0.0, None, None), Rounded("0")),
    ],
)
def test_other_intervals_have_both_ends(numbers: tuple[float, float | None, float | None], expected: Rounded) -> None:
    assert rounded(*numbers) == expected


@given(st.floats(-1e300, 1e300), st.floats(1e-300, 1e300))
def test_rounding_changes_a_number_by_at_most_a_tenth_of_its_uncertainty(value: float, half: float) -> None:
    found = rounded(value, value - half, value + half)
    if found.half and found.half != "0":
        shown = float(f"{found.value.replace('−', '-')}e{found.exponent}")
        low, high = value - half, value + half
        assert abs(shown - value) <= 0.051 * (high / 2 - low / 2) + 1e-12 * abs(value)
