"""Networks have the edges and positions of the data, and refuse what is no network."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from sierra.deliverables.figures import node_layout
from sierra.deliverables.figures.base import kind_of
from sierra.deliverables.figures.drawing import Drawing, noted
from sierra.errors import UsageError
from sierra.extensions.figures import network_drawing
from sierra.testing.figures import Row, Trial
from tests.drawings import refusal


def linked(*columns: str, **keys: object) -> Drawing:
    """Return the drawing of three runs, whose edges a-b and b-a are one; b-c is in run 0 only, and d has no edge."""

    def row(experiment: int, run: int, row: int) -> Row:
        source, target, weight = [("a", "b", 1.0), ("b", "a", 3.0), ("b", "c", 6.0), ("c", None, None), ("d", None, None)][
            row % 5
        ]
        if target == "c" and run:
            target = None
        return {"from": source, "to": target, "w": weight, "x": float("abcd".index(source)), "y": float(run)}

    return Trial("network", {"column": ("from", "to", *columns), **keys}, row, ()).drawing(runs=lambda experiment: 3)


@pytest.mark.integration
def test_edges_have_their_mean_weight_over_the_runs() -> None:
    edges = [tuple(edge.values())[1:] for edge in linked("w").rows["edges"].to_pylist()]
    assert edges == [("a", "b", 2.0), ("b", "c", 2.0)]
    parts = {edge["target"]: edge["weight"] for edge in linked().rows["edges"].to_pylist()}
    assert parts == {"b": 1.0, "c": pytest.approx(1 / 3)}
    assert len(linked(directed=True).rows["edges"]) == 3
    assert "hollow: no edge" in noted(linked()).note
    assert [edge["target"] for edge in linked(run=1).rows["edges"].to_pylist()] == ["b"]
    assert linked(at=2.0, run=0).rows["edges"].num_rows == 1


@pytest.mark.integration
def test_positions_come_from_the_data_or_from_a_layout_that_is_always_the_same() -> None:
    drawing = linked(place=["x", "y"])
    assert {row["node"]: (row["x"], row["y"]) for row in drawing.rows["nodes"].to_pylist()} == {
        name: (float(place), 1.0) for place, name in enumerate("abcd")
    }
    nodes, edges = (drawing.rows[name] for name in ("nodes", "edges"))
    for layout in ("spring", "kamada_kawai", "circular"):
        first = network_drawing._layout(edges, nodes, layout)
        assert first == network_drawing._layout(edges.slice(0).take([1, 0]), nodes.take([3, 2, 1, 0]), layout)


def looking(**keys: object) -> Trial:
    """Return a figure of three nodes: a has the areas 1 and 3, b 8, c none; the edge a-b the colours 1, 1 and 4, b-c none."""

    def row(experiment: int, run: int, row: int) -> Row:
        source, target, area, colour = [
            ("a", "b", 1.0, 1.0),
            ("a", "b", 3.0, 1.0),
            ("b", "a", 8.0, 4.0),
            ("c", "b", None, None),
        ][row % 4]
        return {"from": source, "to": target, "area": area, "delay": colour, "name": f"robot {source}"}

    looks = {"node_size": "area", "edge_color": "delay", "node_label": "name"}
    return Trial("network", {"column": ("from", "to"), **looks, **keys}, row, ())


@pytest.mark.parametrize(("directed", "colours"), [(False, {2.0}), (True, {1.0, 4.0})])
def test_areas_colours_and_texts_are_those_of_the_data(directed: bool, colours: set[float]) -> None:
    trial = looking(directed=directed)
    drawing = trial.drawing()
    assert {row["node"]: row["value"] for row in drawing.rows["size"].to_pylist()} == {"a": 2.0, "b": 8.0}
    assert {row["value"] for row in drawing.rows["colour"].to_pylist()} == colours
    note = noted(drawing).note
    assert "area: mean area, at most 8; 1 without a value are dots" in note
    assert "grey: 1 of " in note
    plot, bar = kind_of(drawing.figure).draw(drawing).axes
    assert bar.get_ylabel() == "delay"
    assert {text.get_text() for text in plot.texts if text.get_text()} == {"robot a", "robot b", "robot c"}
    sizes = {round(line.get_markersize(), 3) for line in plot.lines}
    assert sizes == {10.0, 5.0, 1.0}, "the area of b is four times that of a"


def test_an_area_below_0_is_refused() -> None:
    def below(experiment: int, run: int, row: int) -> Row:
        return {"from": "a", "to": "b", "area": -1.0}

    drawing = Trial("network", {"column": ("from", "to"), "node_size": "area"}, below, ()).drawing()
    assert "node_size: the area of a mark cannot be below 0, but a node has -1" in refusal(drawing)


@pytest.mark.integration
def test_parts_of_a_network_without_edges_between_them_do_not_collapse() -> None:
    """Nodes are apart by a good part of the distance that they would have on a grid."""
    rings = [(f"{ring}-{node}", f"{ring}-{(node + 1) % 5}") for ring in range(4) for node in range(5)]
    places = np.array(list(node_layout.layout([*(end for edge in rings for end in edge), "alone"], rings, "spring").values()))
    apart = np.linalg.norm(places[:, None] - places, axis=2)[~np.eye(len(places), dtype=bool)]
    assert (len(places), np.abs(places).max() <= 1, apart.min() > 0.2) == (21, True, True)


def test_networks_without_edges_positions_times_or_networkx_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "no row is what the keys of the figure ask for" in refusal(linked(at=99))

    def star(experiment: int, run: int, row: int) -> Row:
        return {"from": "a", "to": f"b{row}", "x": 0.0, "y": 0.0}

    lost = Trial("network", {"column": ("from", "to"), "place": ["x", "y"]}, star, ()).drawing()
    assert "8 of 9 nodes have no position: b0, b1, b2 and 5 more; a node needs a row" in refusal(lost)
    with pytest.raises(UsageError, match="there is no column 'z'"):
        linked(place=["x", "z"])
    monkeypatch.setattr(network_drawing, "NODES", 3)
    assert "a network of 4 nodes cannot be read; at most 3 are possible" in refusal(linked())
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "networkx", None)
    assert refusal(linked()) == "networkx is not installed; pip install 'sierra-experiments[figures]'"
