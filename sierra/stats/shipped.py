"""The statistics that SIERRA ships, as plug-ins on the contract in `sierra.stats.base`.

=========  ==========================================  ==================================================================
name       statistic                                   interval
=========  ==========================================  ==================================================================
`mean`     mean                                        Student's t; Wilson's if the column is a rate
`median`   median                                      order statistics, from 6 runs on
`iqm`      interquartile mean                          t of a trimmed mean (Tukey and McLaughlin)
`sd`       standard deviation                          Bonett's, from 5 runs on
`iqr`      distance of the quartiles                   percentile bootstrap, from 10 runs on
`mad`      median absolute deviation from the median   percentile bootstrap, from 10 runs on
`range`    distance of the smallest and largest value  none: it grows with n
`q90`      quantile, here that of 90 %                 order statistics; the further from the median, the more runs
=========  ==========================================  ==================================================================

Those of quantiles hold for any distribution. The others are approximate: `tests/nightly/test_coverage_of_intervals.py` has how
often they contain the true value. A bootstrap of fewer values, and BCa for `sd`, `iqr` and `mad`, were found to be too narrow.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.stats.base import LEVEL, Formula, Parameter
from sierra.stats.order_statistics import ranks

ORDER_STATISTICS = "order statistics"


class InSql:
    """A statistic whose formula is a file in `statistics/`."""

    contract = 1
    Options: ClassVar[type[Table]] = NoOptions
    interval: ClassVar[str] = ""
    formula: ClassVar[Formula]

    def __init__(self, options: Table) -> None:
        pass

    def definition(self, level: float = LEVEL) -> Formula:
        return self.formula


class Mean(InSql):
    """The mean, with Student's t interval, or Wilson's for a rate."""

    interval = "t"
    formula = Formula("mean", "low", "high", "interval", ("interval",))


class Median(InSql):
    """The median, with the interval of order statistics."""

    interval = ORDER_STATISTICS
    formula = Formula("median", "median_low", "median_high", uses=("median_interval",))


class InterquartileMean(InSql):
    """The interquartile mean, with the interval of a trimmed mean."""

    interval = "trimmed t"
    formula = Formula("iqm", "iqm_low", "iqm_high", uses=("iqm_interval",))


class StandardDeviation(InSql):
    """The standard deviation, with Bonett's interval."""

    interval = "Bonett"
    formula = Formula("sd", "sd_low", "sd_high", uses=("sd_interval",))


class Range(InSql):
    """The distance of the smallest and the largest value. It grows with n, so there is no true value for an interval."""

    formula = Formula("CASE WHEN isfinite(max - min) THEN max - min END", uses=("range",))


class Quantile:
    """One quantile (type 7 of Hyndman and Fan 1996), with the interval of order statistics."""

    contract: ClassVar[int] = 1
    Options: ClassVar[type[Table]] = NoOptions
    interval: ClassVar[str] = ORDER_STATISTICS

    def __init__(self, name: str, p: float) -> None:
        self._p = p
        self._name = name.replace(".", "_")

    def definition(self, level: float = LEVEL) -> Formula:
        position = f"((n - 1) * ${self._name}_p)"
        below, above = f"x[1 + floor({position})::INTEGER]", f"x[least(n, 2 + floor({position})::INTEGER)]"
        part = f"({position} - floor({position}))"
        value = (
            f"CASE WHEN {below} = {above} THEN {below} WHEN isfinite({above} - {below}) "
            f"THEN {below} + {part} * ({above} - {below}) ELSE (1 - {part}) * {below} + {part} * {above} END"
        )
        low, high = (f"x[CAST(${self._name}_{end} AS INTEGER[])[n]]" for end in ("low", "high"))
        return Formula(value, low, high, uses=("n",), parameters=partial(self._parameters, level))

    def _parameters(self, level: float, most: int) -> Mapping[str, Parameter]:
        low, high = ranks(self._p, max(1, most), 1 - level)
        return {f"{self._name}_p": self._p, f"{self._name}_low": low, f"{self._name}_high": high}
