"""Principal components equal those of scikit-learn, and t-SNE keeps groups together and gives the same plane again."""

from __future__ import annotations

import numpy as np
import pytest

from sierra.extensions.figures import embedding_methods as embedding


def clusters(seed: int, n: int = 20) -> embedding.Floats:
    """Return 2 n rows of five columns of very different sizes, in two groups."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(2 * n, 5)) + np.repeat([[0.0], [8.0]], n, axis=0)
    return rows * [1, 1e6, 1e-6, -1, 1e200]


def test_components_do_not_depend_on_units_and_their_sign_is_fixed() -> None:
    table = embedding.standardised(clusters(3))
    found, other = (
        embedding.principal_components(table),
        embedding.principal_components(embedding.standardised(clusters(3) * -7)),
    )
    assert other.points == pytest.approx(-found.points)
    weights = table.T @ found.points
    assert all(column[np.abs(column).argmax()] > 0 for column in weights.T)
    assert found.explained[0] > 0.9
    assert embedding.varying(np.array([[1.0, 2.0, 1e9], [1.0, 3.0, 1e9 + 1e-3]])) == [1]


@pytest.mark.integration
def test_components_equal_those_of_scikit_learn() -> None:
    from sklearn.decomposition import PCA

    table = embedding.standardised(clusters(4))
    found, known = embedding.principal_components(table), PCA(2, svd_solver="full")
    points = known.fit_transform(table)
    assert np.abs(found.points) == pytest.approx(np.abs(points))
    assert found.explained == pytest.approx(known.explained_variance_ratio_)


@pytest.mark.nightly
def test_neighbours_of_t_sne_are_those_of_the_same_group() -> None:
    table = embedding.standardised(clusters(5))
    found = embedding.tsne(table, 5.0)
    far = np.linalg.norm(found[:, None] - found, axis=2) + np.diag([np.inf] * len(found))
    assert ((far.argmin(axis=1) < 20) == (np.arange(40) < 20)).all()
    assert (embedding.tsne(table, 5.0) == found).all()
