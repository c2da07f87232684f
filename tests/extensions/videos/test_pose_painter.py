"""Robots that are told apart have colours, numbers and trails; nothing of a robot is cut off at the edge of a panel."""

from __future__ import annotations

import numpy as np
import pytest

from sierra.config.deliverable_tables import Figure
from sierra.extensions.videos.painting.pose_painter import PosePainter, marks
from sierra.extensions.videos.painting.text_strip import Box
from sierra.extensions.videos.table import Video

SIZE = 100


def painted(painter: PosePainter, *frames: list[tuple[float, float, float]]) -> np.ndarray:
    """Return the last of some frames of a panel from 0 to 10; a robot is x, y and its number."""
    for robots in frames:
        image = np.zeros((SIZE, SIZE, 3), np.uint8)
        state = np.array([robot[:2] for robot in robots]).reshape(-1, 2), np.array([robot[2] for robot in robots])
        painter.paint(image, 0, Box(0, SIZE, 0, SIZE), state)
    return image.astype(int)


def painter(*names: str) -> PosePainter:
    return PosePainter((0, 10), (0, 10), ("x", "y"), names)


def test_robots_have_colours_and_a_trail_to_where_they_were() -> None:
    image = painted(painter("a", "b"), [(2, 2, 0), (8, 8, 1)], [(5, 2, 0), (8, 8, 1)])
    first, second = image[80, 50], image[20, 80]
    assert abs(first - second).max() > 60
    trail = image[80, 30]
    assert (trail > first).any(), "it is paler than the robot"
    assert (trail < 250).any()
    assert (image[60, 30] == 255).all()


def test_a_robot_that_jumped_or_was_away_has_no_trail() -> None:
    assert (painted(painter("a"), [(1, 5, 0)], [(9, 5, 0)])[50, 30:70] == 255).all()
    assert (painted(painter("a"), [(3, 5, 0)], [], [(7, 5, 0)])[50, 40:60] == 255).all()


def test_numbers_are_names_if_these_are_short_and_are_not_cut_off() -> None:
    assert marks(["a", "b10"]) == ["a", "b10"]
    assert marks(["robot_1", "robot_2"]) == ["1", "2"]
    assert marks([str(k) for k in range(31)]) == []
    with_number, without = (painted(painter(*names), [(10, 10, 0)]) for names in (("8",), ()))
    assert (with_number != without)[:20, -20:].any()


def test_trajectories_and_poses_are_one_kind_in_figures_and_videos() -> None:
    for kind in ("trajectories", "poses"):
        assert Video.model_validate({"kind": kind, "column": ["x", "y"]}).kind == "trajectories"
        assert Figure.model_validate({"kind": kind, "column": ["x", "y"]}).kind == "trajectories"


@pytest.mark.parametrize(("frames", "format", "seconds"), [(1, "mp4", 5), (60, "mp4", 5), (300, "webm", 12), (1000, "gif", 20)])
def test_a_video_lasts_from_5_to_20_seconds(frames: int, format: str, seconds: float) -> None:
    video = Video.model_validate({"column": ["i", "j", "v"]})
    assert frames / video.rate(frames, format) == pytest.approx(seconds)
    assert Video.model_validate({"column": ["i", "j", "v"], "fps": 10}).rate(frames, format) == 10
