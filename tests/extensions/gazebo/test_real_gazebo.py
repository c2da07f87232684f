"""Gazebo classic 11 in containers, here and on SLURM: the image is built from its recipe, once for all tests of this file."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import clusters, projects
from tests.projects import values

RECIPE = Path(__file__).parents[3] / "containers" / "gazebo"
IMAGE = 'container.image = "containers/gazebo"\n'
CROWD = """\
    <population name="crowd">
      <pose>0 0 0.1 0 0 0</pose><model_count>8</model_count>
      <distribution><type>random</type></distribution><box><size>4 4 0.01</size></box>
"""
pytestmark = [pytest.mark.real, pytest.mark.nightly]


@pytest.fixture(scope="module")
def storage() -> Iterator[Path]:
    """Yield the configuration of a storage of podman that is removed at the end."""
    folder = Path(tempfile.mkdtemp(dir="/tmp"))  # sockets of podman need short paths
    text = f'[storage]\ndriver = "overlay"\ngraphroot = "{folder}/graph"\nrunroot = "{folder}/run"\n'
    (folder / "storage.conf").write_text(text)
    yield folder / "storage.conf"
    for graph in folder.glob("graph/overlay"):
        subprocess.run(["umount", "--lazy", graph], check=False, capture_output=True)
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def built(storage: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the example of Gazebo, whose image was built and pinned; tests copy it."""
    root = tmp_path_factory.mktemp("gazebo") / "demo"
    assert projects.quick(root.parent, "init", "--example", "gazebo", "demo").returncode == 0
    shutil.copytree(RECIPE, root / "containers" / "gazebo")
    (root / "sierra.toml").write_text(IMAGE + (root / "sierra.toml").read_text())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CONTAINERS_STORAGE_CONF", str(storage))
        for word in ("build", "pin"):
            done = projects.quick(root, "image", word)
            assert done.returncode == 0, done.stderr
    return root


@pytest.fixture
def demo(
    require: Callable[..., str],
    tmp_path: Path,
    request: pytest.FixtureRequest,
    storage: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    for program in ("podman", "mmdebstrap", "mksquashfs"):
        require(program)
    require("the rights to make a system's files", there=os.geteuid() == 0)
    shutil.copytree(request.getfixturevalue("built"), tmp_path / "demo")
    monkeypatch.setenv("CONTAINERS_STORAGE_CONF", str(storage))
    return tmp_path / "demo"


def verdict(root: Path, batch: str, *words: str) -> str:
    return projects.quick(root, "replay", batch[:10], *words).stdout.splitlines()[-1]


def test_the_example_is_identical_in_both_engines_and_three_at_once(demo: Path, require: Callable[..., str]) -> None:
    require("apptainer")
    done = projects.quick(demo, "run", "population_size=1,8", "--runs", "3", "--jobs", "3")
    assert done.returncode == 0, done.stderr
    assert len(list((demo / "figures").glob("*/*.png"))) == 1
    last = "SELECT avg(x) AS x FROM poses WHERE time = 30 GROUP BY run"
    assert len(values(demo, last)) == 6
    assert values(demo, "SELECT count(*) AS n FROM poses GROUP BY run") == {31, 248}
    inside = "SELECT bool_and(abs(x) < 3 AND abs(y) < 3 AND abs(z - 0.1) < 0.1) AS inside FROM poses"
    assert values(demo, inside) == {True}
    batch = str(projects.sql(demo, "SELECT batch FROM batches")[0]["batch"])
    assert verdict(demo, batch) == f"batch {batch[:10]}: identical (6 runs: 6 identical)"
    assert verdict(demo, batch, "--engine", "apptainer") == f"batch {batch[:10]}: identical (6 runs: 6 identical)"


def test_runs_on_slurm_in_the_image_are_identical_here(demo: Path, slurm: clusters.Slurm, require: Callable[..., str]) -> None:
    require("apptainer")
    settings = 'container.engine = "apptainer"\n' + (demo / "sierra.toml").read_text()
    (demo / "sierra.toml").write_text(f"{settings}[runners.slurm]\narray_tasks = 2\n")
    summary, _ = projects.run(demo, "population_size=1,8", "--runs", "2", "--on", "slurm")
    assert (summary["executed"], summary["failed"]) == (4, 0)
    contained = "executions e JOIN attempts a USING (attempt) JOIN isolations i USING (isolation) WHERE e.host = a.node"
    assert values(demo, f"SELECT count(*) FROM {contained} AND i.engine = 'apptainer'") == {4}
    assert "identical (4 runs: 4 identical)" in verdict(demo, str(summary["batch"]), "--engine", "podman")


def test_a_population_is_complete_at_the_start_and_its_poses_repeat(demo: Path) -> None:
    text = (demo / "arena.world").read_text()
    text = text.replace('    <model name="robot">', f'{CROWD}<model name="ant">').replace(
        "    </model>\n  </w", "</model></population></w"
    )
    (demo / "arena.world").write_text(text)
    settings = (demo / "sierra.toml").read_text().replace('robot = "robot"\n', "").partition("start_area")[0]
    (demo / "sierra.toml").write_text(settings)
    summary, _ = projects.run(demo, "population_size=1,8", "--runs", "2")
    assert (summary["executed"], summary["failed"]) == (4, 0)
    first = "SELECT run, count(*) AS n, sum(x) AS x FROM poses WHERE time = 0 GROUP BY run"
    assert sorted(int(row["n"]) for row in projects.sql(demo, first)) == [1, 1, 8, 8]
    assert len({row["x"] for row in projects.sql(demo, first)}) == 4
    assert "identical (4 runs: 4 identical)" in verdict(demo, str(summary["batch"]))


def test_a_run_over_its_time_limit_and_a_missing_model_fail(demo: Path) -> None:
    settings = (demo / "sierra.toml").read_text()
    (demo / "sierra.toml").write_text(settings.replace("length = 30.0", "length = 10000.0") + "[limits]\nwall = 8\ngrace = 1\n")
    done = projects.quick(demo, "run", "population_size=2", "--runs", "1", "--no-figures")
    assert (done.returncode, values(demo, "SELECT status FROM executions")) == (1, {"timeout"}), done.stderr
    (demo / "sierra.toml").write_text(settings)
    (demo / "arena.world").write_text((demo / "arena.world").read_text().replace("model://sun", "model://moon"))
    done = projects.quick(demo, "run", "population_size=3", "--runs", "1", "--no-figures")
    assert (done.returncode, "missing: some of those that are included" in done.stdout + done.stderr) == (1, True), done
