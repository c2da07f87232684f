"""The example `robots`: nodes of the real ROS 2 on this machine, and the same controller in MuJoCo."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests import projects
from tests.extensions.ros import ros2
from tests.support import robot_fleet
from tests.support.robot_fleet import Fleet

pytestmark = pytest.mark.integration
RUNS = 6
"""The fewest pairs for which the test has an interval."""
LENGTH = 3.0
"""Seconds; 10 ticks each."""
WORLDS = (("nodes", 0), ("sim", 1))
"""The targets, with the number of their first robot."""
HEARD = """
[targets.nodes.outputs.heard]
file = "run/*.mcap"
format = "bag"
topics = ["/poses"]
mismatch = "ragged"
"""


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]) -> Path:
    """Return the example with short runs, whose bags are read."""
    ros2.find(monkeypatch, require)
    require("mujoco", there=find_spec("mujoco") is not None)
    done = projects.quick(tmp_path, "init", "--example", "robots", "demo")
    assert done.returncode == 0, done.stderr
    settings = tmp_path / "demo" / "sierra.toml"
    settings.write_text(f'observe = "none"\n{settings.read_text().replace("6.0", str(LENGTH))}{HEARD}')
    return tmp_path / "demo"


@pytest.mark.nightly
def test_nodes_on_this_machine_are_compared_with_the_same_swarm_in_mujoco(demo: Path) -> None:
    done = projects.quick(demo, "run", "population_size=2", "--runs", str(RUNS), "--target", "sim,nodes", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
    assert_sampled_in_the_same_way(demo)
    assert_recorded(demo)
    ends = projects.sql(demo, "SELECT arg_max(spread, time) AS spread FROM spread GROUP BY run")
    assert all(0.2 < row["spread"] < 0.75 for row in ends), "they start at 0.87 m"
    batches = projects.sql(demo, "SELECT target, batch FROM sessions ORDER BY target DESC")
    groups = [f"{row['target']}={row['batch']}" for row in batches]
    compared = projects.quick(demo, "compare", *groups, "--column", "spread", "--no-figure", "--json")
    assert compared.returncode == 0, compared.stderr
    [pair] = json.loads(compared.stdout)["pairs"]
    assert (pair["first"], pair["second"], pair["n_first"], pair["n_second"]) == ("sim", "nodes", RUNS, RUNS)
    assert pair["low"] <= pair["difference"] <= pair["high"]
    assert abs(pair["difference"]) < 0.3


HOSTS = ("base", "robot1", "robot2", "robot3")


@pytest.fixture
def swarm(require: Callable[..., str]) -> Iterator[Fleet]:
    """Yield four hosts with ROS 2: a base station, and three robots."""
    robot_fleet.needed(require)
    with Fleet(4, lent=ros2.PROGRAMS.parent) as fleet:
        yield fleet


@pytest.mark.nightly
def test_robots_with_networks_of_their_own_are_compared_with_the_same_swarm_in_mujoco(demo: Path, swarm: Fleet) -> None:
    settings = demo / "sierra.toml"
    text = settings.read_text()
    for host, name in zip(HOSTS, swarm.names, strict=True):
        text = text.replace(f"{host}.local", name)
    link = f'[runners.robots]\ndisk_min = 1\nlink_options = {{ ssh_config = "{swarm.ssh_config}" }}\n'
    own = '[platforms.ros]\nsetup = "{project}/setup.bash"\n'
    (demo / "setup.bash").write_text(ros2.SETUP)
    settings.write_text(text.replace("[runners.robots]\n", link).replace("[platforms.ros]\n", own))
    done = projects.quick(demo, "run", "population_size=3", "--runs", "2", "--target", "sim,robots", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
    rows = projects.sql(
        demo,
        "SELECT target, robot, count(*) AS rows, count(DISTINCT time) AS times, round(arg_min(x, time), 2) AS x "
        "FROM path JOIN batch_runs USING (run) JOIN sessions USING (batch) GROUP BY ALL ORDER BY target, robot",
    )
    ticks = round(10 * LENGTH)
    assert [tuple(row.values()) for row in rows] == [
        (target, robot, 2 * ticks, ticks, x) for target in ("robots", "sim") for robot, x in enumerate((1.0, -0.5, -0.5), 1)
    ]
    ends = projects.sql(demo, "SELECT arg_max(spread, time) AS spread FROM spread GROUP BY run")
    assert all(0.2 < row["spread"] < 0.9 for row in ends), "they start at 1 m"
    delays = projects.sql(demo, (demo / "delay.sql").read_text())
    assert [row["robot"] for row in delays] == [1, 2, 3]
    assert all(row["messages"] > 60 and -row["uncertainty_ms"] < row["delay_ms"] < 500 for row in delays), delays
    for name in swarm.names:
        assert not [line for line in swarm.commands(name) if "ros" in line]


def assert_sampled_in_the_same_way(demo: Path) -> None:
    """Assert that each robot has a row for each tick, and starts in the same place, in both worlds."""
    rows = projects.sql(
        demo,
        "SELECT target, run, robot, count(*) AS rows, count(DISTINCT time) AS times, max(time) AS last, "
        "round(arg_min(x, time), 2) AS x, round(arg_min(y, time), 2) AS y, round(arg_min(heading, time), 2) AS heading "
        "FROM path JOIN batch_runs USING (run) JOIN sessions USING (batch) GROUP BY ALL ORDER BY target, run, robot",
    )
    ticks = round(10 * LENGTH)
    assert {(row["rows"], row["times"], row["last"]) for row in rows} == {(ticks, ticks, (ticks - 1) / 10)}
    starts = [(row["target"], row["robot"], row["x"], row["y"], row["heading"]) for row in rows]
    places = [(1.0, 0.0, 0.0), (-0.5, 0.87, 2.09)]
    of_nodes, of_sim = ([(target, robot, *place) for robot, place in enumerate(places, first)] for target, first in WORLDS)
    assert starts == RUNS * of_nodes + RUNS * of_sim


def assert_recorded(demo: Path) -> None:
    """Assert that the bag of each run has what all robots have told, more often than they have ticked."""
    heard = projects.sql(demo, "SELECT run, child_frame_id AS robot, count(*) AS messages FROM heard GROUP BY ALL ORDER BY ALL")
    assert [row["robot"] for row in heard] == ["robot0", "robot1"] * RUNS
    assert all(row["messages"] > 10 * LENGTH for row in heard), heard
