"""The comparison methods that SIERRA ships, as plug-ins on the contract in `sierra.stats.comparison.base`.

===============  ==========================================================  ===========================================
name             tests                                                       for
===============  ==========================================================  ===========================================
`signed_rank`    Wilcoxon's signed-rank test of each two groups              pairs
`friedman`       the same                                                    pairs
`rank_sum`       the Mann-Whitney test of each two groups                    no pairs
`kruskal`        Dunn's test of each two groups                              no pairs, more than two groups
`mcnemar`        McNemar's exact test of each two groups                     rates, with pairs
`fisher`         Fisher's exact test of each two groups                      rates, without pairs
`log_rank`       the log-rank test of each two groups                        times that some runs never reached
`aligned_ranks`  analysis of variance of aligned ranks                       factors (`--by a,b`), with pairs or without
===============  ==========================================================  ===========================================

An omnibus test of more than two groups stands beside the pairs: Friedman's, that of Kruskal and Wallis, Cochran's Q, or that of
Freeman and Halton. It decides about no pair: a test of ranks of all groups depends on groups that are far away, and sees no
difference of neighbours (so does Dunn's, which is shipped for those who must report it).

By default (`auto`), the data decide: see `suitable`.
"""

from __future__ import annotations

from typing import ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.stats.comparison.base import CellResult, pairs_of
from sierra.stats.comparison.model import Cell, Question

HODGES_LEHMANN = "Hodges-Lehmann estimates"
NEWCOMBE = "differences of rates, with Newcombe's intervals"


def suitable(*, factors: bool, censored: bool, rate: bool, paired: bool) -> str:
    """Return the name of the method for data of this kind."""
    if factors:
        return "aligned_ranks"
    if censored:
        return "log_rank"
    if rate:
        return "mcnemar" if paired else "fisher"
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


class _OfPairs(_Shipped):
    """A method that tests signs or signed ranks of pairs."""

    def smallest(self, n: int) -> float:
        from sierra.stats.comparison import rank_tests

        return rank_tests.smallest_signed_rank(n)


class SignedRank(_OfPairs):
    """Wilcoxon's signed-rank test of each two groups; of three or more, also Friedman's."""

    title = "Wilcoxon signed-rank test"
    takes = frozenset({"pairs", "margin"})

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        from sierra.stats.comparison import one_cell

        pairs = tuple(one_cell.signed_rank(cell, question, *places) for places in pairs_of(cell, question))
        return CellResult(pairs, one_cell.friedman(cell, question) if len(cell.samples) > 2 else None)


class Friedman(SignedRank):
    """The same under another name, which was that for more than two groups."""

    title = "Friedman test"


class RankSum(_Shipped):
    """The Mann-Whitney test of each two groups; of three or more, also that of Kruskal and Wallis."""

    title = "Mann-Whitney test"
    takes = frozenset({"samples", "margin"})
    _dunn = False

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        from sierra.stats.comparison import one_cell

        several = len(cell.samples) > 2
        dunn = self._dunn and several
        pairs = tuple(one_cell.rank_sum(cell, question, *places, dunn=dunn) for places in pairs_of(cell, question))
        return CellResult(pairs, one_cell.kruskal(cell) if several else None)


class Kruskal(RankSum):
    """Dunn's test of each two of three groups or more, with that of Kruskal and Wallis; the Mann-Whitney test of only two."""

    title = "Kruskal-Wallis test"
    _dunn = True


class McNemar(_OfPairs):
    """McNemar's exact test of each two rates with Newcombe's interval of pairs; of three groups or more, also Cochran's Q."""

    title = "McNemar's exact test"
    takes = frozenset({"pairs", "margin", "rates"})
    estimates = NEWCOMBE

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        from sierra.stats.comparison import one_cell

        pairs = tuple(one_cell.rates_of_pairs(cell, question, *places) for places in pairs_of(cell, question))
        return CellResult(pairs, one_cell.cochran(cell) if len(cell.samples) > 2 else None)


class Fisher(_Shipped):
    """Fisher's exact test of each two rates with Newcombe's interval; of three or more, also that of Freeman and Halton."""

    title = "Fisher's exact test"
    takes = frozenset({"samples", "margin", "rates"})
    estimates = NEWCOMBE

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        from sierra.stats.comparison import one_cell

        pairs = tuple(one_cell.rates_of_samples(cell, question, *places) for places in pairs_of(cell, question))
        return CellResult(pairs, one_cell.freeman_halton(cell) if len(cell.samples) > 2 else None)


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
