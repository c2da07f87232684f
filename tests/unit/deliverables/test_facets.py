"""Panels: `facet` is the variable of their columns, in the order of its values, in kinds with a panel for each experiment."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sierra.deliverables.figures import style
from sierra.deliverables.figures.drawing import Drawing, noted, painted
from sierra.model import Axis
from sierra.testing.figures import Row, Trial
from tests.tiers import of_extension

SIZE, NOISE = Axis("size", (1, 2, 4)), Axis("noise", ("calm", "windy"))
COLUMNS = {
    "trajectories": ("energy", "distance"),
    "density": ("energy", "distance"),
    "matrix": ("place", "place", "energy"),
    "confusion": ("truth", "guess"),
    "stacked": ("energy", "distance"),
    "timeseries": ("energy",),
}


def row(experiment: int, run: int, row: int) -> Row:
    energy = 10.0 * experiment + row + run
    guesses: dict[str, float | str] = {"truth": "ab"[row % 2], "guess": "ab"[(row + run) % 2], "place": float(row % 3)}
    return {"energy": energy, "distance": energy / 2, **guesses}


def made(kind: str, axes: tuple[Axis, ...] = (SIZE, NOISE), **keys: Any) -> Drawing:
    return Trial(kind, {"column": COLUMNS[kind], **keys}, row, axes).drawing()


def panels(drawing: Drawing) -> list[Any]:
    with style.applied(drawing.figure):
        figure = painted(drawing)
    return [plot for plot in figure.axes if plot.get_label() != "<colorbar>"]


def titles(drawing: Drawing) -> dict[tuple[int, int], str]:
    """Return the titles of the panels and the texts beside them, by their row and column."""
    places = {plot: plot.get_subplotspec() for plot in panels(drawing)}
    return {
        (at.rowspan.start, at.colspan.start): " ".join(
            " ".join((plot.get_title(), *(text.get_text() for text in plot.texts if text.get_gid() == style.STRIP))).split()
        )
        for plot, at in places.items()
    }


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["trajectories", "density", "matrix", *of_extension("figures", "confusion"), "stacked"])
def test_facet_is_the_variable_of_the_columns(kind: str) -> None:
    noises, sizes = [f"noise = {value}" for value in NOISE.values], [f"size = {value}" for value in SIZE.values]
    assert titles(made(kind, facet="noise")) == grid(noises, sizes)
    assert titles(made(kind, facet="size")) == grid(sizes, noises)


def grid(columns: list[str], rows: list[str]) -> dict[tuple[int, int], str]:
    """Return the texts of the panels of a grid: those of columns above the first row, those of rows beside the last column."""
    last = len(columns) - 1
    return {
        (i, j): " ".join(filter(None, (column if i == 0 else "", row if j == last else "")))
        for i, row in enumerate(rows)
        for j, column in enumerate(columns)
    }


def test_panels_follow_the_order_of_the_values_and_not_that_of_experiments() -> None:
    drawing = made("density")
    turned = replace(drawing, axes=(SIZE, Axis("noise", ("windy", "calm"))))
    found = titles(turned)
    assert found == grid(["size = 1", "size = 2", "size = 4"], ["noise = windy", "noise = calm"])


def test_a_panel_shows_the_data_of_its_title() -> None:
    drawing = made("trajectories", facet="noise")
    calm, size = (list(axis.values).index(value) for axis, value in ((NOISE, "calm"), (SIZE, 4)))
    (only,) = [plot for plot in panels(drawing) if plot.get_subplotspec() == plot.get_gridspec()[size, calm]]
    assert min(float(np.min(line.get_xdata())) for line in only.lines) == 40.0


def test_experiments_that_are_missing_leave_a_place_free() -> None:
    drawing = made("density", facet="noise")
    cells = drawing.rows["cells"]
    lacking = replace(drawing, rows={**drawing.rows, "cells": cells.filter(cells.column("experiment").to_numpy() != 2)})
    assert titles(lacking) == {
        (0, 0): "noise = calm",
        (0, 1): "noise = windy size = 1",
        (1, 1): "size = 2",
        (2, 0): "",
        (2, 1): "size = 4",
    }


def test_a_heat_map_has_a_panel_for_each_value_of_a_third_variable() -> None:
    drawing = Trial("heatmap", {"facet": "side"}, row, (SIZE, NOISE, Axis("side", (1, 2, 3)))).drawing()
    plots = panels(drawing)
    maps = [plot.collections[0].get_array() for plot in plots]
    expected = [10.0 * (6 * size + 3 * noise + side) + 7 + 2.5 for side in range(3) for noise in range(2) for size in range(3)]
    assert np.ravel(maps).tolist() == pytest.approx(expected)
    assert len({(plot.collections[0].norm.vmin, plot.collections[0].norm.vmax) for plot in plots}) == 1


def test_matrices_at_several_times_have_a_column_for_each_time() -> None:
    drawing = made("matrix", (SIZE,), at=[0, 3.0, 99])
    assert (titles(drawing)[0, 1], titles(drawing)[1, 1]) == ("time = 3 size = 1", "size = 2")
    assert np.nanmax(panels(drawing)[3].collections[0].get_array()) == 10 + 3 + 2.5
    assert noted(drawing).note == "mean of the runs, at 0, 3, 99, n = 6; 1 of 3 times without a row"


def test_too_many_panels_are_one_line_that_says_what_to_do() -> None:
    drawing = Trial("density", {"column": ("energy", "distance")}, row, (Axis("size", tuple(range(40))),)).drawing()
    with pytest.raises(Exception, match=r"^the figure needs 40 panels, but at most 36 are possible; choose some with where"):
        panels(drawing)
