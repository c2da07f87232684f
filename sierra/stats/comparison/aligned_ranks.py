"""Main effects and interactions by ranks: the aligned rank transform (ART).

For each effect, the values are first aligned: all other effects are removed from them. Then they are ranked, and an analysis of
variance of the ranks tests this one effect (Wobbrock, Findlater, Gergle, Higgins 2011, CHI '11: 143-146). With the mean
ȳ_T of the cells that have the same values of the factors T, the aligned value of y for the effect S is

    y − (mean of the cell of y) + Σ over T ⊆ S of (−1)^(|S| − |T|) · ȳ_T

Runs with the same seed are a block, which is a further factor without interactions. Sums of squares are those of an effect
after all others (type III), so that cells need not have equal numbers of runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, product

import numpy as np
import numpy.typing as npt

from sierra.errors import UsageError
from sierra.stats.comparison.model import Effect
from sierra.stats.comparison.rank_distributions import ranked
from sierra.stats.comparison.ties import Floats, alike, rounded

MOST = 4
"""The largest number of factors."""
Levels = Sequence[Sequence[int]]
"""For each factor: the level of each value, as a number from 0."""
Codes = npt.NDArray[np.signedinteger]


def effects(names: Sequence[str], values: Floats, levels: Levels, blocks: Sequence[int] | None = None) -> list[Effect]:
    """Return the main effects and all interactions of factors. Raises UsageError for a design that is not complete."""
    if not 2 <= len(names) <= MOST:
        raise UsageError(f"a factorial comparison has 2 to {MOST} factors, not {len(names)}")
    codes = np.array(levels)
    sizes = [int(code.max()) + 1 for code in codes]
    if min(sizes) < 2:
        raise UsageError(f"factor {names[sizes.index(min(sizes))]!r} has one value only; a factor needs two or more")
    cell = np.ravel_multi_index(list(codes), sizes)
    [values], size = alike([values])
    counts = np.bincount(cell, minlength=int(np.prod(sizes)))
    if not counts.all():
        raise UsageError("a combination of the factors has no value; main effects and interactions need all combinations")
    means = (np.bincount(cell, values, len(counts)) / counts).reshape(sizes)
    residual = values - means[tuple(codes)]
    block = _dummies(np.array(blocks)) if blocks is not None else np.empty((len(values), 0))
    terms = list(_subsets(range(len(names))))
    columns = {term: _columns(term, codes, sizes) for term in terms}
    return [
        _effect(term, names, rounded(residual + _own(term, means)[tuple(codes)], size), columns, block)
        for term in terms
        if term
    ]


def _effect(
    term: tuple[int, ...], names: Sequence[str], aligned: Floats, columns: dict[tuple[int, ...], Floats], block: Floats
) -> Effect:
    from scipy import stats

    ranks = ranked(aligned)
    full = np.column_stack([*columns.values(), block])
    rest = np.column_stack([*(part for other, part in columns.items() if other != term), block])
    error, df_error = _unexplained(full, ranks)
    without, df_without = _unexplained(rest, ranks)
    df = df_without - df_error
    if df_error < 1:
        raise UsageError("there are too few runs for main effects and interactions: each combination needs two or more")
    explained = max(0.0, without - error)
    name = " × ".join(names[factor] for factor in term)
    if error <= 1e-9 * max(1.0, without):
        none = explained <= 1e-9
        return Effect(name, 0.0 if none else np.inf, df, df_error, 1.0 if none else 0.0, 0.0 if none else 1.0)
    f = explained / df / (error / df_error)
    return Effect(name, f, df, df_error, float(stats.f.sf(f, df, df_error)), explained / (explained + error))


def _own(term: tuple[int, ...], means: Floats) -> Floats:
    """Return the part of the cells' means that belongs to one effect, in the shape of `means`."""
    total = np.zeros_like(means)
    for part in _subsets(term):
        others = tuple(axis for axis in range(means.ndim) if axis not in part)
        total = total + (-1) ** (len(term) - len(part)) * means.mean(axis=others, keepdims=True)
    return total


def _subsets(places: Sequence[int]) -> Iterator[tuple[int, ...]]:
    for size in range(len(places) + 1):
        yield from combinations(places, size)


def _columns(term: tuple[int, ...], codes: Codes, sizes: Sequence[int]) -> Floats:
    """Return the columns of an effect in the design matrix, with contrasts that sum to zero; of no factor, the constant."""
    parts = [_contrasts(codes[factor], sizes[factor]) for factor in term]
    columns = [np.prod([np.ones(codes.shape[1]), *chosen], axis=0) for chosen in product(*(part.T for part in parts))]
    return np.column_stack(columns)


def _contrasts(code: Codes, size: int) -> Floats:
    contrasts: Floats = np.vstack([np.eye(size - 1), -np.ones(size - 1)])[code]
    return contrasts


def _dummies(code: Codes) -> Floats:
    _, places = np.unique(code, return_inverse=True)
    dummies: Floats = _contrasts(places, int(places.max()) + 1)
    return dummies


def _unexplained(design: Floats, values: Floats) -> tuple[float, int]:
    """Return the sum of squares that a linear model leaves, and its degrees of freedom."""
    solution, _, rank, _ = np.linalg.lstsq(design, values, rcond=None)
    return float(((values - design @ solution) ** 2).sum()), len(values) - int(rank)
