"""The parts of a run of ROS 2 on several robots, as they tell each other, without ROS."""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from sierra.extensions.ros.launch import Launch2
from tests.extensions.ros.ros2 import driver

VARIABLES = {
    "SIERRA_EXECUTION": "0123456789abcdef",
    "SIERRA_ROBOT": "1",
    "SIERRA_ROBOTS": "2",
    **{f"SIERRA_ADDRESS_{place}": f"192.0.2.{place + 1}" for place in range(3)},
}
READY = {"programs": 2, "awaited": 1, "ready": True, "finished": True, "over": False, "closed": True}


GROUP = '<group><push_ros_namespace namespace="robot1"/><let name="robot" value="1"/><let name="index" value="1"/></group>'


@pytest.fixture(scope="module")
def parts() -> ModuleType:
    return driver("ros2_fleet")


def launch_of(
    monkeypatch: pytest.MonkeyPatch,
    launch: Path,
    content: str,
    place: int,
    *,
    has_base: bool = True,
    bag: str = "",
) -> Any:
    """Return the driver's run of a part that sees two programs in each of three parts."""
    for name, value in {**VARIABLES, "SIERRA_ROBOT": str(place)}.items():
        monkeypatch.setenv(name, value)
    launch.write_text(f"<launch>{content}</launch>")
    given = Namespace(
        setup=None,
        launch=launch,
        fleet="base" if has_base else "robots",
        bag=bag,
        barrier=True,
        awaited=["walker"],
        patience=9.0,
    )
    made = driver("ros2_run").Launch2(given)
    made.watcher = SimpleNamespace(
        participants=6, nodes=["/robot1/walker"], changed=0.0, pending=[], unheard=0, has_started=False, members=[]
    )
    made.watcher.send = lambda line: made.watcher.members.append(said(place, **json.loads(line)))
    made.watcher.members += [said(other) for other in made.fleet.places]
    return made


def test_no_part_is_ready_before_it_has_started_a_node(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    robot = launch_of(monkeypatch, tmp_path / "launch.xml", GROUP, 1)
    robot.follow_others()
    assert (robot.missing(), robot.fleet.state["ready"], robot.fleet.state["finished"]) == ("no node was started", False, False)
    robot.watch.processes.add("walker-1")
    robot.follow_others()
    robot.follow_others()
    assert (robot.missing(), robot.fleet.state["ready"]) == ("", True)
    idle = launch_of(monkeypatch, tmp_path / "launch.xml", '<let name="a" value="b"/>', 0)
    idle.follow_others()
    assert (idle.missing(), idle.starts_nothing) == ("", True)
    busy = launch_of(monkeypatch, tmp_path / "launch.xml", '<node pkg="a" exec="b"/>', 0)
    busy.follow_others()
    assert (busy.missing(), busy.starts_nothing) == ("no node was started", False)


def test_a_robot_that_records_nothing_of_its_own_is_not_ready(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    robot = launch_of(monkeypatch, tmp_path / "launch.xml", GROUP, 1, has_base=False, bag="run")
    robot.watch.processes.add("walker-1")
    robot.follow_others()
    assert (robot.own, robot.missing()) == ("/robot1", "")
    robot.watcher.nodes = ["/lab/robot1/walker"]
    assert robot.missing() == "no node is in the namespace /robot1, whose topics are recorded here"


def test_the_driver_knows_the_elements_that_start_nothing() -> None:
    program = driver("ros2_run")
    assert (Launch2.of_all, Launch2.pushed) == (program.OF_ALL, program.PUSHED)


def test_a_run_with_one_robot_has_no_other_part(parts: ModuleType) -> None:
    assert parts.fleet({"SIERRA_ROBOTS": "1"}, has_base=False) is None
    assert parts.fleet({**VARIABLES, "SIERRA_ROBOTS": "1"}, has_base=True).places == [0, 1]


def said(place: int, run: str = "0123456789abcdef", **state: Any) -> dict[str, Any]:
    return {"run": run, "place": place, "state": {**READY, **state}}


@pytest.mark.parametrize(("has_base", "leader", "addresses"), [(True, 0, 3), (False, 1, 2)])
def test_the_first_part_leads_and_all_have_one_domain(parts: ModuleType, has_base: bool, leader: int, addresses: int) -> None:
    fleets = [
        parts.Fleet({**VARIABLES, "SIERRA_ROBOT": str(place)}, has_base=has_base) for place in range(0 if has_base else 1, 3)
    ]
    assert [fleet.place for fleet in fleets if fleet.leads] == [leader]
    assert len({fleet.number for fleet in fleets}) == 1
    assert {len(fleet.addresses) for fleet in fleets} == {addresses}
    assert [fleet.place for fleet in fleets if fleet.records] == ([0] if has_base else [1, 2])


def test_the_time_begins_when_all_are_ready_and_the_leader_ends_it(parts: ModuleType) -> None:
    fleet = parts.Fleet(VARIABLES, has_base=True)
    assert fleet.absent() == "the base station"
    fleet.hear([said(0), said(1)])
    assert fleet.absent() == fleet.unready() == "robot 2"
    fleet.hear([said(2, ready=False, finished=False, over=True, closed=False)])
    assert (fleet.absent(), fleet.unready(), fleet.unfinished()) == ("", "robot 2", ["robot 2"])
    assert (fleet.programs, fleet.awaited) == (6, 3)
    assert (fleet.is_over, fleet.unclosed()) == (False, "robot 2"), "only the leader ends the run"
    fleet.hear([said(0, over=True), said(2)])
    assert (fleet.unready(), fleet.unfinished(), fleet.is_over, fleet.unclosed()) == ("", [], True, "")


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"SIERRA_ADDRESS_2": None}, "SIERRA_ADDRESS_2 is not set; give each robot its address"),
        ({"SIERRA_ADDRESS_2": "127.0.0.1"}, "other robots cannot reach 127.0.0.1; give it another address"),
        ({"SIERRA_ADDRESS_2": "fe80::1"}, "fe80::1 is no address of IPv4"),
    ],
)
def test_a_fleet_whose_robots_cannot_reach_each_other_is_refused(
    parts: ModuleType, variables: dict[str, str | None], message: str
) -> None:
    given = {name: value for name, value in {**VARIABLES, **variables}.items() if value is not None}
    with pytest.raises(parts.Failure, match=message):
        parts.Fleet(given, has_base=True)


def test_another_run_in_the_domain_is_refused(parts: ModuleType) -> None:
    fleet = parts.Fleet(VARIABLES, has_base=True)
    with pytest.raises(parts.Failure, match="another run, fedcba9876, uses the same domain"):
        fleet.hear([said(2, run="fedcba9876543210")])


def test_programs_here_find_only_each_other(parts: ModuleType) -> None:
    alone, fleet = parts.profile(["127.0.0.1"]), parts.profile(["192.0.2.1", "192.0.2.2"])
    assert "<interfaceWhiteList><address>127.0.0.1</address></interfaceWhiteList>" in alone
    assert (fleet.count("<udpv4>"), fleet.count("interfaceWhiteList")) == (2, 0)
