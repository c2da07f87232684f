"""Numbers as papers print them: rounded to two significant digits of their uncertainty.

The uncertainty is half the width of the interval. Its second significant digit is the last digit of the value and of the ends
of the interval: 0.71362 ± 0.02149 becomes 0.714 ± 0.021. A number without an interval has four significant digits. Very large
and very small numbers have a power of ten.
"""

from __future__ import annotations

from decimal import Decimal
from math import isclose

from sierra.util.lazy_definitions import dataclass

ALONE = 4
"""The number of significant digits of a number without an uncertainty."""
PRECISE = 2
"""The number of significant digits of an uncertainty."""
LARGE, SMALL = 6, -4
"""The powers of ten from which on, and below which, numbers are written with a power of ten."""


@dataclass(frozen=True, slots=True)
class Rounded:
    """The texts of a number: times 10 to the power of `exponent`, if it is not 0."""

    value: str
    half: str | None = None
    """Half the width of an interval whose middle is the value."""
    ends: tuple[str, str] | None = None
    """The ends of any other interval; an end that is unknown is `∞`."""
    exponent: int = 0


def rounded(value: float, low: float | None = None, high: float | None = None) -> Rounded:
    """Return the texts of a finite number and of its interval; without `high`, the interval has no upper end."""
    if low is None and high is None:
        exponent = _shown(_exponent(value))
        return Rounded(_text(value, exponent, _exponent(value) - ALONE + 1, whole=True), exponent=exponent)
    reach = [abs(value - end) for end in (low, high) if end is not None]
    half = (
        Decimal(repr(high)) / 2 - Decimal(repr(low)) / 2 if low is not None and high is not None else Decimal(repr(max(reach)))
    )
    last_digit = _last(half) if half else _exponent(value) - ALONE + 1
    exponent = _shown(max(_exponent(value), _exponent(float(half))))
    text = _text(value, exponent, last_digit, whole=not half)
    if (
        low is not None
        and high is not None
        and isclose(high - value, value - low, rel_tol=1e-6, abs_tol=1e-9 * abs(float(half)))
    ):
        return Rounded(text, half=_text(float(half), exponent, last_digit) if half else "0", exponent=exponent)
    first, second = ("∞" if end is None else _text(end, exponent, last_digit, whole=not half) for end in (low, high))
    return Rounded(text, ends=(f"−{first}" if low is None else first, second), exponent=exponent)


def fixed(value: float, digits: int) -> Rounded:
    """Return the text of a finite number with these digits after the decimal point."""
    return Rounded(_text(value, 0, -digits))


def _exponent(value: float) -> int:
    """Return the power of ten of the first digit of a number; 0 for 0."""
    return Decimal(repr(value)).adjusted() if value else 0


def _shown(exponent: int) -> int:
    return exponent if exponent >= LARGE or exponent < SMALL else 0


def _last(half: Decimal) -> int:
    """Return the power of ten of the second significant digit, after rounding: 0.0996 is 0.10, not 0.100."""
    digit = half.adjusted() - PRECISE + 1
    return half.quantize(Decimal(1).scaleb(digit)).adjusted() - PRECISE + 1


def _text(value: float, exponent: int, last_digit: int, *, whole: bool = False) -> str:
    """Return a number divided by a power of ten, rounded to the digit of `last_digit`. `whole`: without zeros at the end."""
    scaled = Decimal(repr(value)).scaleb(-exponent).quantize(Decimal(1).scaleb(last_digit - exponent))
    text = format(scaled if scaled else abs(scaled), "f")
    if whole and "." in text:
        text = text.rstrip("0").rstrip(".")
    return text.replace("-", "−")
