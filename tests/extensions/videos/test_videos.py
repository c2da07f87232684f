"""Videos of recorded matrices show the recorded values, at their times, with the number of runs behind them."""

from __future__ import annotations

import json
import os
import re
import subprocess
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import sierra
from sierra.config.project_file import load, parse
from sierra.deliverables import default_figures
from sierra.deliverables.gallery import Gallery
from sierra.extensions.videos import draw
from sierra.extensions.videos.painting.pose_painter import PosePainter
from sierra.extensions.videos.painting.scene import MatrixPainter, Scale, Scene, Words, settings
from sierra.extensions.videos.prepare import Prepared, prepare, small_print
from sierra.extensions.videos.sql_tracks import completed
from sierra.extensions.videos.table import Video
from sierra.store.batch_data import BatchData
from tests import projects, stores
from tests.extensions.videos import video_files

SIMULATOR = """\
import sys

arena = open(sys.argv[1]).read()
count = int(arena.split('<swarm count="')[1].split('"')[0])
seed = int(arena.split('<random seed="')[1].split('"')[0])
number = int(arena.split('run="')[1].split('"')[0])
TICKS = (0, 1, 2, 4) if count == 3 else (0, 1, 2, 3)

def heat(tick, i, j):
    return 10 * count * (number + 1) + tick + 0.1 * i + 0.01 * j

with open("floor.csv", "w") as file:
    print("tick,i,j,heat", file=file)
    for tick in TICKS:
        for i in range(2):
            for j in range(3):
                if not (count == 4 and tick == 2 and i == 1):
                    print(tick, i, j, heat(tick, i, j), sep=",", file=file)
for tick in TICKS:
    with open(f"grid-{tick}.csv", "w") as file:
        print("a,b,c", file=file)
        for i in range(1 if count == 4 and tick == 2 else 2):
            print(*(heat(tick, i, j) for j in range(3)), sep=",", file=file)
with open("poses.csv", "w") as file:
    print("tick,robot,x,y,heading", file=file)
    for tick in TICKS:
        print(tick, "a", 1 + tick, 1, 0, sep=",", file=file)
        print(tick, "b" if count < 4 else "a", 1, 4, 1.5707963, sep=",", file=file)
if count == 2 and number == 1:
    sys.exit(3)
"""
TEMPLATE = projects.TEMPLATE.replace("<arena ", '<arena run="0" ')
CONFIG = """\
template = "arena.xml"
command = "python3 sim.py {input}"
seed = "//random/@seed"
runs = 2
observe = "none"
run_changes = [{ set = "/arena/@run", value = "{run}" }]
[variables]
population_size = "//swarm/@count"
[outputs.floor]
file = "floor.csv"
time = "tick"
ticks_per_second = 10
units = { heat = "K" }
[outputs.poses]
file = "poses.csv"
time = "tick"
units = { x = "m", y = "m" }
[outputs.grid]
file = "grid-{tick}.csv"
time = "tick"
"""
CELLS = {"table": "floor", "column": ["i", "j", "heat"], "formats": ["mp4"]}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a project with a batch: the population 2 has a failed run, 3 lacks the tick 3, 4 lacks cells at tick 2."""
    made = projects.make(tmp_path_factory.mktemp("videos") / "p", CONFIG, simulator=SIMULATOR, template=TEMPLATE)
    stores.ask(made, "population_size=1,2,3,4")
    return made


def prepared(root: Path, **keys: Any) -> Prepared:
    project = load(root)
    opened = sierra.open(root)
    with BatchData(opened.store, opened.records.batch()) as frame:
        video = Video.model_validate(CELLS | keys)
        return prepare("film", video, {"": Gallery(project, opened.store, frame)})


def write(root: Path, text: str) -> None:
    (root / "sierra.toml").write_text(CONFIG + text)


@pytest.mark.integration
def test_a_video_shows_the_matrix_of_each_time_by_its_colours(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("PIL.Image.Image.save", None)  # frames do not become files
    monkeypatch.setattr("matplotlib.backends.backend_agg.FigureCanvasAgg.print_png", None)
    write(
        root,
        '[videos.heat]\ntable = "floor"\ncolumn = ["i", "j", "heat"]\nexperiments = "population_size=1"\nlimits = [10, 14]\n'
        'title = "a <b> $x$"\nsize = [321, 241]\n'
        '[videos.grid]\nkind = "grid"\ntable = "grid"\nexperiments = "population_size=1"\nsize = [160, 160]\n',
    )
    done = projects.quick(root, "video", "--json")
    assert done.returncode == 0, done.stderr
    heat, grid = map(Path, json.loads(done.stdout)["files"])
    assert (heat.name, grid.name) == ("heat-population_size=1.mp4", "grid-population_size=1.mp4")
    frames = video_files.decoded(heat)
    assert [frame.shape for frame in frames] == [(242, 322, 3)] * 4
    for tick, frame in enumerate(frames):
        assert video_files.part(frame[110, 150]) == pytest.approx((tick + 0.05) / 4, abs=0.04)
    assert len(video_files.decoded(grid)) == 4
    before = heat.read_bytes(), grid.read_bytes()
    assert projects.quick(root, "video", "-j", "2").returncode == 0
    assert (heat.read_bytes(), grid.read_bytes()) == before, "the same store gives the same bytes"
    rows = projects.sql(root, "SELECT name, kind, sql, files FROM deliverables ORDER BY name")
    assert [(row["name"], row["kind"]) for row in rows] == [("grid", "video"), ("heat", "video")]
    found = projects.sql(root, rows[1]["sql"])
    assert [row["heat"] for row in found[:6]] == pytest.approx([10, 10.01, 10.02, 10.1, 10.11, 10.12])
    assert len(found) == 24
    assert "heat: follows from the store" in projects.quick(root, "figures", "--check").stdout
    config = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text(config.replace("limits = [10, 14]", "limits = [10, 15]"))
    said = projects.quick(root, "figures", "--check").stdout
    assert "heat: sierra.toml changes how it is made: it has another limits" in said
    (root / "sierra.toml").write_text(config)
    heat.write_bytes(before[0][:-1])
    changed = projects.quick(root, "figures", "--check")
    assert (changed.returncode, "is not the file that SIERRA made" in changed.stdout) == (1, True)


@pytest.mark.nightly
def test_a_check_names_each_format_of_a_video_once(root: Path) -> None:
    for format_ in ("mp4", "gif"):
        write(
            root,
            f'[videos.heat]\ntable = "floor"\ncolumn = ["i", "j", "heat"]\nsize = [160, 160]\nformats = ["{format_}"]\n'
            'experiments = "population_size<=2"\n',
        )
        done = projects.quick(root, "video", "--json")
        assert done.returncode == 0, done.stderr
        assert len(json.loads(done.stdout)["files"]) == 2
    said = projects.quick(root, "figures", "--check").stdout
    assert [line.split(":")[0] for line in said.splitlines()] == ["heat (gif)", "heat (mp4)"]


@pytest.mark.integration
def test_the_mean_has_only_good_runs_and_says_how_many(root: Path) -> None:
    made = prepared(root, show="mean", experiments="population_size<=2")
    one, two = made.films
    assert (made.whole.values.low, made.whole.values.high) == pytest.approx((15, 23.12))
    assert one.found.values.low == pytest.approx(15), "the mean of 10 and 20"
    assert two.found.values.low == pytest.approx(20), "the second run has failed"
    assert two.film.notes == ("mean over 1 of 2 runs", "without a result: run 1")
    assert "video film-population_size=2: without a result: run 1" in made.notes
    assert "n = " not in draw._count(two.film, [(1,)]), "a single run is no mean"


def test_a_run_without_a_result_is_reported_and_not_replaced(root: Path) -> None:
    made = prepared(root, run=1, experiments="population_size<=2")
    assert [one.film.name for one in made.films] == ["film-population_size=1"]
    assert "video film-population_size=2: run 1 has no successful execution, so there is nothing to show" in made.notes


def test_a_run_without_rows_is_noted_beside_the_mean(root: Path) -> None:
    keys = {"table": "", "sql": "SELECT run, tick, i, j, heat FROM floor WHERE heat < 20 OR population_size > 1"}
    (film,) = prepared(root, show="mean", experiments="population_size=1", **keys).films
    assert film.film.notes == ("mean over 2 runs",)
    assert film.subject.left_out() == ["without a row: run 1 of experiment 0"]


def test_a_difference_is_a_minus_b_with_zero_in_the_middle(root: Path) -> None:
    made = prepared(root, show="difference", groups=["population_size=1", "population_size=2"])
    (film,) = made.films
    assert [panel.label for panel in film.film.panels] == ["A: population size = 1", "B: population size = 2", "A − B"]
    assert (film.found.differences.low, film.found.differences.high) == pytest.approx((-5, -5))
    painter = film.subject.painter(film.film, made.whole, film.subject.tracks)
    assert isinstance(painter, MatrixPainter)
    values, differences = painter.scales
    assert (values.low, values.high) == pytest.approx((15, 23.12))
    assert (differences.low, differences.high) == pytest.approx((-5, 5))
    assert (values.panels, differences.panels) == ((0, 1), (2,))


def images(root: Path, **keys: Any) -> tuple[Prepared, Scene, list[Any]]:
    """Return a video, the scene of its first film, and the frames."""
    project, opened = load(root), sierra.open(root)
    with BatchData(opened.store, opened.records.batch()) as frame, settings():
        made = prepare("film", Video.model_validate(CELLS | keys), {"": Gallery(project, opened.store, frame)})
        one = made.films[0]
        words = Words(one.film.title, [panel.label for panel in one.film.panels], "; ".join(small_print(made, one)))
        painter = one.subject.painter(one.film, made.whole, one.subject.tracks)
        return made, Scene(made.video.size, words, painter), list(draw.frames(made, one))


def cell(scene: Scene, image: Any, panel: int, i: int, j: int) -> Any:
    """Return the colour in the middle of a cell of a matrix of 2 × 3 cells."""
    box = scene.boxes()[panel]
    high, wide = box.bottom - box.top, box.right - box.left
    return image[box.top + int((i + 0.5) * high / 2), box.left + int((j + 0.5) * wide / 3)]


def test_the_frame_of_a_mean_has_the_colours_of_the_mean(root: Path) -> None:
    _, scene, shown = images(root, show="mean", experiments="population_size=1", limits=[10, 20])
    for (i, j), tick in (((0, 0), 0), ((1, 2), 3)):
        mean = 15 + tick + 0.1 * i + 0.01 * j
        assert video_files.part(cell(scene, shown[tick], 0, i, j)) == pytest.approx((mean - 10) / 10, abs=0.01)


@pytest.mark.integration
def test_the_frame_of_a_difference_has_the_colour_of_a_minus_b(root: Path) -> None:
    wide = {"show": "difference", "size": [640, 240]}
    _, scene, shown = images(root, groups=["population_size=2", "population_size=1"], run=0, limits=[0, 40], **wide)
    for panel, value in ((0, 20.11), (1, 10.11)):
        assert video_files.part(cell(scene, shown[0], panel, 1, 1)) == pytest.approx(value / 40, abs=0.01)
    assert video_files.part(cell(scene, shown[0], 2, 1, 1), "coolwarm") == pytest.approx(1, abs=0.01), "A − B is 10 everywhere"
    _, scene, shown = images(root, groups=["population_size=1", "population_size=2"], **wide)
    assert video_files.part(cell(scene, shown[0], 2, 1, 1), "coolwarm") == pytest.approx(0, abs=0.01), "A − B is -5 everywhere"


@pytest.mark.integration
def test_a_frame_has_axes_the_time_and_a_bar_with_both_ends_and_a_label(root: Path) -> None:
    keys = {"experiments": "population_size=1"}
    made, scene, (first, second, *_) = images(root, **keys)
    (box,) = scene.boxes()
    beside = first[box.top : box.bottom, box.right + 4 :].reshape(-1, 3).astype(int)
    for end in ((68, 1, 84), (253, 231, 36)):
        assert np.abs(beside - end).sum(axis=1).min() < 12, "the bar has the colours of both ends"
    assert first[box.bottom + 4 : box.bottom + 40, box.left : box.right].min() < 120, "numbers and the name of columns"
    assert first[box.top : box.bottom, : box.left - 4].min() < 120, "numbers and the name of rows"
    changed = (first != second).any(axis=2)
    changed[box.pixels] = False
    rows, columns = np.nonzero(changed)
    assert len(rows), "the time has changed"
    assert (rows.min() > box.bottom, columns.max() < box.left + 100) == (True, True)
    one = made.films[0]
    painter = one.subject.painter(one.film, made.whole, one.subject.tracks)
    assert isinstance(painter, MatrixPainter)
    assert [scale.label for scale in painter.scales] == ["heat [K]"]
    _, _, (other, *_) = images(root, label="hot", **keys)
    differing = np.argwhere((first != other).any(axis=2))
    assert len(differing), "the label is in the frame"
    assert differing[:, 1].min() > box.right, "beside the bar"


def inked(places: Mapping[str, str], rows: slice) -> tuple[int, Any]:
    """Return how wide the text in some rows of a frame is, and the frame. `places`: a text in its title, notes, …"""
    with settings():
        scale = Scale(0, 1, "viridis", places.get("label", ""), (0,))
        painter = MatrixPainter(np.arange(1.0), np.arange(1.0), ("i", "j"), [scale])
        scene = Scene((400, 300), Words(places.get("title", ""), [places.get("panel", "")], places.get("notes", "")), painter)
        image = scene.frame(places.get("time", ""), [None])
    found = np.flatnonzero((image[rows] < 170).any(axis=(0, 2)))
    return int(found[-1] - found[0]), image


@pytest.mark.integration
@pytest.mark.parametrize(
    ("place", "rows"),
    [("title", slice(0, 16)), ("panel", slice(0, 15)), ("notes", slice(-12, None)), ("time", slice(-22, None))],
)
def test_texts_of_others_are_shown_literally_in_frames(place: str, rows: slice) -> None:
    """In the font, $ is as wide as S; if it began mathematics, it would not be shown. Characters that control are escapes."""
    for text in ("a <b> $x$", r"$\frac{$", "$$ and $$", r"\$5 $a_1$"):
        assert inked({place: text}, rows)[0] == pytest.approx(inked({place: text.replace("$", "S")}, rows)[0], abs=3), text
    for text, shown in {} if place == "time" else {"a\nb": "a b", "a\u202eb": r"a\u202eb"}.items():
        assert (inked({place: text}, rows)[1] == inked({place: shown}, rows)[1]).all()


@pytest.mark.integration
def test_uneven_times_are_noted_and_a_step_makes_them_even(root: Path) -> None:
    made = prepared(root, experiments="population_size=3")
    assert made.films[0].times.tolist() == pytest.approx([0, 0.1, 0.2, 0.4])
    assert "times are uneven: 0.1 to 0.2 between frames (step makes them even)" in made.notes[0]
    made = prepared(root, experiments="population_size=3", step=0.1)
    assert made.films[0].times.tolist() == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    tiles = prepared(root, experiments="population_size=3", show="tiles")
    assert [panel.label for panel in tiles.films[0].film.panels] == ["run 0", "run 1"]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "output 'floor', run 0 of experiment 3 at tick 2: 3 of 2 × 3 cells have no row (set fill"),
        ({"kind": "grid", "table": "grid", "column": []}, "at tick 2: a matrix of 1 rows, but the first one has 2"),
        ({"column": ["i", "i", "heat"]}, "3 rows for the cell i 0, i 0; make one by sql"),
        ({"column": ["i", "j", "none"]}, "output 'floor' has no numeric column 'none'"),
        ({"experiments": "population_size=9"}, "does not vary it so"),
        ({"table": "flor"}, "this batch has no output 'flor'"),
        ({"sql": "SELECT run, i, j, heat FROM floor", "table": ""}, "has no time column"),
    ],
)
def test_what_cannot_be_shown_is_an_error_in_one_line(root: Path, keys: dict[str, Any], message: str) -> None:
    with pytest.raises(sierra.SierraError) as caught:
        prepared(root, **{"experiments": "population_size=4", **keys})
    if "population_size=9" not in str(keys):
        assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_values_too_large_for_a_scale_are_refused(root: Path) -> None:
    keys = {"table": "", "sql": "SELECT run, tick, i, j, heat * 1e306 AS heat FROM floor"}
    with pytest.raises(sierra.SierraError, match=r"e\+307 is too large to be drawn; let runs write it in a larger unit"):
        images(root, experiments="population_size=1", **keys)


def test_cells_without_a_row_have_the_value_of_fill(root: Path) -> None:
    made = prepared(root, experiments="population_size=4", fill=0)
    assert (made.whole.values.low, made.whole.empty) == (0, 0)
    assert "cells without a row count as 0" in small_print(made, made.films[0])


@pytest.mark.integration
def test_rows_without_any_value_are_not_cut_out(root: Path) -> None:
    apart = {"table": "", "sql": "SELECT run, tick, i, CASE j WHEN 2 THEN 6 ELSE j END AS j, heat FROM floor"}
    keys = {"experiments": "population_size=1", **apart}
    even = prepared(root, fill=0, **keys)
    assert even.films[0].subject.layout["j"] == [0, 1, 2, 3, 4, 5, 6]
    (uneven,) = prepared(root, **keys).films
    assert uneven.subject.layout["j"] == [0, 1, 6]
    assert "numbers of j are uneven: 1 to 5 between neighbours" in uneven.subject.notes(uneven.found)
    assert completed(np.array([-4.0, 0.0, 6.0]), "i").tolist() == [-4, -2, 0, 2, 4, 6]
    assert completed(np.array([0.1, 0.2, 0.9]), "i").tolist() == [0.1, 0.2, 0.9]
    with pytest.raises(sierra.SierraError, match=r"i: 1000001 numbers from 0 to 1e\+06 are too many cells"):
        completed(np.array([0, 1, 1e6]), "i")


@pytest.mark.integration
def test_a_wrong_video_does_not_prevent_the_others(root: Path) -> None:
    write(
        root,
        '[videos.bad]\ntable = "floor"\ncolumn = ["i", "j", "none"]\n'
        '[videos.good]\ntable = "floor"\ncolumn = ["i", "j", "heat"]\nexperiments = "population_size=1"\nsize = [160, 160]\n',
    )
    done = projects.quick(root, "video")
    assert (done.returncode, done.stdout.count("\n")) == (1, 1), done.stderr
    assert "note: video bad: output 'floor' has no numeric column 'none'" in done.stderr
    named = projects.quick(root, "video", "bad")
    assert (named.returncode, named.stderr.startswith("sierra: video bad: ")) == (2, True), named.stderr
    assert "there is no [videos.god]" in projects.quick(root, "video", "god").stderr


@pytest.mark.each_case
@pytest.mark.parametrize(
    ("keys", "made", "note"),
    [
        ('column = ["i", "j", "none"]\n', 0, "video heat: output 'floor' has no numeric column 'none'"),
        (
            'column = ["i", "j", "heat"]\nrun = 7\n',
            0,
            "video heat: video heat-population_size=1: run 7 has no successful execution",
        ),
        (
            'column = ["i", "j", "heat"]\nrun = 1\nexperiments = "population_size<=2"\n',
            1,
            "video heat-population_size=2: run 1 has no successful execution, so there is nothing to show",
        ),
    ],
)
def test_scripts_learn_that_a_file_could_not_be_made(root: Path, keys: str, made: int, note: str) -> None:
    write(root, f'[videos.heat]\ntable = "floor"\nsize = [160, 160]\n{keys}')
    done = projects.quick(root, "video", "--json")
    printed = json.loads(done.stdout)
    assert (done.returncode, len(printed["files"])) == (1, made), done.stderr
    assert note in " ".join(printed["notes"])
    assert note in done.stderr


def test_only_tables_without_a_video_need_a_default_figure(root: Path) -> None:
    write(root, '[videos.heat]\ntable = "floor"\ncolumn = ["i", "j", "heat"]\n')
    opened = sierra.open(root)
    with BatchData(opened.store, opened.records.batch()) as frame:
        _, notes = default_figures.wanted(Gallery(load(root), opened.store, frame), None)
    assert ["'floor'" in " ".join(notes), "'poses'" in " ".join(notes)] == [False, True]


@pytest.mark.integration
def test_png_files_have_a_frame_each_and_their_times_in_their_names(root: Path) -> None:
    keys = 'table = "floor"\ncolumn = ["i", "j", "heat"]\nexperiments = "population_size=1"\nsize = [320, 240]\n'
    write(root, f'[videos.heat]\n{keys}formats = ["png"]\n')
    done = projects.quick(root, "video", "--json")
    assert done.returncode == 0, done.stderr
    files = list(map(Path, json.loads(done.stdout)["files"]))
    assert len(files) > 1
    assert all(path.name.startswith("heat-population_size=1-tick=") for path in files)
    frames = [np.asarray(Image.open(path)) for path in files]
    assert {frame.shape for frame in frames} == {(240, 320, 3)}
    assert not np.array_equal(frames[0], frames[1])
    assert "follows from the store" in projects.quick(root, "show", str(files[0])).stdout


POSES: dict[str, Any] = {"kind": "poses", "table": "poses", "column": ["x", "y", "heading"], "robot": "robot"}


@pytest.mark.integration
def test_robots_are_at_their_places_with_their_headings(root: Path) -> None:
    limits = {"xlim": [0, 6], "ylim": [0, 6]}
    keys = "".join(f"{key} = {json.dumps(value)}\n" for key, value in (POSES | limits).items())
    write(root, f'[videos.paths]\n{keys}experiments = "population_size=1"\nsize = [300, 300]\n')
    done = projects.quick(root, "video", "--json")
    assert done.returncode == 0, done.stderr
    frames = [frame.astype(int) for frame in video_files.decoded(Path(json.loads(done.stdout)["files"][0]))]
    moved = [(frame[..., 2] - frame[..., 0] > 60) & (np.indices(frame.shape[:2])[0] > 120) for frame in frames]
    centers = [np.argwhere(one).mean(axis=0) for one in moved]
    steps = np.diff(centers, axis=0)
    assert np.abs(steps[:, 0]).max() < 2, "robot a moves along x only"
    assert steps[:, 1] == pytest.approx(steps[:, 1].mean(), abs=2)
    assert 25 < steps[:, 1].mean() < 50, "one of six metres in a panel of some 200 pixels"
    with pytest.raises(sierra.SierraError, match="at tick 0: robot 'a' has 2 poses; make one by sql"):
        prepared(root, **POSES, experiments="population_size=4")


def test_poses_share_their_limits_over_all_frames_and_files(root: Path) -> None:
    made = prepared(root, **POSES, experiments="population_size=1,3")
    for one in made.films:
        painter = one.subject.painter(one.film, made.whole, one.subject.tracks)
        assert isinstance(painter, PosePainter)
        assert (*painter.xlim, *painter.ylim) == pytest.approx((0.76, 5.24, 0.76, 4.24))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('column = ["i", "j"]', "kind 'matrix' needs 3 columns, not 2"),
        ('column = ["i", "j", "v"]\nshow = "difference"', 'show = "difference" and two "groups"'),
        (
            'kind = "poses"\ncolumn = ["x", "y"]\nlimits = [0, 1]',
            "\"limits\" needs kind 'matrix' or 'grid' or 'network', not 'trajectories'",
        ),
        ('kind = "poses"\ncolumn = ["x", "y"]\nshow = "mean"', 'show = "mean" needs numbers'),
        ('column = ["i", "j", "v"]\nsize = [9000, 480]', "4096"),
        ('column = ["i", "j", "v"]\nformats = ["gif"]\nfps = 60', "a gif has at most 50 frames per second"),
        ('column = ["i", "j", "v"]\nformats = ["avi"]', "'mp4', 'webm', 'gif' or 'png'"),
    ],
)
def test_keys_that_do_not_fit_are_refused(text: str, message: str) -> None:
    with pytest.raises(sierra.SierraError, match=re.escape(message)):
        parse(tomllib.loads(f"{projects.CONFIG}[videos.a]\n{text}\n"), "sierra.toml")


def test_cells_keep_their_places() -> None:
    values = np.array([[0.0, 1.0, np.nan], [0.25, 0.5, 0.75]])
    with settings():
        painter = MatrixPainter(np.arange(2.0), np.arange(3.0), ("i", "j"), [Scale(0, 1, "viridis", "v", (0,))])
        scene = Scene((400, 300), Words("", [""], ""), painter)
        image, empty = scene.frame("t = 0", [(values,)]), scene.frame("t = 0", [None])
    (box,) = scene.boxes()
    for (i, j), value in np.ndenumerate(values):
        y = box.top + int((i + 0.5) * (box.bottom - box.top) / 2)
        x = box.left + int((j + 0.5) * (box.right - box.left) / 3)
        if np.isnan(value):
            assert video_files.is_grey(image[y, x])
        else:
            assert video_files.part(image[y, x]) == pytest.approx(value, abs=0.01)
    assert video_files.is_grey(empty[box.top + 5, box.left + 5])


def test_a_matrix_with_more_cells_than_pixels_is_refused_with_a_size_that_fits() -> None:
    def frame(cells: int, size: tuple[int, int]) -> None:
        with settings():
            painter = MatrixPainter(np.arange(1.0 * cells), np.arange(20.0), ("i", "j"), [Scale(0, 1, "viridis", "v", (0,))])
            Scene(size, Words("", [""], ""), painter).frame("t = 0", [(np.zeros((cells, 20)),)])

    frame(200, (400, 300))
    with pytest.raises(sierra.SierraError, match=r"500 × 20 cells do not fit into a panel of \d+ × \d+ pixels") as caught:
        frame(500, (400, 300))
    wide, high = map(int, re.findall(r"size = \[(\d+), (\d+)\]", str(caught.value))[0])
    frame(500, (wide, high))
    with pytest.raises(sierra.SierraError, match="make fewer cells by sql"):
        frame(20_000, (400, 300))


@pytest.mark.integration
@pytest.mark.parametrize(("ending", "value"), [("npz", "heat"), ("npy", "value")])
def test_an_array_of_numpy_becomes_a_video(tmp_path: Path, ending: str, value: str) -> None:
    """Its first dimension is the time."""
    keys = (
        f'file = "cube.{ending}"\nformat = "npy"\ntime = "i"\n[videos.cube]\ntable = "cube"\ncolumn = ["j", "k", "{value}"]\n'
    )
    config = projects.CONFIG.replace("python3 sim.py {input}", f"cp {{project}}/cube.{ending} .")
    root = projects.make(tmp_path / "p", f"{config}[outputs.cube]\n{keys}size = [320, 240]\nlimits = [0, 30]\n")
    cube = 10.0 * np.arange(3).reshape(3, 1, 1) + np.arange(6.0).reshape(2, 3)
    with (root / f"cube.{ending}").open("wb") as file:
        np.savez(file, heat=cube) if ending == "npz" else np.save(file, cube)
    stores.ask(root, "population_size=1", runs=1)
    done = projects.quick(root, "video", "--json")
    assert done.returncode == 0, done.stderr
    (path,) = map(Path, json.loads(done.stdout)["files"])
    frames = video_files.decoded(path)
    assert [video_files.part(frame[100, 130]) for frame in frames] == pytest.approx([1 / 30, 11 / 30, 21 / 30], abs=0.04)


MANY = """\
import sys

