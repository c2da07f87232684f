"""Launch files of ROS on robots with real sshd: each starts its own, with stand-ins for the drivers of a TurtleBot3."""

from __future__ import annotations

import re
import signal
import subprocess
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import pytest

from sierra.errors import Missing
from sierra.extensions.hosts.fabric import Fabric
from sierra.runners.links.base import Ended, LinkOptions
from tests import projects
from tests.support import robot_fleet, robot_project
from tests.support.pages import DOCS
from tests.support.robot_fleet import Fleet
from tests.support.robot_runs import Runs, job
from tests.waiting import until

TABLES = re.compile(r"(?ms)^```toml\n(\[runners\.robots\]\n.*?)^```$")
VELOCITIES = "/home/robot/velocities"
"""The commands that the drivers of a robot got: a time of CLOCK_MONOTONIC, a speed and a turn in each line."""
TOLD = "    command, commanded = message, time.monotonic()\n"
"""The line of the stand-in for the drivers that takes a velocity."""
RUN = ("run", "population_size=2", "speed=0.2", "--runs", "1", "--target", "robots", "--no-figures")
SHORT_S = 0.01
"""A grace time that is too short for roslaunch. It depends on the machine whether a bag is cut off then."""
KILLED = f"was killed {SHORT_S} s after the stop, so that its files may be cut; raise grace in [runners.robots]"
MOVED = """
SELECT {robot} AS robot, count(*) AS rows, max({x}) - min({x}) + max({y}) - min({y}) AS way
FROM {table} GROUP BY {robot} ORDER BY {robot}
"""
"""The way of each robot: half of the circumference of the rectangle in which it was."""
pytestmark = pytest.mark.integration


@pytest.fixture
def turtles(require: Callable[..., str], tmp_path: Path) -> Path:
    """Return the example of TurtleBot3, whose runs are short."""
    require("roslaunch")
    done = projects.quick(tmp_path, "init", "--example", "turtlebot3", "demo")
    assert done.returncode == 0, done.stderr
    return tmp_path / "demo"


def test_the_launch_file_of_turtlebots_is_valid_and_has_their_nodes(turtles: Path, tmp_path: Path) -> None:
    done = projects.quick(turtles, "inputs", "population_size=3", "speed=0.1", "--runs", "1", "--to", str(tmp_path / "inputs"))
    assert done.returncode == 0, done.stderr
    [launch] = (tmp_path / "inputs").glob("**/input.launch")
    keeper = tmp_path / "packages" / "sierra_ros"
    keeper.mkdir(parents=True)
    (keeper / "package.xml").write_text("<package><name>sierra_ros</name></package>")
    path = f"{turtles / 'packages'}:{tmp_path / 'packages'}:/usr/share"
    environment = {"PATH": "/usr/bin", "ROS_PACKAGE_PATH": path, "SIERRA_OUTPUT": "/out", "HOME": str(tmp_path)}

    def says(option: str) -> str:
        return subprocess.run(["roslaunch", option, launch], env=environment, check=True, capture_output=True, text=True).stdout

    nodes = {f"/tb3_{number}/{name}" for number in range(3) for name in ("turtlebot3_core", "wander")}
    assert set(says("--nodes").split()) == nodes | {"/sierra_timekeeper"}
    parameters = says("--dump-params")
    assert "/tb3_2/turtlebot3_core/tf_prefix: tb3_2" in parameters
    assert "/tb3_2/turtlebot3_core/lidar_frame_id: tb3_2/base_scan" in parameters


