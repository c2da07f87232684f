"""Critical-difference diagrams rank within experiments or seeds, and refuse what has no ranks."""

from __future__ import annotations

import math

import pytest

from sierra.deliverables.figures.drawing import Drawing, noted
from sierra.errors import UsageError
from sierra.extensions.figures import ranks_drawing
from sierra.model import Axis
from sierra.testing.figures import Row, Trial
from tests.drawings import noise, refusal

GROUPS = Axis("controller", ("a", "b", "c"))


def ranked(*axes: Axis, runs: int = 12, **keys: object) -> Drawing:
    def row(experiment: int, run: int, row: int) -> Row:
        group = experiment // math.prod(len(axis.values) for axis in axes[1:])
        return {"score": 0.6 * group + noise(experiment, run)}

    return Trial("critical_difference", keys, row, axes).drawing(runs=lambda experiment: runs)


@pytest.mark.integration
def test_seeds_are_blocks_of_one_variable_and_experiments_of_several() -> None:
    assert "mean ranks of runs, n = 12; 12 blocks, Friedman p = " in noted(ranked(GROUPS)).note
    scenarios = Axis("scenario", tuple("vwxyz"))
    note = noted(ranked(GROUPS, scenarios)).note
    assert "mean ranks of the mean of the runs, n = 12; 5 blocks, Friedman p = 0.0067, Nemenyi CD = 1.48, α = 0.05" in note
    assert "60 blocks" in noted(ranked(GROUPS, scenarios, blocks="seeds")).note
    assert "2 blocks are too few to show any difference" in noted(ranked(GROUPS, runs=2)).note
    assert len(ranks_drawing.blocks(ranked(GROUPS), "seeds")) == 12


def test_ranks_of_one_group_one_block_many_groups_or_censored_times_are_refused() -> None:
    with pytest.raises(UsageError, match="needs a variable \\(x\\) with two values or more"):
        ranked(Axis("controller", ("a",)))
    assert "ranks need two blocks or more in which each group has a value, but there is one" in refusal(ranked(GROUPS, runs=1))
    assert "ranks of 25 groups cannot be read" in refusal(ranked(Axis("size", tuple(range(25)))))
    assert "censored times have no ranks" in refusal(ranked(GROUPS, measure="time_to", threshold=1.5))
    with pytest.raises(UsageError, match='use blocks = "seeds"'):
        ranked(GROUPS, blocks="experiments")
