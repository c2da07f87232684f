"""The platform `ros` with the real ROS 1: many runs at once, the simulated time, containers of both engines, and on SLURM."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests import clusters, projects
from tests.support import ros_image

pytestmark = pytest.mark.nightly


@pytest.fixture
def demo(tmp_path: Path) -> Path:
    """Return the example of ROS, whose runs are short."""
    done = projects.quick(tmp_path, "init", "--example", "ros", "demo")
    assert done.returncode == 0, done.stderr
    settings = (tmp_path / "demo" / "sierra.toml").read_text().replace("length = 3.0", "length = 1.0")
    (tmp_path / "demo" / "sierra.toml").write_text('observe = "none"\n' + settings)
    return tmp_path / "demo"


def test_eight_runs_on_two_slots_are_apart(demo: Path, require: Callable[..., str]) -> None:
    require("roslaunch")
    summary, _ = projects.run(demo, "population_size=1,3", "--runs", "4", "--jobs", "2", "--no-figures")
    assert (summary["executed"], summary["failed"]) == (8, 0)
    ways = projects.sql(demo, "SELECT run, robot, count(*) AS rows, sum(x) AS x FROM walk GROUP BY run, robot")
    assert (len(ways), {row["rows"] for row in ways}) == (16, {21})
    assert len({row["x"] for row in ways}) == 12  # robot 0 walks alike in both experiments


def test_a_run_without_the_simulated_time_fails(demo: Path, require: Callable[..., str]) -> None:
    require("roslaunch")
    settings = (demo / "sierra.toml").read_text()
    (demo / "sierra.toml").write_text(settings + "use_sim_time = true\npatience = 20.0\n")
    done = projects.quick(demo, "run", "population_size=1", "--runs", "1", "--no-figures")
    assert "ros: nothing has published the simulated time (/clock)" in done.stdout + done.stderr


def test_the_example_runs_on_slurm(demo: Path, slurm: clusters.Slurm, require: Callable[..., str]) -> None:
    require("roslaunch")
    with (demo / "sierra.toml").open("a") as file:
        file.write("[runners.slurm]\narray_tasks = 2\n")
    summary, _ = projects.run(demo, "population_size=1,2", "--runs", "1", "--on", "slurm", "--no-figures")
    assert (summary["executed"], summary["failed"]) == (2, 0)


@pytest.mark.real
def test_the_example_runs_in_an_image_from_the_recipe_on_slurm(
    demo: Path, slurm: clusters.Slurm, require: Callable[..., str]
) -> None:
    require("apptainer")
    with (demo / "sierra.toml").open("a") as file:
        file.write(f'[container]\nimage = "{ros_image.IMAGE}"\nengine = "apptainer"\n[runners.slurm]\narray_tasks = 2\n')
    ros_image.pin(demo, require)
    summary, _ = projects.run(demo, "population_size=1,2", "--runs", "1", "--on", "slurm", "--no-figures")
    assert (summary["executed"], summary["failed"]) == (2, 0)
    where = (
        "SELECT engine, host = node AS there FROM executions JOIN isolations USING (isolation) JOIN attempts USING (attempt)"
    )
    assert projects.sql(demo, where) == [{"engine": "apptainer", "there": True}] * 2
    assert projects.sql(demo, "SELECT count(*) AS rows FROM walk GROUP BY run, robot") == [{"rows": 21}] * 3


@pytest.mark.real
def test_podman_and_apptainer_give_the_same_results_in_an_image_from_the_recipe(
    demo: Path, require: Callable[..., str]
) -> None:
    require("apptainer")
    with (demo / "sierra.toml").open("a") as file:
        file.write(f'[container]\nimage = "{ros_image.IMAGE}"\nengine = "podman"\n')
    ros_image.pin(demo, require)
    summary, _ = projects.run(demo, "population_size=2", "--runs", "1", "--no-figures")
    assert (summary["executed"], summary["failed"]) == (1, 0)
    replayed = projects.quick(demo, "replay", str(summary["batch"])[:10], "--engine", "apptainer")
    assert "identical (1 run: 1 identical)" in replayed.stdout, replayed.stdout + replayed.stderr
