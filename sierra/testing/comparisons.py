"""Conformance suite for comparison methods, as functions that a plug-in's author calls in tests.

    from sierra.testing import comparisons as conformance

    def test_it_is_a_comparison_method():
        conformance.check("welch")

The package must be installed, because methods are found by their name. The suite makes its own data from what the method
`takes`. Each claim is one function of a `Trial`, and can be called alone. A broken claim raises AssertionError with one line,
even if Python runs with `-O`.

The suite can't know the right p values: test them against a second source.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from sierra.config.field_types import RawTable
from sierra.config.plugin_registry import COMPARISONS
from sierra.errors import UsageError
from sierra.stats.comparison.analyse import analyse
from sierra.stats.comparison.base import TAKES, CellResult, ComparisonMethod
from sierra.stats.comparison.model import Analysis, Cell, Pair, Question, RunValue, Sample
from sierra.stats.comparison.wording import paragraph
from sierra.testing.assertions import holds, says_what_its_options_are

REPEATS = 200
"""The number of simulated comparisons of equal groups."""
FALSE = 0.12
"""The largest part of them in which a test at alpha = 0.05 may find a difference: chance alone exceeds it once in 10,000."""


@dataclass
class Trial:
    """A comparison method to test."""

    name: str
    options: RawTable = field(default_factory=dict)

    @property
    def takes(self) -> frozenset[str]:
        """Return what the method takes."""
        found: frozenset[str] = COMPARISONS.load(self.name).takes
        return found

    @property
    def paired(self) -> bool:
        """Return whether its data are pairs."""
        return "pairs" in self.takes

    def made(self) -> ComparisonMethod:
        """Return the method."""
        made: ComparisonMethod = COMPARISONS.make(self.name, {self.name: self.options})
        return made

    def tests(self, cell: Cell, question: Question | None = None) -> CellResult:
        """Return the tests of a cell."""
        return self.made().compare(cell, question or Question(), paired=self.paired)

    def analysed(self, cell: Cell) -> Analysis:
        """Return the whole analysis of a cell, as `sierra compare` makes it."""
        return analyse([cell], Question(), cell.names, self.name, {self.name: self.options})

    def cell(self, *means: float, n: int = 12, seed: int = 1) -> Cell:
        """Return groups of normal values around means; two factors with two values each, if the method takes factors.

        If it takes rates, there are 0 and 1 instead; their rates have the order of the means.
        """
        rng = random.Random(seed)
        if "factors" in self.takes:
            means = (means[0], means[0], means[-1], means[-1])
        rate = "rates" in self.takes
        draw = partial(_flag, rng, means) if rate else rng.gauss
        samples = tuple(
            Sample(f"g{index}", tuple(RunValue(run, draw(mean)) for run in range(n)), n, index)
            for index, mean in enumerate(means)
        )
        if "factors" not in self.takes:
            return Cell({"noise": 0.5}, samples, rate=rate)
        return Cell({}, samples, ((0, 0), (0, 1), (1, 0), (1, 1)), ("a", "b"))


def _flag(rng: random.Random, means: Sequence[float], mean: float) -> float:
    """Return 0 or 1, with a rate that is 0.5 if all means are equal, and otherwise from 0.04 for the lowest to 0.96."""
    others = len(set(means)) - 1
    rate = 0.04 + 0.92 * sorted(set(means)).index(mean) / others if others else 0.5
    return float(rng.random() < rate)


def check(name: str, options: RawTable | None = None) -> None:
    """Check all claims about the comparison method `name`. `options` are those of `[comparison_methods.NAME]`."""
    trial = Trial(name, options or {})
    for claim in CLAIMS:
        claim(trial)


def declares_what_it_takes(trial: Trial) -> None:
    """Check its options, and that it says what it takes and how its test is called."""
    found = COMPARISONS.load(trial.name)
    says_what_its_options_are(found)
    holds(found.takes <= TAKES, f"takes has {', '.join(sorted(found.takes - TAKES))}; known are {', '.join(sorted(TAKES))}")
    holds(bool(found.takes & {"pairs", "samples"}), "takes has neither pairs nor samples")
    holds(isinstance(found.title, str) and bool(found.title), f"title is {found.title!r}, not the name of a test")


def compares_each_two_groups(trial: Trial) -> None:
    """Check the groups and the signs of differences of two and three groups, with and without a group to compare with."""
    if "factors" in trial.takes:
        names = [effect.name for effect in trial.tests(trial.cell(0, 3)).effects]
        holds({"a", "b"} <= set(names), f"two factors a and b have the effects {', '.join(names)}")
        return
    for question, expected in (
        (Question(), [("g0", "g1"), ("g0", "g2"), ("g1", "g2")]),
        (Question(against="g1"), [("g1", "g0"), ("g1", "g2")]),
    ):
        pairs = trial.tests(trial.cell(0, 20, 40), question).pairs
        compared = [(pair.first, pair.second) for pair in pairs]
        holds(sorted(compared) == sorted(expected), f"it compares {compared}, not {expected} (against: {question.against})")
        for pair in pairs:
            up = pair.second > pair.first
            right = pair.difference is None or (pair.difference > 0) is up
            holds(right, f"{pair.second} − {pair.first} is {pair.difference}; it should be {'above' if up else 'below'} 0")
            holds(dict(pair.point) == {"noise": 0.5}, f"the point of a pair is {dict(pair.point)}, not that of its cell")


def has_p_values_and_intervals(trial: Trial) -> None:
    """Check p values, smallest p values and intervals for small, equal and very different values."""
    cells = [trial.cell(0, 0, n=n) for n in (2, 3, 5, 40)] + [trial.cell(0, 100), trial.cell(-1e9, 1e9)]
    for cell in [*cells, _equal(trial)]:
        try:
            tests = trial.tests(cell)
        except UsageError:
            continue
        for p in _p_values(tests):
            holds(0 <= p <= 1, f"a p value of {len(cell.samples[0].values)} runs is {p}")
        for pair in tests.pairs:
            _has_a_right_interval(pair)


def _equal(trial: Trial) -> Cell:
    cell = trial.cell(0, 0)
    samples = (Sample(one.group, tuple(RunValue(run.seed, 1.0) for run in one.values), one.planned) for one in cell.samples)
    return replace(cell, samples=tuple(samples))


def _has_a_right_interval(pair: Pair) -> None:
    ends = (pair.low, pair.high)
    holds((pair.low is None) == (pair.high is None), f"an interval has one end: {ends}")
    if pair.low is not None and pair.high is not None:
        holds(pair.difference is not None and pair.low <= pair.difference <= pair.high, f"{pair.difference} is outside {ends}")
    holds(0 <= pair.smallest <= 1, f"the smallest possible p value is said to be {pair.smallest}")
    numbers = [number for number in (pair.difference, *ends) if number is not None]
    holds(all(map(math.isfinite, numbers)), f"a difference or its interval is not finite: {numbers}")


def finds_what_is_there_and_seldom_what_is_not(trial: Trial) -> None:
    """Check that groups far apart differ, and that equal groups differ in about 5 % of simulations at most."""
    far = min(_p_values(trial.tests(trial.cell(0, 9, n=30))))
    holds(far < 0.001, f"groups that are far apart have the p value {far}")
    found = [_first(trial.tests(trial.cell(0, 0, seed=seed))) <= 0.05 for seed in range(REPEATS)]
    holds(sum(found) <= FALSE * REPEATS, f"equal groups differ in {sum(found)} of {REPEATS} simulations at alpha = 0.05")


def tests_for_equivalence_if_it_takes_a_margin(trial: Trial) -> None:
    """Check that a margin gives a p value of equivalence, which is small for equal groups and large for others."""
    if "margin" not in trial.takes:
        return
    for means, margin, equivalent in (((0, 0), 5.0, True), ((0, 9), 0.1, False)):
        (pair,) = trial.tests(trial.cell(*means, n=30), Question(margin=margin)).pairs
        p = pair.p_equivalent
        holds(p is not None and (p < 0.05) is equivalent, f"groups with means {means} and margin {margin}: p_equivalent is {p}")


def is_repeatable(trial: Trial) -> None:
    """Check that the same values give the same results, and that the report can be written."""
    cell = trial.cell(0, 1)
    holds(trial.tests(cell) == trial.tests(cell), "the same values give another result the second time")
    holds(bool(paragraph(trial.analysed(cell), "the value")), "there is no text")


def _p_values(tests: CellResult) -> Iterator[float]:
    yield from (one.p for one in tests.pairs)
    yield from (one.p for one in tests.effects)
    if tests.omnibus:
        yield tests.omnibus.p


def _first(tests: CellResult) -> float:
    """Return the p value of one test: of the first effect, or of the first two groups."""
    return tests.effects[0].p if tests.effects else tests.pairs[0].p


CLAIMS: tuple[Callable[[Trial], None], ...] = (
    declares_what_it_takes,
    compares_each_two_groups,
    has_p_values_and_intervals,
    finds_what_is_there_and_seldom_what_is_not,
    tests_for_equivalence_if_it_takes_a_margin,
    is_repeatable,
)
