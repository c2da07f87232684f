"""The shipped comparison methods pass the conformance suite; methods that break the contract do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from sierra.config.plugin_registry import COMPARISONS
from sierra.errors import SierraError
from sierra.stats.comparison.analyse import analyse
from sierra.stats.comparison.base import CellResult
from sierra.stats.comparison.model import Cell, Question, RunValue, Sample
from sierra.stats.comparison.shipped import RankSum
from sierra.testing import comparisons as conformance
from tests import plugins


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("name", COMPARISONS.shipped)
def test_a_shipped_method_fulfils_the_contract(name: str) -> None:
    conformance.check(name)


class NoNumber(RankSum):
    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        tests = super().compare(cell, question, paired=paired)
        return CellResult(tuple(replace(pair, p=float("nan")) for pair in tests.pairs))


class AlwaysDifferent(RankSum):
    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        return CellResult(
            tuple(replace(pair, p=0.0, smallest=0.0) for pair in super().compare(cell, question, paired=paired).pairs)
        )


class Backwards(RankSum):
    def compare(self, cell: Cell, question: Question, *, paired: bool) -> CellResult:
        pairs = super().compare(cell, question, paired=paired).pairs
        return CellResult(tuple(replace(pair, difference=-(pair.difference or 0.0), low=None, high=None) for pair in pairs))


@pytest.mark.parametrize(
    ("broken", "claim"),
    [
        ("NoNumber", "a p value of 2 runs is nan"),
        ("AlwaysDifferent", "equal groups differ in 200 of 200 simulations"),
        ("Backwards", "it should be above 0"),
    ],
)
def test_a_method_that_breaks_the_contract_is_found(
    broken: str, claim: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = Path(__file__).read_text()
    monkeypatch.syspath_prepend(str(plugins.write(tmp_path, "broken_method", {f"sierra.comparisons {broken}": broken}, code)))
    with pytest.raises(AssertionError, match=claim):
        conformance.check(broken)


def test_a_p_value_that_is_none_ends_the_comparison(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    point = {"sierra.comparisons none": "NoNumber"}
    monkeypatch.syspath_prepend(str(plugins.write(tmp_path, "no_number", point, Path(__file__).read_text())))
    cell = Cell({}, tuple(Sample(name, tuple(RunValue(k, k + 1.0) for k in range(5)), 5) for name in "ab"))
    with pytest.raises(SierraError, match=r"the Mann-Whitney test has the p value nan, which is not from 0 to 1"):
        analyse([cell], Question(paired=False), (), "none")
