"""Statistics in SQL equal those of numpy and scipy, and missing values are never silently averaged."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

import sierra
from sierra.config.deliverable_tables import Figure
from sierra.deliverables.figures.base import Request, kind_of
from sierra.errors import SierraError, UsageError
from sierra.model import Axis
from sierra.stats import aggregate as stats
from sierra.stats import student_t
from sierra.stats.selection import Selection
from tests import random_times
from tests.samples import Memory, samples

AXIS = (Axis("size", (1, 2)),)
NUMBERS = st.floats(min_value=-1e6, max_value=1e6, allow_nan=False).map(lambda x: round(x, 6))


def compute(figure: Figure, frames: dict[str, Any], **more: Any) -> stats.Computed:
    """Compute what a figure over one variable needs."""
    seen = stats.coverage(next(iter(frames.values())))
    needs = kind_of(figure).needs(Request(figure, AXIS, len(seen.runs), seen.most))
    return stats.compute(figure, frames, needs, **more)


def over_runs(values: Iterable[float | None], *, rate: bool = False) -> dict[str, Any]:
    """Return all statistics of one experiment whose runs ended with these values."""
    frame = Memory((0, number, 0.0, value) for number, value in enumerate(values))
    table, _ = samples(frame, rate=rate).by_experiment("final", stats.STATISTICS)
    found: list[dict[str, Any]] = table.to_pylist()
    return found[0]


def figure(kind: str = "timeseries", **more: Any) -> Figure:
    return Figure.model_validate({"kind": kind, "column": "energy", **more})


def trimmed_interval(x: np.ndarray[Any, Any]) -> tuple[float, float]:
    """Compute the interval of Tukey and McLaughlin independently."""
    n, g = len(x), len(x) // 4
    h = n - 2 * g
    winsorized = np.clip(np.sort(x), np.sort(x)[g], np.sort(x)[n - g - 1])
    half = scipy.stats.t.ppf(0.975, h - 1) * math.sqrt(((winsorized - winsorized.mean()) ** 2).sum() / (h * (h - 1)))
    center = float(scipy.stats.trim_mean(x, 0.25))
    return center - half, center + half


@pytest.mark.integration
@settings(max_examples=25, deadline=None)
@given(st.lists(NUMBERS, min_size=2, max_size=40))
def test_all_statistics_equal_those_of_numpy_and_scipy(values: list[float]) -> None:
    x, found = np.array(values), over_runs(values)
    near = pytest.approx
    scale = 1e-12 * max(1.0, float(np.abs(x).max()))
    half = scipy.stats.t.ppf(0.975, len(x) - 1) * x.std(ddof=1) / math.sqrt(len(x))
    q1, median, q3 = np.quantile(x, [0.25, 0.5, 0.75])
    assert found["n"] == len(x)
    assert found["mean"] == near(x.mean(), rel=1e-12, abs=scale)
    assert found["sd"] == near(x.std(ddof=1), rel=1e-11, abs=scale)
    assert (found["low"], found["high"]) == near((x.mean() - half, x.mean() + half), rel=1e-11, abs=20 * scale)
    assert (found["q1"], found["median"], found["q3"]) == near((q1, median, q3), rel=1e-12, abs=scale)
    assert (found["min"], found["max"]) == (x.min(), x.max())
    assert found["iqm"] == near(scipy.stats.trim_mean(x, 0.25), rel=1e-12, abs=scale)
    assert (found["iqm_low"], found["iqm_high"]) == near(trimmed_interval(x), rel=1e-11, abs=30 * scale)


SCALES = st.sampled_from([-1020, -1000, -700, 0, 700, 1000])


@pytest.mark.integration
@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(-1000, 1000), min_size=2, max_size=20), SCALES)
def test_statistics_keep_full_precision_at_any_magnitude(values: list[int], power: int) -> None:
    """Scaling by a power of two is exact: numpy's results for small numbers are valid for huge and tiny ones."""
    x, scale = np.array(values, float), 2.0**power
    found = over_runs((x * scale).tolist())
    half = scipy.stats.t.ppf(0.975, len(x) - 1) * x.std(ddof=1) / math.sqrt(len(x))
    expected = {
        "mean": x.mean(),
        "sd": x.std(ddof=1),
        "low": x.mean() - half,
        "high": x.mean() + half,
        "median": np.median(x),
        "q1": np.quantile(x, 0.25),
        "q3": np.quantile(x, 0.75),
        "iqm": scipy.stats.trim_mean(x, 0.25),
    }
    for name, value in expected.items():
        assert found[name] / scale == pytest.approx(value, rel=1e-12, abs=1e-10), name


@pytest.mark.integration
@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 2**20), min_size=2, max_size=20), st.sampled_from([1e6, 1e9, 1e12]))
def test_the_standard_deviation_keeps_full_precision_next_to_a_large_mean(values: list[int], offset: float) -> None:
    exact = np.array([value / 2**12 for value in values])  # exact: adding the offset does not change them
    found = over_runs((exact + offset).tolist())
    assert found["sd"] == pytest.approx(exact.std(ddof=1), rel=1e-13)
    assert found["mean"] - offset == pytest.approx(exact.mean(), abs=1e-15 * offset)


HOSTILE: Mapping[str, list[float]] = {
    "the largest doubles": [1e308, 1.5e308, 1.7e308, -1.6e308],
    "denormals": [5e-324, 1e-323, 4e-320, 0.0, 2e-322],
    "a large offset and a small spread": [1e15 + k / 8 for k in (0, 1, 3, 4, 9)],
    "neighbouring doubles": [1e15, math.nextafter(1e15, 2e15), 1e15],
    "decimals": [0.1, 0.2, 0.3, 0.7, 1e-9, 1e-17],
    "a mean near 0": [-1.0, 1.0, 1e-9, -1e-9 + 2e-16],
    "constant": [0.1] * 7,
    "one value apart": [0.1] * 999 + [1e9],
    "tiny": [1e-300, 3e-300, 2e-300],
    "many magnitudes": [1e-300, 1e-9, 3.0, 1e9, 1e300],
}
"""Values that cost digits, each a group of its own; the tiny ones are beside huge ones in one column."""


