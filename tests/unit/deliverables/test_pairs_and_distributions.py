"""Distributions and pairs of columns are drawn with the right numbers, which are compared with NumPy, SciPy and known cases."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.stats

from sierra.deliverables.figures import pairs
from sierra.deliverables.figures.drawing import Drawing, noted
from sierra.errors import UsageError
from sierra.model import Axis
from sierra.testing.figures import ROWS, RUNS, Row, Trial
from tests.drawings import plot

SIZE = (Axis("size", (1, 2)),)
PAIR = {"column": ("energy", "distance")}


def final(kind: str, *values: float, **keys: object) -> Drawing:
    """Return a drawing of one experiment whose runs end with these values."""

    def row(experiment: int, run: int, row: int) -> Row:
        return {"energy": values[run]}

    return Trial(kind, keys, row, ()).drawing(runs=lambda experiment: len(values))


def area(shape: Any) -> float:
    """Return the area of a filled shape, by Gauss's formula."""
    x, y = shape.get_paths()[0].vertices.T
    return abs(float(x @ np.roll(y, 1) - y @ np.roll(x, 1))) / 2


def test_the_steps_of_an_ecdf_are_the_parts_of_the_runs() -> None:
    drawn = plot(final("ecdf", 4.0, 1.0, 2.0, 2.0, interval=False))
    line = drawn.lines[0]
    expected = scipy.stats.ecdf([4.0, 1.0, 2.0, 2.0]).cdf
    steps = dict(zip(line.get_xdata(), line.get_ydata(), strict=True))
    assert {x: steps[x] for x in (1.0, 2.0, 4.0)} == dict(zip(expected.quantiles, expected.probabilities, strict=True))
    assert not drawn.collections


def test_the_band_of_an_ecdf_has_the_half_width_of_massart() -> None:
    band = plot(final("ecdf", *range(40))).collections[0].get_paths()[0].vertices
    at_20 = [y for x, y in band if x == 20.0]
    assert max(at_20) - 21 / 40 == pytest.approx(np.sqrt(np.log(40) / 80))


def test_histograms_of_all_experiments_have_the_same_bins_and_count_every_run() -> None:
    drawing = Trial("histogram", {"bins": 7}).drawing(runs=lambda experiment: 9)
    outlines = plot(drawing).collections
    one, other = (np.unique(outline.get_paths()[0].vertices[:, 0]) for outline in outlines)
    assert list(one) == list(other)
    assert len(one) == 8
    assert [area(outline) / (one[1] - one[0]) for outline in outlines] == pytest.approx([9, 9])
    assert "7 bins" in noted(drawing).note


def test_a_linear_fit_and_its_interval_are_those_of_scipy() -> None:
    x, y = np.array([1.0, 2.0, 3.0, 4.0, 6.0]), np.array([2.1, 3.9, 6.2, 8.1, 11.0])
    fit = pairs.fitted(x, y, "linear")
    assert fit is not None
    known = scipy.stats.linregress(x, y)
    assert fit.y == pytest.approx(known.intercept + known.slope * fit.x)
    assert fit.r2 == pytest.approx(known.rvalue**2)
    s = np.sqrt(((y - known.intercept - known.slope * x) ** 2).sum() / 3)
    half = scipy.stats.t.ppf(0.975, 3) * s * np.sqrt(1 / 5 + (fit.x - x.mean()) ** 2 / ((x - x.mean()) ** 2).sum())
    assert fit.high - fit.y == pytest.approx(half)


@pytest.mark.parametrize(
    ("kind", "curve"),
    [
        ("quadratic", lambda x: 3 * x**2 - x + 1),
        ("cubic", lambda x: x**3 - 2 * x),
        ("log", lambda x: 2 * np.log(x) + 1),
        ("exp", lambda x: 2 * np.exp(0.5 * x)),
        ("power", lambda x: 3 * x**1.5),
    ],
)
def test_a_fit_finds_the_curve_that_the_points_are_on(kind: str, curve: Any) -> None:
    x = np.array([1.0, 2.0, 3.0, 5.0, 8.0])
    fit = pairs.fitted(x, curve(x), kind)
    assert fit is not None
    assert fit.y == pytest.approx(curve(fit.x))
    assert fit.r2 == pytest.approx(1)


