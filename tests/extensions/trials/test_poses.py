"""Start poses: listed, or drawn from the seed of a run."""

from __future__ import annotations

import json
import math
from itertools import combinations

import pytest

from sierra.errors import ConfigError
from sierra.extensions.trials import poses
from sierra.extensions.trials.table import DrawnPoses, Trials
from sierra.model import Pose

DRAWN = Trials(draw_poses=DrawnPoses(count="population_size", x=(0.0, 4.0), y=(-1.0, 2.0), apart=0.5))


def test_listed_poses_are_those_of_every_run() -> None:
    listed = Trials(poses=((0.0, 1.0), (2.0, 3.0, 90.0)))
    assert poses.declared(listed, 1, {}) == poses.declared(listed, 2, {}) == (Pose(0.0, 1.0), Pose(2.0, 3.0, 90.0))
    assert json.loads(poses.as_json(poses.declared(listed, 1, {})) or "") == {"1": [0.0, 1.0], "2": [2.0, 3.0, 90.0]}
    assert poses.as_json(poses.declared(Trials(), 1, {})) is None


def test_drawn_poses_follow_from_the_seed_and_keep_their_distance() -> None:
    drawn = poses.declared(DRAWN, 7, {"population_size": 8})
    assert drawn == poses.declared(DRAWN, 7, {"population_size": 8}) != poses.declared(DRAWN, 8, {"population_size": 8})
    assert len(drawn) == 8
    assert all(0 <= one.x <= 4 and -1 <= one.y <= 2 for one in drawn)
    assert all(math.dist(one[:2], other[:2]) >= 0.5 for one, other in combinations(drawn, 2))
    assert drawn[:3] == poses.declared(DRAWN, 7, {"population_size": 3}), "more robots leave the others where they are"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "the query does not vary 'population_size'; give a number, or vary it"),
        ({"population_size": 2.5}, "population_size = 2.5 is not a number of robots"),
        ({"population_size": 200}, r"found no place for robot \d+ of 200 that is 0.5 m from the others"),
    ],
)
def test_poses_that_cannot_be_drawn_are_an_error(values: dict[str, int | float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        poses.declared(DRAWN, 7, values)