def test_the_mean_and_sd_of_hostile_values_equal_exact_fractions() -> None:
    rows = [(e, run, 0.0, v) for e, values in enumerate(HOSTILE.values()) for run, v in enumerate(values)]
    table, _ = samples(Memory(rows)).by_time(["mean", "sd"])
    for found, (name, values) in zip(table.to_pylist(), HOSTILE.items(), strict=True):
        x = [Fraction(value) for value in values]
        mean = sum(x) / len(x)
        last_digits = (max(x) - min(x)) / 2**51 + Fraction(math.ulp(float(mean)))
        assert abs(Fraction(found["mean"]) - mean) <= last_digits, name
        unit = max(x) - min(x) or Fraction(1)
        variance = sum(((value - mean) / unit) ** 2 for value in x) / (len(x) - 1)
        sd = Fraction(math.sqrt(variance)) * unit
        assert abs(Fraction(found["sd"]) - sd) <= sd * Fraction(1, 10**14) + Fraction(5e-324), name


def test_the_mean_and_sd_do_not_depend_on_the_statistics_beside_them() -> None:
    rng = np.random.default_rng(3)
    rows = [(e, run, float(t), v) for e in range(3) for run in range(20) for t, v in enumerate(rng.lognormal(0, 9, 5).tolist())]
    frame = samples(Memory(rows))
    few, text = frame.by_time(["interval"])
    every, _ = frame.by_time(stats.STATISTICS)
    assert "list(" not in text
    assert few.equals(every.select(few.column_names))
    assert few.equals(samples(Memory(reversed(rows), threads=4)).by_time(["interval"])[0])


def test_the_place_of_a_negative_zero_has_no_effect() -> None:
    for values in ([0.0, -0.0], [-0.0, 0.0], [-0.0, -0.0]):
        table, _ = samples(Memory((0, k, 0.0, v) for k, v in enumerate(values))).by_time(["interval", "range"])
        assert [math.copysign(1, table[name][0].as_py()) for name in ("mean", "sd", "min", "max")] == [1] * 4


def test_a_mean_of_huge_values_does_not_overflow() -> None:
    found = over_runs([1e308, 1.5e308, 1.7e308, 1.6e308])
    assert found["mean"] == pytest.approx(1.45e308, rel=1e-12)
    assert (found["median"], found["iqm"]) == pytest.approx((1.55e308, 1.55e308), rel=1e-12)
    assert found["sd"] == pytest.approx(np.std([1.0, 1.5, 1.7, 1.6], ddof=1) * 1e308, rel=1e-12)
    assert measured("mean", [1e308, 1.5e308, 1.7e308])["mean"] == pytest.approx(1.4e308, rel=1e-12)
    assert over_runs([-1.7e308, -1.7e308, 1.7e308, 1.7e308])["q1"] == -1.7e308


def test_one_huge_value_does_not_change_the_median_and_the_iqm() -> None:
    found = over_runs([1e-200, 2e-200, 3e-200, 4e-200, 1e300])
    assert (found["median"], found["iqm"]) == pytest.approx((3e-200, 3e-200), rel=1e-12)


@pytest.mark.integration
@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(2, 12))
@settings(max_examples=25, deadline=None)
def test_equal_values_have_that_value_as_mean_and_bounds(value: float, n: int) -> None:
    found = over_runs([value] * n)
    assert [found[name] for name in ("mean", "median", "q1", "q3", "iqm", "low", "high")] == [value] * 7
    assert found["sd"] == 0


@pytest.mark.parametrize(("good", "n"), [(0, 5), (5, 5), (1, 5), (3, 10), (100, 100), (1, 1000)])
def test_the_interval_of_a_rate_equals_scipys_wilson_interval(good: int, n: int) -> None:
    found = over_runs([1.0] * good + [0.0] * (n - good), rate=True)
    interval = scipy.stats.binomtest(good, n).proportion_ci(0.95, method="wilson")
    assert (found["low"], found["high"]) == pytest.approx((interval.low, interval.high), rel=1e-12, abs=1e-15)
    assert 0 <= found["low"] <= found["mean"] <= found["high"] <= 1
    assert 0 <= found["iqm_low"] <= found["iqm_high"] <= 1
    assert found["interval"] == "Wilson"


@pytest.mark.parametrize("values", [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.5, 1.0]])
def test_numbers_that_nobody_calls_a_rate_have_the_interval_of_a_mean(values: list[float]) -> None:
    assert over_runs(values)["interval"] == "t"


def test_a_rate_has_only_zeros_and_ones_and_an_interval_from_two_runs_on() -> None:
    assert over_runs([0.0, 2.0], rate=True)["interval"] == "t"
    assert (over_runs([1.0], rate=True)["low"], over_runs([1.0], rate=True)["interval"]) == (None, None)


def test_the_mean_of_several_flags_of_a_run_is_no_rate_over_runs() -> None:
    """If no run ever succeeds, Wilson's interval would treat each run as one trial."""
    frame = Memory((0, run, float(t), 0.0) for run in range(5) for t in range(3))
    assert samples(frame, rate=True).by_experiment("mean", ["interval"])[0]["interval"].to_pylist() == ["t"]
    assert samples(frame, rate=True).by_experiment("final", ["interval"])[0]["interval"].to_pylist() == ["Wilson"]


