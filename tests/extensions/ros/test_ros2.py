"""Runs of the platform `ros` with the real ROS 2: rclpy with Fast DDS."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import projects
from tests.extensions.ros import ros2

pytestmark = pytest.mark.integration

SHARED_MEMORY = Path("/dev/shm")
QUIET = """\
platform = "ros"
template = "nodes.launch.xml"
variables.level = "//let[@name='level']/@value"

[platforms.ros]
ros = 2
length = 1.0
packages = ["packages"]
"""
SETTINGS = f"""\
{QUIET}
record = ["/chatter"]

[outputs.heard]
file = "run/*.mcap"
format = "bag"
topics = ["/*"]
mismatch = "ragged"
volatile = ["received_ns"]
"""
NODE = """\
import os, signal, subprocess, sys, time
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, DurabilityPolicy, ReliabilityPolicy
from std_msgs.msg import Bool, Int64, String

rclpy.init()
node = Node("node")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""
TALKER = """\
seed = node.declare_parameter("seed", -1).value
chatter = node.create_publisher(Int64, "chatter", 10)
node.create_subscription(Bool, "/sierra/started", lambda _: node.create_timer(0.05, say), latched)
def say():
    chatter.publish(Int64(data=seed))
rclpy.spin(node)
"""


@pytest.fixture(autouse=True)
def _ros2(monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]) -> None:
    ros2.find(monkeypatch, require)


def project(root: Path, launch: str, *, settings: str = SETTINGS, **nodes: str) -> Path:
    """Make a project with nodes, which are programs in Python by name, after the beginning that all share."""
    scripts = root / "packages" / "nodes" / "scripts"
    scripts.mkdir(parents=True)
    (scripts.parent / "package.xml").write_text("<package><name>nodes</name></package>")
    for name, program in nodes.items():
        (scripts / f"{name}.py").write_text(NODE + program)
    (root / "nodes.launch.xml").write_text(f'<launch>\n<let name="level" value="0"/>\n{launch}\n</launch>\n')
    (root / "sierra.toml").write_text(settings)
    return root


def failed(root: Path, query: str = "level=1") -> str:
    """Execute one run, which fails; return what is printed."""
    done = projects.quick(root, "run", query, "--runs", "1", "--no-figures")
    assert done.returncode == 1, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_the_example_needs_two_commands(tmp_path: Path) -> None:
    assert projects.quick(tmp_path, "init", "--example", "ros2", "demo").returncode == 0
    settings = (tmp_path / "demo" / "sierra.toml").read_text().replace("length = 3.0", "length = 1.0")
    bag = 'outputs.pose = { file = "run/*.mcap", format = "bag", topics = ["/{name}/pose"], mismatch = "ragged" }\n'
    (tmp_path / "demo" / "sierra.toml").write_text(bag + settings + 'record = ["/.*/pose"]\n')
    done = projects.quick(tmp_path / "demo", "run", "population_size=1,3", "--runs", "1", "--jobs", "2")
    assert done.returncode == 0, done.stderr
    assert any("distance" in str(figure) for figure in (tmp_path / "demo" / "figures").rglob("*.png"))
    walk = "SELECT run, 'robot' || robot AS name, count(*) AS rows, sum(x::DECIMAL(9, 6)) AS x FROM walk GROUP BY ALL"
    pose = "SELECT run, name, count(*) AS rows, sum(round(x, 6)::DECIMAL(9, 6)) AS x FROM pose GROUP BY ALL"
    rows = projects.sql(tmp_path / "demo", f"{walk} ORDER BY ALL")
    assert [row["rows"] for row in rows] == [21] * 4
    assert projects.sql(tmp_path / "demo", f"{pose} ORDER BY ALL") == rows
    assert len({row["x"] for row in rows}) == 3  # robot0 walks alike in both experiments


def test_runs_at_once_hear_only_their_own_nodes_and_get_their_seeds(tmp_path: Path) -> None:
    launch = '<node pkg="nodes" exec="talker.py" name="talker"/><node pkg="nodes" exec="quiet.py" name="quiet"/>'
    root = project(tmp_path / "project", launch, talker=TALKER, quiet="rclpy.spin(node)")
    summary, _ = projects.run(root, "level=1", "--runs", "4", "--jobs", "2")
    assert (summary["executed"], summary["failed"]) == (4, 0)
    heard = projects.sql(
        root, "SELECT run, seed, min(data) AS least, max(data) AS most FROM heard JOIN runs USING (run) GROUP BY ALL"
    )
    assert [(row["least"], row["most"]) for row in heard] == [(row["seed"], row["seed"]) for row in heard]
    assert len({row["seed"] for row in heard}) == 4
    assert not list(SHARED_MEMORY.glob("*fast*"))


