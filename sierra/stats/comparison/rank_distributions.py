"""Ranks, and the distributions of their statistics if there is no difference, counted over all arrangements.

Ranks may have ties, so they are multiples of 1/2; here they are doubled. `sums[s]` is the probability of the doubled sum s.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Doubled = npt.NDArray[np.int64]

PAIRS = 200
VALUES = 80
"""The largest number of pairs, and of values of two samples together, for which all arrangements are counted."""


def ranked(values: Floats) -> Floats:
    """Return the ranks of values from 1; equal values have the mean of their ranks. SciPy's module takes 0.5 s to import."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: Floats = (np.cumsum(counts) - (counts - 1) / 2)[places]
    return ranks


def doubled(ranks: Floats) -> Doubled:
    """Return ranks as whole numbers: twice their values."""
    return np.rint(2 * ranks).astype(np.int64)


def of_signs(ranks: Doubled) -> Floats:
    """Return the distribution of the sum of ranks, if each of them counts with probability 1/2."""
    sums = np.ones(1)
    for rank in ranks:
        sums = (np.pad(sums, (0, rank)) + np.pad(sums, (rank, 0))) / 2
    return sums


def of_choices(ranks: Doubled, chosen: int) -> Floats:
    """Return the distribution of the sum of `chosen` of the ranks, if each choice has the same probability."""
    total = int(ranks.sum())
    table = np.zeros((chosen + 1, total + 1))
    table[0, 0] = 1.0
    for rank in ranks:
        before = table.copy()
        table[1:, rank:] += before[:-1, : total + 1 - rank]
    sums: Floats = table[chosen] / table[chosen].sum()
    return sums
