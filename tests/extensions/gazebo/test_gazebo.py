"""The platform `gazebo`: the inputs that it generates; Gazebo itself is not needed."""

from __future__ import annotations

import math
import re
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import pytest

import sierra.extensions.gazebo
from sierra.config import project_file
from sierra.design.platforms import base
from sierra.errors import SierraError
from sierra.extensions.gazebo.platform import PARTS, Gazebo
from sierra.model import Criterion, Listed
from sierra.templates import several
from sierra.testing import platforms
from tests import projects
from tests.simulator_inputs import inputs

ROBOT = '<model name="robot"><pose>0 0 0.1 0 0 1.5</pose><link name="body"/></model>'
CROWD = (
    '<population name="crowd"><model_count>3</model_count><box><size>2 2 1</size></box>'
    '<model name="ant"><link name="body"/></model></population>'
)
WORLD = f"""\
<sdf version="1.6">
  <world name="arena">
    <physics type="ode"><max_step_size>0.01</max_step_size></physics>
    <include><uri>model://sun</uri></include>
    {ROBOT}
  </world>
</sdf>
"""
COPIED = 'platforms.gazebo = { robot = "robot", start_area = { x = [-2, 2], y = [0, 1], distance = 0.5 } }\n'
LISTED = 'platforms.gazebo = { robot = "robot", starts = [[1, 2], [3, 4, 0.5], [5, 6, 0.2, 0, 0.1, 0]] }\n'


def make(folder: Path, more: str = "", world: str = WORLD) -> Path:
    """Write a project of Gazebo."""
    folder.mkdir()
    (folder / "arena.world").write_text(world)
    (folder / "sierra.toml").write_text('template = "arena.world"\nplatform = "gazebo"\n' + more)
    return folder


def world(root: Path, *words: str) -> str:
    return inputs(root, *words)["input.world"]


def places(text: str) -> dict[str, list[float]]:
    """Return the poses of the robots in a world."""
    models = ElementTree.fromstring(text).iterfind("world/model")  # noqa: S314
    return {str(one.get("name")): [float(word) for word in one.findtext("pose", "").split()] for one in models}


@pytest.mark.parametrize(("more", "text"), [(COPIED, WORLD), (LISTED, WORLD), ("", WORLD.replace(ROBOT, CROWD))])
def test_it_is_a_platform(tmp_path: Path, more: str, text: str) -> None:
    root = make(tmp_path / "p", more, text)
    project = project_file.load(root).config
    criterion = Criterion("population_size", Listed((1, 2)))
    platforms.check(Gazebo, project, several.of_project(project, root), {"population_size": criterion})


def test_the_world_of_a_run_has_copies_whose_places_are_drawn_with_the_seed(tmp_path: Path) -> None:
    root = make(tmp_path / "p", COPIED)
    found = places(world(root, "population_size=8"))
    assert list(found) == [f"robot_{number}" for number in range(8)]
    assert all(-2 <= x <= 2 and 0 <= y <= 1 and rest == [0.1, 0, 0] for x, y, *rest, _ in found.values())
    assert min(math.dist(one[:2], other[:2]) for one, other in combinations(found.values(), 2)) >= 0.5
    assert len({yaw for *_, yaw in found.values()}) == 8
    assert places(world(root, "population_size=4")) == dict(list(found.items())[:4])
    assert found["robot_0"] == [-0.704669, 0.150849, 0.1, 0, 0, 0.948349]  # 0.32383276, 0.15084917, 0.65093447 of seed 7
    assert not re.search("copies|seed=", world(root, "population_size=1"))


def test_listed_starts_replace_parts_of_the_pose_of_the_model(tmp_path: Path) -> None:
    root = make(tmp_path / "p", LISTED)
    assert list(places(world(root, "population_size=3")).values()) == [
        [1, 2, 0.1, 0, 0, 1.5],
        [3, 4, 0.1, 0, 0, 0.5],
        [5, 6, 0.2, 0, 0.1, 0],
    ]


def test_an_included_model_can_be_copied(tmp_path: Path) -> None:
    included = "<include><name>robot</name><uri>model://turtle</uri></include>"
    text = world(make(tmp_path / "p", LISTED, WORLD.replace(ROBOT, included)), "population_size=2")
    assert re.findall("<name>(.*?)</name>", text) == ["robot_0", "robot_1"]
    assert re.findall("<pose>(.*?)</pose>", text) == ["1 2 0 0 0 0", "3 4 0 0 0 0.5"]


def test_a_population_of_the_world_gets_its_size(tmp_path: Path) -> None:
    found = world(make(tmp_path / "p", world=WORLD.replace(ROBOT, CROWD)), "population_size=8")
    assert "<model_count>8</model_count>" in found


