"""Videos of networks have the edges of each time, with nodes that keep their places."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sierra
from sierra.config.project_file import load
from sierra.deliverables.gallery import Gallery
from sierra.extensions.videos.painting.network_painter import NetworkPainter
from sierra.extensions.videos.painting.scene import Scene, Words, settings
from sierra.extensions.videos.prepare import Prepared, prepare
from sierra.extensions.videos.table import Video
from sierra.store.batch_data import BatchData
from tests import projects, stores
from tests.extensions.videos import video_files

SIMULATOR = """\
ROWS = (
    (0, "n2", "n10", 2, 1, 5, 7), (0, "n10", "n2", 4, 9, 5, 3), (0, "n1", "", "", 5, 1, 1), (0, "n1", "n1", 1, 5, 1, 1),
    (1, "n2", "n1", 8, 2, 5, 7), (1, "n1", "", "", 5, 1, 2), (1, "n10", "n2", "nan", 9, 5, 3),
    (2, "n1", "n10", 1, 5, 1, 2),
)
with open("links.csv", "w") as file:
    print("tick,from,to,weight,x,y,energy", file=file)
    for row in ROWS:
        print(*row, sep=",", file=file)
"""
CONFIG = (
    projects.CONFIG.replace("runs = 2", 'runs = 1\nobserve = "none"') + '[outputs.links]\nfile = "links.csv"\ntime = "tick"\n'
)
EDGES = {"kind": "network", "table": "links", "column": ["from", "to", "weight"]}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = projects.make(tmp_path_factory.mktemp("networks") / "p", CONFIG, simulator=SIMULATOR)
    stores.ask(made, "population_size=1")
    return made


def states(root: Path, **keys: Any) -> tuple[Prepared, list[Any], NetworkPainter]:
    """Return a video, the states of its only run, and two of its painters, which are the same."""
    project, opened = load(root), sierra.open(root)
    with BatchData(opened.store, opened.records.batch()) as frame:
        video = Video.model_validate(EDGES | keys)
        made = prepare("film", video, {"": Gallery(project, opened.store, frame)})
        (one,) = made.films
        painter, again = (one.subject.painter(one.film, made.whole, one.subject.tracks) for _ in range(2))
        assert isinstance(painter, NetworkPainter)
        assert isinstance(again, NetworkPainter)
        assert painter.look == again.look, "a layout is the same each time"
        return made, list(one.subject.tracks[0].states()), painter


def edges(state: Any) -> list[tuple[float, ...]]:
    return [tuple(row) for row in state[1].tolist()]


@pytest.mark.integration
def test_edges_have_the_mean_weight_of_both_directions(root: Path) -> None:
    made, (first, second, third), _ = states(root)
    assert made.films[0].subject.layout == {"nodes": ["n1", "n2", "n10"]}
    assert (edges(first), edges(second), edges(third)) == ([(1, 2, 3)], [(0, 1, 8)], [(0, 2, 1)])
    assert "video film: 1 edge from a node to itself left out" in made.notes
    assert "video film: 1 edge without a finite weight left out" in made.notes
    _, (first, *_), _ = states(root, directed=True)
    assert edges(first) == [(1, 2, 2), (2, 1, 4)]
    _, (first, second, _), painter = states(root, column=["from", "to"])
    assert (edges(first), edges(second)) == ([(1, 2, 1)], [(0, 1, 1), (1, 2, 1)])
    assert painter.look.widest == 0


@pytest.mark.integration
def test_nodes_have_the_places_and_values_of_their_rows(root: Path) -> None:
    keys = {"place": ["x", "y"], "node_value": "energy"}
    _, (first, *_), painter = states(root, **keys, sql="FROM links WHERE tick < 2", table="")
    np.testing.assert_array_equal(first[0], [[5, 1, 1, 0], [1, 5, 7, 1], [9, 5, 3, 2]])
    assert painter.look.limits == (pytest.approx((0.6, 9.4)), pytest.approx((0.8, 5.2)))
    assert painter.look.widest == 8
    assert painter.look.scale is not None
    assert (painter.look.scale.low, painter.look.scale.high) == (1, 7)
    with pytest.raises(
        sierra.SierraError, match="at tick 2: node 'n10' has an edge but no position; it needs a row as a source"
    ):
        states(root, place=["x", "y"])
    with pytest.raises(sierra.SierraError, match="has no numeric column 'to'"):
        states(root, node_value="to")


@pytest.mark.integration
@pytest.mark.parametrize("layout", ["spring", "circular"])
def test_nodes_keep_their_places_and_edges_are_between_them(root: Path, layout: str) -> None:
    _, found, painter = states(root, layout=layout)
    look = painter.look
    with settings():
        scene = Scene((400, 300), Words("", [""], ""), painter)
        frames = [scene.frame("", [state]).astype(int) for state in found]
    (box,) = scene.boxes()
    assert look.places is not None
    places = np.array([look.places[name] for name in ("n1", "n2", "n10")])
    size = np.array([box.right - box.left, box.bottom - box.top])
    pixels = (places + 1.25) / 2.5 * size
    for frame, (start, stop) in zip(frames, ((1, 2), (0, 1), (0, 2)), strict=True):
        inside = frame[box.pixels]

        def dark(one: int, other: int, inside: Any = inside) -> bool:
            x, y = pixels[one] + 0.4 * (pixels[other] - pixels[one])
            return bool(inside[int(size[1] - y) - 2 : int(size[1] - y) + 3, int(x) - 2 : int(x) + 3].min() < 170)

        drawn = {pair for pair in ((0, 1), (0, 2), (1, 2)) if dark(*pair)}
        assert drawn == {(start, stop)}
        blue = [inside[int(size[1] - y), int(x)] for x, y in pixels[[start, stop]]]
        assert all(colour[2] - colour[0] > 100 for colour in blue), "nodes with an edge are filled"
        lonely = pixels[3 - start - stop]
        assert inside[int(size[1] - lonely[1]), int(lonely[0])].min() > 200, "a node without an edge is hollow"


@pytest.mark.integration
def test_networks_are_made_by_the_command_and_side_by_side(root: Path) -> None:
    keys = "".join(f"{key} = {json.dumps(value)}\n" for key, value in EDGES.items())
    (root / "sierra.toml").write_text(f'{CONFIG}[videos.net]\n{keys}size = [200, 160]\nshow = "tiles"\n')
    done = projects.quick(root, "video", "--json")
    assert done.returncode == 0, done.stderr
    (path,) = map(Path, json.loads(done.stdout)["files"])
    assert len(video_files.decoded(path)) == 3
    assert "net: follows from the store" in projects.quick(root, "figures", "--check").stdout


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"column": ["a"]}, "kind 'network' needs 2 to 3 columns, not 1"),
        ({"place": ["x"]}, '"place" should name the two columns of x and y'),
        ({"palette": "magma"}, 'of a network need "node_value"'),
        ({"xlim": [0, 1]}, 'of a network need "place"'),
        ({"show": "mean"}, 'show = "mean" needs numbers'),
        ({"kind": "matrix", "directed": True}, "\"directed\" needs kind 'network', not 'matrix'"),
        ({"kind": "pictures", "table": "", "column": []}, "kind 'pictures' needs \"table\""),
    ],
)
def test_keys_that_do_not_fit_are_refused(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        Video.model_validate(EDGES | keys)
    assert message in str(caught.value)