@pytest.mark.nightly
def test_turtlebots_move_as_cmd_vel_says_and_publish_odom_and_scan(turtles: Path) -> None:
    bag = '{{ file = "run.bag", format = "bag", mismatch = "ragged", topics = ["/{{model}}/{0}"] }}'
    outputs = "".join(f"outputs.{topic} = {bag.format(topic)}\n" for topic in ("cmd_vel", "odom", "scan"))
    text = (turtles / "sierra.toml").read_text()
    recorded = text.replace("[platforms.ros]\n", '[platforms.ros]\nrecord = ["/.*/cmd_vel", "/.*/odom", "/.*/scan"]\n')
    (turtles / "sierra.toml").write_text('observe = "none"\n' + outputs + recorded)
    done = projects.quick(turtles, "run", "population_size=2", "speed=0.2", "--runs", "1", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
    driven = 'SELECT model, max("linear.x") AS speed, count(*) > 20 AS often FROM cmd_vel GROUP BY model ORDER BY model'
    assert projects.sql(turtles, driven) == [{"model": f"tb3_{robot}", "speed": 0.2, "often": True} for robot in range(2)]
    moved = projects.sql(
        turtles, MOVED.format(x='"pose.pose.position.x"', y='"pose.pose.position.y"', table="odom", robot="model")
    )
    assert [(row["robot"], row["way"] > 0.01) for row in moved] == [("tb3_0", True), ("tb3_1", True)]
    assert projects.sql(turtles, "SELECT DISTINCT model, len(ranges) AS beams FROM scan ORDER BY model") == [
        {"model": f"tb3_{robot}", "beams": 360} for robot in range(2)
    ]


def on_fleet(turtles: Path, fleet: Fleet, length: float) -> None:
    """Let the robots of a fleet execute runs of the example, of so many seconds."""
    text = 'observe = "none"\n' + (turtles / "sierra.toml").read_text().replace("length = 5.0", f"length = {length}")
    kept = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("fleet."))
    robots = "".join(f'fleet.{name} = {{ host = "{name}" }}\n' for name in fleet.names)
    (turtles / "sierra.toml").write_text(
        f'{kept}disk_min = 1\nlink_options = {{ ssh_config = "{fleet.ssh_config}" }}\n{robots}'
    )


def log_velocities(turtles: Path, *, deaf: bool = False) -> None:
    """Let the stand-in for the drivers write down what it is told. `deaf`: the controller ignores signals."""
    drivers, wander = (turtles / f"packages/{name}" for name in ("turtlebot3_bringup/scripts/drivers", "wander/scripts/wander"))
    log = f"    print(time.monotonic(), message.linear.x, message.angular.z, file=open({VELOCITIES!r}, 'a'))\n"
    assert drivers.read_text().count(TOLD) == 1
    drivers.write_text(drivers.read_text().replace(TOLD, TOLD + log))
    if deaf:
        ignored = "import signal\nfor number in (signal.SIGINT, signal.SIGTERM):\n    signal.signal(number, signal.SIG_IGN)\n"
        wander.write_text(wander.read_text().replace("rate, turn =", ignored + "rate, turn ="))


def velocities(fleet: Fleet, name: str) -> list[tuple[float, bool]]:
    """Return the time of each velocity that a robot was told, and whether the robot moves by it."""
    log = fleet.robots[name].home / Path(VELOCITIES).name
    lines = [line.split() for line in log.read_text().splitlines()] if log.exists() else []
    return [(float(when), float(forward) != 0 or float(turn) != 0) for when, forward, turn in lines]


def all_move(fleet: Fleet, names: Iterable[str]) -> None:
    for name in names:
        until(lambda name=name: [moves for _, moves in velocities(fleet, name)][-5:] == [True] * 5, f"{name} moves", 120)


def test_turtlebots_of_a_fleet_start_their_own_launch_files(turtles: Path, fleet: Fleet) -> None:
    on_fleet(turtles, fleet, 2.0)
    done = projects.quick(turtles, *RUN)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "stop command" not in done.stderr
    rows = projects.sql(turtles, MOVED.format(x="x", y="y", table="path", robot="robot"))
    assert [(row["robot"], row["rows"], row["way"] > 0.01) for row in rows] == [(1, 21, True), (2, 21, True)]
    seen = projects.sql(turtles, "SELECT robot, count(DISTINCT free) > 1 AS changes FROM path GROUP BY robot ORDER BY robot")
    assert [row["changes"] for row in seen] == [True, True], "the laser measures other distances while a robot moves"
    for name in fleet.names:
        assert not [line for line in fleet.commands(name) if "ros" in line]


@pytest.mark.nightly
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_node_outlives_a_driver_that_is_ended(turtles: Path, fleet: Fleet, number: signal.Signals) -> None:
    on_fleet(turtles, fleet, 600.0)
    log_velocities(turtles)
    with robot_project.drive(turtles, RUN) as process:
        all_move(fleet, fleet.names[:2])
        process.send_signal(number)
        process.communicate(timeout=120)
    for name in fleet.names:
        until(lambda name=name: not fleet.commands(name), lambda name=name: fleet.commands(name), 30)
    assert [velocities(fleet, name)[-1][1] for name in fleet.names[:2]] == [False, False], "the last velocity is zero"


