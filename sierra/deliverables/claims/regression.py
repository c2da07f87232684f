"""Regressions: changes of claims for the worse since a baseline.

A value with `regression` and `better` is decided by the 95 % interval of the change, as a test of non-inferiority: it is a
regression if the whole interval is worse than the margin, and none if no part of the interval is. Everything else can't be
told. So a change within the margin is called a regression with a probability of at most 2.5 %, even at the margin itself; noise
alone, without a change, far less often. A regression is shown if the runs suffice for an interval that is narrower than the
part of the change beyond the margin.

The interval of the change:

- Runs with the same seeds and the same values: the change is 0.
- The mean over runs with the same seeds: Student's t interval of the mean of the differences within pairs. It is right also if
  pairs do not correlate.
- Rates over runs with the same seeds: Newcombe's interval of pairs (see `sierra.stats.rates`).
- All others: from the intervals of both values, by the square-and-add method (Zou and Donner 2008, Stat. Med.
  27: 1693-1702; of rates: Newcombe 1998, Stat. Med. 17: 873-890).

Other claims have no margin: a regression is that a claim which held does not hold. The intervals of several claims are not
corrected for each other.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Protocol

from sierra.config.claim_table import ClaimedValue, distance
from sierra.config.project_file import Project
from sierra.deliverables.claims.baseline import ClaimInBaseline, decision_of
from sierra.deliverables.claims.by_value import decide
from sierra.deliverables.claims.model import Evaluated, Ground, Registration, Verdict
from sierra.stats import rates, student_t
from sierra.stats.rates import Interval, square_and_add
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import digits_apart, short_number


class Change(StrEnum):
    """The conclusion about a claim since the baseline."""

    no_regression = "no regression"
    regression = "regression"
    cannot_tell = "can't tell"


OF_VERDICT = {
    Verdict.holds: Change.no_regression,
    Verdict.does_not_hold: Change.regression,
    Verdict.cannot_tell: Change.cannot_tell,
}


class Estimate(Protocol):
    """A value with its interval, and the values of the runs by seed."""

    @property
    def value(self) -> float | None: ...
    @property
    def low(self) -> float | None: ...
    @property
    def high(self) -> float | None: ...
    @property
    def runs(self) -> Mapping[str, float]: ...
    @property
    def n(self) -> int: ...


@dataclass(frozen=True, slots=True)
class Changed:
    """The change of one claim since a baseline."""

    name: str
    says: str
    verdict: Change
    text: str
    """The numbers, in one line."""
    now: Evaluated
    difference: float | None = None
    """The value now minus that of the baseline, in the column's unit; None if it is not decided by a margin."""
    low: float | None = None
    """The lower end of the 95 % interval of `difference`."""
    high: float | None = None

    @property
    def n(self) -> int:
        """Return the number of runs with a value now."""
        return self.now.n

    @property
    def ground(self) -> Ground:
        """Return the origin of the data now."""
        return self.now.ground

    @property
    def registration(self) -> Registration:
        """Return the registration of the claim as it is now."""
        return self.now.registration

    @property
    def notes(self) -> tuple[str, ...]:
        """Return notes on data that are not in the numbers now."""
        return self.now.notes


def compare(config: Project, evaluations: Sequence[Evaluated], baseline: Mapping[str, ClaimInBaseline]) -> tuple[Changed, ...]:
    """Return the changes of evaluated claims since a baseline."""
    return tuple(_compared(config, evaluation, baseline.get(evaluation.name)) for evaluation in evaluations)


def _compared(config: Project, now: Evaluated, before: ClaimInBaseline | None) -> Changed:
    claim = config.claims[now.name]
    if before is None:
        return Changed(now.name, now.says, Change.cannot_tell, "it is not in the baseline", now)
    if before.decision != decision_of(config, claim):
        return Changed(now.name, now.says, Change.cannot_tell, "it is not decided as in the baseline", now)
    if claim.value and claim.value.regression is not None:
        return _by_margin(claim.value, now, before)
    text = f"{before.verdict} → {now.verdict}: {now.text}"
    return Changed(now.name, now.says, _of_verdicts(before.verdict, now.verdict), text, now)


def _of_verdicts(before: str, now: str) -> Change:
    """Return the change of a verdict: one that did not hold cannot become worse."""
    if now == Verdict.holds or before == Verdict.does_not_hold:
        return Change.no_regression
    return Change.regression if (before, now) == (Verdict.holds, Verdict.does_not_hold) else Change.cannot_tell


def _by_margin(asked: ClaimedValue, now: Evaluated, before: ClaimInBaseline) -> Changed:
    if before.value is None or now.value is None:
        missing = f"the baseline has no value: {before.text}" if before.value is None else now.text
        return Changed(now.name, now.says, Change.cannot_tell, missing, now)
    margin = distance(asked.regression or 0.0, before.value)
    estimate = change(before, now, asked.statistic)
    digits = digits_apart([now.value, before.value])
    what = f"{short_number(now.value, digits)} instead of {short_number(before.value, digits)}"
    if estimate is None:
        return Changed(now.name, now.says, Change.cannot_tell, f"{what}; the runs are too few for an interval", now)
    difference, low, high = estimate
    worse = (low, high) if asked.better == "lower" else (-high, -low)
    verdict = OF_VERDICT[decide(*worse, -math.inf, margin)]
    text = f"{what}: change {difference:+.6g}, 95 % CI [{low:.6g}, {high:.6g}], {asked.better} is better, margin {margin:.6g}"
    return Changed(now.name, now.says, verdict, text, now, difference, low, high)


def change(before: Estimate, now: Estimate, statistic: str) -> tuple[float, float, float] | None:
    """Return the change of a value and its 95 % interval; None if there is none."""
    if None in (before.value, before.low, before.high, now.value, now.low, now.high):
        return None
    pairs = _pairs(before, now)
    if pairs and all(old == new for old, new in pairs):
        return 0.0, 0.0, 0.0
    if len(pairs) > 1 and statistic == "mean":
        return _of_rates(pairs) if _is_rate(pairs) else _of_pairs([new - old for old, new in pairs])
    return _of_intervals(before, now)


def _pairs(before: Estimate, now: Estimate) -> list[tuple[float, float]]:
    """Return the values of runs with the same seed; none unless the seeds are the same, and each is that of one run."""
    if before.runs.keys() != now.runs.keys() or not len(before.runs) == before.n == now.n:
        return []
    return [(value, now.runs[seed]) for seed, value in before.runs.items()]


def _is_rate(pairs: Sequence[tuple[float, float]]) -> bool:
    return all(value in (0, 1) for pair in pairs for value in pair)


def _of_rates(pairs: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Return the difference of the rates of pairs, and Newcombe's interval."""
    counts = (pairs.count(which) for which in ((1, 1), (1, 0), (0, 1), (0, 0)))
    return rates.of_pairs(rates.Pairs(*counts), statistics.NormalDist().inv_cdf(0.975))


def _of_pairs(differences: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean of differences and its t interval: mean ± t · s / √n."""
    mean, n = statistics.fmean(differences), len(differences)
    half = student_t.quantile(0.975, n - 1) * statistics.stdev(differences) / math.sqrt(n)
    return mean, mean - half, mean + half


def _of_intervals(before: Estimate, now: Estimate) -> tuple[float, float, float]:
    """Return the difference d of two independent values, and its interval.

    It is d − √((now − its low)² + (high of before − before)²) to d + √((high of now − now)² + (before − its low)²).
    """
    first, second = (Interval(estimate.value or 0.0, estimate.low or 0.0, estimate.high or 0.0) for estimate in (before, now))
    return square_and_add(first, second)