@pytest.mark.parametrize(
    ("values", "doubtful"),
    [
        ([0.0, 1.0, 1.0], True),
        ([0.0, 1.0, 0.5], False),
        ([0.0, 0.0], False),
        ([1.0, 1.0], False),
        ([0.0, 1.0, 2.0], False),
        ([0.0, 0.1, 0.9, 1.0], False),
    ],
)
def test_numbers_that_may_be_a_rate_are_noticed(values: list[float], doubtful: bool) -> None:
    frame = Memory((0, number, 0.0, value) for number, value in enumerate(values))
    assert stats.may_be_rate(frame, "final") is doubtful


def test_a_rate_is_a_rate_in_all_experiments_and_at_all_times() -> None:
    frame = Memory((e, run, float(t), float(e == 1 and run > t)) for e in range(2) for run in range(5) for t in range(3))
    for table in (
        samples(frame, rate=True).by_time(["interval"])[0],
        samples(frame, rate=True).by_experiment("final", ["interval"])[0],
    ):
        assert set(table["interval"].to_pylist()) == {"Wilson"}
        assert table["high"].to_pylist()[0] == pytest.approx(0.434482, abs=1e-6)
    late, _ = samples(frame, rate=True).by_experiment("time_to", ["interval"], 1.0)
    assert "Wilson" not in late["interval"].to_pylist()
    note = compute(figure(), {"energy": frame}, rates=["energy"]).note
    assert note.startswith("mean, Wilson's 95 % CI of a rate, n = 5")


@pytest.mark.nightly
@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(-1000, 1000), min_size=1, max_size=40))
def test_whiskers_end_at_values_that_were_observed(values: list[int]) -> None:
    found = over_runs(map(float, values))
    q1, q3 = np.quantile(values, [0.25, 0.75])
    inside = [v for v in values if q1 - 1.5 * (q3 - q1) <= v <= q3 + 1.5 * (q3 - q1)]
    assert (found["whisker_low"], found["whisker_high"]) == (min(inside), max(inside))


@pytest.mark.parametrize(("far", "end"), [(13.4, 13.4), (13.6, 8.0)])
def test_a_whisker_reaches_at_most_one_and_a_half_interquartile_ranges(far: float, end: float) -> None:
    """The quartiles are 2.25 and 6.75, so the limit of the whisker is 13.5."""
    values = [*map(float, range(9)), far]
    assert over_runs(values)["whisker_high"] == end
    assert over_runs([-value for value in values])["whisker_low"] == -end


def test_the_interval_of_four_runs_equals_scipys_t_interval() -> None:
    found = over_runs([1.0, 2.0, 4.0, 4.6])
    interval = scipy.stats.ttest_1samp([1.0, 2.0, 4.0, 4.6], 0).confidence_interval(0.95)
    assert (found["low"], found["high"]) == pytest.approx((interval.low, interval.high), rel=1e-12)


def test_one_run_has_a_mean_but_no_interval() -> None:
    found = over_runs([3.0])
    assert (found["n"], found["mean"], found["median"], found["q1"], found["iqm"]) == (1, 3.0, 3.0, 3.0, 3.0)
    assert [found[name] for name in ("sd", "low", "high", "iqm_low", "iqm_high")] == [None] * 5


def test_missing_and_infinite_values_are_left_out_and_counted() -> None:
    found = over_runs([1.0, None, math.nan, math.inf, -math.inf, 3.0])
    assert (found["n"], found["missing"], found["infinite"], found["mean"]) == (2, 2, 2, 2.0)


def test_an_experiment_with_only_missing_values_has_no_mean() -> None:
    found = over_runs([None, math.nan])
    assert (found["n"], found["missing"], found["mean"], found["median"], found["low"]) == (0, 2, None, None, None)


def test_n_is_counted_at_each_time() -> None:
    frame = Memory((0, run, float(t), float(run)) for run in range(5) for t in range(3 if run else 2))
    table, _ = samples(frame).by_time(["interval"])
    assert table["n"].to_pylist() == [5, 5, 4]
    assert table["mean"].to_pylist() == [2.0, 2.0, 2.5]


@pytest.mark.integration
def test_results_are_bit_identical_for_any_row_order_and_number_of_threads() -> None:
    rng = np.random.default_rng(1)
    keys = [(e, run, float(t)) for e in range(10) for run in range(20) for t in range(100)]
    values = rng.normal(size=len(keys)) * 10.0 ** rng.integers(-8, 17, len(keys))
    rows = [(*key, value) for key, value in zip(keys, values.tolist(), strict=True)]
    rng.shuffle(mixed := list(range(len(rows))))
    one, many = Memory(rows, threads=1), Memory((rows[k] for k in mixed), threads=4)
    plain = "SELECT experiment, t, avg(value) AS mean FROM samples GROUP BY ALL ORDER BY ALL"
    assert not one.sql(plain).equals(many.sql(plain)), "the order of these values must matter for a plain mean"
    chosen = Selection.of(["mean", "sd", "iqm", "q90", "mad"], {})
    for measure in ("mean", "final"):
        for wanted in (stats.STATISTICS, chosen):
            found = [samples(frame).by_experiment(measure, wanted)[0] for frame in (one, many)]
            assert found[0].equals(found[1])
    assert samples(one).by_time(stats.STATISTICS)[0].equals(samples(many).by_time(stats.STATISTICS)[0])


STEPS = [(0.0, 0.0), (1.0, 0.0), (2.0, 10.0), (100.0, 10.0)]


