"""Figures describe what they show, contain their provenance, and are reproduced byte for byte."""

from __future__ import annotations

import itertools
import json
import os
import re
import subprocess
import sys
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.collections import PolyCollection
from PIL import Image

from sierra.config import project_file
from sierra.config.deliverable_tables import Figure
from sierra.deliverables.figures import drawing as figures
from sierra.deliverables.figures.drawing import Drawing
from sierra.deliverables.record import origin_of
from sierra.errors import ConfigError, Missing, SierraError, UsageError
from sierra.model import Axis
from tests.support.characters import LETTERS, MIXED, SHOWN
from tests.tiers import at_night

SIZES = Axis("population_size", (1, 2, 4, 8), unit="robots")
NAMES = Axis("scenario", ("low", "high"))
SQL = "SELECT avg(value) -- ∓ t · sd / √n\nFROM samples WHERE value <> 'a''; &'"
BATCH = "0123456789abcdef" * 4
DC = "{http://purl.org/dc/elements/1.1/}"


def table(experiments: int, times: int = 0, **changed: Any) -> pa.Table:
    """Return aggregates in the form of `sierra.stats.aggregate`: over time, or one row per experiment if `times` is 0."""
    rows = experiments * (times or 1)
    ordinal = np.repeat(np.arange(experiments), times or 1)
    t = np.tile(np.arange(times or 1, dtype=float), experiments)
    center = (ordinal + 1) * 10.0 + t
    zero = np.zeros(rows, dtype=np.int64)
    columns: dict[str, Any] = {"experiment": ordinal.astype(np.int32)}
    columns |= {"t": t} if times else {"never": zero}
    columns |= {"missing": zero, "infinite": zero, "n": zero + 10}
    for name, shift in {
        "mean": 0, "mean_low": -1, "mean_high": 1, "median": 0, "q1": -1, "q3": 1,
        "whisker_low": -2, "whisker_high": 2, "iqm": 0, "iqm_low": -1, "iqm_high": 1,
    }.items():  # fmt: skip
        columns[name] = center + shift
    return pa.table(columns | changed)


def reduced(experiments: int, runs: int = 10) -> pa.Table:
    values = [(e, f"{e}-{r}", (e + 1) * 10.0 + (r - runs / 2) / 2) for e in range(experiments) for r in range(runs)]
    return pa.table(dict(zip(("experiment", "run", "value"), zip(*values, strict=True), strict=True)))


def cells(axes: Sequence[Axis]) -> dict[int, dict[str, Any]]:
    points = itertools.product(*(axis.values for axis in axes))
    return {k: dict(zip((axis.name for axis in axes), point, strict=True)) for k, point in enumerate(points)}


def drawing(
    kind: str = "timeseries", axes: Sequence[Axis] = (SIZES,), tables: Mapping[str, Any] | None = None, **more: Any
) -> Drawing:
    """Return a drawing of generated data; `more` are options of the figure."""
    count = len(cells(axes))
    stacked = {"searching": table(count, 20), "carrying": table(count, 20)}
    timed = kind in ("timeseries", "stacked")
    given = tables or (stacked if kind == "stacked" else {"energy": table(count, 20 if timed else 0)})
    return Drawing(
        name=kind,
        figure=Figure.model_validate({"kind": kind, "column": tuple(given), **more}),
        axes=tuple(axes),
        cells=cells(axes),
        tables=given,
        runs=reduced(count) if kind in ("box", "violin") else None,
        note="mean, 95 % CI, n = 8–10; 2 of 40 runs missing",
        sql=SQL,
        batch=BATCH,
        units={"energy": "J", "time": "s"},
    )


KINDS = ("timeseries", "summary", "box", "violin", "stacked")


def texts(svg: bytes) -> str:
    """Return all text in a figure, one item per line."""
    root = ElementTree.fromstring(svg)  # noqa: S314 - what we have just written ourselves
    return "\n".join("".join(element.itertext()) for element in root.iter("{http://www.w3.org/2000/svg}text"))


