"""Pairs of runs: with common random numbers, runs with the same seed belong together.

Pairs remove what the seed does to all groups alike, so that smaller differences are found. This helps only if the values of
runs with the same seed are correlated. The correlation is the mean of Spearman's rank correlations of all groups over all
cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from sierra.errors import UsageError
from sierra.stats.comparison.model import Cell, Paired, Pairing, Sample
from sierra.stats.comparison.rank_distributions import ranked
from sierra.stats.comparison.ties import Floats, each_alike

HELPFUL = 0.0
"""The correlation above which pairs help."""


def decide(cells: Sequence[Cell], wanted: Paired) -> Pairing:
    """Return whether to compare runs as pairs. Raises UsageError if pairs are requested, but seeds are not in common."""
    if wanted is False:
        return Pairing(False, "runs are not compared as pairs, as requested")
    common = sum(len(common_seeds(cell.samples)) for cell in cells)
    most = sum(min(len(sample.values) for sample in cell.samples) for cell in cells)
    if not common or (wanted == "auto" and common < most / 2):
        if wanted is True:
            raise UsageError("the groups have no seeds in common, so runs cannot be paired; leave out paired = true (--paired)")
        few = "few" if common else "no"
        return Pairing(False, f"the groups have {few} seeds in common, so runs are not compared as pairs")
    coefficient = correlation(cells)
    if wanted is True:
        return Pairing(True, "runs with the same seed are pairs, as requested", coefficient)
    if coefficient is None:
        return Pairing(True, "runs with the same seed are pairs (common random numbers); a correlation cannot be computed")
    if coefficient > HELPFUL:
        return Pairing(True, "runs with the same seed are pairs (common random numbers)", coefficient)
    if coefficient < -2 / math.sqrt(common):
        return Pairing(
            True,
            "runs with the same seed are pairs, because they depend on each other; their negative correlation makes "
            "differences harder to show",
            coefficient,
        )
    return Pairing(False, "runs with the same seed are not correlated, so they are not compared as pairs", coefficient)


def common_seeds(samples: Sequence[Sample]) -> list[int]:
    """Return the seeds with a value in all samples, in ascending order."""
    return sorted(set.intersection(*({run.seed for run in sample.values} for sample in samples)))


def blocks(samples: Sequence[Sample]) -> Floats:
    """Return the values of runs with common seeds: a row for each seed, a column for each sample."""
    seeds = common_seeds(samples)
    values = [{run.seed: run.value for run in sample.values} for sample in samples]
    return np.array([[by_seed[seed] for by_seed in values] for seed in seeds], dtype=float).reshape(len(seeds), len(samples))


def correlation(cells: Sequence[Cell]) -> float | None:
    """Return the mean rank correlation of all groups; None if no two groups vary."""
    coefficients = [coefficient for cell in cells for coefficient in _correlations(blocks(cell.samples))]
    return float(np.mean(coefficients)) if coefficients else None


def _correlations(values: Floats) -> Iterator[float]:
    """Yield the rank correlation of each two columns that are not constant."""
    if len(values) < 3:
        return
    ranks = np.array([ranked(column) for column in each_alike(values.T)]).T
    varying = ranks[:, np.ptp(ranks, axis=0) > 0]
    if varying.shape[1] > 1:
        matrix = np.corrcoef(varying, rowvar=False)
        yield from map(float, matrix[np.triu_indices(len(matrix), 1)])
