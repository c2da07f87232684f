"""All tests of one report, and their correction for being many.

A comparison method tests the groups of each cell: see `sierra.stats.comparison.base`. The p values of all tests of the report,
omnibus tests and tests of equivalence included, are corrected together (Holm). So the probability that the report finds any
difference that does not exist is at most alpha. Two of more groups differ only if the omnibus test of their cell, where the
method has one, finds a difference too.

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
from sierra.util.text import counted

LARGEST = 1e150
"""The largest number that can be compared: squares of larger ones overflow."""
MOST = 100
"""The number of runs below which a note on too few runs looks for one that is enough."""
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
    chosen, found = _chosen(complete, question, name, censored=censored)
    method: ComparisonMethod = COMPARISONS.make(chosen, tables or {})
    if found.paired:
        notes += _unpaired_runs(complete)
        complete = [cell for cell in complete if pairing.common_seeds(cell.samples)]
    else:
        notes += _unequal(complete)
    tests = [_checked(method.compare(cell, question, paired=found.paired), method) for cell in complete]
    result = Analysis(
        groups=tuple(dict.fromkeys(sample.group for cell in complete for sample in cell.samples)),
        question=question,
        pairing=found,
        pairs=tuple(pair for one in tests for pair in one.pairs),
        omnibus=tuple(one.omnibus for one in tests if one.omnibus),
        effects=tuple(effect for one in tests for effect in one.effects),
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
    largest = max((abs(run.value) for cell in cells for one in cell.samples for run in one.values), default=0.0)
    if largest > LARGEST:
        raise SierraError(f"{largest:.3g} is too large to be compared; let runs write it in a larger unit")
    if question.against is not None and question.against not in groups:
        raise UsageError(f"there is no group {question.against!r} to compare with; the groups are {', '.join(groups)}")


def _chosen(cells: Sequence[Cell], question: Question, name: str, *, censored: bool) -> tuple[str, Pairing]:
    """Return the name of the method, and whether it compares runs as pairs. Raises UsageError if it does not fit."""
    factors, several = bool(cells[0].names), any(len(cell.samples) > 2 for cell in cells)
    suitable = [
        shipped.suitable(factors=factors, censored=censored, paired=paired, several=several) for paired in (True, False)
    ]
    names = suitable if name == AUTO else [name]
    methods: list[type[ComparisonMethod]] = [COMPARISONS.load(one) for one in names]
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
    if "pairs" not in takes:
        return names[-1], Pairing(False, f"the {title} uses no pairs")
    found = pairing.decide(cells, True if "samples" not in takes else question.paired)
    return names[0 if found.paired else -1], found


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
    found = [pair.p for pair in tests.pairs] + [effect.p for effect in tests.effects]
    found += [tests.omnibus.p] if tests.omnibus else []
    found += [pair.p_equivalent for pair in tests.pairs if pair.p_equivalent is not None]
    if wrong := [p for p in found if not 0 <= p <= 1]:
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
    notes = (*result.notes, *_too_few(pairs, result, method, len(p)))
    return replace(result, omnibus=omnibus, pairs=pairs, effects=effects, tests=len(p), notes=notes)


def _too_few(pairs: Sequence[Pair], result: Analysis, method: ComparisonMethod, tests: int) -> Iterator[str]:
    """Yield a note if comparisons have too few runs, with the number of runs from which on a verdict is possible."""
    if not any(pair.verdict is Verdict.too_few for pair in pairs):
        return
    sides = 2 if result.question.margin is not None else 1
    possible = (n for n in range(2, MOST) if method.smallest(n) / sides * tests <= result.question.alpha)
    if needed := next(possible, None):
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
