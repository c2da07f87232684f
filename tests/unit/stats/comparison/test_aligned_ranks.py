"""Main effects and interactions are those of another program, and are not found where there are none."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from sierra.errors import UsageError
from sierra.stats.comparison import aligned_ranks

A, B = [0] * 10 + [1] * 10, ([0] * 5 + [1] * 5) * 2


def found(names: str, values: list[float], levels: list[list[int]], blocks: list[int] | None = None) -> dict[str, list[float]]:
    effects = aligned_ranks.effects(list(names), np.array(values, dtype=float), levels, blocks)
    return {effect.name: [effect.f, effect.df, effect.df_error, effect.p] for effect in effects}


def test_two_factors_agree_with_statsmodels() -> None:
    """F, df and p of anova_lm(typ=3) in statsmodels 0.15.0, on ranks that pandas aligned."""
    y = [3, 7, 5, 9, 12, 8, 6, 15, 11, 4, 8, 14, 10, 2, 9, 16, 13, 20, 18, 17]
    effects = found("ab", y, [A, B])
    assert effects["a"] == pytest.approx([7.135889, 1, 16, 0.0167255], rel=1e-5)
    assert effects["b"] == pytest.approx([8.586815, 1, 16, 0.00980357], rel=1e-5)
    assert effects["a × b"] == pytest.approx([3.373353, 1, 16, 0.0849078], rel=1e-5)


def test_blocks_agree_with_statsmodels() -> None:
    """As above, with the block as a further factor."""
    y = [12, 15, 11, 18, 14, 13, 17, 12, 16, 15, 19, 25, 20, 24, 22, 11, 14, 13, 15, 12, 16, 18, 14, 20, 19, 30, 28, 25, 33, 29]
    effects = found("ab", y, [[k // 15 for k in range(30)], [k // 5 % 3 for k in range(30)]], [k % 5 for k in range(30)])
    assert effects["a"] == pytest.approx([25.439942, 1, 20, 6.21522e-05], rel=1e-5)
    assert effects["b"] == pytest.approx([94.506657, 2, 20, 6.43518e-11], rel=1e-5)
    assert effects["a × b"] == pytest.approx([19.471334, 2, 20, 2.02303e-05], rel=1e-5)


def test_three_factors_with_unequal_numbers_of_runs_agree_with_statsmodels() -> None:
    y = [3, 5, 4, 6, 8, 7, 9, 10, 2, 4, 9, 11, 13, 5, 7, 12, 15, 14, 8, 6]
    points = [point for point, n in zip(product((0, 1), repeat=3), [3, 2] * 4, strict=True) for _ in range(n)]
    effects = found("abc", y, [list(levels) for levels in zip(*points, strict=True)])
    assert effects["a"] == pytest.approx([36.075157, 1, 12, 6.15733e-05], rel=1e-5)
    assert effects["b × c"] == pytest.approx([11.212314, 1, 12, 0.00579643], rel=1e-5)
    assert effects["a × b × c"] == pytest.approx([4.697069, 1, 12, 0.0510433], rel=1e-5)


def test_a_main_effect_makes_no_interaction() -> None:
    rng = np.random.default_rng(3)
    y = [10.0 * a + rng.random() for a in A]
    effects = found("ab", y, [A, B])
    assert effects["a"][3] < 0.001
    assert effects["b"][3] > 0.01
    assert effects["a × b"][3] > 0.01


def test_constant_values_have_no_effect() -> None:
    assert {p for *_, p in found("ab", [4.0] * 20, [A, B]).values()} == {1.0}


def test_designs_that_are_not_complete_are_refused() -> None:
    with pytest.raises(UsageError, match="combination of the factors has no value"):
        found("ab", [1, 2, 3], [[0, 0, 1], [0, 1, 0]])
    with pytest.raises(UsageError, match="'b' has one value only"):
        found("ab", [1, 2, 3, 4], [[0, 0, 1, 1], [0, 0, 0, 0]])
    with pytest.raises(UsageError, match="each combination needs two or more"):
        found("ab", [1, 2, 3, 4], [[0, 0, 1, 1], [0, 1, 0, 1]])
    with pytest.raises(UsageError, match="2 to 4 factors, not 5"):
        found("abcde", [1, 2], [[0, 1]] * 5)