def svg(shown: Drawing) -> bytes:
    return dict(figures.rendered(replace(shown, formats=("svg",))))["svg"]


def xs(line: Any) -> list[float]:
    """Return the x values of the points of a line."""
    return list(line.get_xdata())


def said(shown: Drawing) -> str:
    return texts(svg(shown))


def flowing(shown: Drawing) -> str:
    """Return the text of a figure in one line."""
    return " ".join(said(shown).split())


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["timeseries", "heatmap", *at_night(set(KINDS) - {"timeseries"})])
def test_every_kind_of_figure_is_written_in_three_formats_with_captions(kind: str, tmp_path: Path) -> None:
    axes = (SIZES, NAMES) if kind == "heatmap" else (SIZES,)
    paths = figures.draw(drawing(kind, axes), tmp_path / "new")
    assert [path.name for path in paths] == [f"{kind}.{ending}" for ending in ("png", "pdf", "svg", "txt", "tex")]
    assert [path.read_bytes()[:4] for path in paths[:3]] == [b"\x89PNG", b"%PDF", b"<?xm"]
    assert sorted(paths) == sorted((tmp_path / "new").iterdir())


@pytest.mark.integration
def test_figures_are_identical_across_processes_dates_and_time_zones() -> None:
    code = (
        "import sys, hashlib, importlib.util as u; s = u.spec_from_file_location('t', sys.argv[1]);"
        "m = u.module_from_spec(s); s.loader.exec_module(m);"
        "print([hashlib.sha256(d).hexdigest() for k in m.KINDS for _, d in m.figures.rendered(m.drawing(k))])"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    another = environment | {"PYTHONHASHSEED": "2", "SOURCE_DATE_EPOCH": "1700000000", "TZ": "Asia/Tokyo"}
    drawn = subprocess.run([sys.executable, "-c", code, __file__], env=another, capture_output=True, text=True, check=True)
    assert drawn.stdout == f"{[sha256(data).hexdigest() for kind in KINDS for _, data in figures.rendered(drawing(kind))]}\n"


@pytest.mark.nightly
def test_matplotlib_settings_of_the_user_are_neither_used_nor_changed() -> None:
    import matplotlib as mpl

    before = figures.rendered(drawing())
    with mpl.rc_context({"font.size": 20, "axes.facecolor": "red", "text.usetex": True}):
        assert figures.rendered(drawing()) == before
        assert mpl.rcParams["font.size"] == 20


def test_importing_figures_loads_neither_plotting_nor_array_libraries() -> None:
    heavy = ("matplotlib", "seaborn", "numpy", "pyarrow")
    code = f"import sys, sierra.deliverables.figures.drawing; print([m for m in {heavy} if m in sys.modules])"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    out = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_png_contains_its_batch_sql_and_note(tmp_path: Path) -> None:
    png, *_ = figures.draw(drawing(), tmp_path)
    with Image.open(png) as image:
        image.load()
        held: Mapping[str, str] = image.text  # type: ignore[attr-defined]
    assert held["sierra"] == origin_of(BATCH, drawing().data)
    assert held["sierra:sql"] == SQL
    assert held["Description"] == drawing().note


def test_pdf_contains_its_batch_and_sql_but_no_date_and_embeds_its_fonts() -> None:
    pdf = dict(figures.rendered(drawing()))["pdf"]
    assert f"/Keywords ({origin_of(BATCH, drawing().data)})".encode() in pdf
    assert SQL.encode("utf-16-be") in _unescaped(pdf)
    assert b"Date" not in pdf
    assert b"/Subtype /Type0" in pdf or b"/Subtype /TrueType" in pdf
    assert b"/Type3" not in pdf
    assert any(b"begincmap" in stream for stream in _streams(pdf))


def test_svg_contains_its_batch_and_sql_but_no_date() -> None:
    data = svg(drawing())
    root = ElementTree.fromstring(data)  # noqa: S314 - what we have just written ourselves
    assert [element.text for element in root.iter(f"{DC}identifier")] == [origin_of(BATCH, drawing().data)]
    assert ["".join(element.itertext()) for element in root.iter(f"{DC}source")] == [SQL]
    assert not list(root.iter(f"{DC}date"))


def test_svg_contains_the_note_on_n_and_absent_runs_as_text() -> None:
    assert drawing().note in said(drawing())


def test_axis_labels_have_units_in_brackets() -> None:
    assert {"time [s]", "energy [J]"} <= set(said(drawing()).splitlines())
    assert {"population size [robots]", "final energy [J]"} <= set(said(drawing("summary")).splitlines())
    timed = drawing("summary", measure="time_to", threshold=3)
    assert "time until energy ≥ 3 [s]" in said(timed)


def test_given_labels_and_title_are_drawn_literally() -> None:
    shown = said(drawing("summary", xlabel="$N_r$ _x_", ylabel="E $ [µJ]", title=r"\alpha costs $5 or $6_"))
    assert {"$N_r$ _x_", "E $ [µJ]", r"\alpha costs $5 or $6_"} <= set(shown.splitlines())


def test_legend_shows_the_values_and_n_if_it_differs() -> None:
    assert set("1248") <= set(said(drawing()).splitlines())
    changed = table(4, 20, n=np.repeat([10, 9, 10, 10], 20))
    assert "2 (n = 9)" in said(drawing(tables={"energy": changed}))


def test_legend_does_not_cover_data() -> None:
    from sierra.deliverables.figures import style, timeseries

    with style.applied():
        figure = timeseries.timeseries(drawing())
        style.settle(figure, drawing())
        boxes = [legend.get_window_extent() for legend in figure.legends]
        assert boxes
        assert not any(plot.get_window_extent().overlaps(box) for plot in figure.axes for box in boxes)


@pytest.mark.parametrize("kind", [*KINDS, "heatmap"])
@pytest.mark.parametrize("title", ["", "A title " * 12])
def test_text_neither_overlaps_nor_leaves_the_figure(kind: str, title: str) -> None:
    from sierra.deliverables.figures import style

    long = Axis("terrain", tuple(f"a rather long name of terrain {k}" for k in range(4)))
    shown = drawing(kind, (long, NAMES) if kind == "heatmap" else (long,), title=title)
    with style.applied():
        figure = figures.painted(shown)
        figure.canvas.draw()
        outer = figure.bbox.padded(2)
        boxes: list[Any] = [plot.get_tightbbox() for plot in figure.axes]
        around = [item.get_window_extent() for item in (*figure.legends, *figure.texts)]
        for box in (*boxes, *around):
            assert outer.x0 <= box.x0
            assert box.x1 <= outer.x1
            assert outer.y0 <= box.y0
            assert box.y1 <= outer.y1
        for one, other in itertools.combinations(around, 2):
            assert not one.overlaps(other)
        assert not any(one.overlaps(other) for one in around for other in boxes)


@pytest.mark.nightly
def test_thirty_numeric_values_get_a_colour_bar_and_thirty_names_get_a_legend() -> None:
    many = Axis("max_speed", tuple(k / 10 for k in range(30)), unit="m/s")
    lines = said(drawing(axes=(many,))).splitlines()
    assert "max speed [m/s]" in lines
    assert len(lines) < 35
    names = Axis("scenario", tuple(f"scenario_{k}" for k in range(30)))
    assert "scenario_28" in said(drawing(axes=(names,)))


def test_values_that_look_alike_in_short_have_longer_names() -> None:
    close = Axis("gain", (0.1000001, 0.1000002, 0.5))
    assert {"0.1000001", "0.1000002", "0.5"} <= set(said(drawing("box", (close,))).splitlines())
    long = [f"a controller with a very long name and {middle} in the middle of its name" for middle in ("one", "two")]
    words = flowing(drawing("box", (Axis("controller", tuple(long)),)))
    assert "one" in words
    assert "two" in words


def test_values_in_geometric_progression_get_a_log_axis() -> None:
    from sierra.deliverables.figures import style, summary

    with style.applied():
        geometric = summary.summary(drawing("summary")).axes[0]
        linear = summary.summary(drawing("summary", (Axis("speed", (1, 2, 3, 4)),))).axes[0]
        names = summary.summary(drawing("summary", (Axis("s", ("a", "b", "c", "d")),))).axes[0]
    assert [plot.get_xscale() for plot in (geometric, linear, names)] == ["log", "linear", "linear"]
    assert [label.get_text() for label in geometric.get_xticklabels()] == ["1", "2", "4", "8"]
    assert [line.get_linestyle() for line in names.lines if len(xs(line)) == 4][-1] == "None"


def test_second_variable_gets_a_legend_in_summaries_and_panels_in_timeseries() -> None:
    assert {"scenario", "low", "high"} <= set(said(drawing("summary", (SIZES, NAMES))).splitlines())
    assert {"scenario = low", "scenario = high"} <= set(said(drawing("timeseries", (SIZES, NAMES))).splitlines())


def test_heatmap_shows_numbers_and_hatches_missing_cells() -> None:
    full = drawing("heatmap", (SIZES, NAMES))
    assert {"10", "80", "population size [robots]", "scenario", "final energy [J]"} <= set(said(full).splitlines())
    holed = drawing("heatmap", (SIZES, NAMES), {"energy": table(8).slice(1)})
    assert "10" not in said(holed).splitlines()
    assert b"pattern" in svg(holed)
    assert b"pattern" not in svg(full)


def test_timeseries_without_intervals_has_no_bands() -> None:
    from sierra.deliverables.figures import style, timeseries

    none = pa.nulls(80, pa.float64())
    alone = drawing(tables={"energy": table(4, 20, mean_low=none, mean_high=none)})
    with style.applied():
        assert len(timeseries.timeseries(drawing()).axes[0].collections) == 4
        assert not timeseries.timeseries(alone).axes[0].collections


def test_marks_are_hollow_if_some_runs_never_reached_the_threshold() -> None:
    from sierra.deliverables.figures import style, summary

    censored = table(4, never=np.array([0, 3, 0, 0]))
    with style.applied():
        plot = summary.summary(drawing("summary", tables={"energy": censored}, measure="time_to", threshold=1)).axes[0]
    assert [xs(line) for line in plot.lines if line.get_markerfacecolor() == "white"] == [[2.0]]


def test_experiments_that_never_reached_the_threshold_are_marked_at_the_upper_edge() -> None:
    from sierra.deliverables.figures import style

    nan = np.array([10.0, 20.0, np.nan, np.nan])
    late = table(4, n=np.array([10, 7, 0, 0]), never=np.array([0, 3, 10, 10]), mean=nan, mean_low=nan, mean_high=nan)
    runs = reduced(2)
    for kind, places in {"summary": [4.0, 8.0], "box": [2.0, 3.0], "violin": [2.0, 3.0]}.items():
        shown = replace(drawing(kind, tables={"energy": late}, measure="time_to", threshold=1), runs=runs)
        with style.applied():
            plot = figures.painted(shown).axes[0]
        marks = [line for line in plot.lines if line.get_marker() == "^" and len(xs(line))]
        assert sorted(x for line in marks for x in xs(line)) == places
        assert all(list(line.get_ydata()) == [1.0] * len(xs(line)) for line in marks)


def ragged(n: int = 2, reach: float = 500.0) -> dict[str, Any]:
    """Return lines of ten runs of which only `n` reach the end, where the interval is wide."""
    few = np.tile(np.arange(20) >= 15, 4)
    center = table(4, 20).column("mean").to_numpy()
    half = np.where(few, reach, 1.0)
    return {"energy": table(4, 20, n=np.where(few, n, 10), mean_low=center - half, mean_high=center + half)}


def plot_of(shown: Drawing) -> Any:
    from sierra.deliverables.figures import style, summary, timeseries

    with style.applied():
        return {"timeseries": timeseries.timeseries, "summary": summary.summary}[shown.figure.kind](shown).axes[0]


@pytest.mark.integration
def test_intervals_of_few_runs_do_not_set_the_axis_range_and_the_cut_is_noted() -> None:
    shown = drawing(tables=ragged())
    low, high = plot_of(shown).get_ylim()
    assert 5 < low < 9  # the lines go from 10 to 59; their intervals are ± 1
    assert 60 < high < 64
    assert "some intervals of n ≤ 2 are cut off" in flowing(shown)
    assert figures.rendered(shown) == figures.rendered(shown)


@pytest.mark.nightly
def test_intervals_that_fit_or_belong_to_most_runs_are_not_cut_off() -> None:
    for tables in (ragged(n=6), ragged(reach=10.0), {"energy": table(4, 20)}):
        shown = drawing(tables=tables)
        low, high = plot_of(shown).get_ylim()
        spread = tables["energy"]
        assert low <= min(spread["mean_low"].to_pylist())
        assert high >= max(spread["mean_high"].to_pylist())
        assert "cut off" not in flowing(shown)


def test_experiment_with_few_runs_does_not_set_the_axis_range_of_a_summary() -> None:
    few = table(
        4, n=np.array([10, 2, 10, 10]), mean_low=np.array([9, -980, 29, 39.0]), mean_high=np.array([11, 1020, 31, 41.0])
    )
    shown = drawing("summary", tables={"energy": few})
    assert plot_of(shown).get_ylim() == pytest.approx((9 - 1.6, 41 + 1.6))
    assert "some intervals of n ≤ 2 are cut off" in flowing(shown)
    wide = drawing("summary", tables={"energy": few}, log_y=True)
    assert plot_of(wide).get_ylim() == pytest.approx((9 * (9 / 41) ** 0.05, 41 * (41 / 9) ** 0.05))


@pytest.mark.integration
def test_values_that_a_log_axis_cannot_show_are_noted() -> None:
    means = np.array([0.0, -1.0, 30.0, 40.0])
    lacking = table(4, mean=means, mean_low=means - 1, mean_high=means + 1)
    for kind, axes in (("summary", (SIZES,)), ("heatmap", (Axis("a", (1, 2)), Axis("b", (1, 2))))):
        assert "log scale: 2 of 4 means not above 0 left out" in flowing(drawing(kind, axes, {"energy": lacking}, log_y=True))
        assert "log scale" not in flowing(drawing(kind, axes, {"energy": lacking}))
    wide = drawing(tables={"energy": table(4, 20, mean_low=np.full(80, -5.0))}, log_y=True)
    assert "log scale: intervals that reach 0 are cut off" in flowing(wide)
    values = np.where(np.arange(40) % 10 == 0, 0.0, np.arange(40) + 1.0)
    runs = pa.table({"experiment": np.repeat(np.arange(4), 10), "run": [str(k) for k in range(40)], "value": values})
    for kind in ("box", "violin"):
        assert "log scale: 4 of 40 runs not above 0 left out" in flowing(replace(drawing(kind, log_y=True), runs=runs))


def test_violin_on_a_log_axis_keeps_its_density_if_one_run_is_zero() -> None:
    from sierra.deliverables.figures import style

    runs = reduced(4)
    lowered = np.where(np.arange(40) % 10 == 0, 0.0, runs.column("value").to_numpy())
    shown = replace(drawing("violin", log_y=True), runs=runs.set_column(2, "value", pa.array(lowered)))
    with style.applied():
        shapes = figures.painted(shown).axes[0].collections
    assert sum(isinstance(shape, PolyCollection) for shape in shapes) == 4


def test_colour_bar_of_a_log_heatmap_shows_powers_of_ten_without_tex() -> None:
    wide = table(8, mean=10.0 ** np.arange(-2, 6))
    lines = said(drawing("heatmap", (SIZES, NAMES), {"energy": wide}, log_y=True)).splitlines()
    assert {"0.01", "100", "10⁴", "1e5"} <= set(lines)
    assert not [line for line in lines if "$" in line or "e+" in line]


def test_intervals_of_several_groups_at_the_same_value_are_side_by_side() -> None:
    plot = plot_of(drawing("summary", (SIZES, NAMES)))
    marks = [line for line in plot.lines if line.get_linestyle() == "None" and len(xs(line)) == 4 and line.get_marker() in "os"]
    places = [line.get_transform().transform([(2.0, 20.0)])[0][0] for line in marks]
    assert [xs(line) for line in marks] == [[1, 2, 4, 8]] * 2
    assert places[1] - places[0] == pytest.approx(1.6 * 300 / 72)
    assert len(plot.collections) == 2
    assert {bar.get_transform().transform([(2.0, 20.0)])[0][0] for bar in plot.collections} == set(places)


@pytest.mark.parametrize("axis", [SIZES, NAMES, Axis("terrain", tuple(f"terrain {k}" for k in range(12)))])
@pytest.mark.parametrize("kind", ["timeseries", "summary"])
def test_lines_differ_in_style_and_not_only_in_colour(axis: Axis, kind: str) -> None:
    from sierra.deliverables.figures import style

    axes = (axis,) if kind == "timeseries" else (SIZES, axis)
    looks = style.looks(axis)
    assert len({str(look["linestyle"]) for look in looks}) == min(len(axis.values), 8)
    assert len({(str(look["color"]), str(look["linestyle"])) for look in looks}) == len(axis.values)
    entries = said(drawing(kind, axes)).splitlines()
    assert {str(value) for value in axis.values} <= set(entries), "each has an entry in the legend"
    styles = {str(line._dash_pattern) for line in plot_of(drawing(kind, axes)).lines if line.get_linestyle() != "None"}
    assert len(styles) >= min(len(axis.values), 8)


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["stacked", "timeseries"])
def test_labels_of_many_panels_stay_within_the_figure_and_do_not_overlap(kind: str) -> None:
    from sierra.deliverables.figures import style, timeseries

    axes = (Axis("population_size", (1, 2, 4), unit="robots"), Axis("communication_range", (0.25, 0.5, 1.5, 2.5), unit="m"))
    shown = drawing(kind, axes, ylabel="the energy that all robots have used together")
    with style.applied():
        figure = timeseries.stacked(shown) if kind == "stacked" else timeseries.timeseries(shown)
        style.settle(figure, shown)
        figure.canvas.draw()
        outer = figure.bbox.padded(2)
        titles = [plot.title.get_window_extent() for plot in figure.axes]
        labels = [label.get_window_extent() for plot in figure.axes for label in (plot.xaxis.label, plot.yaxis.label)]
        boxes = [box for box in (*titles, *labels) if box.width > 0]
        for box in boxes:
            assert outer.x0 <= box.x0
            assert box.x1 <= outer.x1
            assert outer.y0 <= box.y0
            assert box.y1 <= outer.y1
        for one, other in itertools.combinations(boxes, 2):
            assert not one.overlaps(other)


