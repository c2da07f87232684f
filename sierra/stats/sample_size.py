"""The number of runs that an interval of a certain width needs, from the standard deviation of a pilot.

The interval of the mean of n runs has the half-width t·s/√n, with Student's t quantile for n − 1 degrees of freedom. The
standard deviation s of a pilot of m runs is itself uncertain: about half of all pilots show a smaller one than the true one. So
there is a second answer, with the upper limit of s that is not exceeded with the probability `ASSURANCE` (Browne 1995,
Stat. Med. 14: 1933-1940):

    s · √((m − 1) / χ²),    χ²: the quantile for 1 − ASSURANCE and m − 1 degrees of freedom

The interval of a rate is Wilson's, whose half-width depends on n and the rate: it is the widest at a rate of 0.5. There, the
second answer is that for the rate nearest to 0.5 that the pilot does not exclude with the same probability.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from statistics import NormalDist

from sierra.stats import student_t
from sierra.stats.rates import center_and_half

ASSURANCE = 0.8
MOST = 10**7
"""The largest number of runs that is answered."""


def runs_needed(sd: float, half_width: float, level: float = 0.95) -> int | None:
    """Return the smallest n of at least 2 with t·sd/√n ≤ half_width; None if it is above `MOST`."""
    return _smallest(lambda n: student_t.quantile((1 + level) / 2, n - 1) * sd / math.sqrt(n) <= half_width)


def runs_for_rate(rate: float, half_width: float, level: float = 0.95) -> int | None:
    """Return the smallest n of at least 2 for which Wilson's interval of this rate has the half-width; None if above `MOST`."""
    z = NormalDist().inv_cdf((1 + level) / 2)
    return _smallest(lambda n: center_and_half(rate, n, z)[1] <= half_width)


def doubtful_rate(rate: float, n: int) -> float:
    """Return the rate nearest to 0.5 that n runs do not exclude: the end of Wilson's one-sided interval (`ASSURANCE`)."""
    center, half = center_and_half(rate, n, NormalDist().inv_cdf(ASSURANCE))
    return min(max(center + half, rate), 0.5) if rate <= 0.5 else max(min(center - half, rate), 0.5)


def _smallest(fits: Callable[[int], bool]) -> int | None:
    """Return the smallest n of at least 2 that fits, as all larger ones do; None if it is above `MOST`."""
    low, high = 1, 2
    while not fits(high):
        if high >= MOST:
            return None
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high


def upper_sd(sd: float, n: int) -> float:
    """Return the upper limit of the true standard deviation, from that of n runs."""
    from scipy import special

    return sd * math.sqrt((n - 1) / float(special.chdtri(n - 1, ASSURANCE)))
