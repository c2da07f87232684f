"""All tests of one report, and their correction for being many.

Two groups are compared by one test in each cell. More groups get an omnibus test first, then a test of each two groups. The p
values of all tests of the report, omnibus tests and tests of equivalence included, are corrected together (Holm). So the
probability that the report finds any difference that does not exist is at most alpha. Two of more groups differ only if the
omnibus test of their cell finds a difference too.

A censored time is not replaced by a number: if a run never reached the threshold, all cells use the log-rank test.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from sierra.errors import SierraError, UsageError
from sierra.stats.comparison import aligned_ranks, effect_sizes, pairing, rank_tests
from sierra.stats.comparison.model import Analysis, Cell, Effect, Omnibus, Pair, Pairing, Question, Sample, Verdict
from sierra.stats.comparison.rank_tests import Floats
from sierra.util.text import counted

SIGNED, RANKS, DUNN, LOG_RANK = "Wilcoxon signed-rank test", "Mann-Whitney test", "Dunn's test", "log-rank test"
LARGEST = 1e150
"""The largest number that can be compared: squares of larger ones overflow."""


def analyse(cells: Sequence[Cell], question: Question, factors: Sequence[str] = ()) -> Analysis:
    """Compare the samples of each cell, and return all results.

    With `factors`, the samples of the only cell are the combinations of their values. Raises UsageError for options that do not
    fit, SierraError if there is nothing to compare.
    """
    _check(cells, question, factors)
    groups = tuple(sample.group for sample in cells[0].samples)
    notes = list(_without_value(cells))
    complete = [cell for cell in cells if all(sample.values for sample in cell.samples)]
    notes += [_lacking(cell) for cell in cells if cell not in complete]
    if not complete:
        raise SierraError("no comparison is possible: no value of " + _lacking(cells[0]).partition(": no value of ")[2])
    censored = _is_censored(complete)
    found = Pairing(False, "the log-rank test uses no pairs") if censored else pairing.decide(complete, question.paired)
    if found.paired:
        notes += _unpaired_runs(complete)
        complete = [cell for cell in complete if pairing.common_seeds(cell.samples)]
    else:
        notes += _unequal(complete)
    result = Analysis(groups, question, found, notes=tuple(notes))
    if factors:
        return _corrected(replace(result, effects=tuple(_effects(complete[0], factors, paired=found.paired))))
    several = len(groups) > 2 and not censored
    omnibus = tuple(_omnibus(cell, question, paired=found.paired) for cell in complete) if several else ()
    pairs = tuple(pair for cell in complete for pair in _pairs(cell, question, paired=found.paired, censored=censored))
    return _corrected(replace(result, omnibus=omnibus, pairs=pairs))


def _check(cells: Sequence[Cell], question: Question, factors: Sequence[str]) -> None:
    if not 0 < question.alpha < 0.5:
        raise UsageError(f"alpha must be above 0 and below 0.5, not {question.alpha:g}")
    if question.margin is not None and not 0 < question.margin < math.inf:
        raise UsageError(f"the margin must be a number above 0, not {question.margin:g}")
    groups = [sample.group for sample in cells[0].samples] if cells else []
    if len(groups) < 2:
        raise UsageError(f"a comparison needs two groups or more, not {len(groups)}")
    largest = max((abs(run.value) for cell in cells for one in cell.samples for run in one.values), default=0.0)
    if largest > LARGEST:
        raise SierraError(f"{largest:.3g} is too large to be compared; let runs write it in a larger unit")
    if question.against is not None and question.against not in groups:
        raise UsageError(f"there is no group {question.against!r} to compare with; the groups are {', '.join(groups)}")
    if not _is_censored(cells):
        if factors and (question.margin is not None or question.against is not None):
            raise UsageError("main effects and interactions have neither a margin nor a group to compare with")
        return
    runs = "some runs never reached the threshold, so their times are censored"
    if factors:
        raise UsageError(f"{runs}; main effects and interactions of censored times cannot be computed")
    if question.margin is not None:
        raise UsageError(f"{runs}; equivalence of censored times cannot be tested")
    if question.paired is True:
        raise UsageError(f"{runs}; censored times cannot be compared as pairs")


def _is_censored(cells: Sequence[Cell]) -> bool:
    return any(not run.reached for cell in cells for sample in cell.samples for run in sample.values)


def _without_value(cells: Sequence[Cell]) -> Iterator[str]:
    """Yield a note on the runs that have no value, by group."""
    planned: dict[str, int] = {}
    lost: dict[str, int] = {}
    for sample in (sample for cell in cells for sample in cell.samples):
        planned[sample.group] = planned.get(sample.group, 0) + sample.planned
        lost[sample.group] = lost.get(sample.group, 0) + sample.planned - len(sample.values)
    if total := sum(lost.values()):
        where = ", ".join(f"{count} of {group}" for group, count in lost.items() if count)
        runs = counted(sum(planned.values()), "run")
        yield f"{total} of {runs} have no value, because they failed, are missing or wrote no finite value: {where}"


def _lacking(cell: Cell) -> str:
    empty = ", ".join(sample.group for sample in cell.samples if not sample.values)
    return f"{cell.name or 'all'} left out: no value of {empty}"


def _unpaired_runs(cells: Sequence[Cell]) -> Iterator[str]:
    """Yield notes on the runs without partners, and on cells without pairs."""
    lost = sum(len(sample.values) - len(pairing.common_seeds(cell.samples)) for cell in cells for sample in cell.samples)
    if lost:
        yield f"{counted(lost, 'run')} left out, because another group has no value for the same seed"
    for cell in cells:
        if not pairing.common_seeds(cell.samples):
            yield f"{cell.name} left out: no seed has a value in all groups"


def _unequal(cells: Sequence[Cell]) -> Iterator[str]:
    sizes = [len(sample.values) for cell in cells for sample in cell.samples]
    if len(set(sizes)) > 1:
        yield f"the groups have unequal numbers of runs: {min(sizes)} to {max(sizes)}"


def _omnibus(cell: Cell, question: Question, *, paired: bool) -> Omnibus:
    groups = tuple(sample.group for sample in cell.samples)
    if not paired:
        values = _values(cell.samples)
        statistic, p = rank_tests.kruskal(values)
        ranks = rank_tests.mean_ranks(values)
        n = sum(map(len, values))
        return Omnibus(cell.point, "Kruskal-Wallis test", groups, n, statistic, len(groups) - 1, p, tuple(ranks), None)
    blocks = rank_tests.rounded(pairing.blocks(cell.samples))
    statistic, p = rank_tests.friedman(blocks)
    critical = rank_tests.critical_difference(len(groups), len(blocks), question.alpha)
    ranks = rank_tests.mean_ranks_in_blocks(blocks)
    return Omnibus(cell.point, "Friedman test", groups, len(blocks), statistic, len(groups) - 1, p, tuple(ranks), critical)


def _pairs(cell: Cell, question: Question, *, paired: bool, censored: bool) -> Iterator[Pair]:
    for one, other in combinations(range(len(cell.samples)), 2):
        first, second = cell.samples[one], cell.samples[other]
        if question.against is not None:
            if question.against not in (first.group, second.group):
                continue
            if question.against == second.group:
                first, second, one, other = second, first, other, one
        if censored:
            yield _times(cell, first, second)
        elif paired:
            yield _paired(cell, first, second, question)
        else:
            yield _unpaired(cell, first, second, question, (one, other))


def _paired(cell: Cell, first: Sample, second: Sample, question: Question) -> Pair:
    """Compare two groups by the differences of pairs; with more groups, only seeds with a value in all of them count."""
    places = [[sample.group for sample in cell.samples].index(one.group) for one in (first, second)]
    before, after = _alike([pairing.blocks(cell.samples)[:, place] for place in places])
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
        first=first.group,
        second=second.group,
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


def _unpaired(cell: Cell, first: Sample, second: Sample, question: Question, places: tuple[int, int]) -> Pair:
    groups = _values(cell.samples)
    before, after = groups[places[0]], groups[places[1]]
    estimate = effect_sizes.of_samples(before, after, question.alpha)
    margin, equivalent = question.margin, None
    if margin is not None:
        equivalent = max(_shifted(before, after + margin, "greater"), _shifted(before, after - margin, "less"))
    n, m, several = len(before), len(after), len(groups) > 2
    total = sum(map(len, groups))
    return Pair(
        point=cell.point,
        first=first.group,
        second=second.group,
        n_first=n,
        n_second=m,
        test=DUNN if several else RANKS,
        difference=estimate.value,
        low=estimate.low,
        high=estimate.high,
        a12=effect_sizes.a12(before, after),
        p=rank_tests.dunn(groups, *places) if several else rank_tests.rank_sum(before, after),
        smallest=min(1.0, 2 / (math.comb(total, n) * math.comb(total - n, m))),
        p_equivalent=equivalent,
    )


def _shifted(first: Floats, second: Floats, side: rank_tests.Side) -> float:
    """Return the p value of a one-sided test of samples of which one was shifted by the margin."""
    first, second = _alike([first, second])
    return rank_tests.rank_sum(first, second, side)


def _times(cell: Cell, first: Sample, second: Sample) -> Pair:
    """Compare the times of two groups of which some are censored."""
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
        statistic=statistic,
        never_first=sum(not run.reached for run in first.values),
        never_second=sum(not run.reached for run in second.values),
    )


def _effects(cell: Cell, factors: Sequence[str], *, paired: bool) -> list[Effect]:
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
    for factor in range(len(factors)):
        known = list(dict.fromkeys(point[factor] for point in cell.factors))
        codes = np.array([known.index(point[factor]) for point in cell.factors])
        levels.append(codes[places].tolist())
    return aligned_ranks.effects(factors, values, levels, blocks)


def _corrected(result: Analysis) -> Analysis:
    """Return the result with p values that are corrected for all tests together, and with verdicts."""
    equivalent = [pair.p_equivalent for pair in result.pairs if pair.p_equivalent is not None]
    p = [one.p for one in result.omnibus] + [one.p for one in result.pairs] + [one.p for one in result.effects] + equivalent
    adjusted = iter(rank_tests.holm(p))
    omnibus = tuple(replace(one, p_adjusted=next(adjusted)) for one in result.omnibus)
    gates = {tuple(one.point.items()): one.p_adjusted for one in omnibus}
    pairs = tuple(
        replace(one, p_adjusted=max(next(adjusted), gates.get(tuple(one.point.items()), 0.0))) for one in result.pairs
    )
    effects = tuple(replace(one, p_adjusted=next(adjusted)) for one in result.effects)
    pairs = tuple(one if one.p_equivalent is None else replace(one, p_equivalent_adjusted=next(adjusted)) for one in pairs)
    pairs = tuple(replace(one, verdict=_verdict(one, result.question, len(p))) for one in pairs)
    notes = (*result.notes, *_too_few(pairs, result, len(p)))
    return replace(result, omnibus=omnibus, pairs=pairs, effects=effects, tests=len(p), notes=notes)


def _too_few(pairs: Sequence[Pair], result: Analysis, tests: int) -> Iterator[str]:
    """Yield a note on the comparisons with too few runs, with the number of runs from which on a verdict is possible."""
    count = sum(pair.verdict is Verdict.too_few for pair in pairs)
    if not count:
        return
    sides = 2 if result.question.margin is not None else 1
    smallest = rank_tests.smallest_signed_rank if result.pairing.paired else lambda n: rank_tests.smallest_rank_sum(n, n)
    needed = next(n for n in range(2, 100) if smallest(n) / sides * tests <= result.question.alpha)
    what = "pairs" if result.pairing.paired else "runs of each group"
    yield f"a verdict at alpha = {result.question.alpha:g} over {counted(tests, 'test')} needs {needed} {what} or more"


def _verdict(pair: Pair, question: Question, tests: int) -> Verdict:
    alpha = question.alpha
    one_sided = pair.smallest / 2
    different = max(pair.p_adjusted, pair.smallest) <= alpha
    equivalent = pair.p_equivalent_adjusted is not None and max(pair.p_equivalent_adjusted, one_sided) <= alpha
    if different or equivalent:
        return Verdict.both if different and equivalent else Verdict.different if different else Verdict.equivalent
    possible = one_sided if question.margin is not None else pair.smallest
    return Verdict.open if possible * tests <= alpha * (1 + 1e-12) else Verdict.too_few


def _values(samples: Sequence[Sample]) -> list[Floats]:
    return _alike([np.array([run.value for run in sample.values], dtype=float) for sample in samples])


def _alike(groups: Sequence[Floats]) -> list[Floats]:
    """Return the values of groups without rounding errors, at the scale of all of them."""
    scale = max(float(np.abs(group).max(initial=0.0)) for group in groups)
    return [rank_tests.rounded(group, scale) for group in groups]