def of_rows(measure: str, rows: list[tuple[float, float | None]], *, steps: bool = False) -> dict[str, Any]:
    """Return the statistics of one run with these times and values."""
    frame = Memory((0, 0, t, value) for t, value in rows)
    table, _ = samples(frame).by_experiment(measure, ["mean"], steps=steps)
    found: dict[str, Any] = table.to_pylist()[0]
    return found


def test_the_mean_over_time_weights_each_value_by_its_time() -> None:
    assert of_rows("mean", STEPS)["mean"] == 5
    assert of_rows("time_mean", STEPS)["mean"] == pytest.approx(9.85, rel=1e-15)
    assert of_rows("time_mean", STEPS, steps=True)["mean"] == pytest.approx(9.8, rel=1e-15)
    assert of_rows("time_mean", STEPS[:1])["mean"] == 0
    assert of_rows("time_mean", list(reversed(STEPS)))["mean"] == pytest.approx(9.85, rel=1e-15)
    gap = of_rows("time_mean", [(0, 1.0), (1, None), (2, 3.0), (3, math.inf)])
    assert (gap["mean"], gap["missing"], gap["infinite"]) == (2, 1, 1)
    assert of_rows("time_mean", [(0, math.nan)])["mean"] is None


test_the_mean_over_time_is_that_of_numpy = random_times.INTEGRAL.tests()


@pytest.mark.parametrize(("times", "uneven"), [((0, 1, 2, 3), False), ((0, 1, 2, 3.02), True), ((0, 0.1, 0.2, 0.3), False)])
def test_the_mean_of_rows_with_uneven_steps_is_noted(times: tuple[float, ...], uneven: bool) -> None:
    frame = Memory((0, run, float(t), 1.0) for run in range(3) for t in times)
    note = compute(figure("summary", measure="mean"), {"energy": frame}).note
    assert ("in 3 runs, and mean is the mean of the rows: time_mean is the mean over time" in note) == uneven
    assert "time_mean" not in compute(figure("summary"), {"energy": frame}).note


def test_runs_that_end_at_different_times_are_noted_where_their_last_values_are_shown() -> None:
    frame = Memory((0, run, float(t), 1.0) for run in range(3) for t in range(4 + 2 * run))
    note = "runs of an experiment end at different times, from 3 to 7: final has each at its own end"
    assert note in compute(figure("summary"), {"energy": frame}).note
    assert note in compute(figure("box"), {"energy": frame}).note
    assert "own end" not in compute(figure("summary", measure="mean"), {"energy": frame}).note
    alone = Memory((0, run, float(run), 1.0) for run in range(3))
    assert "own end" not in compute(figure("summary"), {"energy": alone}).note
    swept = Memory((e, run, float(t), 1.0) for e in range(2) for run in range(3) for t in range(4 + e))
    assert "own end" not in compute(figure("summary"), {"energy": swept}).note


def measured(measure: str, values: list[float | None], threshold: float | None = None) -> dict[str, Any]:
    frame = Memory((0, 0, float(t), value) for t, value in enumerate(values))
    table, _ = samples(frame).by_experiment(measure, ["mean"], threshold)
    found: list[dict[str, Any]] = table.to_pylist()
    return found[0]


def test_the_final_value_is_the_one_at_the_largest_time() -> None:
    frame = Memory([(0, 0, 2.0, 7.0), (0, 0, 0.0, 1.0), (0, 0, 1.0, 9.0)])
    assert stats.reduced(frame, "final")["value"].to_pylist() == [7.0]


def test_a_missing_final_value_is_not_replaced_by_an_earlier_one() -> None:
    assert measured("final", [1.0, 2.0, math.nan])["mean"] is None
    assert measured("final", [1.0, 2.0, None])["missing"] == 1


def test_the_mean_over_time_counts_the_values_that_it_leaves_out() -> None:
    found = measured("mean", [1.0, None, 3.0, math.nan, math.inf])
    assert (found["mean"], found["missing"], found["infinite"]) == (2.0, 2, 1)


def test_the_time_to_a_threshold_is_the_first_time_at_which_it_is_reached() -> None:
    assert measured("time_to", [0.0, 1.0, 5.0, 2.0, 7.0], 5.0)["mean"] == 2.0


@pytest.mark.parametrize("gap", [None, math.nan])
def test_a_missing_value_reaches_no_threshold(gap: float | None) -> None:
    assert measured("time_to", [0.0, gap, 5.0], 5.0)["mean"] == 2.0


def test_runs_that_never_reach_a_threshold_are_counted_and_not_averaged() -> None:
    frame = Memory((0, run, float(t), float(t * run)) for run in range(4) for t in range(10))
    found = samples(frame).by_experiment("time_to", ["mean"], 9.0)[0].to_pylist()[0]
    assert (found["n"], found["never"], found["missing"]) == (3, 1, 0)
    assert found["mean"] == pytest.approx((9 + 5 + 3) / 3, rel=1e-12)


def test_a_run_with_only_missing_values_is_counted_as_missing() -> None:
    found = measured("time_to", [None, math.nan], 1.0)
    assert (found["n"], found["never"], found["missing"]) == (0, 0, 2)


RAGGED = [(0, 0, 0.0, 0.0), (0, 0, 2.0, 4.0), (0, 0, 4.0, 0.0), (0, 1, 1.0, 10.0), (0, 1, 2.5, 13.0)]


@pytest.mark.parametrize(
    ("linear", "first", "second"),
    [
        (False, [0.0, 0.0, 4.0, 4.0, 0.0], [None, 10.0, 10.0, None, None]),
        (True, [0.0, 2.0, 4.0, 2.0, 0.0], [None, 10.0, 12.0, None, None]),
    ],
)
def test_runs_are_resampled_to_common_times_and_never_extrapolated(
    linear: bool, first: list[float], second: list[float | None]
) -> None:
    for run, expected in ((0, first), (1, second)):
        frame = Memory(row for row in RAGGED if row[1] == run)
        grid = [0.0, 1.0, 2.0, 3.0, 4.0]
        table, _ = samples(frame).resampled(grid, ["mean"], linear=linear)
        found = dict(zip(table["t"].to_pylist(), table["mean"].to_pylist(), strict=True))
        assert [found.get(t) for t in grid] == expected


