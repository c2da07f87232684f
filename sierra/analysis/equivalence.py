"""Two one-sided tests: whether paired values are the same but for a margin.

The runs of an experiment are executed a second time, with the same seeds; dᵢ is what run i gives now, less what it gave. With
their mean d̄ over n runs, its standard error s/√n and t = Student's t quantile for 1 − α and n − 1 degrees of freedom,

    the means are equivalent  ⇔  −Δ < d̄ − t·s/√n  and  d̄ + t·s/√n < Δ

(Schuirmann 1987, J. Pharmacokinet. Biopharm. 15: 657-680). Not to be so shown is no proof of a difference: the power, the
probability to show it where there is none, is told beside. It is 2·F(Δ·√n/s − t) − 1, with F Student's t distribution, or 0
(the central-t approximation of Phillips 1990, ibid. 18: 137-144), for the s that was found.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from sierra.analysis import student_t


@dataclass(frozen=True, slots=True)
class Tested:
    """What came of the test; all but `n`, `p`, `power` and `alpha` in the values' unit."""

    n: int
    difference: float
    """The mean of the differences."""
    low: float
    """The interval of confidence 1 − 2α around it."""
    high: float
    margin: float
    alpha: float
    p: float
    """The greater of the two p values."""
    power: float
    equivalent: bool


def test(differences: Sequence[float], margin: float, alpha: float) -> Tested:
    """Test n differences of pairs, all finite; two at least. Raises ValueError for fewer, or a margin that is not above 0."""
    n = len(differences)
    if n < 2 or not margin > 0:
        raise ValueError(f"{n} pairs and a margin of {margin}: two pairs and a margin above 0 are needed")
    mean, error = statistics.fmean(differences), statistics.stdev(differences) / math.sqrt(n)
    if error == 0:
        within = abs(mean) < margin
        return Tested(n, mean, mean, mean, margin, alpha, 0.0 if within else 1.0, 1.0, within)
    t = student_t.quantile(1 - alpha, n - 1)
    low, high = mean - t * error, mean + t * error
    p = max(student_t.tail((mean + margin) / error, n - 1), student_t.tail((margin - mean) / error, n - 1))
    power = max(0.0, 1 - 2 * student_t.tail(margin / error - t, n - 1))
    return Tested(n, mean, low, high, margin, alpha, p, power, -margin < low and high < margin)
