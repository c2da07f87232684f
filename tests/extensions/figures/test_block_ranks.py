"""Rankings over blocks equal published ones, and bars join exactly the groups that were not shown to differ."""

from __future__ import annotations

import numpy as np
import pytest

from sierra.extensions.figures.block_ranks import Ranking, ranking
from sierra.stats.comparison.analyse import analyse
from sierra.stats.comparison.model import Cell, Question, RunValue, Sample, Verdict

C45 = ("C4.5", "+m", "+cf", "+m+cf")
RANKS = np.array(
    [
        *([4, 3, 2, 1], [1, 2, 3, 4], [4, 1, 2, 3], [4, 1, 3, 2], [4, 2, 3, 1], [1, 2.5, 4, 2.5], [3, 2, 4, 1]),
        *([2.5, 2.5, 4, 1], [4, 3, 2, 1], [2.5, 2.5, 2.5, 2.5], [4, 2.5, 1, 2.5], [3, 2, 4, 1], [4, 1, 2, 3], [3, 1, 4, 2]),
    ]
)
"""The ranks of four classifiers on 14 data sets (Demšar 2006, J. Mach. Learn. Res. 7: 1-30, table 6)."""


def names_of(found: Ranking) -> list[str]:
    return [f"{found.groups[one]} {found.groups[other]}" for one, other in sorted(found.alike)]


def test_published_ranks_critical_differences_and_verdicts() -> None:
    """Demšar: mean ranks 3.143, 2.000, 2.893, 1.964; CD = 1.25 finds nothing at 0.05, CD = 1.12 finds two pairs at 0.10."""
    found = ranking(C45, RANKS, "nemenyi", 0.05, best_is_high=False)
    assert dict(zip(found.groups, found.ranks, strict=True)) == pytest.approx(
        {"C4.5": 3.143, "+m": 2.0, "+cf": 2.893, "+m+cf": 1.964}, abs=5e-4
    )
    assert found.critical == pytest.approx(1.25, abs=0.005)
    assert found.p is not None
    assert found.p < 0.05
    assert found.bars == ((0, 3),), "Nemenyi's test has too little power to find any difference"
    found = ranking(C45, -RANKS, "nemenyi", 0.10, best_is_high=True)
    assert found.critical == pytest.approx(1.12, abs=0.005)
    assert found.groups == ("+m+cf", "+m", "+cf", "C4.5")
    assert names_of(found) == ["+m+cf +m", "+m+cf +cf", "+m +cf", "+cf C4.5"]
    assert found.bars == ((0, 2), (2, 3))


def test_verdicts_of_wilcoxon_are_those_of_a_comparison() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=(30, 1)) + rng.normal(size=(30, 4)) * 0.5 + [0.0, 0.1, 0.7, 1.5]
    found = ranking("abcd", values, "wilcoxon", 0.05, best_is_high=True)
    samples = tuple(
        Sample(name, tuple(RunValue(seed, value) for seed, value in enumerate(values[:, place])), 30)
        for place, name in enumerate("abcd")
    )
    pairs = analyse([Cell({}, samples)], Question(paired=True)).pairs
    same = {frozenset((one.first, one.second)) for one in pairs if one.verdict is not Verdict.different}
    assert {frozenset(name.split()) for name in names_of(found)} == same == {frozenset("ab")}
    assert (found.groups, found.bars) == (("d", "c", "b", "a"), ((2, 3),))


def test_friedmans_test_decides_about_no_two_groups() -> None:
    """Two groups differ in each block, but among others that vary far more."""
    wide = np.array([sign * (50.0 + run) for run in range(6) for sign in (-1, 1)])
    values = np.column_stack([np.arange(12.0) / 100, 1 + np.arange(12.0) / 50, wide, wide[::-1]])
    found = ranking("abcd", values, "wilcoxon", 0.05, best_is_high=True)
    assert found.p is not None
    assert found.p > 0.05
    assert frozenset("ab") not in {frozenset(name.split()) for name in names_of(found)}


def test_two_groups_are_compared_by_wilcoxon_and_few_blocks_are_said_to_be_too_few() -> None:
    found = ranking("ab", np.array([[1.0, 2], [1, 2], [1, 2], [1, 2], [1, 2]]), "nemenyi", 0.05, best_is_high=True)
    assert (found.ranks, found.critical, found.p, found.enough, found.bars) == ((1.0, 2.0), None, None, False, ((0, 1),))
    found = ranking("abcde", np.tile(np.arange(5.0), (2, 1)), "nemenyi", 0.05, best_is_high=True)
    assert not found.enough, "two blocks can never differ by the critical difference"
    assert found.bars == ((0, 4),)


def test_a_pair_that_no_bar_can_join_is_listed() -> None:
    """The first and the last group do not differ, but one between them differs from both: a bar would claim too much."""
    found = Ranking(("a", "b", "c"), (1.0, 2.0, 3.0), frozenset({(0, 2)}), 9, 0.05, 0.01, None, enough=True)
    assert (found.bars, found.beside) == ((), ((0, 2),))


@pytest.mark.nightly
def test_no_two_groups_differ_if_the_omnibus_test_finds_no_difference() -> None:
    """Simulation with a known truth: of 300 batches of equal groups, at most about 5 % show any difference."""
    rng = np.random.default_rng(7)
    for test in ("nemenyi", "wilcoxon"):
        wrong = sum(
            ranking("abc", rng.normal(size=(20, 3)), test, 0.05, best_is_high=True).bars != ((0, 2),) for _ in range(300)
        )
        assert wrong <= 25