def test_marks_at_zero_are_not_shifted_below_zero() -> None:
    plot = plot_of(drawing("summary", (Axis("noise", (0.0, 0.5, 1.0, 1.5)), NAMES)))
    zero = plot.transData.transform([(0.0, 20.0)])[0][0]
    marks = [line for line in plot.lines if line.get_linestyle() == "None" and len(xs(line)) == 4]
    assert marks
    assert min(line.get_transform().transform([(0.0, 20.0)])[0][0] for line in marks) >= zero - 0.01


@pytest.mark.integration
@pytest.mark.parametrize("first", [SIZES, Axis("noise", (0.0, 0.5, 1.0, 1.5))])
@pytest.mark.parametrize("count", [3, 12, 60])
def test_marks_of_all_groups_stay_within_the_plot(first: Axis, count: int) -> None:
    from sierra.deliverables.figures import style, summary

    shown = drawing("summary", (first, Axis("terrain", tuple(f"terrain {k}" for k in range(count)))))
    with style.applied():
        figure = summary.summary(shown)
        style.settle(figure, shown)
        figure.canvas.draw()
        plot, *_ = figure.axes
        marks = [line for line in plot.lines if line.get_linestyle() == "None" and len(xs(line)) == 4]
        assert len(marks) >= count
        for line in marks:
            places = line.get_transform().transform(line.get_xydata())[:, 0]
            assert plot.bbox.x0 <= min(places)
            assert max(places) <= plot.bbox.x1


