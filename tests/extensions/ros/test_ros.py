"""The platform `ros`: the launch files that it generates, for ROS 1 and ROS 2; ROS itself is not needed."""

from __future__ import annotations

import argparse
import math
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

import sierra
import sierra.extensions.ros
from sierra.config import project_file
from sierra.design import robots
from sierra.design.platforms import base
from sierra.design.query import grammar
from sierra.errors import ConfigError, QueryError, SierraError, TemplateError
from sierra.extensions.ros.platform import Ros
from sierra.extensions.trials import poses
from sierra.model import Set
from sierra.templates import several
from sierra.testing import platforms
from tests import projects
from tests.extensions.ros import ros2
from tests.simulator_inputs import SEED, inputs

LAUNCH = """\
<launch>
  <!-- one robot -->
  <group ns="tb3_0">
    <arg name="x" value="0"/>
    <node pkg="walkers" type="walker" name="walker" args="$(arg x) $(arg robot)"/>
  </group>
  <node pkg="walkers" type="judge" name="judge"/>
</launch>
"""
LAUNCH2 = """\
<launch>
  <group>
    <push_ros_namespace namespace="robot"/>
    <node pkg="walkers" exec="walker" name="walker"><param name="seed" value="$(var sierra_random_seed)"/></node>
  </group>
</launch>
"""
OPTIONS = "length = 5.0\n"
DRIVERS = Path(sierra.extensions.ros.__file__).parent / "drivers"


def make(folder: Path, options: str = OPTIONS, launch: str = LAUNCH, more: str = "", name: str = "swarm.launch") -> Path:
    """Write a project of ROS."""
    folder.mkdir()
    (folder / name).write_text(launch)
    (folder / "sierra.toml").write_text(f'template = "{name}"\nplatform = "ros"\n{more}\n[platforms.ros]\n{options}')
    return folder


def launched(root: Path, *query: str) -> ElementTree.Element:
    """Return the launch file of a run."""
    made = inputs(root, *query)
    return ElementTree.fromstring(next(text for name, text in made.items() if name.startswith("input.launch")))  # noqa: S314


def command(root: Path) -> str:
    return " ".join(base.find("ros", project_file.load(root).config).command())


@pytest.mark.parametrize(("launch", "options"), [(LAUNCH, OPTIONS), (LAUNCH2, OPTIONS + "ros = 2\n")])
def test_it_is_a_platform(tmp_path: Path, launch: str, options: str) -> None:
    root = make(tmp_path / "p", options, launch)
    project = project_file.load(root).config
    [criterion] = grammar.parse_all(("population_size.Log8",))
    platforms.check(Ros, project, several.of_project(project, root), {"population_size": criterion})


def test_a_run_gets_a_group_for_each_robot_and_a_node_that_ends_it(tmp_path: Path) -> None:
    root = make(tmp_path / "p", OPTIONS + "ticks_per_second = 20\nposes = [[1, 2], [3, 4, 0.5]]\n")
    launch = launched(root, "population_size=2")
    settings = {one.get("name"): (one.get("type"), one.get("value")) for one in launch.findall("group[@ns='sierra']/param")}
    assert settings["random_seed"] == ("int", str(SEED))
    assert settings["population_size"] == ("int", "2")
    assert settings["length"] == ("double", "5.0")
    assert settings["ticks_per_second"] == ("auto", "20")
    robots = [group for group in launch.findall("group") if group.get("ns") != "sierra"]
    assert [group.get("ns") for group in robots] == ["tb3_0", "tb3_1"]
    given = {one.get("name"): one.get("value") for one in robots[1].findall("arg")}
    assert given == {"robot": "tb3_1", "index": "1", "x": "3.0", "y": "4.0", "yaw": "0.5"}
    keeper = launch.find("node[@name='sierra_timekeeper']")
    assert keeper is not None
    assert keeper.get("required") == "true"


def test_runs_bring_the_programs_that_start_and_end_them(tmp_path: Path) -> None:
    made = inputs(make(tmp_path / "p"), "montecarlo.C1")
    for name in ("ros_driver.py", "ros1_run.py", "ros_timekeeper.py"):
        assert made[name] == (DRIVERS / name).read_text()


ROSPY = """
import time
began = time.monotonic()
params = {"/sierra/length": 0.8, "/sierra/started": True, "/use_sim_time": SIMULATED}
init_node = is_shutdown = lambda name=None: None
get_param, set_param = params.get, params.__setitem__
def get_time():
    return time.time() + (137.0 if time.monotonic() - began > 0.3 else 0.0)
"""


