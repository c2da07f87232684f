"""Intervals of differences of rates have published values, and the exact tests are those of other programs."""

from __future__ import annotations

from functools import partial
from itertools import product
from math import comb, prod

import numpy as np
import pytest
from scipy import stats

from sierra.stats import rates
from sierra.stats.rates import Pairs

Z = 1.959963984540054


@pytest.mark.parametrize(
    ("first", "second", "difference", "low", "high", "p"),
    [
        ((4, 20), (13, 20), 0.45, 0.1437, 0.6567, 0.009530),
        ((48, 80), (56, 70), 0.2, 0.0524, 0.3339, 0.01252),
        ((0, 20), (20, 20), 1, 0.7721, 1, 1.451e-11),
        ((0, 10), (0, 10), 0, -0.2775, 0.2775, 1),
    ],
)
def test_differences_of_rates_without_pairs(
    first: tuple[int, int], second: tuple[int, int], difference: float, low: float, high: float, p: float
) -> None:
    """The intervals are those of Newcombe's method 10."""
    assert rates.of_samples(first, second, Z) == pytest.approx((difference, low, high), abs=5e-5)
    assert rates.fisher(first, second) == pytest.approx(p, rel=5e-4)
    value, down, up = rates.of_samples(second, first, Z)
    assert (-value, -up, -down) == pytest.approx((difference, low, high), abs=5e-5)


@pytest.mark.parametrize(
    ("pairs", "difference", "low", "high"),
    [
        (Pairs(36, 12, 2, 0), 0.2, 0.0569, 0.3404),
        (Pairs(20, 12, 2, 16), 0.2, 0.0562, 0.3292),
    ],
)
def test_differences_of_rates_of_pairs(pairs: Pairs, difference: float, low: float, high: float) -> None:
    """Newcombe (1998, Stat. Med. 17: 2635-2650), method 10; the difference there is the first rate minus the second."""
    value, down, up = rates.of_pairs(pairs, Z)
    assert (-value, -up, -down) == pytest.approx((difference, low, high), abs=5e-5)


def test_mcnemar_is_the_binomial_test_of_discordant_pairs() -> None:
    assert rates.mcnemar(Pairs(36, 12, 2, 0)) == pytest.approx(0.01294, abs=5e-6)
    for one, other in product(range(6), repeat=2):
        if one + other:
            assert rates.mcnemar(Pairs(3, one, other, 4)) == pytest.approx(stats.binomtest(one, one + other).pvalue)
    assert rates.mcnemar(Pairs(3, 0, 0, 4)) == 1


@pytest.mark.parametrize(("first", "second"), [(1, 1), (3, 3), (4, 7), (6, 2)])
def test_no_data_give_less_than_the_smallest_p_value_of_fisher(first: int, second: int) -> None:
    every = [rates.fisher((one, first), (other, second)) for one in range(first + 1) for other in range(second + 1)]
    assert min(every) == pytest.approx(rates.smallest_fisher(first, second))


def by_all_tables(groups: list[tuple[int, int]]) -> float:
    """Return the p value of Freeman and Halton from a list of all tables with the same sums."""
    total = sum(one for one, _ in groups)
    tables = (table for table in product(*(range(n + 1) for _, n in groups)) if sum(table) == total)
    sizes = [prod(comb(n, one) for one, (_, n) in zip(table, groups, strict=True)) for table in tables]
    found = prod(comb(n, one) for one, n in groups)
    return sum(size for size in sizes if size <= found) / sum(sizes)


@pytest.mark.parametrize(
    "groups", [[(4, 20), (13, 20)], [(1, 5), (4, 5), (3, 6)], [(0, 4), (0, 4), (0, 4)], [(3, 10), (5, 10), (9, 10)]]
)
def test_freeman_and_halton_count_all_tables(groups: list[tuple[int, int]]) -> None:
    p, exact = rates.freeman_halton(groups)
    assert exact
    assert p == pytest.approx(by_all_tables(groups))
    if len(groups) == 2:
        assert p == pytest.approx(rates.fisher(*groups))
    assert rates._drawn(groups) == pytest.approx(p, abs=0.006), "the tables that are drawn if there are too many"


def test_too_many_tables_are_drawn_with_a_fixed_seed() -> None:
    groups = [(20 * k, 200 + 7 * k * k) for k in range(1, 8)]
    p, exact = rates.freeman_halton(groups)
    assert not exact
    assert 0 < p < 0.001
    assert rates.freeman_halton(groups) == (p, exact)


def test_cochran_is_friedman_with_ties() -> None:
    blocks = np.random.default_rng(2).integers(2, size=(30, 4))
    found = stats.friedmanchisquare(*blocks.T)
    assert rates.cochran(blocks.tolist()) == pytest.approx((found.statistic, found.pvalue))
    assert rates.cochran([[1, 1], [0, 0]]) == (0.0, 1.0)
    two = [[1, 0]] * 7 + [[0, 1]] * 2
    assert rates.cochran(two)[0] == pytest.approx((7 - 2) ** 2 / 9), "with two groups, that of McNemar without a correction"


def test_equivalence_is_that_of_the_interval_with_twice_the_level() -> None:
    of = partial(rates.of_samples, (50, 100), (53, 100))
    p = rates.within(of, 0.18)
    _, low, high = of(stats.norm.isf(p))
    assert max(-low, high) == pytest.approx(0.18)
    assert rates.within(of, 0.02) == 1
    assert rates.within(of, 5) == 0


def test_the_table_of_many_runs_is_drawn() -> None:
    p, exact = rates.freeman_halton([(500, 1000), (510, 1000), (490, 1000)])
    assert not exact
    assert p > 0.5
