"""Shipped statistics whose interval is a percentile bootstrap: the interquartile range and the median absolute deviation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from sierra.config.field_types import Table
from sierra.stats.base import LEVEL, Estimate, Function
from sierra.stats.bootstrap import BootstrapOptions, Vectorized, estimate

Floats = npt.NDArray[np.float64]
SMALLEST = 10
"""The smallest number of values with an interval."""


class Resampled:
    """A statistic that is computed again for values that are drawn from the values."""

    contract = 1
    Options: ClassVar[type[Table]] = BootstrapOptions
    interval = "percentile bootstrap"
    function: ClassVar[Vectorized]

    def __init__(self, options: BootstrapOptions) -> None:
        self._options = options

    def definition(self, level: float = LEVEL) -> Function:
        return Function(partial(self._estimate, level))

    def _estimate(self, level: float, values: Sequence[float]) -> Estimate:
        return estimate(type(self).function, values, self._options, method="percentile", smallest=SMALLEST, level=level)


def interquartile_range(values: Floats, axis: int = -1) -> Any:
    """Return the distance of the quartiles (type 7 of Hyndman and Fan 1996)."""
    q1, q3 = np.quantile(values, (0.25, 0.75), axis=axis)
    return q3 - q1


def median_absolute_deviation(values: Floats, axis: int = -1) -> Any:
    """Return the median of the distances from the median, without a factor."""
    return np.median(np.abs(values - np.median(values, axis=axis, keepdims=True)), axis=axis)


class InterquartileRange(Resampled):
    """The interquartile range."""

    function = staticmethod(interquartile_range)


class MedianAbsoluteDeviation(Resampled):
    """The median absolute deviation from the median."""

    function = staticmethod(median_absolute_deviation)