with open("floor.csv", "w") as file:
    print("tick,i,j,heat", file=file)
    for tick in range(int(sys.argv[2])):
        for i in range(10):
            print(*(f"{tick},{i},{j},{i * j + tick % 9}" for j in range(10)), sep="\\n", file=file)
"""


@pytest.mark.nightly
def test_memory_does_not_grow_with_frames(tmp_path: Path) -> None:
    """All frames of the longer video would take 690 MB; a statement reads up to 200,000 rows of either."""
    peaks = []
    for frames in (300, 3000):
        config = projects.CONFIG.replace("{input}", f"{{input}} {frames}")
        config += (
            '[outputs.floor]\nfile = "floor.csv"\ntime = "tick"\n[videos.heat]\ntable = "floor"\ncolumn = ["i", "j", "heat"]\n'
        )
        root = projects.make(tmp_path / str(frames), f"{config}size = [320, 240]\n", simulator=MANY)
        stores.ask(root, "population_size=1", runs=1)
        process = subprocess.Popen([projects.SIERRA, "video", "-q"], cwd=root, stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = status
        assert status == 0
        peaks.append(used.ru_maxrss / 1024)
    assert peaks[1] < peaks[0] + 200, f"{peaks} MB"


def test_a_failed_batch_has_no_video_and_the_first_reason(tmp_path: Path) -> None:
    film = '[videos.film]\nkind = "pictures"\ntable = "frames"\n'
    root = projects.make(tmp_path / "p", projects.CONFIG + film, simulator="raise SystemExit(7)\n")
    batch = sierra.open(root).run("population_size=1,2", runs=2, figures=False).batch
    done = projects.quick(root, "video", batch)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "all 4 runs failed: exit status 7" in done.stderr
