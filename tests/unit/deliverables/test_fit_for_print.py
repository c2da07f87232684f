"""Texts of figures stay apart, whole and inside the figure; `make nightly` draws every kind (tests/nightly/test_gallery.py)."""

from __future__ import annotations

from typing import Any

import pytest
from matplotlib.figure import Figure

from sierra.deliverables.figures import drawing as figures
from sierra.deliverables.figures import font, style
from sierra.deliverables.figures.drawing import noted
from sierra.model import Axis
from sierra.testing.figures import Row, Trial
from tests import gallery
from tests.print_faults import faults

SIZES, NOISE = Axis("size", (1, 2, 4), unit="robots"), Axis("noise", ("calm", "breeze", "windy", "stormy"))
THIRD = Axis("controller", gallery.names(2, "long"))


def painted(kind: str, axes: tuple[Axis, ...], size: str = "acm-column", **keys: Any) -> Figure:
    shown = gallery.drawing(kind, axes, size, **keys)
    with style.applied(shown.figure):
        return gallery.painted(shown)


def ticks(figure: Figure) -> list[str]:
    return [label.get_text() for label in figure.axes[0].get_xticklabels()]


@pytest.mark.parametrize("kind", ["trajectories", "timeseries"])
def test_titles_have_all_variables_and_stay_apart(kind: str) -> None:
    axes = (Axis("size", (1, 2)), THIRD, Axis("noise", ("calm", "windy")))
    assert gallery.found(kind, axes, "acm-column") == []


def test_ticks_of_several_panels_stay_apart() -> None:
    names = Axis("controller", ("forage", "dispersal", "exploration"))
    assert gallery.found("bar", (names, Axis("noise", ("calm", "windy", "stormy"))), "acm-column", facet="noise") == []


def test_forty_categories_keep_their_names_and_more_are_noted() -> None:
    assert len(ticks(painted("bar", (Axis("controller", gallery.names(40, "long")),)))) == 40
    shown = gallery.drawing("bar", (Axis("controller", gallery.names(60, "long")),), "acm-column")
    with style.applied(shown.figure):
        assert "x axis: 30 of 60 names, at equal distances" in noted(shown).note


def test_a_faulty_figure_is_found() -> None:
    with style.applied():
        figure = style.blank()
        plot = figure.add_subplot()
        plot.set_xticks([0, 0.01], ["one", "other"])
        figure.text(0.98, 0.5, "a text that leaves the figure")
    found = faults(figure)
    assert any("overlaps" in line for line in found)
    assert any("leaves the figure" in line for line in found)


def test_log_x_false_is_linear_and_unset_is_as_the_values_are() -> None:
    scales = {key: painted("summary", (SIZES,), **keys).axes[0].get_xscale() for key, keys in KEYS.items()}
    assert scales == {"unset": "log", "true": "log", "false": "linear"}


KEYS: dict[str, dict[str, Any]] = {"unset": {}, "true": {"log_x": True}, "false": {"log_x": False}}


@pytest.mark.parametrize("place", ["right", "below"])
def test_a_legend_can_be_beside_or_below_the_data(place: str) -> None:
    figure = painted("summary", (SIZES, NOISE), legend=place)
    assert faults(figure) == []
    (legend,), plot = figure.legends, figure.axes[0].get_window_extent()
    box = legend.get_window_extent()
    assert box.x0 > plot.x1 if place == "right" else box.y1 < plot.y0


def test_panels_can_have_letters() -> None:
    figure = painted("summary", (SIZES, NOISE), facet="noise", panel_titles="letters")
    assert [plot.get_title() for plot in figure.axes[:2]] == ["(a) noise = calm", "(b) noise = breeze"]
    grid = painted("trajectories", (SIZES, Axis("noise", ("calm", "windy"))), panel_titles="letters")
    titles = [" ".join(plot.get_title().split()) for plot in grid.axes]
    assert titles == ["(a) size = 1 robots", "(b) size = 2 robots", "(c) size = 4 robots", "(d)", "(e)", "(f)"]


def test_small_print_can_be_left_to_the_caption() -> None:
    shown = gallery.drawing("summary", (SIZES,), "acm-column", small_print=False)
    files = dict(figures.rendered(shown))
    assert b"n = 5" not in files["svg"].partition(b"</metadata>")[2]
    assert b"n = 5" in files["txt"]


def test_a_figure_of_one_run_says_which_one() -> None:
    shown = gallery.drawing("trajectories", (SIZES,), "acm-column", run=1)
    assert shown.note == "paths, ○ start, □ end, run 1 of 5"


def test_small_values_have_a_prefix_and_their_unit() -> None:
    def row(experiment: int, run: int, row: int) -> Row:
        return {"latency": 0.00025 * (1 + experiment) + run * 1e-5}

    drawing = Trial("summary", {"column": "latency"}, row, (SIZES,)).drawing()
    with style.applied():
        figure = figures.painted(figures.replace(drawing, units={"latency": "s"}))
        figure.canvas.draw()
    assert figure.axes[0].get_ylabel() == "final latency"
    assert "500\N{NO-BREAK SPACE}µs" in [label.get_text() for label in figure.axes[0].get_yticklabels()]


def test_letters_without_a_font_are_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(font, "_known", dict)
    shown = gallery.drawing("bar", (Axis("controller", ("随机", "a")),), "acm-column")
    with style.applied(shown.figure):
        assert "boxes: this machine has no font for U+673A, U+968F; install one and draw again" in noted(shown).note


def test_one_busy_cell_does_not_take_the_whole_scale() -> None:
    def row(experiment: int, run: int, row: int) -> Row:
        return {"x": 0.0 if row < 4 else 1.0 + run * 3 + row, "y": 0.0 if row < 4 else 1.0 + row + run}

    drawing = Trial("density", {"column": ("x", "y"), "bins": 100}, row, ()).drawing(runs=lambda _: 60)
    with style.applied():
        shown = noted(drawing)
        mesh = figures.painted(shown).axes[0].collections[0]
    assert "colours end at" in shown.note
    assert mesh.norm.vmax < 5 < mesh.get_array().max()


@pytest.mark.parametrize("count", [2, 4])
def test_rows_of_a_comparison_are_whole_and_narrow(count: int) -> None:
    with gallery.comparison(gallery.names(count, "long"), "acm-column") as figure:
        (plot,) = figure.axes
        assert [line for line in faults(figure) if "read" not in line] == []
        assert max(label.get_window_extent().width for label in plot.get_yticklabels()) < 0.35 * figure.bbox.width
        headings = [text.get_text() for text in plot.texts]
        labels = [label.get_text() for label in plot.get_yticklabels()]
    assert not any("…" in text for text in (*headings, *labels))
    assert len(headings) == (3 if count > 2 else 1)