@pytest.mark.each_case
@pytest.mark.parametrize("deaf", [False, True])
def test_a_stop_command_needs_no_master_and_ends_the_velocities_of_a_run(turtles: Path, fleet: Fleet, deaf: bool) -> None:
    on_fleet(turtles, fleet, 600.0)
    log_velocities(turtles, deaf=deaf)
    stop = tomllib.loads((turtles / "sierra.toml").read_text())["runners"]["robots"]["stop"]
    page = (DOCS / "extensions" / "ros.md").read_text()
    assert stop in [tomllib.loads(block)["runners"]["robots"].get("stop") for block in TABLES.findall(page)]
    name = fleet.names[0]
    link = Fabric(name, LinkOptions(ssh_config=str(fleet.ssh_config)))
    assert link.run(stop).status == 0, "no program of a run executes"
    with robot_project.drive(turtles, RUN) as process:
        all_move(fleet, [name])
        assert link.run(stop) == Ended(0, b"", b"")
        ended = time.monotonic()
        assert not [line for line in fleet.commands(name) if "/wander " in line]
        [written] = fleet.robots[name].home.rglob("tb3_1.csv")
        assert bool(written.read_text()) != deaf, "a controller that obeys SIGINT closes its file"
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=120)
    link.close()
    told = velocities(fleet, name)
    assert max(when for when, _ in told) < ended
    assert told[-1][1] == deaf, "a controller that obeys SIGINT sends zero at its end; the firmware stops the others"


def test_rostopic_is_no_stop_command_because_it_fails_without_a_master(require: Callable[..., str], fleet: Fleet) -> None:
    require("rostopic")
    link = Fabric(fleet.names[0], LinkOptions(ssh_config=str(fleet.ssh_config)))
    ended = link.run(["rostopic", "pub", "-1", "/cmd_vel", "geometry_msgs/Twist", "{}"])
    assert ended.status == 1
    assert b"Unable to communicate with master" in ended.stdout + ended.stderr


@pytest.fixture
def recording(turtles: Path, require: Callable[..., str]) -> Iterator[tuple[Path, Fleet]]:
    """Yield the example, whose runs record until they are stopped, and a fleet with the disks that rosbag needs."""
    robot_fleet.needed(require)
    with Fleet(3, disk="2g") as fleet:
        on_fleet(turtles, fleet, 600.0)
        config = turtles / "sierra.toml"
        config.write_text(config.read_text().replace("[platforms.ros]\n", '[platforms.ros]\nrecord = ["/.*/odom"]\n'))
        yield turtles, fleet


def drive_until_recorded(turtles: Path, fleet: Fleet, names: Iterable[str], grace: float) -> subprocess.Popen[str]:
    """Start a run with this grace time; return its driver when these robots have recorded messages."""
    config = turtles / "sierra.toml"
    config.write_text(config.read_text().replace("grace = 8.0", f"grace = {grace}"))
    process = robot_project.drive(turtles, RUN)

    def records(name: str) -> bool:
        assert process.poll() is None, process.communicate()
        return any(bag.stat().st_size > 4096 for bag in fleet.robots[name].home.rglob("run.bag.active"))

    for name in names:
        until(partial(records, name), f"{name} records")
    return process


def bags_of(turtles: Path) -> list[str]:
    """Return the names of all bags that were pulled."""
    return sorted(row["path"] for row in projects.sql(turtles, "SELECT path FROM artifacts WHERE path LIKE '%run.bag%'"))


@pytest.mark.nightly
@pytest.mark.parametrize("grace", [SHORT_S, 30.0])
def test_a_planned_end_counts_only_if_no_bag_can_be_cut(recording: tuple[Path, Fleet], grace: float) -> None:
    turtles, fleet = recording
    base, *others = fleet.names
    text = (turtles / "sierra.toml").read_text().replace('tb3_{number}.csv"', 'none_{number}.csv", required = false')
    command = '["sh", "-c", "until [ -e /home/robot/go ]; do sleep 0.1; done"]'
    text = text.replace("\nrobots.count", f"\nrobots.base = {{ command = {command} }}\nrobots.count")
    (turtles / "sierra.toml").write_text(text.replace(f'host = "{base}"', f'host = "{base}", group = "base"'))
    with drive_until_recorded(turtles, fleet, others, grace) as process:
        (fleet.robots[base].home / "go").touch()
        output, errors = process.communicate(timeout=300)
    [found] = projects.sql(turtles, "SELECT status, reason FROM executions")
    if grace == SHORT_S:
        assert (process.returncode, found["status"]) == (1, "failed"), output + errors
        assert found["reason"].startswith(f"{others[0]} {KILLED}")
    else:
        assert (process.returncode, found["status"]) == (0, "ok"), output + errors
        assert bags_of(turtles) == ["1/run.bag", "2/run.bag"]
    assert all(fleet.commands(name) == [] for name in fleet.names)