@pytest.mark.parametrize(
    ("keys", "complaint"),
    [
        ({"kind": "box", "times": "linear"}, '"times" needs kind "timeseries" or "stacked", not \'box\''),
        ({"times": "cubic"}, "figures.f.times should be 'own', 'carry' or 'linear', not \"cubic\""),
        ({"kind": "box", "threshold": 1.0}, 'measure "time_to" and "threshold" must be used together'),
        ({"measure": "mean"}, '"measure" needs kind "summary", "box", "violin"'),
        ({"titel": "T"}, "figures.f: unknown key 'titel'; did you mean 'title'?"),
        ({"kind": "boxes"}, "figures.f: unknown kind 'boxes'; did you mean 'box'?"),
        ({"kind": "box", "measure": "time_to", "threshold": float("nan")}, "should be a finite number"),
    ],
)
def test_invalid_or_ineffective_keys_of_figures_are_refused(keys: Mapping[str, Any], complaint: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(complaint)):
        project_file.parse({"template": "t.xml", "figures": {"f": keys}}, "sierra.toml")


@pytest.mark.nightly
def test_figure_paths_are_printed_relative_but_are_absolute_in_json(simulate: Callable[..., Any]) -> None:
    project = simulate()
    project.quick("run", "size=1,2", "--runs", "2", "--no-figures")
    listed = project.quick("figures").stdout.splitlines()
    assert listed
    assert all(re.fullmatch(r"figures/\w{10}/\w+\.(png|pdf|svg|txt|tex)", line) for line in listed)
    assert set(listed) == {str(path.relative_to(project.folder)) for path in project.folder.glob("figures/*/[!.]*")}
    whole = json.loads(project.quick("figures", "--json").stdout)
    assert whole == [str(project.folder / line) for line in listed]


