"""Runs of ROS 2 on several robots with real sshd and rclpy: they share one domain, and begin and end together."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import projects
from tests.extensions.ros import ros2
from tests.extensions.ros.test_ros2 import NODE
from tests.support import robot_fleet
from tests.support.robot_fleet import Fleet

pytestmark = pytest.mark.integration

SETTINGS = """\
platform = "ros"
runner = "robots"
template = "nodes.launch.xml"
observe = "none"
variables.level = "//let[@name='level']/@value"
robots.count = 2

[platforms.ros]
ros = 2
length = 1.5
patience = 30.0
packages = ["packages"]
setup = "{project}/setup.bash"
record = ["/chatter", "/.*/own"]
wait_for = ["listener"]

[outputs.heard]
file = "robot{number}.csv"
time = "tick"
mismatch = "ragged"

[runners.robots]
stop = []
grace = 8.0
disk_min = 1
"""
BAG = """
[outputs.bag]
file = "run/run_0.mcap"
format = "bag"
topics = ["/chatter", "/*/own"]
mismatch = "ragged"
volatile = ["received_ns"]
"""
LAUNCH = """\
<launch>
  <let name="level" value="0"/>
  <group>
    <push_ros_namespace namespace="robot0"/>
    <node pkg="nodes" exec="talker.py" name="talker"/>
    <node pkg="nodes" exec="listener.py" name="listener"/>
  </group>
</launch>
"""
TALKER = """\
place = node.declare_parameter("sierra_place", -1).value
chatter = node.create_publisher(Int64, "/chatter", 100)
own = node.create_publisher(Int64, "own", 100)
def say():
    chatter.publish(Int64(data=place))
    own.publish(Int64(data=place))
node.create_subscription(Bool, "/sierra/started", lambda _: node.create_timer(0.05, say), latched)
rclpy.spin(node)
"""
LISTENER = """\
name = node.get_namespace().strip("/")
length = node.declare_parameter("sierra_length", 0.0).value
file = open(os.path.join(os.environ["SIERRA_OUTPUT"], f"{name}.csv"), "w")
print("tick,place", file=file)
rows = []
assert "0100FFEF" not in open("/proc/net/igmp").read(), "nothing is received that was sent to all"
node.create_subscription(Int64, "/chatter", lambda message: rows.append(message.data), 100)
def end():
    for tick, place in enumerate(rows):
        print(tick, place, sep=",", file=file)
    file.close()
    sys.exit()
