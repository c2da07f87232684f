"""Two one-sided tests (TOST): test whether the means of paired values are equivalent within a margin.

The runs of an experiment are executed a second time, with the same seeds; dᵢ is the new value of run i minus its recorded
value. With their mean d̄ over n runs, its standard error s/√n and t = Student's t quantile for 1 − α and n − 1 degrees of
freedom,

    the means are equivalent  ⇔  −Δ < d̄ − t·s/√n  and  d̄ + t·s/√n < Δ

(Schuirmann 1987, J. Pharmacokinet. Biopharm. 15: 657-680). If the test does not show equivalence, that does not prove a
difference. So the power is computed too: the probability to show equivalence if there is no difference and the true standard
deviation is the observed s. With δ = Δ·√n/s and w the ratio of a sample's s to the true one, so that (n − 1)·w² is
distributed as χ² with n − 1 degrees of freedom, it is exactly

    power = ∫ (2·Φ(δ − t·w) − 1) dF(w)   over 0 < w < δ/t

which is the difference of two values of Owen's Q (Owen 1965, Biometrika 52: 437-446; Phillips 1990, J. Pharmacokinet.
Biopharm. 18: 137-144), with Φ the normal distribution and F that of w. The integral runs over the w that ever occur.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from math import isfinite

from sierra.stats import student_t
from sierra.util.lazy_definitions import dataclass

NEVER = 1e-15
"""The probability at each end of a distribution that an integral leaves out."""


@dataclass(frozen=True, slots=True)
class Tested:
    """The result of the test; all values but `n`, `p`, `power` and `alpha` have the unit of the tested values."""

    n: int
    difference: float
    """The mean of the differences."""
    low: float
    """The lower end of the interval of confidence 1 − 2α around it; `high` is the upper end."""
    high: float
    margin: float
    alpha: float
    p: float
    """The larger of the two p values."""
    power: float
    equivalent: bool


def test(differences: Sequence[float], margin: float, alpha: float) -> Tested:
    """Test n differences of pairs. Raises ValueError for fewer than two, one that is not finite, or a margin not above 0."""
    n = len(differences)
    if n < 2 or not margin > 0 or not all(map(isfinite, differences)):
        raise ValueError(f"{n} pairs and a margin of {margin}: at least two pairs, all finite, and a margin above 0 are needed")
    mean, error = mean_of(differences), _error(differences)
    if error == 0:
        within = abs(mean) < margin
        return Tested(n, mean, mean, mean, margin, alpha, 0.0 if within else 1.0, 1.0, within)
    t = student_t.quantile(1 - alpha, n - 1)
    low, high = mean - t * error, mean + t * error
    p = max(student_t.tail((mean + margin) / error, n - 1), student_t.tail((margin - mean) / error, n - 1))
    return Tested(n, mean, low, high, margin, alpha, p, power(margin / error, t, n - 1), -margin < low and high < margin)


def mean_of(values: Sequence[float]) -> float:
    """Return the mean of finite values, even if their sum is too large for a float."""
    try:
        return statistics.fmean(values)
    except OverflowError:
        return math.fsum(value / len(values) for value in values)


def power(delta: float, t: float, df: int) -> float:
    """Return the probability that two one-sided tests show equivalence if there is no difference.

    `delta` is the margin in standard errors, `t` the quantile of the test, `df` its degrees of freedom.
    """
    from scipy import integrate, special

    half = df / 2
    constant = math.log(2) + half * math.log(half) - special.gammaln(half)

    def shown(w: float) -> float:
        density = math.exp(constant + (df - 1) * math.log(w) - half * w * w)
        return float(2 * special.ndtr(delta - t * w) - 1) * density

    begin, end = (math.sqrt(special.gammaincinv(half, p) / half) for p in (NEVER, 1 - NEVER))
    end = min(end, delta / t)
    integral = integrate.quad(shown, begin, end, epsabs=1e-9, limit=100, full_output=True)[0] if begin < end else 0.0
    return min(1.0, max(0.0, float(integral)))


def _error(differences: Sequence[float]) -> float:
    """Return the standard error of the mean; infinity if it is too large for a float."""
    try:
        return statistics.stdev(differences) / math.sqrt(len(differences))
    except OverflowError:
        return math.inf