def test_a_node_that_dies_fails_its_run_and_is_named(tmp_path: Path) -> None:
    group = '<group><push_ros_namespace namespace="robot"/><node pkg="nodes" exec="{}.py" name="walker"/></group>'
    root = project(
        tmp_path / "project", group.format("dying"), dying="node.create_timer(0.3, lambda: os._exit(3))\nrclpy.spin(node)"
    )
    assert "ros: the node /robot0/walker died early: exit code 3" in failed(root, "population_size=1")


def test_a_node_that_ignores_signals_is_killed(tmp_path: Path) -> None:
    program = """
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)
with open(os.path.join(node.declare_parameter("sierra_output", "").value, "pid"), "w") as file:
    file.write(str(os.getpid()))
while True:
    time.sleep(1)
"""
    root = project(tmp_path / "project", '<node pkg="nodes" exec="deaf.py" name="deaf"/>', deaf=program, settings=QUIET)
    summary, _ = projects.run(root, "level=1", "--runs", "1")
    assert (summary["executed"], summary["failed"]) == (1, 0)
    run = str(projects.sql(root, "SELECT run FROM runs")[0]["run"])
    pid = projects.quick(root, "show", run, "output/pid").stdout.strip()
    assert pid.isdecimal()
    assert not Path("/proc", pid).exists()
    assert not list(SHARED_MEMORY.glob("*fast*"))


def test_what_needs_the_real_launch_is_refused_with_its_line(tmp_path: Path) -> None:
    launch = '<node pkg="nodes" exec="talker.py" name="talker"/>\n<timer period="5.0"/>'
    root = project(tmp_path / "project", launch, talker=TALKER)
    expected = r"Unable to launch input\.launch\.xml, line \d+: <timer> needs the real ros2 launch, which is not on PATH"
    assert re.search(expected, failed(root))


def test_the_simulated_time_ends_a_run(tmp_path: Path) -> None:
    program = """
from rosgraph_msgs.msg import Clock
clock = node.create_publisher(Clock, "/clock", 10)
tick = 0
def step():
    global tick
    tick += 1
    message = Clock()
    message.clock.sec, message.clock.nanosec = tick // 10, tick % 10 * 10**8
    clock.publish(message)
node.create_timer(0.005, step)
rclpy.spin(node)
"""
    settings = SETTINGS.replace("/chatter", "/clock").replace("length = 1.0", "length = 30.0\nuse_sim_time = true")
    simulator = '<node pkg="nodes" exec="simulator.py" name="simulator"><param name="use_sim_time" value="false"/></node>'
    root = project(tmp_path / "project", simulator, simulator=program, settings=settings)
    summary, _ = projects.run(root, "level=1", "--runs", "1")
    assert (summary["executed"], summary["failed"]) == (1, 0)
    [times] = projects.sql(root, "SELECT (max(clock_ns) - min(clock_ns)) / 1e9 AS seconds FROM heard")
    assert times["seconds"] >= 30


@pytest.mark.nightly
def test_the_time_does_not_begin_without_a_node(tmp_path: Path) -> None:
    nodes = '<node pkg="nodes" exec="pair.py"/><node pkg="nodes" exec="slow.py" name="slow"/>'
    pair = 'other = Node("other")\nrclpy.spin(node)'
    settings = QUIET + "patience = 30.0\n"
    root = project(tmp_path / "project", nodes, pair=pair, slow="", settings=settings)
    (root / "packages/nodes/scripts/slow.py").write_text("import time\ntime.sleep(1000)\n")
    assert re.search(r"ros: after 30 s, 1 of 2 programs are nodes \(/node, /other\); for programs", failed(root))


def test_messages_of_a_late_publisher_are_lost(tmp_path: Path) -> None:
    program = """
def late(_):
    chatter = node.create_publisher(Int64, "chatter", 10)
    for number in range(5):
        chatter.publish(Int64(data=number))
    time.sleep(0.6)
    chatter.publish(Int64(data=5))
    time.sleep(0.1)
node.create_subscription(Bool, "/sierra/started", late, latched)
rclpy.spin(node)
"""
    root = project(tmp_path / "project", '<node pkg="nodes" exec="late.py" name="late"/>', late=program)
    assert re.search(r"messages were lost while they were recorded: [1-5] of /chatter \(nodes that create", failed(root))


def test_two_types_of_one_topic_fail_their_run(tmp_path: Path) -> None:
    other = TALKER.replace('Int64, "chatter"', 'String, "chatter"').replace("Int64(data=seed)", "String(data=str(seed))")
    nodes = '<node pkg="nodes" exec="talker.py" name="a"/><node pkg="nodes" exec="other.py" name="b"/>'
    root = project(tmp_path / "project", nodes, talker=TALKER, other=other)
    assert "ros: /chatter has several types: std_msgs/msg/Int64, std_msgs/msg/String" in failed(root)


