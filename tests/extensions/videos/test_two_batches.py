"""Videos of two batches show experiments with the same values side by side, with the same limits, shapes and times."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.config.project_file import load
from sierra.deliverables.gallery import Gallery
from sierra.extensions.videos import draw
from sierra.extensions.videos.films import Members, file_names
from sierra.extensions.videos.prepare import Prepared, prepare
from sierra.extensions.videos.table import Video
from sierra.model import Axis, Value
from sierra.store.batch_data import BatchData
from tests import projects, stores
from tests.extensions.videos import video_files
from tests.tiers import needs_extension

pytestmark = pytest.mark.integration
SIMULATOR = """\
import sys

arena = open(sys.argv[1]).read()
count = int(arena.split('<swarm count="')[1].split('"')[0])
noise = float(arena.split("<noise>")[1].split("<")[0])
number = int(arena.split('run="')[1].split('"')[0])
with open("floor.csv", "w") as file:
    print("tick,i,j,heat", file=file)
    for tick in range(2 if noise == 8 else 3):
        for i in range(2):
            for j in range(3 if noise == 8 else 2):
                print(tick, i, j, 10 * count + tick + noise + number, sep=",", file=file)
"""
TEMPLATE = projects.TEMPLATE.replace("<arena ", '<arena run="0" ')
CONFIG = projects.CONFIG.replace("runs = 2", 'observe = "none"\nrun_changes = [{ set = "/arena/@run", value = "{run}" }]') + (
    '[outputs.floor]\nfile = "floor.csv"\ntime = "tick"\n[videos.heat]\ntable = "floor"\ncolumn = ["i", "j", "heat"]\n'
    "size = [320, 240]\n"
)
CELLS = {"table": "floor", "column": ["i", "j", "heat"], "show": "mean"}
NARROW = {"table": "", "sql": "SELECT run, tick, i, j, heat FROM floor WHERE j < 2"}
"""The columns that all batches have."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a project with batches whose noise is 0, 5, and 8 (another shape and fewer ticks)."""
    made = projects.make(tmp_path_factory.mktemp("two") / "p", CONFIG, simulator=SIMULATOR, template=TEMPLATE)
    stores.ask(made, "population_size=1,2", runs=2, sets=[("noise", "0")])
    stores.ask(made, "population_size=1,3", runs=1, sets=[("noise", "5")])
    stores.ask(made, "population_size=1", runs=1, sets=[("noise", "8")])
    return made


def ids(root: Path) -> list[str]:
    return [str(one.batch) for one in sierra.open(root).batches]


def prepared(root: Path, a: int, b: int, **keys: Any) -> Prepared:
    project, store, batches = load(root), sierra.open(root).store, ids(root)
    with ExitStack() as frames:
        galleries = {
            label: Gallery(project, store, frames.enter_context(BatchData(store, batches[place])))
            for label, place in (("calm", a), ("noisy", b))
        }
        return prepare("film", Video.model_validate(CELLS | keys), galleries)


@pytest.mark.nightly
def test_two_batches_are_drawn_side_by_side_and_recorded_for_both(root: Path, tmp_path: Path) -> None:
    first, second, *_ = ids(root)
    done = projects.quick(root, "video", f"calm={first[:10]}", f"noisy={second[:10]}", "--json")
    assert done.returncode == 0, done.stderr
    (path,) = map(Path, json.loads(done.stdout)["files"])
    assert (path.parent.name, path.name) == (f"{first[:10]}-{second[:10]}", "heat-population_size=1.mp4")
    assert len(video_files.decoded(path)) == 3
    assert "video heat: population size = 2 is only in calm" in done.stderr
    assert "video heat: population size = 3 is only in noisy" in done.stderr
    (row,) = projects.sql(root, "SELECT name, batches, sql FROM deliverables")
    assert (row["name"], row["batches"]) == ("heat_calm_noisy", [first, second])
    for batch in (first, second):
        assert "heat_calm_noisy: follows from the store" in projects.quick(root, "figures", batch, "--check").stdout
        assert (
            "Video. heat-population_size=1"
            in sierra.open(root).deliverables.report(batch, to=tmp_path / "page.html").file.read_text()
        )
    path.write_bytes(path.read_bytes()[:-1])
    for batch in (first, second):
        assert "is not the file that SIERRA made" in projects.quick(root, "figures", batch, "--check").stdout


