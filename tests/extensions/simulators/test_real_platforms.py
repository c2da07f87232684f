"""The platforms of simulators with real simulators: their examples, from the stock files to figures and replays."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from ctypes.util import find_library
from pathlib import Path

import pytest
from matplotlib.image import imread

from tests import projects
from tests.extensions.simulators.changes import LOCKS
from tests.projects import values
from tests.simulators import Started, configure

pytestmark = pytest.mark.nightly


def test_the_example_of_sumo_goes_from_a_query_to_figures(started: Started, require: Callable[..., str]) -> None:
    root, sumo = started(LOCKS / "sumo.txt")
    works = subprocess.run([sumo.bin / "sumo", "--version"], check=False, capture_output=True).returncode == 0
    require("the system's libraries that SUMO needs", there=works)
    done = projects.quick(root, "run", "vehicles_per_hour=50,300", "--runs", "3")
    assert done.returncode == 0, done.stderr
    assert len(list((root / "figures").glob("*/*.png"))) == 2
    lost = 'SELECT vehicles_per_hour AS v, avg("timeLoss") AS lost FROM trips GROUP BY v ORDER BY v'
    few, many = (float(str(row["lost"])) for row in projects.sql(root, lost))
    assert few < many
    sums = 'SELECT sum("timeLoss") AS s FROM trips WHERE vehicles_per_hour = 300 GROUP BY run'
    assert len(values(root, sums)) == 3
    assert "Eclipse SUMO sumo 1.28.0" in values(root, "SELECT version FROM programs WHERE name = 'sumo: program'")


def test_init_sets_up_the_stock_files_of_sumo_and_tries_a_run(started: Started, require: Callable[..., str]) -> None:
    root, sumo = started(LOCKS / "sumo.txt")
    works = subprocess.run([sumo.bin / "sumo", "--version"], check=False, capture_output=True).returncode == 0
    require("the system's libraries that SUMO needs", there=works)
    (root / "sierra.toml").unlink()
    done = projects.quick(root, "init", "-y")
    assert done.returncode == 0, done.stderr
    assert "trying one run: platform sumo" in done.stdout
    assert "result  ok" in done.stdout
    summary, _ = projects.run(root, "scale=0.5,1", "--runs", "1")
    assert (summary["executed"], summary["failed"]) == (2, 0)


def test_dates_in_outputs_of_sumo_are_no_difference(started: Started, require: Callable[..., str]) -> None:
    root, sumo = started(LOCKS / "sumo.txt")
    works = subprocess.run([sumo.bin / "sumo", "--version"], check=False, capture_output=True).returncode == 0
    require("the system's libraries that SUMO needs", there=works)
    summary, _ = projects.run(root, "scale=0.5,1", "--runs", "1")
    assert (summary["executed"], summary["failed"]) == (2, 0)
    replayed = projects.quick(root, "replay", summary["batch"][:10])
    assert (replayed.returncode, "equal (2 runs: 2 equal)" in replayed.stdout) == (0, True), replayed.stdout


def mujoco_project(started: Started) -> Path:
    """Return the example of MuJoCo, whose runs use the environment of the test."""
    root, mujoco = started(LOCKS / "mujoco.txt")
    settings = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text(f'command = "{mujoco.bin}/python"\n{settings}')
    return root


def test_the_example_of_mujoco_goes_from_a_query_to_figures(started: Started) -> None:
    root = mujoco_project(started)
    done = projects.quick(root, "run", "population_size=1,8", "--runs", "2")
    assert done.returncode == 0, done.stderr
    assert len(list((root / "figures").glob("*/*.png"))) == 1
    energy = "SELECT avg(energy) AS e FROM sensors GROUP BY population_size ORDER BY population_size"
    few, many = (float(str(row["e"])) for row in projects.sql(root, energy))
    assert 0 < few < many
    assert len(values(root, "SELECT sum(energy) AS s FROM sensors GROUP BY run")) == 4
    assert values(root, "SELECT count(DISTINCT body) AS n FROM bodies GROUP BY run") == {1, 8}
    batch = str(projects.sql(root, "SELECT batch FROM batches")[0]["batch"])
    replayed = projects.quick(root, "replay", batch[:10])
    assert (replayed.returncode, "identical (4 runs: 4 identical)" in replayed.stdout) == (0, True), replayed.stderr


def test_frames_of_mujoco_are_captured_without_changing_its_physics(started: Started, require: Callable[..., str]) -> None:
    require("EGL or OSMesa", there=bool(find_library("EGL") or find_library("OSMesa")))
    root = mujoco_project(started)
    configure(root, "duration = 20.0", "duration = 2.0")
    projects.run(root, "population_size=1,8", "--runs", "2")
    with (root / "sierra.toml").open("a") as settings:
        settings.write('capture = { camera = "top", interval = 0.5, size = [160, 120] }\n')
    done = projects.quick(root, "capture", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    made = json.loads(done.stdout)["made"]
    assert [(row["verdict"], row["frames"], row["ticks_per_second"]) for row in made] == [("identical", 5, 10)] * 2
    projects.quick(root, "files", made[1]["execution"], "--to", str(root.parent / "files"))
    [last] = (root.parent / "files").rglob("frames/000020.png")
    pixels = imread(last)
    assert pixels.shape == (120, 160, 3)
    assert (pixels[..., 2] > pixels[..., 0] + 0.2).any(), "the robots are blue"


def test_what_is_recorded_of_mujoco_and_how_often_changes_no_physics(started: Started) -> None:
    root = mujoco_project(started)
    projects.run(root, "population_size=3", "--runs", "1")
    configure(root, "duration = 20.0,", 'duration = 20.0, interval = 0.5, joints = ["*"],')
    (root / "sierra.toml").write_text(
        (root / "sierra.toml")
        .read_text()
        .replace("outputs.sensors", "outputs.joints = { file = 'joints.csv' }\noutputs.sensors")
    )
    projects.run(root, "population_size=3", "--runs", "1")
    ends = values(root, "SELECT energy FROM sensors WHERE time = 20")
    assert len(ends) == 1
    assert len(values(root, "SELECT count(*) AS n FROM sensors GROUP BY run")) == 2


def test_a_controller_of_mujoco_gets_the_generator_of_the_run(started: Started) -> None:
    root = mujoco_project(started)
    (root / "walk.py").write_text("def control(model, data, random):\n    data.ctrl[:] = random.normal(0, 5, model.nu)\n")
    configure(root, "control_noise = 20.0", 'control = "walk.py"')
    summary, _ = projects.run(root, "population_size=2", "--runs", "2")
    assert (summary["executed"], summary["failed"]) == (2, 0)
    assert len(values(root, "SELECT sum(energy) AS s FROM sensors GROUP BY run")) == 2


def test_a_misspelt_body_fails_with_the_names_that_there_are(started: Started) -> None:
    root = mujoco_project(started)
    configure(root, '"robot*"', '"robto"')
    done = projects.quick(root, "run", "population_size=1", "--no-figures")
    assert (done.returncode, "the model has no 'robto'; known are world, robot" in done.stdout + done.stderr) == (1, True), done


@pytest.fixture
def flight(started: Started) -> Path:
    """Return the example of JSBSim, whose runs use the environment of the test."""
    root, jsbsim = started(LOCKS / "jsbsim.txt")
    settings = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text(f'command = "{jsbsim.bin}/python"\n{settings}')
    return root


def test_the_example_of_jsbsim_goes_from_a_query_to_figures(flight: Path) -> None:
    done = projects.quick(flight, "run", "severity=1,5", "--runs", "2")
    assert done.returncode == 0, done.stderr
    assert len(list((flight / "figures").glob("*/*.png"))) == 2
    speeds = 'SELECT stddev("/fdm/jsbsim/velocities/vc-kts") AS s FROM flight GROUP BY severity ORDER BY severity'
    calm, rough = (float(str(row["s"])) for row in projects.sql(flight, speeds))
    assert 0 < calm < rough
    assert len(values(flight, 'SELECT sum("/fdm/jsbsim/position/h-sl-ft") AS s FROM flight GROUP BY run')) == 4
    batch = str(projects.sql(flight, "SELECT batch FROM batches")[0]["batch"])
    replayed = projects.quick(flight, "replay", batch[:10])
    assert (replayed.returncode, "identical (4 runs: 4 identical)" in replayed.stdout) == (0, True), replayed.stderr


@pytest.mark.parametrize(
    ("file", "before", "after", "message"),
    [
        ("sierra.toml", "position/h-sl-ft", "position/h-sl-fet", "there is no property 'position/h-sl-fet'"),
        ("cruise.xml", "c172x", "c172y", "cannot load the script, or the aircraft"),
    ],
)
def test_mistakes_in_flights_fail_in_one_line(flight: Path, file: str, before: str, after: str, message: str) -> None:
    (flight / file).write_text((flight / file).read_text().replace(before, after))
    done = projects.quick(flight, "run", "severity=1", "--runs", "1", "--no-figures")
    assert (done.returncode, message in done.stdout + done.stderr) == (1, True), done
