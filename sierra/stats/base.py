"""The contract of statistics: a number over the values of runs, with its interval.

SIERRA ships `mean`, `median`, `iqm`, `sd`, `iqr`, `mad` and `range` (see `sierra.stats.shipped`) and quantiles such as `q90`.
Others are entry points of the group `sierra.statistics` (see `sierra.plugin`). The name of the entry point is the name in
`sierra stats --statistic NAME`. `sierra.testing.statistics` has the conformance suite.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Protocol, TypeAlias

from sierra.config.field_types import Table
from sierra.util.lazy_definitions import dataclass, field

LEVEL = 0.95
"""The confidence of intervals, if nothing else is requested."""
Parameter: TypeAlias = bool | float | str | Sequence[float | None] | None
"""The value of a parameter in SQL."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its interval of confidence; None as ends if there is no interval."""

    value: float | None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, slots=True)
class Formula:
    """A statistic as SQL expressions over `x`, the sorted finite values, and `n`, their number."""

    value: str
    low: str = "NULL"
    high: str = "NULL"
    method: str = ""
    """An expression for the name of the method of the interval; empty: the statistic's `interval`, where `low` is not NULL."""
    uses: tuple[str, ...] = ()
    """Shipped formulas whose columns the expressions use: names of files in `sierra/stats/statistics/`, such as `sd`."""
    parameters: Callable[[int], Mapping[str, Parameter]] = field(default=lambda most: {})
    """Values of the parameters `$NAME`; the argument is the largest n. Names begin with that of the statistic."""


@dataclass(frozen=True, slots=True)
class Function:
    """A statistic as a Python function of the sorted finite values; it is called for each experiment."""

    estimate: Callable[[Sequence[float]], Estimate]


class Statistic(Protocol):
    """A statistic over the values of the runs of an experiment.

    - Its values are finite and sorted. There may be none, or one.
    - Without values, its value is None. Without an interval, both ends are None: no interval is better than a wrong one.
    - The interval contains the value. Its confidence is 95 %, or the `level` that a sequential study asks for: the higher,
      the wider. A class whose `definition` takes no level works everywhere else.
    - The same values give the same result, to the last bit. A bootstrap has a fixed seed.
    - The result depends on nothing but the values and the options.
    """

    contract: ClassVar[int]
    """The version of the contract: 1."""
    Options: ClassVar[type[Table]]
    """The model of `[statistics.NAME]`."""
    interval: ClassVar[str]
    """The method of its interval, in a few words, as in `BCa bootstrap`; empty if it has none."""

    def __init__(self, options: Any, /) -> None: ...

    def definition(self, level: float = LEVEL) -> Formula | Function:
        """Return how it is computed, with intervals of this confidence. A formula is faster, above all over time.

        The parameters of shipped formulas (`uses`) have this confidence already.
        """