@pytest.mark.nightly
@needs_extension("explorer")
def test_the_explorer_shows_a_video_of_two_batches_with_both(root: Path) -> None:
    from sierra.extensions.explorer import explorer
    from tests.extensions.explorer.page import served

    first, second, *_ = ids(root)
    done = projects.quick(root, "video", f"calm={first[:10]}", f"noisy={second[:10]}", "--json")
    (path,) = json.loads(done.stdout)["files"]
    with served(explorer(sierra.open(root))) as page:
        for batch in (first, second):
            (shown,) = page.ask("batch", batch=batch)["videos"]
            assert (root / shown["file"]).samefile(path)


def test_limits_are_those_of_both_and_the_difference_is_of_means(root: Path) -> None:
    made = prepared(root, 0, 1)
    (one,) = made.films
    assert [panel.label for panel in one.film.panels] == ["A: calm", "B: noisy", "A − B"]
    assert (made.whole.values.low, made.whole.values.high) == pytest.approx((10.5, 17))
    assert (made.whole.differences.low, made.whole.differences.high) == pytest.approx((-4.5, -4.5))
    assert one.film.notes == ("A: mean over 2 runs", "B: mean over 1 run")
    assert draw._count(one.film, [(2,), (1,), (2, 1)]) == ", n = 2, 1"
    of_runs = prepared(root, 0, 1, show="run")
    assert (of_runs.whole.values.low, of_runs.whole.values.high) == pytest.approx((10, 17))


@pytest.mark.parametrize(
    ("second", "keys", "message"),
    [
        (2, {}, "batches 'calm' and 'noisy' have different 'j': 2 from 0 to 1 and 3 from 0 to 2"),
        (2, NARROW, "have different times: 3 from 0 to 2 and 2 from 0 to 1; with step, frames show the last values of each"),
        (1, {"show": "tiles"}, 'show = "tiles" shows one batch'),
        (1, {"experiments": "population_size=2"}, "population_size"),
        (1, {"show": "run", "run": 7}, "run 7 has no successful execution"),
    ],
)
def test_batches_that_do_not_fit_are_refused_in_one_line(root: Path, second: int, keys: dict[str, Any], message: str) -> None:
    with pytest.raises(sierra.SierraError) as caught:
        prepared(root, 0, second, **keys)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_sides_with_other_units_are_refused(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Gallery, "unit", lambda self, _, column: "K" if column == "heat" and self.planned == {0: 1} else "")
    with pytest.raises(sierra.SierraError, match="'calm' and 'noisy' have different units of 'heat': none and K"):
        prepared(root, 0, 2, **NARROW, step=1)


@pytest.mark.nightly
def test_with_a_step_times_may_differ(root: Path) -> None:
    (one,) = prepared(root, 0, 2, step=1, **NARROW).films
    assert (one.times.tolist(), one.found.gaps) == ([0, 1, 2], 1)


def test_more_than_two_batches_and_the_same_batch_twice_are_refused(root: Path) -> None:
    first, second, third = ids(root)
    assert "a video shows two batches at most, not 3" in projects.quick(root, "video", first, second, third).stderr
    assert "cannot be compared with itself" in projects.quick(root, "video", first, first).stderr


def test_experiments_are_chosen_by_names_and_by_labels() -> None:
    axes = (Axis("controller", ("random walk", "b")),)
    shown: dict[int, dict[str, Value]] = {0: {"controller": "random walk"}, 1: {"controller": "b"}}
    members = Members(axes, shown, {0: {"controller": "crw"}, 1: {"controller": "b"}}, ())
    for word in ("random walk", "crw"):
        assert members.matching(f"controller={word}", "experiments") == [0]
        assert members.matching(f"controller!={word}", "experiments") == [1]
    assert members.matching("", "experiments") == [0, 1]


def test_names_of_files_have_the_values_and_differ() -> None:
    axes = Axis("noise", (0.5, 1)), Axis("controller", ("a/b", "a b", "A_B", "c"))
    names: dict[int, dict[str, Value]] = {
        k: {"noise": 0.5, "controller": word} for k, word in enumerate(("a/b", "a b", "A_B", "c"))
    }
    found = file_names("heat", Members(axes, names, names, ()))
    assert found[3] == "heat-noise=0.5-controller=c"
    assert found[0] == "heat-noise=0.5-controller=a_b_experiment0"
    assert len({name.lower() for name in found.values()}) == 4
    assert file_names("heat", Members(axes, {0: names[0]}, {0: names[0]}, ())) == {0: "heat"}
