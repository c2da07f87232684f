"""Embeddings leave out what has no place in a plane, and say so."""

from __future__ import annotations

import math
import sys

import pytest

from sierra.deliverables.figures.drawing import Drawing, noted
from sierra.errors import UsageError
from sierra.model import Axis
from sierra.testing.figures import Row, Trial
from tests.drawings import noise, plot, refusal

GROUPS = Axis("controller", ("a", "b", "c"))


def points(runs: int = 12, **columns: float) -> Drawing:
    """Return an embedding of random columns, and of constant ones."""

    def row(experiment: int, run: int, row: int) -> Row:
        return {"p": noise(experiment, run), "q": noise(run, experiment + 5), **columns}

    names = tuple(row(0, 0, 0))
    return Trial("embedding", {"column": names}, row, (GROUPS,)).drawing(runs=lambda experiment: runs)


def test_constant_columns_are_left_out_of_an_embedding(monkeypatch: pytest.MonkeyPatch) -> None:
    drawing = points(same=4.0)
    assert (
        "principal components of 2 columns, with their % of the variance; the same in all runs and left out: same"
        in noted(drawing).note
    )
    drawn = plot(drawing)
    assert sum(len(line.get_xdata()) for line in drawn.lines) == 36
    assert drawn.get_xlabel().startswith("PC 1 (")
    assert "needs 3 runs with values in all columns" in refusal(points(runs=1, bad=math.nan))
    with pytest.raises(UsageError, match="needs two columns or more, not 1"):
        Trial("embedding").drawing()
    monkeypatch.setitem(sys.modules, "sklearn.manifold", None)
    without = Trial("embedding", {"column": ("energy", "distance"), "method": "tsne"}).drawing()
    assert refusal(without) == "scikit-learn is not installed; pip install 'sierra-experiments[embedding]'"
