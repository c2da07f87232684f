"""Tests of `[runners.robots]`."""

from __future__ import annotations

from typing import Any

import pytest

from sierra.config.validate import options
from sierra.errors import ConfigError
from sierra.extensions.robots.fleet_table import FleetTable, allocate

TWO = {"a": {"host": "pi@a"}, "b": {"host": "pi@b", "group": "fast"}}


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"fleet": {"a": {"host": "pi@a"}, "b": {"host": "pi@a"}}, "stop": []}, "a and b have the same host 'pi@a'"),
        (
            {"fleet": {"a": {"host": "a", "address": "10.0.0.1"}, "b": {"host": "b", "address": "10.0.0.1"}}, "stop": []},
            "a and b have the same address '10.0.0.1'",
        ),
        ({"fleet": TWO, "use": ["c"], "stop": []}, "use: unknown robot or group 'c'; known are a, b, fast, robot"),
        ({"fleet": TWO}, "[runners.robots]: a has no stop command; give stop"),
        ({"fleet": {"a": {"host": "pi@a", "hots": 1}}, "stop": []}, "hots"),
    ],
)
def test_a_wrong_fleet_is_refused_in_one_line(table: dict[str, Any], said: str):
    with pytest.raises(ConfigError) as raised:
        options(FleetTable, table, "[runners.robots]")
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_places_are_taken_by_robots_of_their_group():
    table = FleetTable(fleet={**TWO, "c": {"host": "c"}, "d": {"host": "d", "group": "base"}}, stop=())
    assert allocate(table, [(0, "base"), (1, "fast"), (2, "scouts"), (3, "robot")]) == {0: "d", 1: "b", 2: "a", 3: "c"}
    chosen = table.model_copy(update={"use": ("c", "fast")})
    assert allocate(chosen, [(1, "robot"), (2, "fast")]) == {1: "c", 2: "b"}
    with pytest.raises(
        ConfigError, match="needs 2 robots of the group 'fast', but the fleet has 1; runs of 1 robot are possible"
    ):
        allocate(table, [(1, "fast"), (2, "fast")])
    with pytest.raises(
        ConfigError, match="needs 2 robots of the group 'robot', but the fleet with its \"use\" has 1; runs of 1 rob"
    ):
        allocate(chosen, [(1, "robot"), (2, "robot")])
