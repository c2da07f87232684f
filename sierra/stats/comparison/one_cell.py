"""The shipped tests of the groups of one cell: by pairs, by samples, of censored times, of factors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sierra.stats.comparison import aligned_ranks, effect_sizes, pairing, rank_tests
from sierra.stats.comparison.model import Cell, Effect, Omnibus, Pair, Question, Sample
from sierra.stats.comparison.rank_tests import Floats

SIGNED, RANKS, DUNN, LOG_RANK = "Wilcoxon signed-rank test", "Mann-Whitney test", "Dunn's test", "log-rank test"


def friedman(cell: Cell, question: Question) -> Omnibus:
    """Return Friedman's test, with seeds as blocks, and Nemenyi's critical difference."""
    groups = tuple(sample.group for sample in cell.samples)
    blocks = rank_tests.rounded(pairing.blocks(cell.samples))
    statistic, p = rank_tests.friedman(blocks)
    critical = rank_tests.critical_difference(len(groups), len(blocks), question.alpha)
    ranks = rank_tests.mean_ranks_in_blocks(blocks)
    return Omnibus(cell.point, "Friedman test", groups, len(blocks), statistic, len(groups) - 1, p, tuple(ranks), critical)


def kruskal(cell: Cell) -> Omnibus:
    """Return the test of Kruskal and Wallis."""
    groups = tuple(sample.group for sample in cell.samples)
    values = _values(cell.samples)
    statistic, p = rank_tests.kruskal(values)
    ranks = tuple(rank_tests.mean_ranks(values))
    n = sum(map(len, values))
    return Omnibus(cell.point, "Kruskal-Wallis test", groups, n, statistic, len(groups) - 1, p, ranks, None)


def signed_rank(cell: Cell, question: Question, one: int, other: int) -> Pair:
    """Compare two groups by the differences of pairs; with more groups, only seeds with a value in all of them count."""
    blocks = pairing.blocks(cell.samples)
    before, after = _alike([blocks[:, one], blocks[:, other]])
    scale = float(max(np.abs(before).max(), np.abs(after).max()))
    differences = rank_tests.rounded(after - before, scale)
    estimate = effect_sizes.of_pairs(differences, question.alpha)
    n = len(differences)
    margin, equivalent = question.margin, None
    if margin is not None:
        lower = rank_tests.signed_rank(rank_tests.rounded(differences + margin, scale + margin), "greater")
        equivalent = max(lower, rank_tests.signed_rank(rank_tests.rounded(differences - margin, scale + margin), "less"))
    return Pair(
        point=cell.point,
        first=cell.samples[one].group,
        second=cell.samples[other].group,
        n_first=n,
        n_second=n,
        test=SIGNED,
        difference=estimate.value,
        low=estimate.low,
        high=estimate.high,
        a12=effect_sizes.a12(before, after),
        p=rank_tests.signed_rank(differences),
        smallest=rank_tests.smallest_signed_rank(n),
        p_equivalent=equivalent,
    )


def rank_sum(cell: Cell, question: Question, one: int, other: int, *, dunn: bool = False) -> Pair:
    """Compare two groups without pairs: by the test of Mann and Whitney, or by Dunn's, which uses the ranks of all groups."""
    groups = _values(cell.samples) if dunn else _values([cell.samples[one], cell.samples[other]])
    places = (one, other) if dunn else (0, 1)
    before, after = groups[places[0]], groups[places[1]]
    estimate = effect_sizes.of_samples(before, after, question.alpha)
    margin, equivalent = question.margin, None
    if margin is not None:
        equivalent = max(_shifted(before, after + margin, "greater"), _shifted(before, after - margin, "less"))
    n, m, total = len(before), len(after), sum(map(len, groups))
    return Pair(
        point=cell.point,
        first=cell.samples[one].group,
        second=cell.samples[other].group,
        n_first=n,
        n_second=m,
        test=DUNN if dunn else RANKS,
        difference=estimate.value,
        low=estimate.low,
        high=estimate.high,
        a12=effect_sizes.a12(before, after),
        p=rank_tests.dunn(groups, *places) if dunn else rank_tests.rank_sum(before, after),
        smallest=min(1.0, 2 / (math.comb(total, n) * math.comb(total - n, m))),
        p_equivalent=equivalent,
    )


def log_rank(cell: Cell, one: int, other: int) -> Pair:
    """Compare the times of two groups of which some are censored."""
    first, second = cell.samples[one], cell.samples[other]
    medians = [rank_tests.median_time(sample.values) for sample in (first, second)]
    known = [median for median in medians if median is not None]
    statistic, p = rank_tests.log_rank(first.values, second.values)
    return Pair(
        point=cell.point,
        first=first.group,
        second=second.group,
        n_first=len(first.values),
        n_second=len(second.values),
        test=LOG_RANK,
        difference=known[1] - known[0] if len(known) == 2 else None,
        low=None,
        high=None,
        a12=None,
        p=p,
        smallest=rank_tests.smallest_rank_sum(len(first.values), len(second.values)),
        estimate="difference of the median times",
        statistic=statistic,
        never_first=sum(not run.reached for run in first.values),
        never_second=sum(not run.reached for run in second.values),
    )


def effects(cell: Cell, *, paired: bool) -> list[Effect]:
    """Return the effects of a factorial design; pairs make blocks, and blocks that are not complete are left out."""
    if paired:
        table = pairing.blocks(cell.samples)
        places = np.repeat(np.arange(len(cell.samples))[None], len(table), axis=0).ravel()
        values, blocks = table.ravel(), np.repeat(np.arange(len(table)), table.shape[1]).tolist()
    else:
        parts = [np.array([run.value for run in sample.values]) for sample in cell.samples]
        values, blocks = np.concatenate(parts), None
        places = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    levels = []
    for factor in range(len(cell.names)):
        known = list(dict.fromkeys(point[factor] for point in cell.factors))
        codes = np.array([known.index(point[factor]) for point in cell.factors])
        levels.append(codes[places].tolist())
    return aligned_ranks.effects(cell.names, values, levels, blocks)


def _shifted(first: Floats, second: Floats, side: rank_tests.Side) -> float:
    """Return the p value of a one-sided test of samples of which one was shifted by the margin."""
    first, second = _alike([first, second])
    return rank_tests.rank_sum(first, second, side)


def _values(samples: Sequence[Sample]) -> list[Floats]:
    return _alike([np.array([run.value for run in sample.values], dtype=float) for sample in samples])


def _alike(groups: Sequence[Floats]) -> list[Floats]:
    """Return the values of groups without rounding errors, at the scale of all of them."""
    scale = max(float(np.abs(group).max(initial=0.0)) for group in groups)
    return [rank_tests.rounded(group, scale) for group in groups]
