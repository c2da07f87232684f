"""ROS in containers on robots, over real sshd: each starts its own launch file in the image, and nothing is left."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests import projects
from tests.extensions.robots.test_containers_on_robots import left
from tests.extensions.ros.test_ros_on_robots import MOVED, on_fleet
from tests.support import robot_fleet, ros_image
from tests.support.robot_fleet import Fleet

pytestmark = [pytest.mark.nightly, pytest.mark.real]


@pytest.mark.parametrize("engine", ["apptainer", "podman"])
def test_turtlebots_of_a_fleet_start_their_launch_files_in_the_image(
    require: Callable[..., str], tmp_path: Path, engine: str
) -> None:
    robot_fleet.needed(require)
    require(engine)
    root = tmp_path / "demo"
    assert projects.quick(tmp_path, "init", "--example", "turtlebot3", "demo").returncode == 0
    with Fleet(2, disk="6g") as fleet:  # memory is only used for what is written
        on_fleet(root, fleet, 5.0)
        with (root / "sierra.toml").open("a") as file:
            file.write(f'[targets.robots.container]\nimage = "{ros_image.IMAGE}"\nengine = "{engine}"\n')
        ros_image.pin(root, require)
        query = ("population_size=2", "speed=0.2", "--runs", "1", "--target", "robots", "--no-figures")
        done = projects.quick(root, "run", *query)
        assert done.returncode == 0, done.stdout + done.stderr
        rows = projects.sql(root, MOVED.format(x="x", y="y", table="path", robot="robot"))
        assert [(row["robot"], row["rows"], row["way"] > 0.01) for row in rows] == [(1, 51, True), (2, 51, True)]
        assert left(fleet) == []