@pytest.mark.parametrize("simulated", [False, True])
def test_the_length_of_a_run_is_in_simulated_time_or_else_that_of_no_clock_that_is_set(tmp_path: Path, simulated: bool) -> None:
    (tmp_path / "rospy.py").write_text(ROSPY.replace("SIMULATED", str(simulated)))
    names = {"PATIENCE": "1", "AWAIT": "", "ROBOTS": "", "RUN": "whole", "MARKER": str(tmp_path / "marker")}
    variables = {"PYTHONPATH": str(tmp_path), **{f"SIERRA_ROS_{name}": value for name, value in names.items()}}
    began = time.monotonic()
    subprocess.run([sys.executable, DRIVERS / "ros_timekeeper.py"], env=variables, check=True)
    assert (tmp_path / "marker").read_text() == "whole"
    assert simulated or time.monotonic() - began >= 0.8


def test_poses_come_from_the_seed_and_do_not_depend_on_the_number_of_robots(tmp_path: Path) -> None:
    root = make(tmp_path / "p", OPTIONS + "random_poses = { x = [-1, 1], y = [2, 3], distance = 0.4 }\n")

    def places(count: int) -> list[tuple[float, float]]:
        groups = launched(root, f"population_size={count}").findall("group")[1:]
        return [tuple(float(group.find(f"arg[@name='{name}']").get("value")) for name in "xy") for group in groups]  # type: ignore[union-attr, arg-type, misc]

    eight = places(8)
    assert places(3) == eight[:3]
    assert all(-1 <= x <= 1 and 2 <= y <= 3 for x, y in eight)
    assert min(abs(complex(*a) - complex(*b)) for a in eight for b in eight if a != b) >= 0.4
    with pytest.raises(QueryError, match="found no place at a distance"):
        inputs(root, "population_size=40")


def test_a_person_places_robots_where_the_launch_file_says(tmp_path: Path) -> None:
    more = '[robots]\ncount = "population_size"\n[trials]\nsupervised = true\n'
    root = make(tmp_path / "p", OPTIONS + "random_poses = { x = [-1, 1], y = [2, 3], distance = 0.4 }\n", more=more)
    plan = sierra.open(root).plan("population_size=3", runs=2)
    for run, files in plan.inputs.files(plan.batch, lambda run: True):
        launches = [dict(own)["input.launch"].decode() for _, own in robots.read(files)]
        found = [[float(re.findall(f'name="{name}" value="(.*?)"', one)[0]) for name in ("x", "y", "yaw")] for one in launches]
        expected = tuple((x, y, round(math.degrees(yaw) % 360, 1)) for x, y, yaw in found)
        assert poses.of_run(plan, run, plan.project.config.added("trials", None)) == expected
        assert len(set(expected)) == 3


@pytest.mark.parametrize("declared", ["poses = [[1, 2]]", "draw_poses = { count = 1, x = [0, 1], y = [0, 1] }"])
def test_start_poses_are_declared_once(tmp_path: Path, declared: str) -> None:
    more, own = f"[trials]\nsupervised = true\n{declared}\n", '    <arg name="x" value="0"/>\n'
    with pytest.raises(ConfigError, match="both declare start poses; remove those in"):
        inputs(make(tmp_path / "a", OPTIONS + "poses = [[1, 2]]\n", more=more), "population_size=1")
    with pytest.raises(TemplateError, match="the launch file gives robots its own argument x; declare the poses in"):
        inputs(make(tmp_path / "b", more=more), "population_size=1")
    assert inputs(make(tmp_path / "c", launch=LAUNCH.replace(own, ""), more=more), "population_size=1")
    assert inputs(make(tmp_path / "d", OPTIONS + "poses = [[1, 2]]\n", more=f"[trials]\n{declared}\n"), "population_size=1")


def test_options_are_arguments_of_the_program(tmp_path: Path) -> None:
    assert command(make(tmp_path / "a")) == ("/usr/bin/python3 {run}/ros_driver.py {input} {output} roslaunch --patience 60.0")
    options = (
        'packages = ["ros"]\nwait_for = ["walker"]\nrecord = ["/.*/odom"]\nbarrier = false\npatience = 5\nsetup = "/o/s.bash"\n'
    )
    assert command(make(tmp_path / "b", OPTIONS + options)).endswith(
        " roslaunch --packages {project}/ros --setup /o/s.bash --await walker --patience 5.0 --no-barrier"
        " --record /.*/odom --bag run.bag"
    )
    assert "--setup /b.bash" in command(make(tmp_path / "c", OPTIONS + 'robots.b = { setup = "/b.bash" }\n'))


