"""Quantiles of Student's t distribution, in pure Python.

The quantile is the t whose upper tail is q = 1 − p. The tail is half a regularized incomplete beta function of
k degrees of freedom,

    Q(t) = ½ I_x(k/2, ½)   with x = k / (k + t²)        (Abramowitz and Stegun 1964, 26.5.27 and 26.7.1)

computed by its continued fraction (26.5.8, evaluated by Lentz's method, as in Press et al., Numerical Recipes,
3rd ed., 6.4) or, where that converges slowly, by the one of its complement. The equation Q(t) = q is solved by
Newton's method for log Q as a function of log t, which is concave and decreasing, so that Newton's method
converges from anywhere. It begins with the expansion of the quantile in powers of 1/k (26.7.5), which is
already exact to 10⁻¹² where k is large and the tail is not extreme.

For k degrees of freedom from 1 to 10⁶, the relative error is below 10⁻¹⁰ for p from 10⁻¹² to 0.4 and from 0.6 to
1 − 10⁻¹²; where p is nearer to ½, the quantile itself goes to 0, and the absolute error stays below 10⁻¹².
"""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

_TINY = 1e-300
_PRECISE = 1e-16


@lru_cache(maxsize=1 << 16)
def quantile(p: float, df: float) -> float:
    """Return the t that the variable stays below with probability `p`. Raises ValueError unless 0 < p < 1 and df ≥ 1."""
    if not 0 < p < 1 or not df >= 1:
        raise ValueError(f"no Student-t quantile for p = {p} and df = {df}; p must be between 0 and 1, and df at least 1")
    if p == 0.5:
        return 0.0
    if p < 0.5:
        return -_upper(p, df)
    return _upper(1 - p, df)


def quantiles(p: float, count: int) -> list[float]:
    """Return the quantiles for 1, 2, … `count` degrees of freedom."""
    return [quantile(p, df) for df in range(1, count + 1)]


def tail(t: float, df: float) -> float:
    """Return the probability that a Student-t variable with `df` degrees of freedom is greater than `t`."""
    if t == 0 or math.isinf(t):
        return 0.5 if t == 0 else float(t < 0)
    return _tail(t, df) if t > 0 else 1 - _tail(-t, df)


def _upper(q: float, df: float) -> float:
    """Return the t > 0 whose upper tail has the probability `q` < ½."""
    z = -NormalDist().inv_cdf(q)
    t = _expansion(z, df)
    if df >= 1000 and z <= 4:
        return t
    for _ in range(100):
        tail = _tail(t, df)
        step = math.log(tail / q) * tail / (t * _density(t, df))
        t *= math.exp(max(-5.0, min(5.0, step)))
        if abs(step) < 1e-13:
            break
    return t


def _expansion(z: float, df: float) -> float:
    """Return the quantile from the normal quantile `z`: Abramowitz and Stegun, 26.7.5."""
    y = z * z
    g1 = (y + 1) / 4
    g2 = ((5 * y + 16) * y + 3) / 96
    g3 = (((3 * y + 19) * y + 17) * y - 15) / 384
    g4 = ((((79 * y + 776) * y + 1482) * y - 1920) * y - 945) / 92160
    return z * (1 + (g1 + (g2 + (g3 + g4 / df) / df) / df) / df)


def _density(t: float, df: float) -> float:
    return _gamma_ratio(df / 2) / math.sqrt(math.pi * df) * math.exp(-(df + 1) / 2 * math.log1p(t * t / df))


def _tail(t: float, df: float) -> float:
    """Return the probability above t > 0."""
    a, x, y = df / 2, df / (df + t * t), t * t / (df + t * t)
    # x^a · y^½ / B(a, ½)
    front = math.exp(-a * math.log1p(t * t / df)) * math.sqrt(y) * _gamma_ratio(a) / math.sqrt(math.pi)
    if x < (a + 1) / (a + 2.5):
        return front * _fraction(a, 0.5, x) / a / 2
    return 0.5 - front * _fraction(0.5, a, y)


def _gamma_ratio(x: float) -> float:
    """Return Γ(x + ½) / Γ(x): by recurrence up to x ≥ 24, and from there by its series in 1/x (Tricomi and Erdélyi 1951)."""
    factor = 1.0
    while x < 24:
        factor *= x / (x + 0.5)
        x += 1
    r = 1 / (8 * x)
    series = 1 + r * (-1 + r * (0.5 + r * (2.5 + r * (-21 / 8 + r * (-399 / 8 + r * (869 / 16 + r * 39325 / 16))))))
    return factor * math.sqrt(x) * series


def _fraction(a: float, b: float, x: float) -> float:
    """Return the continued fraction of the incomplete beta function I_x(a, b)."""
    c, d = 1.0, 1 / _off_zero(1 - (a + b) * x / (a + 1))
    value = d
    for m in range(1, 100_000):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for step in (even, odd):
            d = 1 / _off_zero(1 + step * d)
            c = _off_zero(1 + step / c)
            change = c * d
            value *= change
        if abs(change - 1) <= 4 * _PRECISE:
            break
    return value


def _off_zero(value: float) -> float:
    return value if abs(value) > _TINY else _TINY
