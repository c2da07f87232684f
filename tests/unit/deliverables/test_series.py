"""Long series are thinned without losing a peak, and each of many series can be told apart, also in grey."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from sierra.deliverables.figures import style, thinning
from sierra.deliverables.figures.drawing import noted, painted
from sierra.errors import SierraError, UsageError
from sierra.model import Axis
from sierra.testing.figures import Row, Trial
from tests.tiers import of_extension
from tests.unit.deliverables.test_figures import SIZES, drawing, plot_of, said, table

LONG = 30_000


def peaks() -> Mapping[str, pa.Table]:
    """Return a long line at 5 with one peak, one dip and one gap of a single time each, and a band of the same width."""
    mean = np.full(LONG, 5.0)
    mean[[12_345, 23_456]] = 100.0, -100.0
    mean[17_777] = np.nan
    return {"energy": table(1, LONG, mean=mean, mean_low=mean - 1, mean_high=mean + 1)}


@pytest.mark.parametrize("keys", [{}, {"log_x": True}])
def test_a_long_series_is_thinned_but_keeps_each_peak_and_gap(keys: Mapping[str, Any]) -> None:
    shown = drawing(axes=(), tables=peaks(), **keys)
    line = plot_of(shown).lines[0]
    x, y = (np.asarray(values, dtype=float) for values in line.get_data())
    assert len(x) < 4 * thinning.PARTS
    assert list(x[np.isin(y, (100, -100))]) == [12_345, 23_456]
    assert x[np.isnan(y)] == [17_777]
    assert (x[0], x[-1]) == (0, LONG - 1)
    words = "series of 30000 times thinned: of each 1/1000 of the x axis, the extremes are drawn"
    assert words in noted(shown).note
    assert "thinned" not in noted(drawing()).note


def test_thinned_stacked_areas_have_common_times_and_say_so() -> None:
    shown = drawing("stacked", (), {"a": peaks_above_0(), "b": table(1, LONG)})
    areas = plot_areas(shown)
    assert len({len(area) for area in areas}) == 1
    assert "series of 30000 times thinned" in noted(shown).note


def peaks_above_0() -> pa.Table:
    return table(1, LONG, mean=np.where(np.arange(LONG) == 12_345, 99.0, 1.0))


def plot_areas(shown: Any) -> list[Any]:
    with style.applied():
        return [area.get_paths()[0].vertices for area in painted(shown).axes[0].collections]


@pytest.mark.integration
def test_sixty_four_names_have_an_entry_each_and_no_two_look_the_same() -> None:
    names = Axis("controller", tuple(f"controller_{k}" for k in range(64)))
    looks = style.looks(names)
    assert len({(str(look["color"]), str(look["linestyle"])) for look in looks}) == 64
    shown = drawing(axes=(names,), tables={"energy": table(64, 3)})
    assert set(names.values) <= set(said(shown).splitlines())
    slide = drawing(axes=(names,), tables={"energy": table(64, 3)}, size="slide")
    assert set(names.values) - set(said(slide).splitlines()), "there, a legend would leave no room for the plot"


@pytest.mark.parametrize("kind", ["timeseries", "summary", "bar", "box", "ecdf"])
@pytest.mark.parametrize("values", [tuple(range(500)), tuple(f"c{k}" for k in range(500))])
def test_five_hundred_series_are_one_line_that_says_what_to_do(kind: str, values: tuple[Any, ...]) -> None:
    over_runs = kind in ("timeseries", "ecdf")
    axes = (Axis("robots", values),) if over_runs else (Axis("size", (1, 2)), Axis("robots", values))
    shown = Trial(kind, {}, axes=axes).drawing(runs=lambda experiment: 1)
    with pytest.raises(UsageError, match=r"^the figure has 500 series, .* at most 200 can be drawn; choose some with where"):
        plot_of_any(shown)


def plot_of_any(shown: Any) -> Any:
    with style.applied():
        return painted(shown)


@pytest.mark.integration
def test_surfaces_and_dots_differ_in_more_than_colour() -> None:
    two = (SIZES, Axis("controller", ("walk", "flock", "levy")))
    bars = plot_of_any(Trial("bar", axes=two).drawing())
    assert [bar.get_hatch() for bar in bars.axes[0].patches[:3]] == list(style.HATCHES[:3])
    assert [handle.get_hatch() for handle in bars.legends[0].legend_handles[1:]] == list(style.HATCHES[:3])
    boxes = plot_of_any(Trial("box", axes=two).drawing())
    assert {box.get_hatch() or "" for box in boxes.axes[0].patches} == set(style.HATCHES[:3])
    dots = plot_of_any(Trial("strip", axes=two).drawing())
    assert len({str(one.get_paths()[0].vertices) for one in dots.axes[0].collections if len(one.get_offsets())}) >= 3


@pytest.mark.parametrize("kind", ["timeseries", "summary", "box", "heatmap", "scatter"])
def test_negative_values_on_a_log_axis_are_one_line(kind: str, recwarn: pytest.WarningsRecorder) -> None:
    def below(experiment: int, run: int, row: int) -> Row:
        return {"energy": -1.0 - experiment, "distance": -2.0}

    keys = {"column": ("energy", "distance")} if kind == "scatter" else {}
    axes = (SIZES, Axis("b", (1, 2))) if kind == "heatmap" else (SIZES,)
    shown = Trial(kind, {"log_y": True, **keys}, below, axes).drawing()
    with pytest.raises(UsageError, match=r"needs? values above 0, but"):
        plot_of_any(shown)
    assert not recwarn.list


@pytest.mark.parametrize("kind", ["timeseries", "summary", "box", *of_extension("figures", "ridge", "pareto")])
def test_one_run_and_missing_and_unequal_runs_are_noted(kind: str) -> None:
    keys = {"column": ("energy", "distance")} if kind == "pareto" else {}

    def holes(experiment: int, run: int, row: int) -> Row:
        return {"energy": math.nan if experiment == 0 else float(run + row), "distance": 1.0 + run}

    assert "n = 1" in Trial(kind, keys).drawing(runs=lambda experiment: 1).note
    assert "n = 3–6" in Trial(kind, keys).drawing(runs=lambda experiment: 6 - 3 * experiment).note
    assert "missing values left out" in Trial(kind, keys, holes).drawing().note
    with pytest.raises(SierraError, match=r"^no finite value in energy"):
        Trial(kind, keys, lambda e, run, row: {"energy": math.nan, "distance": math.nan}).drawing()
