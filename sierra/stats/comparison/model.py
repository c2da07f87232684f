"""The terms of comparisons: what is compared, and what a comparison finds."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Literal

from sierra.model import Value
from sierra.util.lazy_definitions import dataclass

VERSION = 2
"""The version of how comparisons are computed, which recorded ones keep. Version 1 had no record of it: omnibus tests decided
about pairs, Dunn's test was that of more than two groups, rates were compared by ranks, and values had 12 digits."""
Paired = bool | Literal["auto"]
"""The choices for runs with the same seed: they are pairs or not; `auto`: pairs if they are correlated."""


class Verdict(StrEnum):
    """The conclusion about the difference between two groups."""

    different = "different"
    equivalent = "equivalent"
    both = "different, equivalent"
    """There is a difference, and it is smaller than the margin."""
    open = "not shown"
    """Neither a difference nor equivalence was shown. This does not mean that the groups are equal."""
    too_few = "too few runs"
    """No result of these tests could have shown anything with this number of runs."""


OF_RATES = "difference of rates"
"""The estimate of the comparison of two rates, in words."""


@dataclass(frozen=True, slots=True)
class RunValue:
    """One run as one number."""

    seed: int
    value: float
    reached: bool = True
    """False if the run ended, at time `value`, before it reached the threshold of `time_to`: a censored time."""


@dataclass(frozen=True, slots=True)
class Sample:
    """The runs of one group in one cell."""

    group: str
    values: tuple[RunValue, ...]
    planned: int
    """The number of requested runs; those without a value have failed, are missing or have no finite value."""
    experiment: int = 0
    """The position of the experiment in its batch."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A combination of values of the variables that are not compared, with a sample of each group."""

    point: Mapping[str, Value]
    samples: tuple[Sample, ...]
    factors: tuple[tuple[Value, ...], ...] = ()
    """For a factorial comparison: the values of the factors, for each sample."""
    names: tuple[str, ...] = ()
    """The names of the factors; empty if this is no factorial comparison."""
    rate: bool = False
    """True if all values are 0 or 1, and their mean is a rate."""

    @property
    def name(self) -> str:
        """Return the point in words, as in `population_size = 4`; empty if there is nothing but the groups."""
        return ", ".join(f"{name} = {value}" for name, value in self.point.items())


@dataclass(frozen=True, slots=True)
class Question:
    """The options of a comparison."""

    alpha: float = 0.05
    margin: float | None = None
    """The largest difference that does not matter, in the column's unit; None: equivalence is not tested."""
    paired: Paired = "auto"
    against: str | None = None
    """The group that all others are compared with; None: each group is compared with each other one."""


@dataclass(frozen=True, slots=True)
class Pair:
    """The comparison of two groups in one cell: `second` minus `first`.

    p values are those of one test; the adjusted ones are corrected for all tests of the report (Holm), without omnibus tests.
    The interval is that of this pair alone: it is not corrected for the others.
    """

    point: Mapping[str, Value]
    first: str
    second: str
    n_first: int
    n_second: int
    test: str
    difference: float | None
    """The estimate of the difference: see `estimate`. None if it is not known."""
    low: float | None
    """The lower end of the interval of confidence 1 − alpha of the difference; None if n is too small for one."""
    high: float | None
    a12: float | None
    """The probability that a run of `second` has the greater value, plus half of that of equal values (Vargha-Delaney)."""
    p: float
    smallest: float
    """The smallest p value that this test can have with this n; 0 if it can have any."""
    p_adjusted: float = 1.0
    estimate: str = "median difference"
    """The name of the estimate in `difference`."""
    p_equivalent: float | None = None
    """The p value of two one-sided tests (TOST) that the difference lies within the margin."""
    p_equivalent_adjusted: float | None = None
    statistic: float | None = None
    """For censored times only: a statistic that is above 0 if `first` reaches the threshold earlier."""
    never_first: int = 0
    """The number of runs of `first` that never reached the threshold."""
    never_second: int = 0
    verdict: Verdict = Verdict.open

    @property
    def smallest_equivalent(self) -> float:
        """Return the smallest p value of equivalence that n allows; 0 for rates, whose equivalence is that of an interval."""
        return 0.0 if self.estimate == OF_RATES else self.smallest / 2

    @property
    def direction(self) -> float:
        """Return a number above 0 if `second` has the greater values or later times, and below 0 if `first` has them."""
        if self.statistic is not None:
            return self.statistic
        return self.difference or (0.5 if self.a12 is None else self.a12) - 0.5

    @property
    def delta(self) -> float | None:
        """Return Cliff's delta: 2 · A12 − 1."""
        return None if self.a12 is None else 2 * self.a12 - 1


@dataclass(frozen=True, slots=True)
class Omnibus:
    """One test of whether any of more than two groups differs, in one cell. It decides about no two of them."""

    point: Mapping[str, Value]
    test: str
    groups: tuple[str, ...]
    n: int
    """The number of blocks (paired), or of runs of all groups together."""
    statistic: float | None
    """The statistic, whose distribution is χ² with `df` degrees of freedom; None if the test needs none."""
    df: int | None
    p: float
    mean_ranks: tuple[float, ...]
    """The mean rank of each group; the highest values have the highest ranks. Empty for rates."""
    critical_difference: float | None
    """Mean ranks that differ by more are different, by Nemenyi's test at level alpha; None if the runs are not paired."""
    p_adjusted: float = 1.0
    """The p value, corrected for the omnibus tests of the report only."""


@dataclass(frozen=True, slots=True)
class Effect:
    """A main effect or an interaction in a factorial design, by an analysis of variance of aligned ranks."""

    name: str
    f: float
    df: int
    df_error: int
    p: float
    eta: float
    """Partial eta squared: the share of the rank variance that the other effects do not explain and this one does."""
    p_adjusted: float = 1.0


@dataclass(frozen=True, slots=True)
class Pairing:
    """The decision on comparing runs as pairs, and its reason."""

    paired: bool
    reason: str
    correlation: float | None = None
    """The mean rank correlation (Spearman) of the groups over common seeds; None if there is none."""


@dataclass(frozen=True, slots=True)
class Analysis:
    """The result of all tests of one report."""

    groups: tuple[str, ...]
    question: Question
    pairing: Pairing
    pairs: tuple[Pair, ...] = ()
    omnibus: tuple[Omnibus, ...] = ()
    effects: tuple[Effect, ...] = ()
    tests: int = 0
    """The number of tests that the p values are corrected for; omnibus tests are corrected for each other only."""
    notes: tuple[str, ...] = ()
    """Notes on data that are not in the numbers: runs without a value, pairs that were left out, cells that lack a group."""
    limits: tuple[str, ...] = ()
    """Notes on what the numbers of runs allow: the smallest p value, and groups that cannot be found different."""
    method: str = ""
    """The name of the comparison method."""
    title: str = ""
    """The name of the method's test."""
    estimates: str = ""
    """The name of the estimates of differences, in the plural."""
    version: int = VERSION
    """The version of how comparisons are computed."""
