"""Looks at data that is still being collected: their schedule, and the correction for looking several times.

A study that stops as soon as an interval is narrow enough stops rather where the interval is too narrow by chance. So the
interval at the stop contains the true value less often than it says: with 95 % intervals of the mean of normal values,
looked at with 10, 15, 23, … runs, in about 94 %, and of exponential values in 86 to 91 %.

The intervals of all looks together miss the true value with a probability of at most alpha if each of K looks uses the level
1 − alpha / K (Bonferroni's inequality). These are repeated confidence intervals (Jennison and Turnbull 1989, J. R. Stat.
Soc. B 51: 305-361). They hold whatever rule stops the study, and for every statistic, because nothing is assumed about how
looks depend on each other. They are conservative: for normal values, 99 % contain the true value. Group-sequential boundaries
(Pocock, O'Brien and Fleming) are narrower, but they hold only for means of many runs with known variance.

The correction adds nothing to the intervals themselves: where they are too narrow for few runs of a skewed quantity, those
of a study are so too.
"""

from __future__ import annotations

import math

from sierra.errors import UsageError

FIRST = 10
"""The default number of runs at the first look."""
GROWTH = 1.5
"""The factor from one look to the next. Each look costs confidence; a larger factor wastes more runs after the last one."""
CORRECTION = "bonferroni"
"""The name of the correction in records."""


def schedule(first: int, most: int) -> tuple[int, ...]:
    """Return the numbers of runs per experiment at each look. Raises UsageError unless 2 ≤ first ≤ most."""
    if first < 2:
        raise UsageError(f"the first look has {first} run per experiment; an interval needs 2 or more (--runs)")
    if most < first:
        raise UsageError(f"--max-runs {most} is below the {first} runs of the first look (--runs)")
    looks = [first]
    while looks[-1] < most:
        looks.append(min(most, math.ceil(looks[-1] * GROWTH)))
    return tuple(looks)


def level(alpha: float, looks: int) -> float:
    """Return the confidence of the intervals at each of some looks."""
    return 1 - alpha / looks


def estimate(n: int, half_width: float, wanted: float) -> int | None:
    """Return about how many runs make an interval narrower than wanted: its width falls with √n. None if there is no answer."""
    if wanted <= 0 or not math.isfinite(half_width / wanted):
        return None
    return max(n + 1, math.ceil(n * (half_width / wanted) ** 2))
