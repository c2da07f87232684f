"""Mean ranks of groups over blocks, and which groups were not shown to differ: the content of a critical-difference diagram.

A block has one value of each group, for example one scenario, or one seed. Within each block the groups are ranked, the best
one first (Demšar 2006, J. Mach. Learn. Res. 7: 1-30). Friedman's test is a statement about all groups, and decides about no
two of them. Two groups differ by one of two tests:

- Nemenyi's: their mean ranks differ by the critical difference or more.
- Wilcoxon's signed-rank test of their values, corrected by Holm over all tests, as in `sierra compare`. It does not depend on
  the other groups (Benavoli, Corani and Mangili 2016, J. Mach. Learn. Res. 17: 1-10).

Two groups alone are compared by Wilcoxon's test.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Literal

from sierra.stats.comparison import rank_tests
from sierra.stats.comparison.analyse import analyse
from sierra.stats.comparison.model import Cell, Question, RunValue, Sample, Verdict
from sierra.stats.comparison.ties import Floats, each_alike
from sierra.util.lazy_definitions import dataclass

Test = Literal["nemenyi", "wilcoxon"]


@dataclass(frozen=True, slots=True)
class Ranking:
    """The groups by their mean rank, the best one first."""

    groups: tuple[str, ...]
    ranks: tuple[float, ...]
    """The mean rank of each group, in ascending order; 1 is the best."""
    alike: frozenset[tuple[int, int]]
    """The pairs of places, the lower one first, of groups that were not shown to differ."""
    blocks: int
    alpha: float
    p: float | None
    """The p value of Friedman's test; None for two groups."""
    critical: float | None
    """The critical difference of mean ranks; None if pairs were compared by Wilcoxon's test."""
    enough: bool
    """False if no result of the tests could have shown a difference with this number of blocks."""
    left_out: int = 0
    """The number of blocks in which some group has no value."""

    @property
    def bars(self) -> tuple[tuple[int, int], ...]:
        """Return the first and last place of each longest row of groups, of which no two were shown to differ."""
        count = len(self.groups)
        last = [max(end for end in range(start, count) if self._all_alike(start, end)) for start in range(count)]
        return tuple((start, end) for start, end in enumerate(last) if end > start and (start == 0 or last[start - 1] < end))

    @property
    def beside(self) -> tuple[tuple[int, int], ...]:
        """Return the pairs that were not shown to differ, and that no bar joins, because groups between them differ."""
        joined = {pair for start, end in self.bars for pair in combinations(range(start, end + 1), 2)}
        return tuple(sorted(self.alike - joined))

    def _all_alike(self, start: int, end: int) -> bool:
        return all(pair in self.alike for pair in combinations(range(start, end + 1), 2))


def ranking(groups: Sequence[str], values: Floats, test: Test, alpha: float, *, best_is_high: bool) -> Ranking:
    """Return the ranking of groups by their values: a row for each block, a column for each group; two of each at least."""
    values = each_alike(values)
    means = rank_tests.mean_ranks_in_blocks(-values if best_is_high else values)
    order = sorted(range(len(groups)), key=lambda group: means[group])
    names, values = [groups[group] for group in order], values[:, order]
    of_pairs = _by_wilcoxon if test == "wilcoxon" or len(groups) == 2 else _by_nemenyi
    p = rank_tests.friedman(values)[1] if len(groups) > 2 else None
    ranks = sorted(means)
    alike, critical, enough = of_pairs(ranks, values, alpha)
    return Ranking(tuple(names), tuple(ranks), frozenset(alike), len(values), alpha, p, critical, enough)


def _by_nemenyi(ranks: Sequence[float], values: Floats, alpha: float) -> tuple[set[tuple[int, int]], float | None, bool]:
    critical = rank_tests.critical_difference(len(ranks), len(values), alpha)
    alike = {(one, other) for one, other in combinations(range(len(ranks)), 2) if ranks[other] - ranks[one] < critical}
    return alike, critical, critical <= len(ranks) - 1


def _by_wilcoxon(ranks: Sequence[float], values: Floats, alpha: float) -> tuple[set[tuple[int, int]], float | None, bool]:
    names = [str(place) for place in range(len(ranks))]
    samples = tuple(
        Sample(name, tuple(RunValue(block, value) for block, value in enumerate(column)), len(values))
        for name, column in zip(names, values.T.tolist(), strict=True)
    )
    pairs = analyse([Cell({}, samples)], Question(alpha, paired=True)).pairs
    alike = {(int(one.first), int(one.second)) for one in pairs if one.verdict is not Verdict.different}
    return alike, None, any(one.verdict is not Verdict.too_few for one in pairs)
