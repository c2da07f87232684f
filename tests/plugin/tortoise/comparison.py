"""The comparison method `welch`: Welch's t test of each two groups, for means of runs without pairs."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from sierra.plugin import Cell, CellResult, Pair, Question, Table, UsageError, pairs_of


class WelchOptions(Table):
    """The options of the test."""

    fewest: int = Field(2, ge=2, description="smallest number of runs of a group that may be compared")


class Welch:
    """Welch's t test."""

    contract = 1
    Options: ClassVar[type[Table]] = WelchOptions
    title = "Welch's t test"
    takes = frozenset({"samples"})
    estimates = "differences of means"

    def __init__(self, options: WelchOptions) -> None:
        self._options = options

    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        return CellResult(tuple(self._pair(cell, question, *places) for places in pairs_of(cell, question)))

    def smallest(self, n: int) -> float:
        return 0.0

    def _pair(self, cell: Cell, question: Question, one: int, other: int) -> Pair:
        from scipy import stats

        first, second = cell.samples[one], cell.samples[other]
        before, after = ([run.value for run in sample.values] for sample in (first, second))
        if min(len(before), len(after)) < self._options.fewest:
            raise UsageError(f"{cell.name or 'a group'} has fewer than {self._options.fewest} runs; use another method")
        if max(before) == min(before) and max(after) == min(after):
            raise UsageError(f"{first.group} and {second.group} do not vary; {self.title} needs values that do")
        found = stats.ttest_ind(after, before, equal_var=False)
        ends = found.confidence_interval(1 - question.alpha)
        return Pair(
            point=cell.point,
            first=first.group,
            second=second.group,
            n_first=len(before),
            n_second=len(after),
            test=self.title,
            difference=sum(after) / len(after) - sum(before) / len(before),
            low=float(ends.low),
            high=float(ends.high),
            a12=None,
            p=float(found.pvalue),
            smallest=0.0,
            estimate="difference of means",
        )