def test_a_kind_of_robot_has_a_prefix_and_a_model(tmp_path: Path) -> None:
    kinds = 'robot = "waffle"\nrobots.burger = { prefix = "b" }\nrobots.waffle = { prefix = "wa_", model = "waffle_pi" }\n'
    groups = launched(make(tmp_path / "p", OPTIONS + kinds), "population_size=2").findall("group")[1:]
    assert [group.get("ns") for group in groups] == ["wa_0", "wa_1"]
    assert all(group.find("arg[@name='model'][@value='waffle_pi']") is not None for group in groups)


def test_topics_are_recorded_by_a_node(tmp_path: Path) -> None:
    launch = launched(make(tmp_path / "p", OPTIONS + 'record = ["/tb3_0/odom", "/.*/scan"]\n'), "montecarlo.C1")
    node = launch.find("node[@pkg='rosbag']")
    assert node is not None
    assert node.get("args") == "-O $(env SIERRA_OUTPUT)/run.bag -e /tb3_0/odom /.*/scan"


def test_no_path_and_no_port_is_in_the_files_of_a_run(tmp_path: Path) -> None:
    one, other = (inputs(make(tmp_path / name, OPTIONS), "population_size=2") for name in ("one", "two"))
    assert one == other
    assert str(tmp_path) not in "".join(one.values())


def test_robots_stay_as_they_are_without_a_group_that_is_one_robot(tmp_path: Path) -> None:
    twice = LAUNCH.replace("</launch>", '<group ns="lead"><node pkg="p" type="t" name="n"/></group></launch>')
    root = make(tmp_path / "p", launch=twice)
    assert [group.get("ns") for group in launched(root, "montecarlo.C1").findall("group")] == ["sierra", "tb3_0", "lead"]
    with pytest.raises(QueryError, match="one group must be one robot, but there are: tb3_0, lead; set group"):
        inputs(root, "population_size=2")
    chosen = launched(make(tmp_path / "q", OPTIONS + 'group = "tb3_0"\n', twice), "population_size=2")
    assert [group.get("ns") for group in chosen.findall("group")] == ["sierra", "tb3_0", "tb3_1", "lead"]


@pytest.mark.parametrize(
    ("options", "added", "message"),
    [
        ("", '<group ns="lead"/>', "one group must be one robot, but there are: tb3_0, lead; set group"),
        ('group = "tb3_0"\n', '<group ns="tb3_2"/>', "another group has the namespace 'tb3_2' of a robot"),
    ],
)
def test_changes_cannot_make_another_number_of_robots(tmp_path: Path, options: str, added: str, message: str) -> None:
    root = make(tmp_path / "p", OPTIONS + options, more=f"changes = [{{ add = '/launch', xml = '{added}' }}]")
    with pytest.raises(SierraError, match=re.escape(message)):
        inputs(root, "population_size=3")


def test_the_length_of_ros_2_is_that_of_the_driver(tmp_path: Path) -> None:
    more = "changes = [{ set = \"//let[@name='sierra_length']/@value\", value = 9 }]"
    root = make(tmp_path / "p", OPTIONS + "ros = 2\n", LAUNCH2, more)
    with pytest.raises(TemplateError, match="no change can set it"):
        inputs(root, "population_size=1")


@pytest.mark.parametrize(
    ("options", "before", "after", "error", "message"),
    [
        ("", "", "", TemplateError, "the launch file has no length"),
        ("length = 1\n", ' ns="tb3_0"', "", TemplateError, "a group with nodes has no namespace"),
        ("length = 1\n", "<launch>", '<launch><machine name="far"/>', TemplateError, "names another machine ('far')"),
        ("length = 1\n", "launch>", "robot>", SierraError, "/launch"),
        ("length = 1\nros = 2\n", "", "", QueryError, "but there are: none"),
        (
            'length = 1\nrecord = ["/(a|b)/odom|scan"]\n',
            "",
            "",
            ConfigError,
            "each alternative must begin with /, as in /a/odom",
        ),
        ('length = 1\nrobot = "x"\n', "", "", ConfigError, "unknown robot 'x'; known are none"),
        ("length = 1\nposes = [[0, 0]]\n", "", "", QueryError, "there are 1 poses for 2 robots"),
        ("length = 1\nposes = [[0, 0]]\n", ' ns="tb3_0"', ' if="1"', TemplateError, "poses need one group that is one robot"),
        ("length = 1\nrobots = { a = {}, b = {} }\n", "", "", ConfigError, "there are several kinds of robots (a, b)"),
        (
            "length = 1\nrandom_poses = { x = [1, 0], y = [0, 1] }\n",
            "",
            "",
            ConfigError,
            "the limits of x are in the wrong order",
        ),
    ],
)
def test_what_would_go_wrong_is_refused(
    tmp_path: Path, options: str, before: str, after: str, error: type[SierraError], message: str
) -> None:
    root = make(tmp_path / "p", options, LAUNCH.replace(before, after) if before else LAUNCH)
    with pytest.raises(error, match=re.escape(message)):
        inputs(root, "montecarlo.C1" if error is TemplateError else "population_size=2")


