"""The deviation of a model from the data, checked against numbers of statsmodels."""

from __future__ import annotations

import math

import pyarrow as pa
import pytest

from sierra.deliverables.models.deviation import deviation, points

DATA = [1.0, 2.0, 3.0, 4.0, 5.0]
MODEL = [0.98, 1.91, 3.4, 3.9, 5.5]
NAN = math.nan


def data(times: list[float], values: list[float | None]) -> pa.Table:
    ends = {"low": [v and v - 0.3 for v in values], "high": [v and v + 0.3 for v in values]}
    return pa.table({"experiment": [0] * len(times), "t": times, "n": [9] * len(times), "mean": values, **ends})


def model(times: list[float], values: list[float]) -> pa.Table:
    return pa.table({"experiment": [0] * len(times), "t": times, "value": values})


def test_errors_are_those_of_statsmodels() -> None:
    times = [0.0, 1.0, 2.0, 3.0, 4.0]
    found = deviation(points(model(times, MODEL), data(times, [*DATA]), "mean", ("low", "high")))
    assert found is not None
    # statsmodels 0.15.0, statsmodels.tools.eval_measures: rmse(MODEL, DATA), bias(MODEL, DATA), maxabs(MODEL, DATA)
    assert (found.rmse, found.bias, found.largest) == pytest.approx((0.2927456233660889, 0.138, 0.5), rel=1e-12)
    assert (found.compared, found.at, found.inside, found.intervals) == (5, 4.0, 3, 5)


def test_only_points_in_common_are_compared_and_times_may_differ_by_rounding() -> None:
    times = [0.1, 0.2, 0.1 + 0.2, 0.4, 0.5]
    found = points(model([0.1, 0.15, 0.3, 0.4, 9.0], MODEL), data(times, [1.0, 2.0, 3.0, None, 5.0]), "mean", None)
    assert found.time.tolist() == [0.1, 0.1 + 0.2]
    assert found.predicted.tolist() == [0.98, 3.4]
    assert deviation(points(model([7.0], [1.0]), data(times, [*DATA]), "mean", None)) is None


def test_huge_values_do_not_overflow() -> None:
    found = deviation(points(model([0.0, 1.0], [3e200, 4e200]), data([0.0, 1.0], [0.0, 0.0]), "mean", None))
    assert found is not None
    assert found.rmse == pytest.approx(5e200 / math.sqrt(2))