@pytest.mark.parametrize(
    ("sequence", "message"),
    [
        ("[0.1 * k for k in range(40)] + [0.2]", r"ros: the simulated time went back from 3\.9 s to 0\.2 s"),
        ("[0.1 * k for k in range(40)] + [1000.0]", r"ros: the simulated time went from 3\.\d s to 1000 s at once"),
        pytest.param(
            "[0.1 * k for k in range(40)]", r"ros: the simulated time has been 3\.9 s for 30 s", marks=pytest.mark.nightly
        ),
    ],
)
@pytest.mark.each_case
def test_a_simulated_time_that_jumps_fails_its_run(tmp_path: Path, sequence: str, message: str) -> None:
    program = f"""
from rosgraph_msgs.msg import Clock
clock = node.create_publisher(Clock, "/clock", 100)
times = iter({sequence})
def step():
    now = next(times, None)
    if now is not None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = int(now), round(now % 1 * 10**9)
        clock.publish(message)
node.create_timer(0.1, step)
rclpy.spin(node)
"""
    settings = QUIET.replace("length = 1.0", "length = 30.0\nuse_sim_time = true\npatience = 30.0")
    simulator = '<node pkg="nodes" exec="simulator.py" name="simulator"><param name="use_sim_time" value="false"/></node>'
    assert re.search(message, failed(project(tmp_path / "project", simulator, simulator=program, settings=settings)))


def test_a_launch_file_with_its_own_seed_is_refused(tmp_path: Path) -> None:
    launch = '<set_parameter name="seed" value="1"/><node pkg="nodes" exec="talker.py" name="talker"/>'
    root = project(tmp_path / "project", launch, talker=TALKER)
    done = projects.quick(root, "run", "level=1", "--dry-run")
    assert (done.returncode, "sets the parameter seed for all nodes, as SIERRA does" in done.stderr) == (2, True)


@pytest.mark.parametrize("may_lose", [False, True])
@pytest.mark.each_case
def test_messages_that_the_recorder_loses_fail_their_run_with_their_number(tmp_path: Path, may_lose: bool) -> None:
    program = """
import glob
chatter = node.create_publisher(Int64, "chatter", 1)
def burst(_):
    domain = f"ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']}".encode()
    for folder in glob.glob("/proc/[0-9]*"):
        try:
            words, variables = (open(f"{folder}/{name}", "rb").read() for name in ("cmdline", "environ"))
        except OSError:
            continue
        if b"ros2_watcher.py" in words and domain in variables.split(b"\\0"):
            watcher = int(os.path.basename(folder))
    os.kill(watcher, signal.SIGSTOP)
    for number in range(20000):
        chatter.publish(Int64(data=number))
    os.kill(watcher, signal.SIGCONT)
    time.sleep(0.5)
    chatter.publish(Int64(data=20000))
    time.sleep(2.0)
    sys.exit()
node.create_subscription(Bool, "/sierra/started", burst, latched)
rclpy.spin(node)
"""
    settings = SETTINGS.replace("length = 1.0", f'length = 1.0\nwait_for = ["fast"]\nmay_lose = {str(may_lose).lower()}')
    root = project(tmp_path / "project", '<node pkg="nodes" exec="fast.py" name="fast"/>', fast=program, settings=settings)
    if may_lose:
        projects.run(root, "level=1", "--runs", "1")
        run = str(projects.sql(root, "SELECT run FROM runs")[0]["run"])
        lines = re.findall(r"recorded (\d+) messages, lost (\d+)", projects.quick(root, "show", run, "stdout").stdout)
        assert [sum(map(int, line)) for line in lines] == [20001]
        assert projects.sql(root, "SELECT count(*)::VARCHAR AS rows FROM heard") == [{"rows": lines[0][0]}]
    else:
        lost = re.search(r"messages were lost while they were recorded: (\d+) of /chatter", failed(root))
        assert lost is not None
        assert 0 < int(lost[1]) < 20001


@pytest.mark.nightly
def test_a_thousand_messages_per_second_are_recorded_without_a_loss(tmp_path: Path) -> None:
    program = """
from nav_msgs.msg import Odometry
topics = [node.create_publisher(Odometry, f"chatter{number}", 10) for number in range(10)]
ticks = 0
def step():
    global ticks
    for number, topic in enumerate(topics):
        message = Odometry()
        message.header.stamp.sec, message.pose.pose.position.x = ticks, float(number)
        topic.publish(message)
    ticks += 1
    if ticks == 6000:
        sys.exit()
node.create_subscription(Bool, "/sierra/started", lambda _: node.create_timer(0.01, step), latched)
rclpy.spin(node)
"""
    settings = SETTINGS.replace("/chatter", "/chatter.*").replace("length = 1.0", 'length = 60.0\nwait_for = ["fast"]')
    root = project(tmp_path / "project", '<node pkg="nodes" exec="fast.py" name="fast"/>', fast=program, settings=settings)
    summary, _ = projects.run(root, "level=1", "--runs", "1")
    assert (summary["executed"], summary["failed"]) == (1, 0)
    counts = projects.sql(
        root, "SELECT topic, count(*) AS rows, count(DISTINCT header_stamp_ns) AS times FROM heard GROUP BY topic"
    )
    assert [(row["rows"], row["times"]) for row in counts] == [(6000, 6000)] * 10