def test_a_change_that_removes_the_required_node_is_refused(tmp_path: Path) -> None:
    more = "changes = [{ remove = \"//node[@name='sierra_timekeeper']\" }]"
    with pytest.raises(TemplateError, match="the required node sierra_timekeeper"):
        inputs(make(tmp_path / "p", more=more), "montecarlo.C1")


def test_each_robot_of_a_run_on_robots_gets_a_launch_file_of_its_own(tmp_path: Path) -> None:
    places = "poses = [[1, 0], [2, 0], [3, 0]]\n"
    more = '[robots]\ncount = "population_size"\nbase = { command = "true" }\n'
    platform = base.find("ros", project_file.load(make(tmp_path / "p", OPTIONS + places + more)).config)
    assert [change.value for change in platform.seed_changes() if isinstance(change, Set)] == ["{seed}", "{robot}"]
    given = '<param name="population_size" value="3"/><param name="place" value="{}"/>'

    def groups(place: int) -> list[tuple[str | None, list[str | None]]]:
        document = LAUNCH.replace("<launch>", f'<launch><group ns="sierra">{given.format(place)}</group>')
        made = ElementTree.fromstring(platform.files(document.encode())[0][1])  # noqa: S314
        found = [group for group in made.findall("group") if group.get("ns") != "sierra"]
        return [(group.get("ns"), [one.get("value") for one in group.findall("arg[@name='x']")]) for group in found]

    assert [groups(place) for place in (0, 1, 3)] == [[], [("tb3_1", ["1.0"])], [("tb3_3", ["3.0"])]]


def test_robots_with_one_master_leave_all_but_their_own_nodes_to_the_base_station(tmp_path: Path) -> None:
    more = 'runner = "robots"\n[robots]\ncount = "population_size"\nbase = {}\n'
    arena = LAUNCH.replace("<launch>", '<launch><arg name="arena" value="lab"/><param name="/goal" value="$(arg arena)"/>')
    root = make(tmp_path / "p", OPTIONS + 'record = ["/.*/pose"]\nposes = [[1, 0], [2, 0]]\n', arena, more)
    assert " --share-master" in command(root)
    plan = sierra.open(root).plan("population_size=2", runs=1)
    [(_, files)] = plan.inputs.files(plan.batch, lambda run: True)
    launches = {place.number: ElementTree.fromstring(dict(own)["input.launch"]) for place, own in robots.read(files)}  # noqa: S314
    assert [child.get("name") or child.get("ns") for child in launches[2]] == ["sierra", "arena", "/goal", "tb3_2"]
    assert launches[2].findall("group/arg[@name='x']")[0].get("value") == "2.0"
    base_station = [child.get("name") or child.get("ns") for child in launches[0] if child.get("ns") != "sierra"]
    assert base_station == ["arena", "/goal", "judge", "sierra_timekeeper", "sierra_bag"]
    settings = [{one.get("name") for one in launch.findall("group[@ns='sierra']/param")} for launch in launches.values()]
    assert settings == [{"random_seed", "population_size", "length"}] * 3
    alone = '[robots]\ncount = 2\nbase = { command = "true" }\n'
    assert "--share-master" not in command(make(tmp_path / "alone", more=alone))


