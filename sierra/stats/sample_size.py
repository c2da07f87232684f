"""How many runs an interval of a certain width needs, from the standard deviation of a pilot.

The interval of the mean of n runs has the half-width t·s/√n, with Student's t quantile for n − 1 degrees of freedom. The
standard deviation s of a pilot of m runs is itself uncertain: about half of all pilots show a smaller one than the true one. So
there is a second answer, with the upper limit of s that is not exceeded with the probability `ASSURANCE` (Browne 1995,
Stat. Med. 14: 1933-1940):

    s · √((m − 1) / χ²),    χ²: the quantile for 1 − ASSURANCE and m − 1 degrees of freedom
"""

from __future__ import annotations

import math

from sierra.stats import student_t

ASSURANCE = 0.8
MOST = 10**7
"""The largest number of runs that is answered."""


def runs_needed(sd: float, half_width: float, level: float = 0.95) -> int | None:
    """Return the smallest n of at least 2 with t·sd/√n ≤ half_width; None if it is above `MOST`."""

    def fits(n: int) -> bool:
        return student_t.quantile((1 + level) / 2, n - 1) * sd / math.sqrt(n) <= half_width

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