def test_runs_that_a_logarithm_cannot_show_are_left_out_and_counted() -> None:
    def around_0(experiment: int, run: int, row: int) -> Row:
        return {"energy": run - 1.0, "distance": float(run * run) + 1}

    drawing = Trial("scatter", {**PAIR, "fit": "power"}, around_0, SIZE).drawing()
    assert "log scale: 4 of 12 runs not above 0 left out" in noted(drawing).note
    nothing = replace(drawing, runs=drawing.runs and drawing.runs.slice(0, 1))
    with pytest.raises(UsageError, match="logarithms need values above 0"):
        plot(nothing)


def of_rows(experiment: int, run: int, row: int) -> Row:
    """Rows on the line y = 3 − 2 x, but one without a value."""
    x = float(run + 10 * row)
    return {"x": x, "y": float("nan") if (run, row) == (1, 1) else 3 - 2 * x}


def test_a_scatter_of_rows_has_all_rows_and_a_curve_without_an_interval() -> None:
    trial = Trial("scatter", {"column": ("x", "y"), "rows": True, "fit": "linear"}, of_rows, ())
    drawing = trial.drawing()
    marks = RUNS * ROWS - 1
    note = noted(drawing).note
    assert f"{marks} rows; 1 rows without a value left out" in note
    assert "y = 3 − 2 x, R² = 1.000" in note
    assert "interval" not in note
    drawn = plot(drawing)
    assert (sum(len(marked.get_offsets()) for marked in drawn.collections), len(drawn.lines)) == (marks, 1)
    assert (drawn.get_xlabel(), drawn.get_ylabel()) == ("x", "y")


def test_a_histogram_of_rows_counts_rows() -> None:
    drawing = Trial("histogram", {"column": ("x",), "rows": True, "bins": 4}, of_rows, ()).drawing()
    assert f"{RUNS * ROWS} rows; 4 bins" in noted(drawing).note
    assert plot(drawing).get_ylabel() == "number of rows"


def test_runs_whose_rows_have_no_value_are_not_in_n() -> None:
    def lost(experiment: int, run: int, row: int) -> Row:
        return {"x": float("nan") if run else float(row)}

    drawing = Trial("histogram", {"column": ("x",), "rows": True}, lost, ()).drawing()
    assert f"n = 1; {RUNS - 1} of {RUNS} runs missing or without such rows; {ROWS} rows" in noted(drawing).note


@pytest.mark.parametrize(
    ("x", "y", "kind", "note"),
    [
        ((1.7e9, 1.7e9 + 5, 1.7e9 + 10), (0.1, 5.0, 9.8), "linear", "y = 0.1167 + 0.97 (x − 1.7e9), R² = 1.000"),
        ((0.0, 1.0, 2.0), (5.0, 5.0, 5.0), "linear", "y = 5"),
        ((0.0, 1.0), (1.0, 3.0), "linear", "y = 1 + 2 x (through all points)"),
    ],
)
def test_an_equation_has_the_digits_that_it_needs(x: tuple[float, ...], y: tuple[float, ...], kind: str, note: str) -> None:
    def row(experiment: int, run: int, row: int) -> Row:
        return {"x": x[run], "y": y[run]}

    drawing = Trial("scatter", {"column": ("x", "y"), "fit": kind}, row, ()).drawing(runs=lambda experiment: len(x))
    assert noted(drawing).note.endswith(f"; {note}")


def test_rows_and_a_measure_of_runs_exclude_each_other() -> None:
    with pytest.raises(UsageError, match="measure reduces the rows of a run to one value, but rows = true shows all rows"):
        Trial("histogram", {"column": ("x",), "rows": True, "measure": "mean"}, of_rows, ()).drawing()


@pytest.mark.parametrize(
    ("kind", "equation"),
    [
        ("linear", "y = −1.5 + 2 x"),
        ("cubic", "y = −1.5 + 2 x − 0.5 x² + 0.25 x³"),
        ("log", "y = −1.5 + 2 ln x"),
        ("exp", "ln y = −1.5 + 2 x"),
        ("power", "ln y = −1.5 + 2 ln x"),
    ],
)
def test_the_equation_of_a_curve_is_the_one_of_its_points(kind: str, equation: str) -> None:
    x = np.linspace(1, 4, 30)
    u = np.log(x) if kind in pairs.LOG_X else x
    v = -1.5 + 2 * u + (kind == "cubic") * (-0.5 * u**2 + 0.25 * u**3)
    fit = pairs.fitted(x, np.exp(v) if kind in pairs.LOG_Y else v, kind)
    assert fit is not None
    assert fit.equation == equation