def test_options_set_the_physics_and_the_command(tmp_path: Path) -> None:
    options = (
        'platforms.gazebo = { step = 0.005, engine = "ode", threads = 2, length = 20, interval = 0.5, models = ["m", "n/o"] }\n'
    )
    root = make(tmp_path / "p", options)
    made = inputs(root, "montecarlo.C1")
    flat = re.sub(r">\s+<", "><", made["input.world"])
    assert "<max_step_size>0.005</max_step_size>" in flat
    assert "<ode><solver><island_threads>2</island_threads></solver></ode>" in flat
    assert "<real_time_update_rate>20000</real_time_update_rate>" in flat
    drivers = Path(sierra.extensions.gazebo.__file__).parent / "drivers"
    assert {name: made[name] for name in PARTS} == {name: (drivers / name).read_text() for name in PARTS}
    words = "{python} {run}/gazebo_driver.py {input} {output} --seed {seed} --length 20.0 --interval 0.5"
    command = base.find("gazebo", project_file.load(root).config).command()
    assert " ".join(command) == f"{words} --models {{project}}/m {{project}}/n/o"


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("physics", "physik", "the world must have one physics with a type"),
        ('type="ode"', 'type="ignored"', "'ignored' is of gz-sim, which platform \"gazebo\" cannot run"),
        ('name="robot"', 'name="rabbit"', "the world has 0 models 'robot'; its models are rabbit"),
        ('<link name="body"/>', "", "the model 'robot' has no link"),
        ("0 0 0.1 0 0 1.5", "0 0 0.1", "the pose '0 0 0.1' of the model to copy must have six numbers"),
        ("<pose>", '<pose relative_to="x">', "has the attribute 'relative_to'"),
        ("model://sun", "https://fuel.example/sun", "'https://fuel.example/sun' would be downloaded"),
        ("0.01<", "0.03<", "interval: 1 s is not a whole number of steps of 0.03 s"),
        ("0.01<", "fast<", "max_step_size: 'fast' is not a time in seconds"),
        ('name="arena"', 'name="my arena"', "the world's name 'my arena'"),
        (ROBOT, ROBOT + CROWD.replace("box", "bax"), "the population 'crowd' has no box or cylinder"),
        (
            ROBOT,
            ROBOT + CROWD.replace('model name="ant"', 'madel name="ant"').replace("</model></p", "</madel></p"),
            "one model",
        ),
        (ROBOT, ROBOT + CROWD.replace("3<", "0<"), "the population 'crowd' needs a model_count of 1 or more"),
    ],
)
def test_worlds_that_would_go_wrong_are_refused(tmp_path: Path, before: str, after: str, message: str) -> None:
    with pytest.raises(SierraError, match=re.escape(message)):
        inputs(make(tmp_path / "p", COPIED, WORLD.replace(before, after)), "population_size=2")


@pytest.mark.parametrize(
    ("more", "query", "message"),
    [
        ("", "population_size=2", "the world has 0 elements <population>; set robot in [platforms.gazebo]"),
        (COPIED, "population_size=0.5", "0.5 is not a whole number of 1 or more"),
        (COPIED, "population_size=40", "no place for robot 17 of 40 at a distance of 0.5 m"),
        (LISTED, "population_size=4", "4 robots need 4 places, but there are 3"),
        ('platforms.gazebo = { robot = "robot" }\n', "population_size=2", "set either starts or start_area"),
        ("platforms.gazebo = { starts = [[1, 2]] }\n", "population_size=2", "need robot, the name of the model"),
        (
            "platforms.gazebo = { length = 10, interval = 3 }\n",
            "population_size=2",
            "10 s is not a whole number of intervals of 3 s",
        ),
        ('platforms.gazebo = { engine = "bullet", threads = 2 }\n', "montecarlo.C1", "only the physics engine ode has threads"),
    ],
)
def test_mistakes_in_settings_and_queries_are_refused(tmp_path: Path, more: str, query: str, message: str) -> None:
    with pytest.raises(SierraError, match=re.escape(message)):
        inputs(make(tmp_path / "p", more), query)


def test_the_example_is_short_and_a_platform_of_gazebo(tmp_path: Path) -> None:
    done = projects.quick(tmp_path, "init", "--example", "gazebo", "demo")
    assert (done.returncode, "next: cd demo && sierra run population_size.Log8" in done.stdout) == (0, True)
    assert len((tmp_path / "demo" / "sierra.toml").read_text().splitlines()) <= 11
    assert world(tmp_path / "demo", "population_size=8", "speed=0.3").count("<velocity_factor>0.3<") == 8