def test_resampling_does_not_fill_missing_values() -> None:
    frame = Memory([(0, 0, 0.0, 1.0), (0, 0, 1.0, None), (0, 0, 2.0, 3.0)])
    for linear in (False, True):
        table, _ = samples(frame).resampled([0.0, 1.5, 2.0], ["mean"], linear=linear)
        assert table["mean"].to_pylist() == [1.0, None, 3.0]
        assert table["missing"].to_pylist() == [0, 1, 0]


@pytest.mark.integration
@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 1000), NUMBERS), min_size=2, max_size=20, unique_by=lambda p: p[0]), st.data())
def test_linear_interpolation_equals_that_of_numpy(points: list[tuple[int, float]], data: st.DataObject) -> None:
    points.sort()
    t, v = np.array(points, dtype=float).T
    grid = sorted(data.draw(st.sets(st.floats(t[0], t[-1]), min_size=1, max_size=10)))
    frame = Memory((0, 0, a, b) for a, b in zip(t.tolist(), v.tolist(), strict=True))
    table, _ = samples(frame).resampled(grid, ["mean"], linear=True)
    assert table["mean"].to_pylist() == pytest.approx(np.interp(grid, t, v).tolist(), rel=1e-9, abs=1e-6)


def test_a_figure_of_runs_with_different_times_notes_the_resampling() -> None:
    frame = Memory((0, run, t + run / 10, float(t)) for run in range(8) for t in range(20))
    computed = compute(figure(), {"energy": frame})
    assert "times differ: last values carried forward to 20 common times" in computed.note
    assert max(computed.tables["energy"]["n"].to_pylist()) == 8


def interpolated(points: list[tuple[float, float | None]], grid: list[float]) -> list[float]:
    """Interpolate with numpy; NaN next to missing values, and outside the first and the last time."""
    t, v = np.array(points, dtype=float).T
    return np.interp(grid, t, v, left=np.nan, right=np.nan).tolist()


@pytest.mark.integration
@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 1000), st.one_of(NUMBERS, st.none(), st.just(math.nan))),
        min_size=2, max_size=20, unique_by=lambda p: p[0],
    ),
    st.sets(st.one_of(st.floats(-10, 1010), st.integers(0, 1000).map(float)), min_size=1, max_size=20),
)  # fmt: skip
def test_linear_interpolation_skips_missing_values_and_never_extrapolates(
    points: list[tuple[int, float | None]], times: set[float]
) -> None:
    rows, grid = sorted((float(t), v) for t, v in points), sorted(times)
    frame = Memory((0, 0, t, v) for t, v in rows)
    table, _ = samples(frame).resampled(grid, ["mean"], linear=True)
    found = dict(zip(table["t"].to_pylist(), table["mean"].to_pylist(), strict=True))
    expected = {t: v for t, v in zip(grid, interpolated(rows, grid), strict=True) if not math.isnan(v)}
    assert {t for t, v in found.items() if v is not None} == set(expected)
    assert [found[t] for t in expected] == pytest.approx(list(expected.values()), rel=1e-9, abs=1e-6)
    inside = [t for t in grid if rows[0][0] <= t <= rows[-1][0]]
    assert sum(table["missing"].to_pylist()) == len(inside) - len(expected)


SHIFTED = [(0, run, t + run / 10, float(t)) for run in range(8) for t in range(20)]


def test_a_figure_interpolates_linearly_on_request_and_notes_it() -> None:
    computed = compute(figure(times="linear"), {"energy": Memory(SHIFTED)})
    assert "; interpolated linearly to 20 common times" in computed.note
    assert "-- $linear: True" in computed.sql
    grid = np.linspace(0.0, 19.7, 20).tolist()
    runs = [interpolated([(t, v) for _, n, t, v in SHIFTED if n == run], grid) for run in range(8)]
    table = computed.tables["energy"]
    assert table["t"].to_pylist() == pytest.approx(grid)
    assert table["mean"].to_pylist() == pytest.approx(np.nanmean(runs, axis=0).tolist(), rel=1e-12)
    assert table["n"].to_pylist() == np.isfinite(runs).sum(axis=0).tolist()


def test_a_figure_uses_the_runs_own_times_on_request_and_notes_that_they_differ() -> None:
    computed = compute(figure(times="own"), {"energy": Memory(SHIFTED)})
    assert computed.tables["energy"].num_rows == 160
    assert computed.note == "mean, no interval, n = 1; times differ: each run has its own times"


@pytest.mark.parametrize("times", ["carry", "linear"])
def test_times_that_all_runs_share_become_common_times_despite_rounding(times: str) -> None:
    """A simulator adds 0.1 repeatedly: a grid just before its times would show the preceding row's value."""
    clock = np.cumsum(np.full(100, 0.1)).tolist()
    frame = Memory((0, run, clock[t], float(t * run)) for run in range(3) for t in range(100))
    table, _, said = samples(frame).at_times(times, ["interval"])
    assert table["mean"].to_pylist() == pytest.approx([float(t) for t in range(100)], abs=1e-9)
    assert said == [f"{'interpolated linearly' if times == 'linear' else 'last values carried forward'} to 100 common times"]


