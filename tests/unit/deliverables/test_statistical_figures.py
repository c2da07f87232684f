"""Statistical figures, which seaborn draws, show the right numbers, few enough points, and their libraries."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_hex
from matplotlib.patches import PathPatch

from sierra.deliverables.figures import sampled_runs, style
from sierra.deliverables.figures.base import made_by
from sierra.deliverables.figures.drawing import Drawing, noted
from sierra.errors import NotInstalled
from sierra.model import Axis
from sierra.testing.figures import Row, Trial
from tests.drawings import plot
from tests.tiers import of_extension

STATISTICAL = {"box", "violin", "strip", "ecdf", "histogram", "scatter"}
TWO = (Axis("size", (1, 2, 4)), Axis("scenario", ("low", "high")))


def runs_of(drawing: Drawing) -> dict[int, Any]:
    return sampled_runs.values(drawing)


def dots(panel: Any) -> list[tuple[float, float]]:
    return [tuple(point) for one in panel.collections if isinstance(one, PathCollection) for point in one.get_offsets()]


def spread(experiment: int, run: int, row: int) -> Row:
    """Return values of which some are far from the others."""
    return {"energy": float(experiment + 1) * 10 + (run * 7 % 11) + (40 if run == 5 else 0)}


@pytest.mark.parametrize("keys", [{}, {"log_y": True}])
def test_boxes_show_the_quartiles_of_numpy_and_the_runs_beyond_the_whiskers(keys: dict[str, object]) -> None:
    drawing = Trial("box", keys, spread, TWO).drawing(runs=lambda experiment: 12)
    panel = plot(drawing)
    boxes = sorted(
        (shape.get_path().get_extents() for shape in panel.patches if isinstance(shape, PathPatch)), key=lambda b: b.x0
    )
    for box, values in zip(boxes, runs_of(drawing).values(), strict=True):
        assert (box.y0, box.y1) == pytest.approx(np.percentile(values, [25, 75]))
        assert any(line.get_ydata() == pytest.approx([np.median(values)] * 2) for line in panel.lines)
    assert sorted(y for _, y in dots(panel)) == sorted(values.max() for values in runs_of(drawing).values())
    assert [box.x0 for box in boxes] == pytest.approx([x - 0.375 + 0.4 * k for x in range(3) for k in (0, 1)], abs=0.03)


def test_a_box_of_three_runs_has_no_whisker_that_ends_within_it() -> None:
    def row(experiment: int, run: int, row: int) -> Row:
        return {"energy": (1.0, 2.0, 100.0, 2.0)[run]}

    panel = plot(Trial("box", {}, row, ()).drawing(runs=lambda experiment: 4))
    (box,) = (shape.get_path().get_extents() for shape in panel.patches)
    ends = [y for line in panel.lines for y in line.get_ydata()]
    assert (min(ends), max(ends)) == (box.y0 - 0.75, box.y1)
    assert [y for _, y in dots(panel)] == [100.0]


@pytest.mark.parametrize("kind", ["violin", "strip"])
def test_each_run_is_a_dot_in_the_colour_of_its_group_near_its_place(kind: str) -> None:
    drawing = Trial(kind, {}, spread, TWO).drawing(runs=lambda experiment: 12)
    panel = plot(drawing)
    found = dots(panel)
    assert sorted(y for _, y in found) == pytest.approx(np.sort(np.concatenate(list(runs_of(drawing).values()))))
    assert all(abs(x - 0.2 - round(x - 0.2)) < 0.2 or abs(x + 0.2 - round(x + 0.2)) < 0.2 for x, _ in found)
    shades = {to_hex(shade) for one in panel.collections if isinstance(one, PathCollection) for shade in one.get_facecolors()}
    assert shades == {colour.lower() for colour in style.NAMED[:2]}
    medians = [line for line in panel.collections if isinstance(line, LineCollection)]
    assert kind == "violin" or len(medians) == 6


@pytest.mark.integration
def test_more_runs_than_the_limit_are_sampled_by_a_rule_that_the_small_print_states(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampled_runs, "MOST", 40)
    for kind, keys in {"strip": {}, "ecdf": {"interval": False}, "scatter": {"column": ("energy", "distance")}}.items():
        drawing = Trial(kind, keys).drawing(runs=lambda experiment: 60)
        assert "of 120 runs, the first, the last and every k-th of each experiment, by " in noted(drawing).note
        assert "are drawn: k = 4" in noted(drawing).note
        panel = plot(drawing)
        if kind != "ecdf":
            assert len(dots(panel)) == 2 * (2 + 14)
            continue
        values = runs_of(drawing)[0]
        steps = dict(zip(panel.lines[0].get_xdata(), panel.lines[0].get_ydata(), strict=True))
        drawn = [value for value in steps if value in values]
        assert [steps[value] for value in drawn] == pytest.approx([(values <= value).mean() for value in drawn])
        assert (drawn[0], drawn[-1], len(drawn)) == (values[0], values[-1], 16)
    assert "k-th" not in noted(Trial("strip").drawing()).note


def test_statistics_are_those_of_all_runs_if_only_some_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    drawing = Trial("histogram", {"bins": 5}).drawing(runs=lambda experiment: 60)
    before = [shape.get_paths()[0].vertices.tolist() for shape in plot(drawing).collections]
    monkeypatch.setattr(sampled_runs, "MOST", 40)
    assert [shape.get_paths()[0].vertices.tolist() for shape in plot(drawing).collections] == before


def test_violins_on_a_log_axis_have_the_densities_of_the_logarithms() -> None:
    drawing = Trial("violin", {"log_y": True}, spread, ()).drawing(runs=lambda experiment: 12)
    assert "densities of the logarithms" in noted(drawing).note
    values = pa.chunked_array([np.log10(drawing.runs.column("value").to_numpy())])  # type: ignore[union-attr]
    logs = replace(drawing, figure=drawing.figure.model_copy(update={"log_y": False}))
    logs = replace(logs, runs=drawing.runs and drawing.runs.set_column(2, "value", values))
    shape, same = (plot(one).collections[0].get_paths()[0].vertices for one in (drawing, logs))
    assert np.log10(shape[:, 1]) == pytest.approx(same[:, 1])
    assert shape[:, 0] == pytest.approx(same[:, 0])


@pytest.mark.parametrize("kind", ["violin", *of_extension("figures", "ridge")])
@pytest.mark.parametrize("scale", [1e-200, 1e-17, 1e200])
def test_values_whose_variance_is_no_number_have_no_density(kind: str, scale: float) -> None:
    def row(experiment: int, run: int, row: int) -> Row:
        return {"energy": scale * (run + 1)}

    drawing = Trial(kind, {}, row, ()).drawing()
    shapes = [shape for shape in plot(drawing).collections if isinstance(shape, PolyCollection)]
    assert len(shapes) == (scale == 1e-17)
    assert ("1 without a density" in noted(drawing).note) == (kind == "ridge" and not shapes)


def test_random_numbers_settings_and_warnings_of_the_caller_stay_as_they_are() -> None:
    import matplotlib as mpl

    np.random.seed(7)
    first = np.random.random()
    np.random.seed(7)
    settings, filters = dict(mpl.rcParams), list(warnings.filters)
    plot(Trial("strip").drawing())
    assert np.random.random() == first
    assert dict(mpl.rcParams) == settings
    assert warnings.filters == filters


def test_the_record_names_seaborn_and_pandas_for_statistical_kinds_only() -> None:
    for kind in ("timeseries", "summary", "heatmap", "bar", *STATISTICAL):
        named = {library.partition("==")[0] for library in made_by(kind)}
        assert named == {"matplotlib", *(("seaborn", "pandas") if kind in STATISTICAL else ())}
    assert set(made_by("box")) <= set(Trial("box").drawing().content().made_by)


@pytest.mark.parametrize("absent", ["seaborn", "pandas"])
def test_a_missing_library_is_reported_with_the_extra_to_install(absent: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == absent]:
        monkeypatch.delitem(sys.modules, name)
    if absent == "pandas":
        for name in [name for name in sys.modules if name.partition(".")[0] == "seaborn"]:
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, absent, None)
    with pytest.raises(NotInstalled, match=rf"but {absent} is not installed; pip install 'sierra-experiments\[figures\]'"):
        plot(Trial("box").drawing())
