"""The statistic `laggards`: the mean of the slowest part of the runs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

from pydantic import Field

from sierra.plugin import BootstrapOptions, Estimate, Function, Table, bootstrap


class LaggardsOptions(BootstrapOptions):
    """The options of laggards."""

    part: float = Field(0.5, gt=0, le=1, description="part of the runs that counts, from the smallest value on")


class Laggards:
    """The statistic of laggards, with a bootstrap as interval."""

    contract = 1
    Options: ClassVar[type[Table]] = LaggardsOptions
    interval = "BCa bootstrap"

    def __init__(self, options: LaggardsOptions) -> None:
        self._options = options

    def definition(self, level: float = 0.95) -> Function:
        return Function(partial(self._estimate, level))

    def _estimate(self, level: float, values: Sequence[float]) -> Estimate:
        return bootstrap(self._mean, values, self._options, method="BCa", smallest=20, level=level)

    def _mean(self, values: Any, axis: int = -1) -> Any:
        import numpy as np

        count = max(1, int(values.shape[axis] * self._options.part))
        return np.sort(values, axis=axis).take(range(count), axis=axis).mean(axis=axis)
