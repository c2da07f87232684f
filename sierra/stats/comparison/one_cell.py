"""The shipped tests of the groups of one cell: by pairs, by samples, of rates, of censored times, of factors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from sierra.stats import rates
from sierra.stats.comparison import aligned_ranks, effect_sizes, pairing, rank_tests, ties
from sierra.stats.comparison.model import OF_RATES, Cell, Effect, Omnibus, Pair, Question, Sample
from sierra.stats.comparison.ties import Floats

SIGNED, RANKS, DUNN, LOG_RANK = "Wilcoxon signed-rank test", "Mann-Whitney test", "Dunn's test", "log-rank test"
FISHER, MCNEMAR = "Fisher's exact test", "McNemar's exact test"


def friedman(cell: Cell, question: Question) -> Omnibus:
    """Return Friedman's test, with seeds as blocks, and Nemenyi's critical difference."""
    groups = tuple(sample.group for sample in cell.samples)
    blocks = ties.each_alike(pairing.blocks(cell.samples))
    statistic, p = rank_tests.friedman(blocks)
    critical = rank_tests.critical_difference(len(groups), len(blocks), question.alpha)
    ranks = rank_tests.mean_ranks_in_blocks(blocks)
    return Omnibus(cell.point, "Friedman test", groups, len(blocks), statistic, len(groups) - 1, p, tuple(ranks), critical)


def kruskal(cell: Cell) -> Omnibus:
    """Return the test of Kruskal and Wallis."""
    groups = tuple(sample.group for sample in cell.samples)
    values, _ = _values(cell.samples)
    statistic, p = rank_tests.kruskal(values)
    ranks = tuple(rank_tests.mean_ranks(values))
    n = sum(map(len, values))
    return Omnibus(cell.point, "Kruskal-Wallis test", groups, n, statistic, len(groups) - 1, p, ranks, None)


def signed_rank(cell: Cell, question: Question, i: int, j: int) -> Pair:
    """Compare two groups by the differences of pairs; with more groups, only seeds with a value in all of them count."""
    blocks = pairing.blocks(cell.samples)
    (before, after), _ = ties.alike([blocks[:, i], blocks[:, j]])
    differences, size = ties.differences(blocks[:, i], blocks[:, j])
    estimate = effect_sizes.of_pairs(differences, question.alpha)
    n = len(differences)
    margin, equivalent = question.margin, None
    if margin is not None:
        above, below = (ties.rounded(differences + shift, size or margin) for shift in (margin, -margin))
        equivalent = max(rank_tests.signed_rank(above, "greater"), rank_tests.signed_rank(below, "less"))
    return Pair(
        point=cell.point,
        first=cell.samples[i].group,
        second=cell.samples[j].group,
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


def rank_sum(cell: Cell, question: Question, i: int, j: int, *, dunn: bool = False) -> Pair:
    """Compare two groups without pairs: by the test of Mann and Whitney, or by Dunn's, which uses the ranks of all groups."""
    groups, size = _values(cell.samples if dunn else [cell.samples[i], cell.samples[j]])
    places = (i, j) if dunn else (0, 1)
    before, after = groups[places[0]], groups[places[1]]
    estimate = effect_sizes.of_samples(before, after, question.alpha)
    margin, equivalent = question.margin, None
    if margin is not None:
        above, below = (ties.rounded(after + shift, size or margin) for shift in (margin, -margin))
        equivalent = max(rank_tests.rank_sum(before, above, "greater"), rank_tests.rank_sum(before, below, "less"))
    n, m, total = len(before), len(after), sum(map(len, groups))
    return Pair(
        point=cell.point,
        first=cell.samples[i].group,
        second=cell.samples[j].group,
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


def rates_of_samples(cell: Cell, question: Question, i: int, j: int) -> Pair:
    """Compare two rates without pairs: Newcombe's interval of their difference, and Fisher's exact test."""
    first, second = cell.samples[i], cell.samples[j]
    before, after = _successes(first), _successes(second)
    return _of_rates(
        (cell, question, first, second),
        (before[1], after[1]),
        lambda z: rates.of_samples(before, after, z),
        (FISHER, rates.fisher(before, after), rates.smallest_fisher(before[1], after[1])),
    )


def rates_of_pairs(cell: Cell, question: Question, i: int, j: int) -> Pair:
    """Compare two rates of pairs; with more groups, only seeds with a value in all of them count."""
    blocks = pairing.blocks(cell.samples)[:, [i, j]] > 0
    counts = [int((blocks == which).all(axis=1).sum()) for which in ((1, 1), (1, 0), (0, 1), (0, 0))]
    pairs = rates.Pairs(*counts)
    return _of_rates(
        (cell, question, cell.samples[i], cell.samples[j]),
        (pairs.n, pairs.n),
        lambda z: rates.of_pairs(pairs, z),
        (MCNEMAR, rates.mcnemar(pairs), rank_tests.smallest_signed_rank(pairs.n)),
    )


def _of_rates(
    about: tuple[Cell, Question, Sample, Sample],
    n: tuple[int, int],
    interval: Callable[[float], rates.Interval],
    tested: tuple[str, float, float],
) -> Pair:
    """Return the comparison of two rates. `tested` is the name of the test, its p value, and the smallest possible one."""
    from scipy import special

    cell, question, first, second = about
    difference, low, high = interval(float(special.ndtri(1 - question.alpha / 2)))
    test, p, smallest = tested
    return Pair(
        point=cell.point,
        first=first.group,
        second=second.group,
        n_first=n[0],
        n_second=n[1],
        test=test,
        difference=difference,
        low=low,
        high=high,
        a12=None,
        p=p,
        smallest=smallest,
        estimate=OF_RATES,
        p_equivalent=None if question.margin is None else rates.within(interval, question.margin),
    )


def freeman_halton(cell: Cell) -> Omnibus:
    """Return the test of Freeman and Halton, which is Fisher's for several groups."""
    groups = [_successes(sample) for sample in cell.samples]
    p, exact = rates.freeman_halton(groups)
    test = "Fisher-Freeman-Halton test" if exact else "Fisher-Freeman-Halton test (Monte Carlo)"
    names = tuple(sample.group for sample in cell.samples)
    return Omnibus(cell.point, test, names, sum(n for _, n in groups), None, None, p, (), None)


def cochran(cell: Cell) -> Omnibus:
    """Return Cochran's Q, with seeds as blocks."""
    blocks = pairing.blocks(cell.samples)
    q, p = rates.cochran(blocks.tolist())
    names = tuple(sample.group for sample in cell.samples)
    return Omnibus(cell.point, "Cochran's Q test", names, len(blocks), q, len(names) - 1, p, (), None)


def _successes(sample: Sample) -> tuple[int, int]:
    """Return how many values are 1, and how many there are."""
    return sum(run.value > 0 for run in sample.values), len(sample.values)


def log_rank(cell: Cell, i: int, j: int) -> Pair:
    """Compare the times of two groups of which some are censored."""
    first, second = cell.samples[i], cell.samples[j]
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


def _values(samples: Sequence[Sample]) -> tuple[list[Floats], float]:
    """Return the values of groups without rounding errors, and their spread."""
    return ties.alike([np.array([run.value for run in sample.values], dtype=float) for sample in samples])