node.create_subscription(Bool, "/sierra/started", lambda _: node.create_timer(length, end), latched)
rclpy.spin(node)
"""


@pytest.fixture
def robots(monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]) -> Iterator[Fleet]:
    """Yield three hosts that have ROS 2."""
    robot_fleet.needed(require)
    ros2.find(monkeypatch, require)
    with Fleet(3, lent=ros2.PROGRAMS.parent) as fleet:
        yield fleet


def project(root: Path, fleet: Fleet, more: str = BAG, *, launch: str = LAUNCH, settings: str = SETTINGS, **nodes: str) -> Path:
    """Make a project for robots, with nodes by name."""
    scripts = root / "packages" / "nodes" / "scripts"
    scripts.mkdir(parents=True)
    (scripts.parent / "package.xml").write_text("<package><name>nodes</name></package>")
    for name, program in {"talker": TALKER, "listener": LISTENER, **nodes}.items():
        (scripts / f"{name}.py").write_text(NODE + program)
    (root / "nodes.launch.xml").write_text(launch)
    (root / "setup.bash").write_text(ros2.SETUP)
    link = f'link_options = {{ ssh_config = "{fleet.ssh_config}" }}\n'
    groups = ["base" if "base = {}" in settings and name == fleet.names[0] else "robot" for name in fleet.names]
    hosts = "".join(
        f'fleet.{name} = {{ host = "{name}", group = "{group}" }}\n' for name, group in zip(fleet.names, groups, strict=True)
    )
    (root / "sierra.toml").write_text(f"{settings}{link}{hosts}{more}")
    return root


def test_robots_hear_each_other_and_record_their_own_topics(robots: Fleet, tmp_path: Path) -> None:
    root = project(tmp_path / "project", robots)
    done = projects.quick(root, "run", "level=1", "--runs", "1", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
    heard = projects.sql(root, "SELECT robot, place, count(*) > 15 AS often FROM heard GROUP BY ALL ORDER BY ALL")
    assert [tuple(row.values()) for row in heard] == [(1, 1, True), (1, 2, True), (2, 1, True), (2, 2, True)]
    recorded = projects.sql(root, "SELECT robot, topic, count(DISTINCT data) AS talkers FROM bag GROUP BY ALL ORDER BY ALL")
    assert [tuple(row.values()) for row in recorded] == [
        *((1, "/chatter", 2), (1, "/robot1/own", 1)),
        *((2, "/chatter", 2), (2, "/robot2/own", 1)),
    ]
    for name in robots.names:
        assert not [line for line in robots.commands(name) if "ros" in line]


@pytest.mark.nightly
def test_a_base_station_starts_what_belongs_to_no_robot_and_records_all(robots: Fleet, tmp_path: Path) -> None:
    launch = LAUNCH.replace("</launch>", '  <node pkg="nodes" exec="talker.py" name="outside"/>\n</launch>')
    settings = SETTINGS.replace("robots.count = 2", "robots = { count = 2, base = {} }")
    root = project(tmp_path / "project", robots, BAG.replace("run/", "0/run/"), launch=launch, settings=settings)
    done = projects.quick(root, "run", "level=1", "--runs", "1", "--no-figures")
    assert done.returncode == 0, done.stdout + done.stderr
    heard = projects.sql(root, "SELECT robot, place, count(*) > 15 AS often FROM heard GROUP BY ALL ORDER BY ALL")
    assert [tuple(row.values()) for row in heard] == [(robot, place, True) for robot in (1, 2) for place in (0, 1, 2)]
    recorded = projects.sql(root, "SELECT topic, count(DISTINCT data) AS talkers FROM bag GROUP BY ALL ORDER BY ALL")
    assert [tuple(row.values()) for row in recorded] == [("/chatter", 3), ("/robot1/own", 1), ("/robot2/own", 1)]


@pytest.mark.nightly
def test_a_node_that_dies_on_one_robot_ends_the_run_on_all(robots: Fleet, tmp_path: Path) -> None:
    dies = 'node.create_timer(0.3, lambda: sys.exit(3 * (node.get_namespace() == "/robot2")))\nrclpy.spin(node)\n'
    root = project(tmp_path / "project", robots, talker=f"time.sleep(0.5)\n{dies}")
    done = projects.quick(root, "run", "level=1", "--runs", "1", "--no-figures")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "ros: the node /robot2/talker died early: exit code 3" in done.stdout
    for name in robots.names:
        assert not [line for line in robots.commands(name) if "ros" in line]


@pytest.mark.parametrize(
    ("launch", "settings", "message"),
    [
        (
            LAUNCH.replace("</launch>", '<node pkg="a" exec="b" name="c"/></launch>'),
            SETTINGS,
            "node is outside the group of the",
        ),
        ('<launch><let name="level" value="0"/></launch>', SETTINGS, "the robots share a domain, but no group of the template"),
        (
            LAUNCH,
            SETTINGS + '[robots.groups.lead]\nplaces = [1]\ncommand = "true"\n',
            "remove the command of robots.groups.lead",
        ),
    ],
)
def test_launch_files_that_one_domain_cannot_have_are_refused(tmp_path: Path, launch: str, settings: str, message: str) -> None:
    (tmp_path / "packages").mkdir()
    (tmp_path / "nodes.launch.xml").write_text(launch)
    (tmp_path / "sierra.toml").write_text(settings)
    done = projects.quick(tmp_path, "run", "-n", "level=1", "--runs", "1")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stdout + done.stderr
    assert message in done.stderr