@pytest.mark.parametrize("times", ["own", "carry", "linear", None])
def test_runs_with_one_time_are_counted_once_each(times: str | None) -> None:
    frame = Memory((0, run, 7.0, float(run)) for run in range(5))
    table, _, _ = samples(frame).at_times(times, ["interval"])
    assert (table["t"].to_pylist(), table["n"].to_pylist(), table["mean"].to_pylist()) == ([7.0], [5], [2.0])


def test_unknown_times_are_refused() -> None:
    frame = Memory(SHIFTED)
    with pytest.raises(UsageError, match="unknown times 'cubic'; known are own, carry, linear"):
        samples(frame).at_times("cubic", ["mean"])


def test_a_run_that_ended_early_does_not_cause_resampling() -> None:
    frame = Memory((0, run, float(t), 1.0) for run in range(8) for t in range(20 if run else 5))
    computed = compute(figure(), {"energy": frame})
    note = "mean, 95 % CI (Student's t), n = 7–8; 15 of 20 times have fewer runs than others, from 5 on"
    assert computed.note == note


def test_times_with_fewer_runs_are_noted_with_two_runs_too() -> None:
    frame = Memory((0, run, float(t), 1.0) for run in range(2) for t in range(4 if run else 3))
    assert compute(figure(), {"energy": frame}).note.endswith("1 of 4 times has fewer runs than others, from 3 on")
    missing = Memory((0, run, float(t), None if t and run else 1.0) for run in range(2) for t in range(4))
    assert "fewer runs" not in compute(figure(), {"energy": missing}).note


def test_the_note_reports_absent_runs_and_left_out_values() -> None:
    frame = Memory([(0, 0, 0.0, 1.0), (0, 1, 0.0, None), (0, 2, 0.0, math.inf), (0, 3, math.nan, 5.0), (1, 0, 0.0, 2.0)])
    note = compute(figure("summary"), {"energy": frame}, planned={0: 5, 1: 4}).note
    assert note == (
        "mean, no interval, n = 1; 4 of 9 runs missing; 1 missing value left out; 1 infinite value left out;"
        " 1 row without a time left out"
    )


def test_several_rows_of_a_run_at_one_time_are_refused() -> None:
    frame = Memory((0, run, float(t), 1.0) for run in range(3) for t in range(5) for _ in range(2))
    with pytest.raises(UsageError, match="3 runs with more than one row at the same time"):
        stats.coverage(frame)


@pytest.mark.parametrize("order", ["t, number", "t DESC", "number, t DESC", "random()"])
def test_the_order_of_rows_has_no_effect_on_whether_times_are_doubled(order: str) -> None:
    rows = [(e, run, float(t), 1.0) for e in range(2) for run in range(3) for t in range(5)]
    for more, doubled in (
        ([], False),
        ([(1, 2, 0.0, 2.0)], True),
        ([(0, 1, 3.0, 2.0)], True),
        ([(0, 1, math.nan, 2.0)], False),
    ):
        frame = Memory([*rows, *more])
        frame.connection.execute(f"CREATE OR REPLACE TABLE samples AS SELECT * FROM samples ORDER BY {order}")
        if doubled:
            with pytest.raises(UsageError, match="1 run with more than one row at the same time"):
                stats.coverage(frame)
        else:
            assert (stats.coverage(frame).rows, stats.coverage(frame).untimed) == (30 + len(more), len(more))


def test_a_frame_without_values_is_an_error() -> None:
    with pytest.raises(SierraError, match="no run has written any row"):
        compute(figure(), {"energy": Memory([])})
    with pytest.raises(SierraError, match="no finite value in energy"):
        compute(figure(), {"energy": Memory([(0, 0, 0.0, None)])})


def test_the_error_for_an_unreached_threshold_names_it_and_the_number_of_runs() -> None:
    rows = [(e, run, float(t), float(t)) for e in range(2) for run in range(6) for t in range(5)]
    asked = figure("summary", measure="time_to", threshold=5.5)
    with pytest.raises(SierraError, match=r"^energy reaches the threshold 5.5 in none of 12 runs; there is no time to draw$"):
        compute(asked, {"energy": Memory(rows)})
    with pytest.raises(SierraError, match=r"in none of 13 runs, 1 without any value of it; there is"):
        compute(asked, {"energy": Memory([*rows, (1, 6, 0.0, None)])})


@pytest.mark.parametrize(
    ("kind", "mark"),
    [("summary", " (hollow: not in all runs, △: in none)"), ("box", " (△: in none)"), ("violin", " (△: in none)")],
)
def test_the_note_reports_how_often_a_threshold_was_not_reached(kind: str, mark: str) -> None:
    frame = Memory((e, run, float(t), float(t + run * e)) for e in range(2) for run in range(4) for t in range(5))
    note = compute(figure(kind, measure="time_to", threshold=6), {"energy": frame}).note
    assert note.endswith(f"; threshold 6 never reached in 6 of 8 runs{mark}")


def test_a_heatmap_of_one_variable_is_refused() -> None:
    with pytest.raises(UsageError, match="two independent variables, but this batch has 1"):
        compute(figure("heatmap"), {"energy": Memory([(0, 0, 0.0, 1.0)])})


@pytest.mark.parametrize("kind", ["timeseries", "summary", "box", "violin", "stacked"])
@pytest.mark.parametrize("center", ["mean", "median", "iqm"])
def test_each_kind_of_figure_gets_its_tables(kind: str, center: str) -> None:
    frame = Memory((e, run, float(t), float(t + run)) for e in range(2) for run in range(6) for t in range(4))
    chosen = {} if kind in ("box", "violin") else {"center": center}
    computed = compute(figure(kind, **chosen), {"energy": frame})
    assert computed.tables["energy"].num_rows == (8 if kind in ("timeseries", "stacked") else 2)
    assert (computed.runs is not None) == (kind in ("box", "violin"))
    assert "FROM samples" in computed.sql


