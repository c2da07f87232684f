"""Intervals of any statistic by the bootstrap, with SciPy: always the same for the same values.

`BCa` is the bias-corrected and accelerated bootstrap (Efron 1987, J. Am. Stat. Assoc. 82: 171-185); `percentile` has the
quantiles of the resampled statistic as ends. Each call begins with the same seed, so that a result depends on the values alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from math import isfinite
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from sierra.config.field_types import Table
from sierra.stats.base import LEVEL, Estimate

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

AT_ONCE = 4_000_000
"""The largest number of resampled values that are in memory at once."""
Vectorized = Callable[..., Any]
"""A function `f(values, axis=-1)` that reduces this axis of an array."""


class BootstrapOptions(Table):
    """The options of a statistic whose interval is a bootstrap."""

    resamples: int = Field(9999, ge=999, le=1_000_000, description="number of times that the values are drawn again")
    seed: int = Field(1, ge=0, description="seed of these draws")


def estimate(
    function: Vectorized,
    values: Sequence[float],
    options: BootstrapOptions,
    *,
    method: Literal["BCa", "percentile"] = "BCa",
    smallest: int = 10,
    level: float = LEVEL,
) -> Estimate:
    """Return the statistic and its interval; no interval for fewer than `smallest` values, or if it is not a finite number.

    With few values, a bootstrap is too narrow, because it draws only from them.
    """
    import numpy as np

    if not values:
        return Estimate(None)
    x = np.asarray(values, dtype=float)
    value = float(function(x, axis=-1))
    if not isfinite(value):
        return Estimate(None)
    if len(x) < smallest:
        return Estimate(value)
    if x.min() == x.max():
        return Estimate(value, value, value)
    low, high = _interval(function, x, options, method, level)
    if not (isfinite(low) and isfinite(high)):
        return Estimate(value)
    return Estimate(value, min(low, value), max(high, value))


def _interval(
    function: Vectorized, x: npt.NDArray[np.float64], options: BootstrapOptions, method: str, level: float
) -> tuple[float, float]:
    import numpy as np
    from scipy import stats

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        interval = stats.bootstrap(
            (x,),
            function,
            n_resamples=options.resamples,
            batch=max(1, AT_ONCE // len(x)),
            vectorized=True,
            axis=-1,
            confidence_level=level,
            method=method,
            rng=np.random.default_rng(options.seed),
        ).confidence_interval
    return float(interval.low), float(interval.high)
