"""Ridges and Pareto fronts are drawn with the right numbers, which are compared with SciPy and known cases."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from sierra.deliverables.figures.drawing import noted
from sierra.extensions.figures import pareto_drawing
from tests.drawings import plot
from tests.unit.deliverables.test_pairs_and_distributions import area, final


def test_a_ridge_is_a_density() -> None:
    runs = [1.0, 2.0, 2.5, 4.0, 7.0, 7.5]
    (shape,) = plot(final("ridge", *runs)).collections
    x, y = shape.get_paths()[0].vertices.T
    upper = y > 0
    assert area(shape) == pytest.approx(1, abs=0.03)
    assert y[upper] == pytest.approx(scipy.stats.gaussian_kde(runs)(x[upper]))


def test_ridges_of_few_runs_are_said_to_be_without_a_density() -> None:
    assert "1 without a density: fewer than 5 runs, or all equal" in noted(final("ridge", 1.0, 2.0)).note


@pytest.mark.parametrize(
    ("better", "front"),
    [(("high", "high"), [3]), (("low", "high"), [0, 1, 3]), (("high", "low"), [2, 3]), (("low", "low"), [0, 2])],
)
def test_the_front_has_the_experiments_that_no_other_one_dominates(better: tuple[str, str], front: list[int]) -> None:
    x, y = np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, 3.0, 1.0, 4.0])
    assert sorted(pareto_drawing._front(x, y, better)) == front
