"""Values that differ by rounding errors only are ties: values of groups are rounded to 10⁻¹² of their spread.

First, a common value is subtracted from all values, as decimals: so 1e15 + 0.5 and 0.5 have the same differences and ties, and
0.3 − 0.2 is 0.1. The spread is a median of distances, so neither a few values that are very large nor a common offset hides the
differences of the others. Distances that rounding explains do not count; if there are no others, all values are equal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
DIGITS = 12
"""The number of digits, relative to the spread, in which values must differ."""
ERRORS = 4
"""The largest difference of two computed values that rounding explains, in distances between neighbouring floats."""


def alike(groups: Sequence[Floats]) -> tuple[list[Floats], float]:
    """Return the values of groups without a common offset and without rounding errors, and their spread."""
    every = np.sort(np.concatenate(groups))
    offset = float(every[len(every) // 2]) if every.size else 0.0
    moved = [minus(group, np.full(len(group), offset)) for group in groups] if offset else groups
    size = spread(moved, noise(every))
    return [rounded(group, size) if size else np.zeros(len(group)) for group in moved], size


def differences(first: Floats, second: Floats) -> tuple[Floats, float]:
    """Return the differences `second` minus `first` of pairs without rounding errors, and their spread."""
    found, errors = minus(second, first), noise(np.concatenate((first, second)))
    if size := spread([found], errors):
        size = min(size, float(np.median(np.abs(found))) or size)
        return rounded(found, size), size
    same = float(np.median(found)) if found.size else 0.0
    return np.full(len(found), same if abs(same) > errors else 0.0), 0.0


def each_alike(rows: Floats) -> Floats:
    """Return an array of which each row is without a common offset and without rounding errors."""
    return np.array([alike([row])[0][0] for row in rows]).reshape(rows.shape)


def spread(groups: Sequence[Floats], errors: float = 0.0) -> float:
    """Return the typical distance of values from each other, of those above `errors`; 0 if there is none.

    It is the median distance from the median of a group, or from that of all groups, whichever is smaller.
    """
    medians = []
    for parts in (groups, [np.concatenate(groups)]):
        distances = np.concatenate([np.abs(part - np.median(part)) for part in parts if len(part)])
        if (above := distances[distances > errors]).size:
            medians.append(float(np.median(above)))
    return min(medians, default=0.0)


def rounded(values: Floats, size: float) -> Floats:
    """Return values that are rounded to 10⁻¹² of `size`; those that have no such digits stay."""
    if not 1e-280 < size < 1e290:
        return values
    digits = DIGITS - math.ceil(math.log10(size))
    with np.errstate(over="ignore", invalid="ignore"):
        found: Floats = np.where(np.abs(values) < 2.0**52 * 10.0**-digits, np.round(values, digits), values)
    return found


def noise(values: Floats) -> float:
    """Return the largest difference of two values that rounding explains; 0 for whole numbers."""
    if not values.size or (values == np.rint(values)).all():
        return 0.0
    return float(ERRORS * np.spacing(np.median(np.abs(values))))


def minus(values: Floats, others: Floats) -> Floats:
    """Return differences, as those of the shortest decimals that stand for the floats."""
    pairs = zip(values.tolist(), others.tolist(), strict=True)
    return np.array([float(Decimal(repr(value)) - Decimal(repr(other))) for value, other in pairs], dtype=float)