@pytest.mark.nightly
@pytest.mark.parametrize("grace", [SHORT_S, 30.0])
def test_a_lost_radio_ends_recordings_on_all_robots(recording: tuple[Path, Fleet], grace: float) -> None:
    turtles, fleet = recording
    first, second, _ = fleet.names
    with drive_until_recorded(turtles, fleet, (first, second), grace) as process:
        fleet.radio(second, up=False)
        output, errors = process.communicate(timeout=300)
    assert process.returncode in (1, 3), output + errors
    for name in fleet.names:
        until(lambda name=name: not fleet.commands(name), lambda name=name: fleet.commands(name))
    [found] = projects.sql(turtles, "SELECT status, reason FROM executions")
    assert found["status"] == "failed"
    assert found["reason"].startswith(f"{second} was lost: ")
    if grace == SHORT_S:
        assert f"{first} {KILLED}" in found["reason"]
    else:
        assert "killed" not in found["reason"]
        assert bags_of(turtles) == ["1/run.bag"]
        assert [bag.name for bag in fleet.robots[second].home.rglob("run.bag*")] == ["run.bag"]


@pytest.mark.nightly
def test_a_run_starts_only_if_topics_have_messages(require: Callable[..., str], fleet: Fleet, tmp_path: Path) -> None:
    require("rostopic")
    name = fleet.names[0]
    options = LinkOptions(ssh_config=str(fleet.ssh_config))
    checks = [["timeout", "8", "rostopic", "echo", "-n1", topic] for topic in ("/scan", "/odom")]
    homes = {name: fleet.robots[name].home}
    runs = Runs(tmp_path, homes, lambda host, _: Fabric(host, options), checks=checks, stop=[])

    def begin(command: str, topic: str) -> None:
        fleet.enter(name, "sh", "-c", f"ROS_HOME=/run/ros setsid {command} >/dev/null 2>&1 </dev/null &")
        until(lambda: topic in fleet.enter(name, "sh", "-c", "rostopic list 2>&1 || true").split(), f"{topic} is there", 60)

    try:
        begin("roscore", "/rosout")
        begin("rostopic pub -r 10 /scan std_msgs/String there", "/scan")
        lacks = (
            r"^rb1: not ready: timeout 8 rostopic echo -n1 /odom: WARNING: topic \[/odom\] does not appear to be published yet$"
        )
        with pytest.raises(Missing, match=lacks):
            runs.run(job(1, robots=1))
        assert runs.begun() == []
        begin("rostopic pub -r 10 /odom std_msgs/String there", "/odom")
        assert [one.error for one in runs.run(job(2, robots=1))] == [None]
        rates = partial(Runs, tmp_path, homes, lambda host, _: Fabric(host, options), stop=[])
        slow = r"^rb1: not ready: /scan: (9\.\d+|1[01](\.\d)?) messages a second; at least 20 are required$"
        with pytest.raises(Missing, match=slow):
            rates(topic_rates={"/scan": 20.0, "/odom": 8.0}).run(job(3, robots=1))
        with pytest.raises(Missing, match=r"/imu: WARNING: topic \[/imu\] does not appear to be published yet$"):
            rates(topic_rates={"/scan": 8.0, "/imu": 8.0}).run(job(4, robots=1))
        assert [one.error for one in rates(topic_rates={"/scan": 8.0, "/odom": 8.0}).run(job(5, robots=1))] == [None]
        nodes = fleet.enter(name, "sh", "-c", "ROS_HOME=/run/ros rosnode list")
        assert nodes.count("/rostopic_") == 2, "only those that publish"
    finally:
        fleet.power_cut(name)
