"""The table `[trials]` of sierra.toml."""

from __future__ import annotations

import pytest

from sierra.config.project_file import parse
from sierra.errors import ConfigError
from sierra.extensions.trials.table import Trials


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"supervised": "yes"}, 'trials.supervised should be true or false, not "yes"'),
        ({"order": "blokced"}, "trials.order"),
        ({"block": 0}, "trials.block"),
        ({"reasons": []}, "trials.reasons should not be empty"),
        ({"pause": -1.0}, "trials.pause"),
        ({"poses": [[0.0]]}, "trials.poses.0 should have at least 2 items"),
        ({"poses": [[0.0, 1.0]], "draw_poses": {"count": 1, "x": [0, 1], "y": [0, 1]}}, '"poses" and "draw_poses" exclude'),
        ({"draw_poses": {"count": 1, "x": [2, 1], "y": [0, 1]}}, "x: the smallest value comes first: [1, 2]"),
        ({"draw_poses": {"count": 1, "x": [0, 1]}}, "'trials.draw_poses.y' is missing"),
        ({"files": ["../secret"]}, "trials.files.0: '../secret' should be a path within the project"),
        ({"commands": {"firmware": ""}}, "trials.commands.firmware should not be empty"),
        ({"superviesd": True}, "unknown key 'trials.superviesd'; did you mean 'supervised'?"),
    ],
)
def test_mistakes_are_reported_in_one_line(table: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        parse({"trials": table}, "sierra.toml")
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_target_may_be_supervised_while_another_is_not() -> None:
    project = parse({"targets": {"sim": {}, "robots": {"trials": {"supervised": True}}}}, "sierra.toml")
    assert [project.for_target(name).added("trials", None) for name in ("sim", "robots")] == [None, Trials(supervised=True)]
