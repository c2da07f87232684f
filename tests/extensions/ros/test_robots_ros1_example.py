"""The example `robots-ros1`: rospy nodes on robots under the master of a base station, and the same controller in MuJoCo."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

import sierra
from tests import projects
from tests.support import robot_fleet, ros_image
from tests.support.robot_fleet import Fleet

pytestmark = pytest.mark.integration
HOSTS = ("base", "robot1", "robot2", "robot3")


@pytest.fixture
def swarm(require: Callable[..., str]) -> Iterator[Fleet]:
    """Yield four hosts: a base station, and three robots."""
    robot_fleet.needed(require)
    require("roslaunch")
    require("mujoco", there=find_spec("mujoco") is not None)
    with Fleet(4, disk="2g") as fleet:  # rosbag needs 1 GB of free space; memory is only used for what is written
        yield fleet


@pytest.fixture
def demo(swarm: Fleet, tmp_path: Path) -> Path:
    """Return the example with the hosts of the fleet, and with short runs."""
    done = projects.quick(tmp_path, "init", "--example", "robots-ros1", "demo")
    assert done.returncode == 0, done.stderr
    settings = tmp_path / "demo" / "sierra.toml"
    text = 'observe = "none"\n' + settings.read_text().replace("6.0", "3.0")
    for host, name in zip(HOSTS, swarm.names, strict=True):
        assert f'host = "{host}.local"' in text
        text = text.replace(f"{host}.local", name)
    link = f'[runners.robots]\nlink_options = {{ ssh_config = "{swarm.ssh_config}" }}\n'
    settings.write_text(text.replace('disk_min = "2 GB"', 'disk_min = "1 GB"').replace("[runners.robots]\n", link))
    return tmp_path / "demo"


@pytest.mark.nightly
def test_a_swarm_under_one_master_is_compared_with_the_same_swarm_in_mujoco(demo: Path, swarm: Fleet) -> None:
    done = projects.quick(demo, "run", "population_size=3", "--runs", "2", "--target", "sim,robots", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
    assert_sampled_in_the_same_way(demo)
    ends = projects.sql(demo, "SELECT arg_max(spread, time) AS spread FROM spread GROUP BY run")
    assert all(0.2 < row["spread"] < 0.9 for row in ends), "they start at 1 m"
    batches = projects.sql(demo, "SELECT target, batch FROM sessions ORDER BY target DESC")
    groups = [f"{row['target']}={row['batch']}" for row in batches]
    compared = projects.quick(demo, "compare", *groups, "--column", "spread", "--no-figure", "--json")
    assert compared.returncode == 0, compared.stderr
    [pair] = json.loads(compared.stdout)["pairs"]
    assert (pair["first"], pair["second"], pair["n_first"], pair["n_second"]) == ("sim", "robots", 2, 2)
    assert abs(pair["difference"]) < 0.3
    delays = projects.sql(demo, (demo / "delay.sql").read_text())
    assert [row["robot"] for row in delays] == [1, 2, 3]
    assert all(row["messages"] > 60 and -row["uncertainty_ms"] < row["delay_ms"] < 500 for row in delays), delays
    for name in swarm.names:
        assert not [line for line in swarm.commands(name) if "ros" in line]


@pytest.mark.nightly
@pytest.mark.real
def test_a_swarm_in_containers_finds_its_master_if_the_network_is_declared(
    demo: Path, swarm: Fleet, require: Callable[..., str]
) -> None:
    require("apptainer")
    with (demo / "sierra.toml").open("a") as file:
        file.write(f'[targets.robots.container]\nimage = "{ros_image.IMAGE}"\nengine = "apptainer"\nnetwork = true\n')
    ros_image.pin(demo, require)
    done = projects.quick(demo, "run", "population_size=2", "--runs", "1", "--target", "robots", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
    rows = projects.sql(demo, "SELECT robot, count(*) AS rows FROM path GROUP BY robot ORDER BY robot")
    assert rows == [{"robot": 1, "rows": 30}, {"robot": 2, "rows": 30}]
    heard = projects.sql(demo, "SELECT child_frame_id AS robot FROM heard GROUP BY robot ORDER BY robot")
    assert heard == [{"robot": "robot1"}, {"robot": "robot2"}], "the base station hears both"
    assert projects.sql(demo, "SELECT DISTINCT engine, network FROM isolations") == [{"engine": "apptainer", "network": "host"}]


@pytest.mark.parametrize("name", ["gathering.py", "arena.xml", "delay.sql"])
def test_the_example_with_ros_2_has_the_same_controller_and_model(name: str) -> None:
    package = Path(sierra.__file__).parent
    here = package / "extensions" / "ros" / "examples" / "robots-ros1" / name
    assert here.read_bytes() == (package / "extensions" / "robots" / "examples" / "robots" / name).read_bytes()


def assert_sampled_in_the_same_way(demo: Path) -> None:
    """Assert that each robot has a row for each tick, and starts in the same place, in both worlds."""
    rows = projects.sql(
        demo,
        "SELECT target, robot, count(*) AS rows, count(DISTINCT time) AS times, min(time) AS first, max(time) AS last, "
        "round(arg_min(x, time), 2) AS x, round(arg_min(y, time), 2) AS y, round(arg_min(heading, time), 2) AS heading "
        "FROM path JOIN batch_runs USING (run) JOIN sessions USING (batch) GROUP BY ALL ORDER BY target, robot",
    )
    assert {(row["rows"], row["times"], row["first"], row["last"]) for row in rows} == {(60, 30, 0.0, 2.9)}
    starts = [(row["target"], row["robot"], row["x"], row["y"], row["heading"]) for row in rows]
    assert [start[:2] for start in starts] == [(target, robot) for target in ("robots", "sim") for robot in (1, 2, 3)]
    assert [start[1:] for start in starts[:3]] == [start[1:] for start in starts[3:]]