def test_robots_in_one_domain_leave_all_but_their_own_nodes_to_the_base_station(tmp_path: Path) -> None:
    more = 'runner = "robots"\n[robots]\ncount = "population_size"\nbase = {}\n'
    launch = LAUNCH2.replace("<launch>", '<launch><let name="arena" value="lab"/><node pkg="w" exec="judge" name="judge"/>')
    root = make(tmp_path / "p", OPTIONS + "ros = 2\n", launch, more, "swarm.launch.xml")
    assert " --fleet base" in command(root)
    plan = sierra.open(root).plan("population_size=2", runs=1)
    [(_, files)] = plan.inputs.files(plan.batch, lambda run: True)
    launches = {
        place.number: ElementTree.fromstring(dict(own)["input.launch.xml"])  # noqa: S314
        for place, own in robots.read(files)
    }
    tags = {
        place: [child.tag for child in root if child.tag not in ("let", "set_parameter")] for place, root in launches.items()
    }
    assert tags == {0: ["node"], 1: ["group"], 2: ["group"]}
    places = [root.findall("let[@name='sierra_place']")[0].get("value") for root in launches.values()]
    assert places == ["0", "1", "2"]
    assert launches[2].findall("let[@name='arena']")[0].get("value") == "lab"
    assert " --fleet robots" in command(
        make(tmp_path / "alone", OPTIONS + "ros = 2\n", LAUNCH2, more.replace("base = {}\n", ""))
    )


def test_robots_find_the_master_of_their_run_and_refuse_one_out_of_reach(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = ros2.driver("ros1_run")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def part(place: int, base_address: str, execution: str = "e1") -> Any:
        monkeypatch.setenv("SIERRA_ADDRESS", "10.0.0.1" if place else base_address)
        given = {
            "SIERRA_EXECUTION": execution,
            "SIERRA_ROBOTS": "2",
            "SIERRA_ROBOT": str(place),
            "SIERRA_ADDRESS_0": base_address,
        }
        for name, value in given.items():
            monkeypatch.setenv(name, value)
        return driver.launch(argparse.Namespace(share_master=True, setup=None))

    base_station, robot, other = part(0, "10.0.0.9"), part(2, "10.0.0.9"), part(2, "10.0.0.9", "e2")
    assert (robot.run, robot.find_master()) == (base_station.run, (str(base_station.ports[0]), "--wait"))
    assert base_station.robots == ["robot1", "robot2"]
    assert other.run != robot.run
    for address in ("127.0.0.1", "fe80::1"):
        with pytest.raises(driver.Failure, match=f"10.0.0.1 cannot reach {address} by ROS 1; give it another address"):
            part(1, address).find_master()
    monkeypatch.delenv("SIERRA_ADDRESS_0")
    with pytest.raises(driver.Failure, match="SIERRA_ADDRESS_0 is not set; give each robot its address"):
        driver.Robot(argparse.Namespace(setup=None))


def test_groups_of_ros_2_are_copied_with_their_namespace(tmp_path: Path) -> None:
    root = make(tmp_path / "p", OPTIONS + "ros = 2\nuse_sim_time = true\n", LAUNCH2)
    launch = launched(root, "population_size=2")
    assert {one.get("name"): one.get("value") for one in launch.findall("let")} == {
        "sierra_random_seed": str(SEED),
        "sierra_population_size": "2",
        "sierra_length": "5.0",
        "sierra_output": "$(env SIERRA_OUTPUT)",
    }
    assert [one.get("namespace") for one in launch.iter("push_ros_namespace")] == ["robot0", "robot1"]
    assert [one.get("value") for one in launch.findall("group/let[@name='robot']")] == ["robot0", "robot1"]
    assert command(root).endswith(" ros2 --ros 2 --length 5.0 --patience 60.0 --sim-time")


def test_launch_files_of_ros_2_may_be_yaml(tmp_path: Path) -> None:
    text = "launch:\n- let: {name: seed, value: '0'}\n- node: {pkg: walkers, exec: walker, name: walker}\n"
    seed = "seed = \"//let[name='seed']/value\""
    root = make(tmp_path / "p", OPTIONS + "ros = 2\n", text, seed, "swarm.launch.yaml")
    assert inputs(root, "montecarlo.C1")["input.launch.yaml"] == text.replace("'0'", f"'{SEED}'")
    with pytest.raises(QueryError, match="SIERRA does not copy groups in YAML"):
        inputs(root, "population_size=2")
    with pytest.raises(ConfigError, match="launch files of ROS 1 are XML"):
        inputs(make(tmp_path / "q", OPTIONS, text, name="swarm.yaml"), "montecarlo.C1")


def test_the_example_can_be_executed_as_it_is(tmp_path: Path) -> None:
    done = projects.quick(tmp_path, "init", "--example", "ros", "demo")
    assert (done.returncode, "next: cd demo && sierra run population_size=1,2,4" in done.stdout) == (0, True)
    assert (tmp_path / "demo" / "packages" / "walkers" / "scripts" / "walker").stat().st_mode & 0o111
    assert len(launched(tmp_path / "demo", "population_size=4").findall("group")) == 5
