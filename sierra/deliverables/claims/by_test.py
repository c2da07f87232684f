"""Claims that tests decide: an order of groups, and the equivalence of two groups.

A claim holds only if it is shown for each two neighbouring groups in each experiment that counts. The largest of their p
values is a valid p value of that (an intersection-union test: Berger 1982, Technometrics 24: 295-300), so the claim counts as
one test.
An order does not hold if the contrary of one of its parts is shown, whose p value is corrected for the number of parts
(Bonferroni). p values are two-sided; those of equivalence are of two one-sided tests. An equivalence does not hold if an
interval of a difference is outside the margin; its confidence is corrected for all parts and claims on the table (Bonferroni).

The p values of all claims of a project on one table of pairs (see `sierra.deliverables.claims.pair_tables`) are corrected
together (Holm), whichever are asked for. A test that cannot be computed counts with p = 1. So the probability that any claim of
the table holds by chance is at most alpha, and so is the probability that any is refuted by chance. Pairs that no claim names
do not count, so each finding says how many of the table's pairs were claimed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeAlias

from sierra.config.claim_table import Claim, ClaimedEquivalence, ClaimedOrder
from sierra.config.deliverable_tables import Comparison
from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims.by_sql import lost
from sierra.deliverables.claims.model import ClaimResult, Verdict
from sierra.deliverables.comparison import cells_of
from sierra.deliverables.run_statistics import RunTable
from sierra.errors import NotFound, SierraError, UsageError
from sierra.stats.comparison.model import Cell, Pair, Question, Sample
from sierra.stats.comparison.wording import covers_zero
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.text import counted, few, like

if TYPE_CHECKING:
    from sierra.config.plugin_registry import Tables

Asked: TypeAlias = ClaimedOrder | ClaimedEquivalence
SHOWN = 3
"""The largest number of comparisons in the text of one claim."""


@dataclass(frozen=True, slots=True)
class Tested:
    """The test of one claim, before the correction for the others."""

    asked: Asked
    pairs: tuple[Pair, ...]
    """The comparison of each two neighbouring groups in each experiment: the first group is `second`, so that differences are
    first minus second."""
    n: int
    unit: str
    paired: tuple[bool, ...]
    """For each comparison: whether runs with the same seed are pairs."""
    notes: tuple[str, ...]
    """Notes on runs that are not in the tests."""
    outside: tuple[Pair, ...] = ()
    """The comparisons that show a difference beyond the margin, after correction for all claims on the table and parts."""

    @property
    def shown(self) -> bool:
        """Return whether all differences have the claimed direction; for an equivalence, whether none is beyond the margin."""
        if isinstance(self.asked, ClaimedEquivalence):
            return not self.outside
        return all(pair.direction > 0 for pair in self.pairs)

    @property
    def p(self) -> float:
        """Return the p value of the claim or, if `shown` is false, of its contrary."""
        if isinstance(self.asked, ClaimedEquivalence):
            return max(1.0 if pair.p_equivalent is None else pair.p_equivalent for pair in self.pairs)
        if self.shown:
            return max(pair.p for pair in self.pairs)
        return min(1.0, len(self.pairs) * min(pair.p for pair in self.pairs if pair.direction <= 0))

    @property
    def smallest(self) -> float:
        """Return the smallest p value that the test can have with this number of runs."""
        sides = 2 if isinstance(self.asked, ClaimedEquivalence) else 1
        return max(pair.smallest for pair in self.pairs) / sides


@dataclass(frozen=True, slots=True)
class Family:
    """The claims on one table of pairs, whose p values are corrected together."""

    tests: int = 1
    """The number of these claims."""
    pairs: int = 0
    """The number of pairs of the table: each two groups in each experiment; 0 if it is not known."""
    claimed: int = 0
    """The number of the pairs that claims name."""
    command: str = ""
    """The command that compares all pairs."""

    @property
    def selection(self) -> str:
        """Return how many pairs were claimed, in words; "" if there is only one."""
        if self.pairs < 2:
            return ""
        verb = "was" if self.claimed == 1 else "were"
        command = f": {self.command}" if self.command else ""
        return f"{self.claimed} of {self.pairs} pairs of this comparison {verb} claimed{command}"


def comparison_of(asked: Asked) -> Comparison:
    """Return the comparison of the groups of a claim."""
    return Comparison(
        groups=asked.groups if asked.by else (),
        by=(asked.by,) if asked.by else (),
        **{name: getattr(asked, name) for name in ("table", "column", "measure", "threshold", "where", "experiments")},
    )


def cells_in_order(asked: Asked, runs: Mapping[str, RunTable]) -> list[Cell]:
    """Return the cells of a claim with its groups in their order; `runs` are those of each batch. Raises SierraError."""
    if not asked.by and (unknown := [group for group in asked.groups if group not in runs]):
        raise NotFound(f"there is no batch labelled {unknown[0]!r}; {like(unknown[0], list(runs))}")
    _, cells, _, left = cells_of(runs, comparison_of(asked))
    if left:
        raise UsageError(f"{left[0]}; name those that count by experiments")
    return [_in_order(cell, asked) for cell in cells]


def test(
    project: LoadedProject, claim: Claim, asked: Asked, runs: Mapping[str, RunTable], cells: list[Cell], tests: int
) -> Tested | ClaimResult:
    """Return the test of a claim, one of `tests`; or the finding that no test is possible. Raises SierraError.

    `runs` are those of each batch, and `cells` the result of `cells_in_order`.
    """
    margin = asked.margin if isinstance(asked, ClaimedEquivalence) else None
    samples = [sample for cell in cells for sample in cell.samples]
    n = sum(len(sample.values) for sample in samples)
    if (too_many := lost(claim, n, sum(sample.planned for sample in samples))) is not None:
        return too_many
    question = Question(asked.alpha, margin, asked.paired)
    tables = project.config.comparison_methods
    pairs, paired, notes = _pairs(cells, question, asked.method, tables)
    first = next(iter(runs.values()))
    unit = f" {first.unit}" if first.unit not in ("", "1") else ""
    about = dict.fromkeys((*(note for table in runs.values() for note in table.notes), *notes))
    tested = Tested(asked, pairs, n, unit, paired, tuple(about))
    if margin is not None and any(_beyond(pair, margin) for pair in pairs):
        strict = replace(question, alpha=asked.alpha / (tests * len(pairs)))
        corrected, _, _ = _pairs(cells, strict, asked.method, tables)
        tested = replace(tested, outside=tuple(pair for pair in corrected if _beyond(pair, margin)))
    return tested


def _in_order(cell: Cell, asked: Asked) -> Cell:
    """Return a cell with its groups in the order of the claim; those of a variable are in that order already."""
    if asked.by:
        return cell
    by_group = {sample.group: sample for sample in cell.samples}
    return replace(cell, samples=tuple(by_group[group] for group in asked.groups))


def _pairs(
    cells: list[Cell], question: Question, method: str, tables: Tables
) -> tuple[tuple[Pair, ...], tuple[bool, ...], tuple[str, ...]]:
    """Return the comparisons of neighbouring groups, for each whether runs are pairs, and notes. Raises SierraError."""
    from sierra.stats.comparison.analyse import analyse

    pairs: list[Pair] = []
    paired: list[bool] = []
    notes: list[str] = []
    for index in range(len(cells[0].samples) - 1):
        two = [replace(cell, samples=_neighbours(cell, index)) for cell in cells]
        analysis = analyse(two, question, (), method, tables)
        if len(analysis.pairs) < len(two):
            raise SierraError("; ".join(analysis.notes) or "an experiment cannot be compared")
        pairs += analysis.pairs
        paired += [analysis.pairing.paired] * len(two)
        notes += analysis.notes
    return tuple(pairs), tuple(paired), tuple(notes)


def _neighbours(cell: Cell, index: int) -> tuple[Sample, Sample]:
    return cell.samples[index + 1], cell.samples[index]


def _beyond(pair: Pair, margin: float) -> bool:
    """Return whether the whole interval of a difference lies outside the margin."""
    return pair.low is not None and pair.high is not None and (pair.low > margin or pair.high < -margin)


def conclude(tested: Tested, p: float, family: Family) -> ClaimResult:
    """Return the finding of a test with its p value after correction for all tests of its family."""
    alpha, tests = tested.asked.alpha, family.tests
    only = tested.pairs[0] if len(tested.pairs) == 1 else None
    margin = f", margin {tested.asked.margin:g}{tested.unit}" if isinstance(tested.asked, ClaimedEquivalence) else ""
    what = few([_text(*compared, tested) for compared in zip(tested.pairs, tested.paired, strict=True)], SHOWN) + margin
    end = f"{_p(p)} after correction for {counted(tests, 'test')} (Holm), alpha = {alpha:g}"
    value, low, high = (only.difference, only.low, only.high) if only else (None, None, None)
    chosen = f"; {family.selection}" if family.selection else ""

    def finding(verdict: Verdict, text: str) -> ClaimResult:
        return ClaimResult(
            verdict,
            text + chosen,
            n=tested.n,
            value=value,
            low=low,
            high=high,
            p=p,
            tests=tests,
            pairs=family.pairs or None,
            claimed_pairs=family.claimed or None,
            notes=tested.notes,
        )

    if tested.smallest * tests > alpha * (1 + 1e-12):
        text = f"n is too small for any verdict at alpha = {alpha:g} over {counted(tests, 'test')}; {what}"
        return finding(Verdict.cannot_tell, text)
    if tested.outside:
        text = f"{what}; beyond the margin after correction for {counted(tests, 'test')} (Bonferroni)"
        return finding(Verdict.does_not_hold, text)
    if max(p, tested.smallest) <= alpha:
        return finding(Verdict.holds if tested.shown else Verdict.does_not_hold, f"{what}; {end}")
    count = max(tests, len(tested.pairs))
    apart = count > 1 and not all(map(covers_zero, tested.pairs))
    alone = f"; each interval is of one pair alone, not corrected for {count} {'tests' if tests == count else 'pairs'}"
    return finding(Verdict.cannot_tell, f"not shown: {what}; {end}{alone if apart else ''}")


def _text(pair: Pair, paired: bool, tested: Tested) -> str:
    at = f"at {', '.join(f'{name}={value}' for name, value in pair.point.items())} " if pair.point else ""
    known = "" if pair.difference is None else f" = {pair.difference:.6g}{tested.unit}"
    level = 100 * (1 - tested.asked.alpha)
    interval = "" if pair.low is None or pair.high is None else f", {level:.4g} % CI [{pair.low:.6g}, {pair.high:.6g}]"
    n = f"n = {pair.n_first} pairs" if paired else f"n = {pair.n_second} and {pair.n_first}"
    return f"{at}{pair.second} − {pair.first}{known}{interval} ({pair.test}, {n})"


def _p(value: float) -> str:
    return "p < 0.001" if value < 0.001 else f"p = {value:.2g}"
