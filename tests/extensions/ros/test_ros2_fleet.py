"""The parts of a run of ROS 2 on several robots, as they tell each other, without ROS."""

from __future__ import annotations

import importlib.util
from types import ModuleType
from typing import Any

import pytest

from tests.extensions.ros.ros2 import DRIVERS

VARIABLES = {
    "SIERRA_EXECUTION": "0123456789abcdef",
    "SIERRA_ROBOT": "1",
    "SIERRA_ROBOTS": "2",
    **{f"SIERRA_ADDRESS_{place}": f"192.0.2.{place + 1}" for place in range(3)},
}
READY = {"programs": 2, "awaited": 1, "ready": True, "finished": True, "over": False, "closed": True}


@pytest.fixture(scope="module")
def parts() -> ModuleType:
    specification = importlib.util.spec_from_file_location("ros2_fleet", DRIVERS / "ros2_fleet.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


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
    assert (fleet.is_over, fleet.is_closed) == (False, False), "only the leader ends the run"
    fleet.hear([said(0, over=True), said(2)])
    assert (fleet.unready(), fleet.unfinished(), fleet.is_over, fleet.is_closed) == ("", [], True, True)


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
    with pytest.raises(parts.Unfit, match=message):
        parts.Fleet(given, has_base=True)


def test_another_run_in_the_domain_is_refused(parts: ModuleType) -> None:
    fleet = parts.Fleet(VARIABLES, has_base=True)
    with pytest.raises(parts.Unfit, match="another run, fedcba9876, uses the same domain"):
        fleet.hear([said(2, run="fedcba9876543210")])


def test_programs_here_find_only_each_other(parts: ModuleType) -> None:
    alone, fleet = parts.profile(["127.0.0.1"]), parts.profile(["192.0.2.1", "192.0.2.2"])
    assert "<interfaceWhiteList><address>127.0.0.1</address></interfaceWhiteList>" in alone
    assert (fleet.count("<udpv4>"), fleet.count("interfaceWhiteList")) == (2, 0)