def test_every_sql_file_is_used_and_begins_with_a_comment() -> None:
    files = sorted(path.relative_to(stats.HERE).as_posix() for path in stats.HERE.rglob("*.sql"))
    known = {f"statistics/{name}.sql" for name in stats.STATISTICS} | {
        f"measures/{m}.sql" for m in ("final", "mean", "time_mean", "time_to")
    }
    assert set(files) == known | {
        "group_by_time.sql",
        "group_by_experiment.sql",
        "unit.sql",
        "sums.sql",
        "coverage.sql",
        "doubled.sql",
        "backward.sql",
        "uneven.sql",
        "resample.sql",
        "censored_times.sql",
        "values_of_runs.sql",
    }
    for path in stats.HERE.rglob("*.sql"):
        text = path.read_text(encoding="utf-8")
        assert text.startswith("-- ")
        assert path.stem.startswith(("by_", "coverage")) or re.match(r"-- .*([=:∓]|the)", text)


def test_statements_pass_their_values_as_parameters() -> None:
    frame = Memory((0, run, 0.0, float(run)) for run in range(3))
    _, text = samples(frame).by_experiment("time_to", ["interval"], 1.5)
    assert "-- $threshold: 1.5\n" in text
    assert "1.5" not in re.sub(r"--[^\n]*", "", text)


@pytest.mark.integration
@settings(max_examples=300, deadline=None)
@given(
    st.one_of(st.floats(1e-12, 0.4), st.floats(0.6, 1 - 1e-9)),
    st.one_of(st.integers(1, 100), st.integers(1, 10**6), st.floats(1, 1e6)),
)
def test_student_quantiles_equal_those_of_scipy(p: float, df: float) -> None:
    expected = scipy.stats.t.ppf(p, df) if p < 0.5 else scipy.stats.t.isf(1 - p, df)
    assert student_t.quantile(p, df) == pytest.approx(expected, rel=1e-10)


def test_student_quantiles_equal_those_of_printed_tables() -> None:
    printed = {1: 12.706, 2: 4.303, 4: 2.776, 9: 2.262, 29: 2.045, 120: 1.980}
    assert {df: round(student_t.quantile(0.975, df), 3) for df in printed} == printed


@given(st.floats(0.4, 0.6), st.integers(1, 10**6))
def test_student_quantiles_near_the_median_are_accurate(p: float, df: int) -> None:
    assert student_t.quantile(p, df) == pytest.approx(scipy.stats.t.ppf(p, df), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("p", "df"), [(0.0, 1), (1.0, 1), (math.nan, 1), (0.5, 0), (0.9, math.nan)])
def test_invalid_arguments_of_student_quantiles_are_refused(p: float, df: float) -> None:
    with pytest.raises(ValueError, match="no Student-t quantile"):
        student_t.quantile(p, df)


RUNS = r"""
size=$(sed 's/.* size="\([0-9]*\)".*/\1/' "$1")
echo t,v > swarm.csv
for t in 0 1 2 3; do echo "$t.$size,$((t * size))" >> swarm.csv; done
"""


@pytest.fixture
def simulated(simulate: Callable[..., Any]) -> Any:
    project = simulate(RUNS)
    assert project.quick("run", "size=1,2,3", "--runs", "2", "--no-figures").returncode == 0
    return project


@pytest.mark.integration
def test_the_stats_command_prints_a_table_with_the_values_of_the_axes(simulated: Any) -> None:
    rows = json.loads(simulated.quick("stats", "swarm", "v", "--json").stdout)
    assert [(row["size"], row["n"], row["mean"], row["low"]) for row in rows] == [(1, 2, 3, 3), (2, 2, 6, 6), (3, 2, 9, 9)]
    first = simulated.quick("stats", "swarm", "v").stdout.splitlines()[0].split()
    assert first[:5] == ["experiment", "size", "missing", "infinite", "never"]
    assert simulated.quick("stats", "swarm", "v", "--format", "csv").stdout.startswith("experiment,size,")
    assert simulated.quick("stats", "swarm", "v", "-f", "parquet", "-o", "table.parquet").returncode == 0
    table = pq.read_table(simulated.folder / "table.parquet")
    assert table["size"].to_pylist() == [1, 2, 3]
    assert b"list_avg" in table.schema.metadata[b"sierra:sql"]


