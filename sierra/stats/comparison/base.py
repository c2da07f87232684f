"""The contract of comparison methods: the tests of the groups of one cell, with the sizes of their differences.

SIERRA ships the methods in `sierra.stats.comparison.shipped`. Others are entry points of the group `sierra.comparisons` (see
`sierra.plugin`). The name of the entry point is the name in `sierra compare --method NAME` and in
`[comparisons.…] method = "NAME"`. `sierra.testing.comparisons` has the conformance suite.

SIERRA does what all methods have in common: it collects the values of runs, says which are missing, decides about pairs,
corrects the p values of all pairs of a report (Holm), decides the verdicts, and writes the table, the text and the figure.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

from sierra.config.field_types import Table
from sierra.stats.comparison.model import Cell, Effect, Omnibus, Pair, Question
from sierra.util.lazy_definitions import dataclass

TAKES = frozenset({"pairs", "samples", "censored", "factors", "margin", "rates"})
"""Data that methods may take: runs with the same seed as pairs, runs without pairs, censored times, factors, a margin, rates.

A method that takes censored times or factors can use other values too, but one that takes rates can use nothing else."""


@dataclass(frozen=True, slots=True)
class CellResult:
    """The results of the tests of one cell. Their p values are those of single tests: SIERRA corrects them."""

    pairs: tuple[Pair, ...] = ()
    omnibus: Omnibus | None = None
    """A test of whether any of more than two groups differs. It is shown beside the pairs, and decides about none of them."""
    effects: tuple[Effect, ...] = ()


class ComparisonMethod(Protocol):
    """One way to compare groups of runs.

    - Each sample of a cell has a value or more; all values are finite. There are two groups or more.
    - A common whole number is subtracted from all values of a comparison if they are whole numbers beyond 2⁵³, which no float
      holds. So only differences have a meaning.
    - p values are from 0 to 1. `Pair.smallest` is the smallest p value that an exact test can have with these numbers of runs,
      or 0. A difference is shown only if both p and `smallest` allow it.
    - `Pair.difference` is `second` minus `first`, in the column's unit. Its interval has the confidence 1 − alpha, and
      contains it. Without an interval, both ends are None: no interval is better than a wrong one.
    - With `Question.against`, each pair has that group as `first`, and there is a pair for each other group. Without it, there
      is a pair for each two groups: `pairs_of` returns them.
    - With `Question.margin`, each pair has `p_equivalent`, the p value of the claim that the difference is within ±margin.
    - The result depends on nothing but the values, the question and the options. The same values give the same result.
    """

    contract: ClassVar[int]
    """The version of the contract: 1."""
    Options: ClassVar[type[Table]]
    """The model of `[comparison_methods.NAME]`."""
    title: ClassVar[str]
    """The name of its test, as in `Mann-Whitney test`."""
    takes: ClassVar[frozenset[str]]
    """The inputs that it can use, of `TAKES`; `pairs` or `samples` or both. Any other is refused before it is called."""
    estimates: ClassVar[str]
    """Its differences, in the plural, as in `Hodges-Lehmann estimates`, for the figure and the text; empty if it has none."""

    def __init__(self, options: Any, /) -> None: ...

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        """Return the tests of one cell. If `paired`, only seeds with a value in all samples count.

        With `cell.factors`, the samples are combinations of factors. Raises UsageError if the values do not suit.
        """

    def smallest(self, n: int) -> float:
        """Return the smallest p value of two groups of n runs, or of n pairs; 0 if there is none."""


def pairs_of(cell: Cell, question: Question) -> list[tuple[int, int]]:
    """Return the places of each two samples to compare; `against` is always the first."""
    groups = [sample.group for sample in cell.samples]
    if question.against is None:
        return [(first, second) for first in range(len(groups)) for second in range(first + 1, len(groups))]
    base = groups.index(question.against)
    return [(base, second) for second in range(len(groups)) if second != base]
