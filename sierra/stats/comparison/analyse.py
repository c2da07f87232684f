"""All tests of one report, and their correction for being many.

A comparison method tests the groups of each cell: see `sierra.stats.comparison.base`. The p values of all pairs of the report,
those of equivalence and of effects included, are corrected together (Holm). So the probability that the report finds any
difference of two groups that does not exist is at most alpha.

An omnibus test of more than two groups is a statement beside the pairs. It is corrected for the other omnibus tests of the
report only, and decides about no pair: it may find a difference although no pair does, and the other way round.

A censored time is not replaced by a number: if a run never reached the threshold, all cells use the log-rank test. A group
without any value in a cell is left out of it, and reported.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from sierra.config.plugin_registry import COMPARISONS, Tables
from sierra.errors import SierraError, UsageError
from sierra.stats.comparison import pairing, rank_tests, shipped
from sierra.stats.comparison.base import CellResult, ComparisonMethod
from sierra.stats.comparison.model import Analysis, Cell, Pair, Pairing, Question, Verdict
from sierra.stats.comparison.wording import number, runs_of, where
from sierra.util.text import counted, few

LARGEST = 1e150
"""The largest number that can be compared: squares of larger ones overflow."""
MOST = 100
"""The number of runs below which a note on too few runs looks for one that is enough."""
SMALL = 0.001
"""The p value from which on a note says that n allows no smaller one."""
SHOWN = 3
"""The largest number of pairs that a note names."""
AUTO = "auto"
"""Stands for the shipped method that suits the data."""


def analyse(
    cells: Sequence[Cell], question: Question, factors: Sequence[str] = (), name: str = AUTO, tables: Tables | None = None
) -> Analysis:
    """Compare the samples of each cell by the method `name`, and return all results.

    With `factors`, the samples of the only cell are the combinations of their values. `tables` are `[comparison_methods]`.
    Raises UsageError for options that do not fit, SierraError if there is nothing to compare.
    """
    _check(cells, question)
    notes = list(_without_value(cells))
    complete, lacking = _with_values(cells, question.against, whole=bool(factors))
    notes += lacking
    if not complete:
        raise SierraError("no comparison is possible: no value of " + lacking[0].partition("no value of ")[2])
    if factors:
        complete = [replace(complete[0], names=tuple(factors))]
    censored = any(not run.reached for cell in complete for sample in cell.samples for run in sample.values)
    chosen, decision = _chosen(complete, question, name, censored=censored)
    method: ComparisonMethod = COMPARISONS.make(chosen, tables or {})
    if decision.paired:
        notes += _unpaired_runs(complete)
        complete = [cell for cell in complete if pairing.common_seeds(cell.samples)]
    else:
        notes += _unequal(complete)
    tests = [_checked(method.compare(cell, question, paired=decision.paired), method) for cell in complete]
    result = Analysis(
        groups=tuple(dict.fromkeys(sample.group for cell in complete for sample in cell.samples)),
        question=question,
        pairing=decision,
        pairs=tuple(pair for test in tests for pair in test.pairs),
        omnibus=tuple(test.omnibus for test in tests if test.omnibus),
        effects=tuple(effect for test in tests for effect in test.effects),
        notes=tuple(notes),
        method=chosen,
        title=method.title,
        estimates=method.estimates,
    )
    return _corrected(result, method)


def _check(cells: Sequence[Cell], question: Question) -> None:
    if not 0 < question.alpha < 0.5:
        raise UsageError(f"alpha must be above 0 and below 0.5, not {question.alpha:g}")
    if question.margin is not None and not 0 < question.margin < math.inf:
        raise UsageError(f"the margin must be a number above 0, not {question.margin:g}")
    groups = [sample.group for sample in cells[0].samples] if cells else []
    if len(groups) < 2:
        raise UsageError(f"a comparison needs two groups or more, not {len(groups)}")
    largest = max((abs(run.value) for cell in cells for sample in cell.samples for run in sample.values), default=0.0)
    if largest > LARGEST:
        raise SierraError(f"{largest:.3g} is too large to be compared; let runs write it in a larger unit")
    if question.against is not None and question.against not in groups:
        raise UsageError(f"there is no group {question.against!r} to compare with; the groups are {', '.join(groups)}")


def _chosen(cells: Sequence[Cell], question: Question, name: str, *, censored: bool) -> tuple[str, Pairing]:
    """Return the name of the method, and whether it compares runs as pairs. Raises UsageError if it does not fit."""
    factors, rate = bool(cells[0].names), all(cell.rate for cell in cells)
    suitable = [shipped.suitable(factors=factors, censored=censored, rate=rate, paired=paired) for paired in (True, False)]
    names = suitable if name == AUTO else [name]
    methods: list[type[ComparisonMethod]] = [COMPARISONS.load(method_name) for method_name in names]
    takes = frozenset().union(*(method.takes for method in methods))
    title = methods[-1].title
    never = "some runs never reached the threshold, so their times are censored; " if censored else ""
    for needed, given, what in (
        ("censored", censored, "compare censored times"),
        ("factors", factors, "compute main effects and interactions"),
        ("margin", question.margin is not None, "test for equivalence within a margin"),
        ("pairs", question.paired is True, "compare runs as pairs"),
        ("samples", question.paired is False, "compare runs that are not pairs"),
    ):
        if given and needed not in takes:
            raise UsageError(f"{never}the {title} cannot {what}")
    if factors and question.against is not None:
        raise UsageError("main effects and interactions have no group to compare with")
    if not factors and "factors" in takes:
        raise UsageError(f"the {title} needs several variables; name them, as in --by a,b")
    if not rate and name != AUTO and "rates" in takes:
        raise UsageError(f"the {title} needs a rate: a column of false and true, or one in rates of [outputs.NAME]")
    if "pairs" not in takes:
        return names[-1], Pairing(False, f"the {title} uses no pairs")
    decision = pairing.decide(cells, True if "samples" not in takes else question.paired)
    return names[0 if decision.paired else -1], decision


def _with_values(cells: Sequence[Cell], against: str | None, *, whole: bool) -> tuple[list[Cell], list[str]]:
    """Return the cells with the samples that have values, and notes on the others. `whole`: a cell needs all its samples."""
    kept, notes = [], []
    for cell in cells:
        samples = tuple(sample for sample in cell.samples if sample.values)
        if len(samples) < len(cell.samples):
            lost = whole or len(samples) < 2 or against not in (None, *(sample.group for sample in samples))
            notes.append(_lacking(cell, lost=lost))
            if lost:
                continue
        kept.append(replace(cell, samples=samples))
    return kept, notes


def _lacking(cell: Cell, *, lost: bool) -> str:
    empty = f"no value of {', '.join(sample.group for sample in cell.samples if not sample.values)}"
    if lost:
        return f"{cell.name or 'all'} left out: {empty}"
    return f"{f'{cell.name}: ' if cell.name else ''}{empty}; the other groups are compared"


def _checked(tests: CellResult, method: ComparisonMethod) -> CellResult:
    """Return the tests of a method. Raises SierraError for a p value that is none, which would make verdicts wrong."""
    p_values = [pair.p for pair in tests.pairs] + [effect.p for effect in tests.effects]
    p_values += [tests.omnibus.p] if tests.omnibus else []
    p_values += [pair.p_equivalent for pair in tests.pairs if pair.p_equivalent is not None]
    if wrong := [p for p in p_values if not 0 <= p <= 1]:
        raise SierraError(f"the {method.title} has the p value {wrong[0]:g}, which is not from 0 to 1")
    return tests


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


def _corrected(result: Analysis, method: ComparisonMethod) -> Analysis:
    """Return the result with p values that are corrected for all tests of their family together, and with verdicts."""
    equivalent = [pair.p_equivalent for pair in result.pairs if pair.p_equivalent is not None]
    p = [pair.p for pair in result.pairs] + [effect.p for effect in result.effects] + equivalent
    adjusted, of_omnibus = iter(rank_tests.holm(p)), iter(rank_tests.holm([test.p for test in result.omnibus]))
    pairs = tuple(replace(pair, p_adjusted=next(adjusted)) for pair in result.pairs)
    effects = tuple(replace(effect, p_adjusted=next(adjusted)) for effect in result.effects)
    pairs = tuple(pair if pair.p_equivalent is None else replace(pair, p_equivalent_adjusted=next(adjusted)) for pair in pairs)
    omnibus = tuple(replace(test, p_adjusted=next(of_omnibus)) for test in result.omnibus)
    best = _best(result)
    pairs = tuple(
        replace(pair, verdict=_verdict(pair, result.question, least)) for pair, least in zip(pairs, best, strict=True)
    )
    limits = (*_limits(pairs, best, result, len(p)), *_too_few(pairs, result, method, len(p)))
    return replace(result, omnibus=omnibus, pairs=pairs, effects=effects, tests=len(p), limits=limits)


def _best(result: Analysis) -> list[tuple[float, float]]:
    """Return for each pair the smallest corrected p values of a difference and of equivalence (1: not tested) that n allows."""
    tested = [pair.p_equivalent is not None for pair in result.pairs]
    smallest = [pair.smallest for pair in result.pairs] + [0.0] * len(result.effects)
    best = rank_tests.holm(smallest + [pair.smallest_equivalent for pair, two in zip(result.pairs, tested, strict=True) if two])
    equivalent = iter(best[len(smallest) :])
    return [(least, next(equivalent) if two else 1.0) for least, two in zip(best[: len(tested)], tested, strict=True)]


def _limits(pairs: Sequence[Pair], best: Sequence[tuple[float, float]], result: Analysis, tests: int) -> Iterator[str]:
    """Yield a note on the smallest p value that n allows, unless it is very small, and on pairs that can't be different."""
    if not pairs or (least := max(lowest for lowest, _ in best)) < SMALL:
        return
    index = [lowest for lowest, _ in best].index(least)
    pair = pairs[index]
    alone = f"the smallest possible p value with {runs_of(pair, paired=result.pairing.paired)} is {number(pair.smallest)}"
    text = f"{alone}, and {number(least)} after correction for {tests} tests (Holm)" if tests > 1 else alone
    without = [pair for pair, (lowest, _) in zip(pairs, best, strict=True) if _above(lowest, result.question.alpha)]
    if len(without) == len(pairs):
        yield f"no two groups can be found different: {text}"
    elif without:
        names = [f"{where(pair.point)}{pair.first} and {pair.second}" for pair in without]
        yield f"these groups cannot be found different: {few(names, SHOWN)}; {text}"
    else:
        yield text


