"""Runs with several columns as points of a plane: principal components, or t-SNE.

Columns are standardised first (mean 0, standard deviation 1), so that units do not matter. Principal components are the
directions of the largest variance, by a singular value decomposition (Jolliffe 2002, Principal Component Analysis). The sign
of a component is free; here its largest weight is above 0. t-SNE (van der Maaten and Hinton 2008, J. Mach. Learn. Res. 9:
2579-2605) keeps neighbours together; its distances between groups have no meaning. It begins at the principal components, with
a fixed seed and one thread, so that the same data give the same plane.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sierra.util.lazy_definitions import dataclass

Floats = npt.NDArray[np.float64]

EQUAL = 1e-9
"""The relative difference of two weights that is due to rounding."""


@dataclass(frozen=True, slots=True)
class Components:
    """The first two principal components."""

    points: Floats
    """The places of the rows: n × 2."""
    explained: tuple[float, float]
    """The parts of the variance of all columns that the components have, 0 … 1."""


def varying(values: Floats) -> list[int]:
    """Return the places of the columns with different values."""
    return [int(place) for place in np.flatnonzero(np.ptp(values, axis=0) > EQUAL * np.abs(values).max(axis=0))]


def standardised(values: Floats) -> Floats:
    """Return varying columns with mean 0 and standard deviation 1."""
    scaled = values / np.abs(values).max(axis=0)  # squares of large numbers would overflow
    result: Floats = (scaled - scaled.mean(axis=0)) / scaled.std(axis=0, ddof=1)
    return result


def principal_components(values: Floats) -> Components:
    """Return the components of standardised columns: two columns and three rows at least."""
    left, sizes, weights = np.linalg.svd(values, full_matrices=False)
    points = left[:, :2] * sizes[:2] * [_sign(weight) for weight in weights[:2]]
    first, second = (sizes[:2] ** 2 / (sizes**2).sum()).tolist()
    return Components(points, (first, second))


def _sign(weights: Floats) -> float:
    """Return the sign of the largest weight; of several equal ones, that of the first."""
    sizes = np.abs(weights)
    return float(np.sign(weights[np.flatnonzero(sizes >= sizes.max() * (1 - EQUAL))[0]]))


def tsne(values: Floats, perplexity: float) -> Floats:
    """Return the places of the rows of standardised columns: n × 2. Raises ImportError without scikit-learn."""
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits

    start = principal_components(values).points
    start = start / start[:, 0].std() * 1e-4  # the scale that van der Maaten and Hinton begin with
    with threadpool_limits(1):
        model = TSNE(perplexity=perplexity, init=start, random_state=0, n_jobs=1)
        points: Floats = model.fit_transform(values).astype(float)
    return points
