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
from sierra.testing.figures import ROWS, Row, Trial


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


def classified(classes: tuple[str, ...] = ("cat", "dog", "owl"), absent: str = "") -> Trial:
    """Return a figure of three classes with a score of each; rows of run 1 never have the class `absent`."""

    def score(experiment: int, run: int, row: int) -> Row:
        names = [name for name in ("cat", "dog", "owl") if not (run == 1 and name == absent)]
        truth, numbers = names[row % len(names)], np.random.default_rng((experiment, run, row)).random(3).round(2)
        return {"truth": truth, **{name: float(v) + (name == truth[0]) * 0.3 for name, v in zip("cdo", numbers, strict=True)}}

    return Trial("roc", {"column": ("truth", "c", "d", "o"), "classes": classes}, score, ())


def test_curves_of_classes_are_those_of_scikit_learn() -> None:
    metrics = pytest.importorskip("sklearn.metrics")
    drawing = classified().drawing(runs=lambda experiment: 1)
    truths, numbers = [], []
    for row in range(ROWS):
        values = np.random.default_rng((0, 0, row)).random(3).round(2)
        values[row % 3] += 0.3
        truths.append(row % 3)
        numbers.append(values)
    onehot = np.eye(3)[truths]
    [scored] = classifiers_drawing._runs(drawing.rows["scores"])
    found = classifiers_drawing._of_classes(scored, classifiers_drawing.roc_of, 3)
    expected = metrics.roc_auc_score(onehot, numbers, average=None)
    assert [found[place][1] for place in range(3)] == pytest.approx(list(expected))
    micro = classifiers_drawing.roc_of(drawing.rows["micro"])
    assert micro is not None
    assert micro[1] == pytest.approx(metrics.roc_auc_score(onehot, numbers, average="micro"))
    entries = [text.get_text() for text in classifiers_drawing.roc(drawing, ("cat", "dog", "owl")).legends[0].get_texts()]
    macro = metrics.roc_auc_score(onehot, numbers, average="macro")
    assert entries[0] == f"cat (AUC {expected[0]:.3f})"
    assert entries[-2:] == [f"micro-average (AUC {micro[1]:.3f})", f"macro-average (AUC {macro:.3f})"]


def test_runs_without_a_class_and_wrong_classes_are_said() -> None:
    note = noted(classified(absent="owl").drawing(runs=lambda experiment: 2)).note
    assert "1 of 2 runs lack rows of a class, and are not in the macro-average" in note
    with pytest.raises(SierraError, match="classes: 'ct' is no value of truth; did you mean 'cat'"):
        noted(classified(("ct", "dog", "owl")).drawing())
    with pytest.raises(SierraError, match="there are 2 classes, but 3 columns after the truth"):
        classified(("cat", "dog")).drawing()