def nan_table(count: int, times: int) -> pa.Table:
    holes = np.where(np.arange(count * (times or 1)) % 3 == 1, np.nan, 5.0)
    holes[: times or 1] = np.nan
    return table(count, times, **dict.fromkeys(("mean", "mean_low", "mean_high"), holes))


ODD: Mapping[str, Any] = {
    "one experiment": lambda k, n: ((Axis("size", (4,)),), None),
    "no variable": lambda k, n: ((), None),
    "missing values": lambda k, n: ((SIZES,), nan_table(4, n)),
    "constant": lambda k, n: (
        (SIZES,),
        table(4, n, **dict.fromkeys(("mean", "mean_low", "mean_high"), np.full(4 * (n or 1), 3.0))),
    ),
    "huge": lambda k, n: ((SIZES,), table(4, n, mean=np.full(4 * (n or 1), 1e300), mean_low=np.full(4 * (n or 1), -np.inf))),
    "tiny": lambda k, n: (
        (SIZES,),
        table(4, n, **dict.fromkeys(("mean", "mean_low", "mean_high"), np.linspace(1e-300, 2e-300, 4 * (n or 1)))),
    ),
    "thirty": lambda k, n: ((Axis("size", tuple(range(1, 31))),), None),
    "names": lambda k, n: (
        (Axis("$x_1$", ("$", "_", "a" * 300, "日本\n\x00\u200b<&>"), label="% $ \\frac{ _", unit="µ$"),),
        None,
    ),
    "three variables": lambda k, n: ((SIZES, NAMES, Axis("z", (0.1, 0.2))), None),
}


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", ODD)
def test_figures_are_drawn_from_unusual_data(kind: str, case: str) -> None:
    axes, odd = ODD[case](kind, 20 if kind in ("timeseries", "stacked") else 0)
    tables = None if odd is None else dict.fromkeys(("searching", "other") if kind == "stacked" else ("energy",), odd)
    drawn = drawing(kind, axes, tables, title="T_$", ylabel="{" * 99)
    assert all(len(data) > 1000 for ending, data in figures.rendered(drawn) if ending not in ("txt", "tex"))
    assert kind == "stacked" or svg(drawing(kind, axes, tables, log_y=True))