def _too_few(pairs: Sequence[Pair], result: Analysis, method: ComparisonMethod, tests: int) -> Iterator[str]:
    """Yield a note if comparisons have too few runs, with the number of runs from which on a verdict is possible."""
    if not any(pair.verdict is Verdict.too_few for pair in pairs):
        return
    sides = 2 if result.question.margin is not None else 1
    possible = (n for n in range(2, MOST) if not _above(method.smallest(n) / sides * tests, result.question.alpha))
    if needed := next(possible, None):
        what = "pairs" if result.pairing.paired else "runs of each group"
        yield f"a verdict at alpha = {result.question.alpha:g} over {counted(tests, 'test')} needs {needed} {what} or more"


def _verdict(pair: Pair, question: Question, best: tuple[float, float]) -> Verdict:
    alpha = question.alpha
    different = max(pair.p_adjusted, pair.smallest) <= alpha
    equivalent = pair.p_equivalent_adjusted is not None and max(pair.p_equivalent_adjusted, pair.smallest_equivalent) <= alpha
    if different or equivalent:
        return Verdict.both if different and equivalent else Verdict.different if different else Verdict.equivalent
    return Verdict.too_few if _above(min(best), alpha) else Verdict.open


def _above(p: float, alpha: float) -> bool:
    return p > alpha * (1 + 1e-12)
