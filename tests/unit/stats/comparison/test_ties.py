"""Rounding errors are ties, and neither a common offset nor a few very large values make ties of different values."""

from __future__ import annotations

import numpy as np
import pytest

from sierra.stats.comparison import ties
from sierra.stats.comparison.analyse import analyse
from sierra.stats.comparison.model import Analysis, Cell, Question, RunValue, Sample, Verdict


def compared(groups: list[list[float]], *, paired: bool) -> Analysis:
    samples = tuple(
        Sample(f"g{place}", tuple(RunValue(seed, value) for seed, value in enumerate(values)), len(values))
        for place, values in enumerate(groups)
    )
    return analyse([Cell({}, samples)], Question(paired=paired, margin=0.25))


def test_rounding_errors_are_ties() -> None:
    first, second = np.array([0.2, 0.1, 0.2, 0.1 + 0.2]), np.array([0.3, 0.2, 0.1, 0.3])
    assert len(np.unique(np.abs(second - first))) == 3
    found, _ = ties.differences(first, second)
    assert found.tolist() == [0.1, 0.1, -0.1, 0]
    groups, _ = ties.alike([np.array([0.1 + 0.2, 0.7]), np.array([0.3, 0.7])])
    assert groups[0].tolist() == groups[1].tolist()


@pytest.mark.parametrize("paired", [True, False])
def test_groups_that_differ_by_rounding_errors_only_are_equal(paired: bool) -> None:
    result = compared([[0.1 + 0.2] * 12, [0.3] * 12], paired=paired)
    assert (result.pairs[0].p, result.pairs[0].difference, result.pairs[0].verdict) == (1, 0, Verdict.equivalent)


@pytest.mark.parametrize("paired", [True, False])
@pytest.mark.parametrize("offset", [1e6, 1e12, 1e15])
def test_a_common_offset_changes_nothing(offset: float, paired: bool) -> None:
    rng = np.random.default_rng(4)
    groups = [(np.round(2 * rng.normal(mean, size=12)) / 2).tolist() for mean in (0, 0.5, 4)]
    one, other = (compared([[value + far for value in group] for group in groups], paired=paired) for far in (0.0, offset))
    assert [pair.p for pair in one.pairs] == [pair.p for pair in other.pairs]
    assert [pair.verdict for pair in one.pairs] == [pair.verdict for pair in other.pairs]
    assert one.omnibus == other.omnibus
    for name in ("difference", "low", "high", "a12", "p_equivalent"):
        values = [[getattr(pair, name) for pair in result.pairs] for result in (one, other)]
        assert values[0] == pytest.approx(values[1])


@pytest.mark.parametrize("paired", [True, False])
def test_one_run_that_diverged_does_not_make_ties_of_the_others(paired: bool) -> None:
    near, far = [float(run) for run in range(12)], [run + 20.0 for run in range(11)]
    (pair,) = compared([near, [*far, 1e30]], paired=paired).pairs
    assert pair.verdict is Verdict.different
    assert pair.low == pytest.approx(20 if paired else 16, abs=2)
    (pair,) = compared([[*near[:1] * 11, 1e30], [2.0] * 12], paired=paired).pairs
    assert pair.difference == 2


def test_numbers_without_digits_to_round_stay() -> None:
    for scale in (1e-300, 1e300, 0.0, 5e-324):
        assert np.all(ties.rounded(np.array([scale, 2 * scale]), scale) == [scale, 2 * scale])
    assert ties.alike([np.array([]), np.array([3.0])])[0][1].tolist() == [0]
