"""The comparison methods that SIERRA ships, as plug-ins on the contract in `sierra.stats.comparison.base`.

===============  ==========================================================  ===========================================
name             tests                                                       for
===============  ==========================================================  ===========================================
`signed_rank`    Wilcoxon's signed-rank test of each two groups              pairs
`rank_sum`       the Mann-Whitney test of each two groups                    no pairs
`friedman`       Friedman's test, then Wilcoxon's of each two groups         pairs, more than two groups
`kruskal`        the Kruskal-Wallis test, then Dunn's of each two groups     no pairs, more than two groups
`log_rank`       the log-rank test of each two groups                        times that some runs never reached
`aligned_ranks`  analysis of variance of aligned ranks                       factors (`--by a,b`), with pairs or without
===============  ==========================================================  ===========================================

By default (`auto`), the data decide: see `suitable`.
"""

from __future__ import annotations

from typing import ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.stats.comparison.base import CellResult, pairs_of
from sierra.stats.comparison.model import Cell, Question

HODGES_LEHMANN = "Hodges-Lehmann estimates"


def suitable(*, factors: bool, censored: bool, paired: bool, several: bool) -> str:
    """Return the name of the method for data of this kind."""
    if factors:
        return "aligned_ranks"
    if censored:
        return "log_rank"
    if several:
        return "friedman" if paired else "kruskal"
    return "signed_rank" if paired else "rank_sum"


class _Shipped:
    """A method without options."""

    contract = 1
    Options: ClassVar[type[Table]] = NoOptions
    title: ClassVar[str]
    takes: ClassVar[frozenset[str]]
    estimates: ClassVar[str] = HODGES_LEHMANN

    def __init__(self, options: Table) -> None:
        pass

    def smallest(self, n: int) -> float:
        from sierra.stats.comparison import rank_tests

        return rank_tests.smallest_rank_sum(n, n)


class SignedRank(_Shipped):
    """Wilcoxon's signed-rank test of each two groups."""

    title = "Wilcoxon signed-rank test"
    takes = frozenset({"pairs", "margin"})

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        from sierra.stats.comparison import one_cell

        return CellResult(tuple(one_cell.signed_rank(cell, question, *places) for places in pairs_of(cell, question)))

    def smallest(self, n: int) -> float:
        from sierra.stats.comparison import rank_tests

        return rank_tests.smallest_signed_rank(n)


class Friedman(SignedRank):
    """Friedman's test of three groups or more, then Wilcoxon's signed-rank test of each two."""

    title = "Friedman test"

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        from sierra.stats.comparison import one_cell

        omnibus = one_cell.friedman(cell, question) if len(cell.samples) > 2 else None
        return CellResult(super().compare(cell, question, paired=paired).pairs, omnibus)


class RankSum(_Shipped):
    """The Mann-Whitney test of each two groups."""

    title = "Mann-Whitney test"
    takes = frozenset({"samples", "margin"})

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        from sierra.stats.comparison import one_cell

        return CellResult(tuple(one_cell.rank_sum(cell, question, *places) for places in pairs_of(cell, question)))


class Kruskal(_Shipped):
    """The Kruskal-Wallis test of three groups or more, then Dunn's test of each two; the Mann-Whitney test of only two."""

    title = "Kruskal-Wallis test"
    takes = frozenset({"samples", "margin"})

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        from sierra.stats.comparison import one_cell

        several = len(cell.samples) > 2
        pairs = (one_cell.rank_sum(cell, question, *places, dunn=several) for places in pairs_of(cell, question))
        return CellResult(tuple(pairs), one_cell.kruskal(cell) if several else None)


class LogRank(_Shipped):
    """The log-rank test of each two groups of times, of which some may be censored."""

    title = "log-rank test"
    takes = frozenset({"samples", "censored"})
    estimates = "differences of Kaplan-Meier medians"

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        from sierra.stats.comparison import one_cell

        return CellResult(tuple(one_cell.log_rank(cell, *places) for places in pairs_of(cell, question)))


class AlignedRanks(_Shipped):
    """The analysis of variance of aligned ranks: main effects and interactions."""

    title = "analysis of variance of aligned ranks"
    takes = frozenset({"pairs", "samples", "factors"})
    estimates = ""

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        from sierra.stats.comparison import one_cell

        return CellResult(effects=tuple(one_cell.effects(cell, paired=paired)))
