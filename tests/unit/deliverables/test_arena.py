"""Densities and matrices have the numbers that NumPy computes from the same rows."""

from __future__ import annotations

import numpy as np
import pytest

from sierra.deliverables.figures.base import kind_of
from sierra.model import Axis
from sierra.testing.figures import ROWS, Row, Trial

SIZE = (Axis("size", (1, 2)),)


def wave(experiment: int, run: int, row: int) -> Row:
    return {"x": 3 * np.cos(row + run) + experiment, "y": 2 * np.sin(2 * row + run)}


def test_a_density_has_the_counts_of_numpy() -> None:
    cells = Trial("density", {"column": ("x", "y"), "bins": 5}, wave, SIZE).drawing().rows["cells"]
    points = [wave(e, run, row) for e in range(2) for run in range(6) for row in range(ROWS)]
    x, y = (np.array([point[name] for point in points], dtype=float) for name in "xy")
    cell = np.ptp(x) / 5
    edges = x.min() + np.arange(6) * cell, y.min() + np.arange(np.ceil(np.ptp(y) / cell) + 1) * cell
    edges[0][-1] = x.max()
    expected, *_ = np.histogram2d(x, y, edges)
    found = np.zeros_like(expected)
    for row in cells.to_pylist():
        found[row["i"], row["j"]] += row["count"]
    assert found.tolist() == expected.tolist()


@pytest.mark.parametrize(
    ("keys", "expected"), [({}, 13.0), ({"run": 2}, 23.0), ({"at": 3.0}, 13.0), ({"at": 3.0, "run": 0}, 3.0)]
)
def test_a_matrix_is_the_mean_over_time_and_runs_or_that_of_one_run_or_time(keys: Row, expected: float) -> None:
    def cell(experiment: int, run: int, row: int) -> Row:
        return {"i": 0.0, "j": float(row % 2), "heat": 10.0 * run + 3}

    drawing = Trial("matrix", {"column": ("i", "j", "heat"), **keys}, cell, ()).drawing(runs=lambda experiment: 3)
    assert drawing.rows["cells"].column("value").to_pylist() == pytest.approx([expected] * (1 if "at" in keys else 2))


def test_long_paths_are_thinned_by_a_rule_that_the_small_print_states(monkeypatch: pytest.MonkeyPatch) -> None:
    from sierra.deliverables.figures.drawing import noted
    from sierra.deliverables.figures.kinds import arena

    monkeypatch.setattr(arena, "MOST", 5)
    drawing = Trial("trajectories", {"column": ("x", "y")}, wave, SIZE).drawing()
    assert drawing.rows["paths"].column("t").to_pylist() == [0.0, 4.0, 7.0] * 2
    assert "each 4th point and the last" in noted(drawing).note


def test_a_matrix_over_x_and_y_has_y_upwards() -> None:
    def cell(experiment: int, run: int, row: int) -> Row:
        return {"x": float(row % 3), "y": float(row // 3), "heat": float(row)}

    drawing = Trial("matrix", {"column": ("x", "y", "heat"), "axes": "xy"}, cell, ()).drawing()
    plot, _ = kind_of(drawing.figure).draw(drawing).axes
    [mesh] = plot.collections
    low, high = plot.get_ylim()
    assert (plot.get_xlabel(), plot.get_ylabel(), low < high) == ("x", "y", True)
    assert mesh.get_array().filled(-1).tolist() == [[0, 1, 2], [3, 4, 5], [6, 7, -1]]