def test_figures_show_letters_and_escape_what_deceives() -> None:
    drawn = drawing("summary", (Axis("law", (LETTERS, "\u202e")),), title=MIXED)
    written = svg(replace(drawn, note=f"a\tb\n{MIXED}\uffff"))
    texts = {(one.text or "").partition("; boxes: ")[0] for one in ElementTree.XML(written).iter()}  # emoji may have no font
    assert {SHOWN, LETTERS, r"\u202e", f"a\tb\n{SHOWN}\\uffff"} <= texts


def test_timeseries_with_one_time_is_drawn_as_marks() -> None:
    from sierra.deliverables.figures import style, timeseries

    with style.applied():
        plot = timeseries.timeseries(drawing(tables={"energy": table(4, 1)})).axes[0]
    assert sum(line.get_marker() == "o" and len(xs(line)) == 1 for line in plot.lines) == 4


def test_empty_data_are_refused_without_writing_files(tmp_path: Path) -> None:
    empty = table(4, 20, n=np.zeros(80, dtype=int))
    for tables in ({"energy": empty}, {"energy": empty.slice(0, 0)}):
        with pytest.raises(SierraError, match=r"^there is no value to draw$"):
            figures.draw(drawing(tables=tables), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("shown", "complaint"),
    [
        (drawing("summary", (Axis("noise", (0, 1)),), log_x=True), "log_x needs values above 0, but noise has 0"),
        (drawing(tables={"energy": table(4, 5, mean=np.full(20, -1.0))}, log_y=True), "log_y needs values above 0"),
        (drawing("stacked", tables={"a": table(4, 5, mean=np.full(20, -1.0))}), "values of at least 0"),
        (drawing("stacked", tables={"energy": table(4, 5), "lifted": table(4, 5)}), r"not energy \[J\], lifted \(no unit\)"),
        (drawing(axes=(SIZES, Axis("seed", tuple(range(40))))), "the figure needs 40 panels, but at most 36 are possible"),
    ],
)
def test_data_that_do_not_fit_the_kind_of_figure_are_refused(shown: Drawing, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=complaint):
        figures.draw(shown, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [*KINDS, "heatmap"])
def test_values_too_large_for_an_axis_are_refused(kind: str, tmp_path: Path) -> None:
    shown = drawing(kind, (SIZES, NAMES) if kind == "heatmap" else (SIZES,))
    large = {name: made.set_column(0, "mean", pa.array(np.full(made.num_rows, 1.7e308))) for name, made in shown.tables.items()}
    with pytest.raises(SierraError, match=r"1\.7e\+308 is too large to be drawn"):
        figures.draw(replace(shown, tables=large), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["", "../up", "a/b", ".."])
def test_figure_names_that_leave_the_folder_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be the name"):
        figures.draw(replace(drawing(), name=name), tmp_path)


def test_unwritable_figure_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(Missing, match=re.escape(str(tmp_path / "file"))):
        figures.draw(drawing(), tmp_path / "file")


def _unescaped(pdf: bytes) -> bytes:
    return re.sub(rb"\\([\\()nr])", lambda m: {b"n": b"\n", b"r": b"\r"}.get(m[1], m[1]), pdf)


def _streams(pdf: bytes) -> list[bytes]:
    found = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL)
    return [zlib.decompress(data) for data in found if data[:1] == b"x"]