@pytest.mark.nightly
def test_the_stats_command_supports_all_measures_and_rows_per_time(simulated: Any) -> None:
    def ask(*options: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = json.loads(simulated.quick("stats", "swarm", "v", "--json", *options).stdout)
        return rows

    assert [row["mean"] for row in ask("--measure", "mean")] == [1.5, 3, 4.5]
    late = simulated.quick("stats", "swarm", "v", "--measure", "time_to", "--threshold", "4", "--json")
    assert [(row["n"], row["never"], row["mean"]) for row in json.loads(late.stdout)] == [
        (0, 2, None),
        (2, 0, 2.2),
        (2, 0, 2.3),
    ]
    assert "threshold 4 never reached in 2 of 6 runs" in late.stderr
    assert [(row["size"], row["t"], row["mean"]) for row in ask("--times", "own")][:2] == [(1, 0.1, 0), (1, 1.1, 1)]
    linear = simulated.quick("stats", "swarm", "v", "--times", "linear", "--json")
    assert "interpolated linearly to 4 common times" in linear.stderr
    times = [row["t"] for row in json.loads(linear.stdout) if row["size"] == 1]
    assert times == pytest.approx([0.1, 0.1 + 3.2 / 3, 0.1 + 6.4 / 3])


@pytest.mark.integration
def test_contradictory_options_of_the_stats_command_are_refused(simulated: Any) -> None:
    together, choose = "--measure time_to and --threshold X must be used together", "choose one of them"
    for words, complaint in {
        ("--measure", "time_to"): together,
        ("--threshold", "4"): together,
        ("--times", "own", "--measure", "mean"): choose,
        ("--times", "carry", "--measure", "time_to", "--threshold", "4"): choose,
        ("--statistic", "km_median"): "'km_median' is one of times until a threshold; it needs the measure time_to",
        ("--measure", "time_to", "--threshold", "nan"): "a threshold must be a finite number, not nan",
    }.items():
        asked = simulated.quick("stats", "swarm", "v", *words)
        assert (asked.returncode, asked.stdout) == (2, "")
        assert complaint in asked.stderr


@pytest.mark.nightly
def test_statistics_in_python_accept_times_and_contain_the_note(simulated: Any) -> None:
    project = sierra.open(simulated.folder)
    table = project.statistics(None, "swarm", "v", measure=None, times="carry")
    assert table.schema.metadata[b"sierra:note"].decode() == (
        "all runs of each experiment have the same data in all tables, although their seeds differ: they are not independent "
        "samples, so n and intervals mean nothing (does the program use its seed? if it needs none, set runs = 1); "
        "last values carried forward to 4 common times"
    )
    assert project.statistics(None, "swarm", "v", measure=None).num_rows == 12
    with pytest.raises(UsageError, match="times 'own' needs statistics at each time"):
        project.statistics(None, "swarm", "v", times="own")
    with pytest.raises(UsageError, match="'time_to' needs a threshold"):
        project.statistics(None, "swarm", "v", measure="time_to")


BOOLEANS = r"""
size=$(sed 's/.* size="\([0-9]*\)".*/\1/' "$1")
[ "$size" = 3 ] && good=true || good=false
printf 't,good,n\n1,false,0\n2,%s,0\n' $good > swarm.csv
"""


@pytest.mark.integration
def test_booleans_are_a_rate_with_wilsons_interval_and_this_is_reported(simulate: Callable[..., Any]) -> None:
    project = simulate(BOOLEANS)
    assert project.quick("run", "size=1,3", "--runs", "5", "--no-figures").returncode == 0
    said = project.quick("stats", "swarm", "good", "--json")
    found = [(row["mean"], round(row["low"], 4), round(row["high"], 4), row["interval"]) for row in json.loads(said.stdout)]
    assert found == [(0, 0, 0.4345, "Wilson"), (1, 0.5655, 1, "Wilson")]
    assert said.stderr.count("all values of good are 0 or 1: low and high are Wilson's 95 % interval of a rate") == 1
    assert {row["interval"] for row in json.loads(project.quick("stats", "swarm", "n", "--json").stdout)} == {"t"}
    batch = sierra.open(project.folder).batches[-1].batch
    assert project.quick("figures", batch, "swarm_good_summary").returncode == 0


COUNTS = r"""
size=$(sed 's/.* size="\([0-9]*\)".*/\1/' "$1")
printf 't,none,some\n1,0,%s\n' $((size > 1)) > swarm.csv
"""


@pytest.mark.nightly
def test_counts_that_are_0_or_1_get_wilsons_interval_only_if_they_are_declared(simulate: Callable[..., Any]) -> None:
    project = simulate(COUNTS)
    config = project.folder / "sierra.toml"
    declared = config.read_text() + '[outputs.swarm]\nfile = "swarm.csv"\n'
    config.write_text(declared)
    assert project.quick("run", "size=1,3", "--runs", "3", "--no-figures").returncode == 0

    def ask(column: str) -> tuple[set[str], str]:
        said = project.quick("stats", "swarm", column, "--json")
        return {row["interval"] for row in json.loads(said.stdout)}, said.stderr

    kind, note = ask("none")
    assert kind == {"t"}
    assert "rate" not in note
    kind, note = ask("some")
    assert kind == {"t"}
    key = 'set rates = ["some"] in [outputs.swarm]'
    for words in (["--statistic", "mean"], ["--format", "markdown"], ["--format", "latex"], ["--times", "own"]):
        told = project.quick("stats", "swarm", "some", *words)
        assert key in (told.stdout + told.stderr).replace("{[}", "[").replace("\\_", "_"), words
    assert key not in project.quick("stats", "swarm", "some", "--statistic", "median").stderr
    assert key in project.quick("compare", "--by", "size", "--column", "some", "--no-figure").stderr
    assert project.quick("figures").returncode == 0
    assert key in next(project.folder.glob("figures/*/swarm_some_summary.txt")).read_text()
    assert (
        "all values of some are 0 or 1, but it may be a count: low and high are Student's t interval"
        ' (for the interval of a rate, set rates = ["some"] in [outputs.swarm])\n'
    ) in note
    config.write_text(declared + 'rates = ["some"]\n')
    assert ask("some")[0] == {"Wilson"}
    assert "evaluated again" not in project.quick("run", "size=1,3", "--runs", "3", "--dry-run").stdout
    config.write_text(declared + 'rates = ["sone"]\n')
    wrong = project.quick("stats", "swarm", "some")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert "[outputs.swarm] rates: no column 'sone'; did you mean 'some'?" in wrong.stderr


@pytest.mark.nightly
def test_an_axis_named_like_a_statistic_keeps_its_name(simulate: Callable[..., Any]) -> None:
    project = simulate()
    config = project.folder / "sierra.toml"
    config.write_text(config.read_text().replace('size = "', 'n = "'))
    assert project.quick("run", "n=3,5", "--runs", "2", "--no-figures").returncode == 0
    rows = json.loads(project.quick("stats", "swarm", "v", "--json").stdout)
    assert [(row["n"], row["n_"]) for row in rows] == [(3, 2), (5, 2)]
