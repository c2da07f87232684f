"""Classifiers: rates and curves of each run, and their mean and interval over the runs, compared with known values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import scipy.stats

from sierra.deliverables.figures.base import made_by
from sierra.deliverables.figures.drawing import noted
from sierra.errors import SierraError
from sierra.extensions.figures import classifiers_drawing
from sierra.model import Axis
from sierra.testing.figures import Row, Trial


def scores(*rows: tuple[float, int, int]) -> pa.Table:
    """Return rows of a score, the number of rows that have it, and the number of positive ones."""
    return pa.table(dict(zip(("score", "count", "positive"), map(list, zip(*rows, strict=True)), strict=True)))


def test_the_area_under_a_roc_is_the_probability_that_a_positive_row_has_the_higher_score() -> None:
    positive, negative = [0.9, 0.8, 0.4, 0.4], [0.7, 0.4, 0.2]
    every = sorted({*positive, *negative}, reverse=True)
    rows = [(s, positive.count(s) + negative.count(s), positive.count(s)) for s in every]
    found = classifiers_drawing.roc_of(scores(*rows))
    assert found is not None
    curve, area = found
    assert area == pytest.approx(scipy.stats.mannwhitneyu(positive, negative).statistic / 12)
    assert (curve[0], curve[-1]) == (0.5, 1.0)
    assert classifiers_drawing.roc_of(scores((0.5, 3, 3))) is None


def test_average_precision_weighs_precision_by_the_steps_of_recall() -> None:
    found = classifiers_drawing.precision_of(scores((0.9, 1, 1), (0.8, 1, 0), (0.7, 1, 1), (0.1, 1, 0)))
    assert found is not None
    curve, average = found
    assert average == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)
    assert (curve[0], curve[100], curve[-1]) == pytest.approx((1, 1, 2 / 3))


def test_risk_is_the_mean_loss_of_the_rows_with_the_highest_confidence() -> None:
    table = pa.table({"score": [0.9, 0.5, 0.1], "count": [2, 1, 1], "loss": [0.0, 1.0, 1.0]})
    found = classifiers_drawing.risk_of(table)
    assert found is not None
    curve, area = found
    assert (curve[50 * 2], curve[75 * 2], curve[-1]) == pytest.approx((0, 1 / 3, 1 / 2))
    assert area == pytest.approx(0.25 * (1 / 3 + 1 / 2))


def test_the_mean_over_runs_has_the_interval_of_student() -> None:
    samples = [np.array([0.2, 1.0]), np.array([0.4, np.nan]), np.array([0.9, np.nan])]
    center, half = classifiers_drawing.mean_of(samples)
    low, high = scipy.stats.t.interval(0.95, 2, 0.5, scipy.stats.sem([0.2, 0.4, 0.9]))
    assert (center[0] - half[0], center[0] + half[0]) == pytest.approx((low, high))
    assert (center[1], bool(np.isnan(half[1]))) == (1.0, True)


def test_a_confusion_matrix_weighs_runs_and_not_rows() -> None:
    """Run 0 takes all of its rows for the right category, run 1 half of them; the mean of the runs is 0.75."""

    def guess(experiment: int, run: int, row: int) -> Row:
        return {"truth": "a", "guess": "b" if run and row % 2 else "a"}

    drawing = Trial("confusion", {"column": ("truth", "guess")}, guess, ()).drawing(runs=lambda experiment: 2)
    runs = [drawing.rows["counts"].slice(0, 1), drawing.rows["counts"].slice(1)]
    center, _ = classifiers_drawing.mean_of([classifiers_drawing.rates(run, ["a", "b"]) for run in runs])
    assert center[0].tolist() == [0.75, 0.25]
    assert np.isnan(center[1]).all(), "no row is truly b"
    assert "accuracy 0.750 ± 3.177" in noted(drawing).note


def test_flags_are_a_truth_without_more_words() -> None:
    def score(experiment: int, run: int, row: int) -> Row:
        return {"truth": row % 2 == 0, "score": float(row % 3)}

    drawing = Trial("roc", {"column": ("truth", "score")}, score, ()).drawing()
    assert sum(drawing.rows["scores"].column("positive").to_pylist()) > 0


def test_a_wrong_positive_value_is_said() -> None:
    def score(experiment: int, run: int, row: int) -> Row:
        return {"truth": "ab"[row % 2], "score": float(row)}

    drawing = Trial("roc", {"column": ("truth", "score"), "positive": "c"}, score, ()).drawing()
    with pytest.raises(SierraError, match="the key `positive` says which value is positive"):
        noted(drawing)


def test_the_accuracies_of_confusion_matrices_have_the_order_of_the_panels() -> None:
    def better(experiment: int, run: int, row: int) -> Row:
        return {"truth": "ab"[row % 2], "guess": "ab"[row % 2] if row <= experiment else "c"}

    drawing = Trial("confusion", {"column": ("truth", "guess")}, better, (Axis("size", (1, 2, 3)),)).drawing()
    turned = replace(drawing, axes=(Axis("size", (3, 1, 2)),))
    assert "accuracy 0.125 ± 0.000, 0.250 ± 0.000, 0.375 ± 0.000" in noted(drawing).note
    assert "accuracy 0.375 ± 0.000, 0.125 ± 0.000, 0.250 ± 0.000" in noted(turned).note


@pytest.mark.parametrize("kind", ["ridge", "confusion"])
def test_the_record_names_seaborn_and_pandas(kind: str) -> None:
    assert {library.partition("==")[0] for library in made_by(kind)} == {"matplotlib", "seaborn", "pandas"}
