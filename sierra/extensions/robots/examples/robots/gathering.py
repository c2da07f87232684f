"""Gathering: each robot drives towards the centre of the others, and stops near it.

The same functions control the robots of ROS (`packages/gathering/scripts/gather`) and those of MuJoCo (`control`, below). They
import neither of the two.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

TICKS_PER_SECOND = 10
"""The rate at which a robot looks, decides, and records its place."""
NEAR = 0.35  # metres from the centre of the others, where a robot stops
GAIN, MAX_TURN = 2.0, 1.5  # 1/s and rad/s
WHEEL_RADIUS, WHEEL_DISTANCE = 0.04, 0.16  # metres
COLUMNS = ("time", "x", "y", "heading", "late")

Pose = tuple[float, float, float]
"""x and y in metres, and the heading in radians, in the frame of the arena."""


def command(own: Pose, others: Sequence[Pose], speed: float) -> tuple[float, float]:
    """Return the speed (m/s) and the turn (rad/s) of a robot that knows its pose, and those of the others."""
    if not others:
        return 0.0, 0.0
    x = sum(pose[0] for pose in others) / len(others) - own[0]
    y = sum(pose[1] for pose in others) / len(others) - own[1]
    if math.hypot(x, y) < NEAR:
        return 0.0, 0.0
    error = math.remainder(math.atan2(y, x) - own[2], 2 * math.pi)
    return speed * max(0.0, math.cos(error)), max(-MAX_TURN, min(MAX_TURN, GAIN * error))


def wheels(forward: float, turn: float) -> tuple[float, float]:
    """Return the speeds (rad/s) of the left and the right wheel."""
    difference = turn * WHEEL_DISTANCE / 2
    return (forward - difference) / WHEEL_RADIUS, (forward + difference) / WHEEL_RADIUS


def row(tick: int, pose: Pose, late: float = 0.0) -> list[float]:
    """Return a row of the table `path`. `late`: seconds that have passed since the time of the tick."""
    heading = math.remainder(pose[2], 2 * math.pi)
    return [tick / TICKS_PER_SECOND, *(round(value, 5) for value in (pose[0], pose[1], heading)), round(late, 4)]


class InMujoco:
    """The robots of a model of MuJoCo, and the file that they write."""

    def __init__(self, model: Any) -> None:
        self.places = [int(start) for start in model.jnt_qposadr[model.jnt_type == 0]]  # those of free joints
        robots = range(len(self.places))
        self.motors = [[model.actuator(f"{side}{robot}").id for side in ("left", "right")] for robot in robots]
        self.speed = float(model.numeric("speed").data[0])
        self.every = round(1 / (TICKS_PER_SECOND * model.opt.timestep))
        self.step = 0
        self.speeds = [(0.0, 0.0)] * len(robots)
        self.write([["robot", *COLUMNS]])

    def act(self, data: Any) -> None:
        """Set the speeds of all wheels before a step of the simulation."""
        if self.step % self.every == 0:
            self.tick([self.pose(data.qpos[start : start + 7]) for start in self.places])
        self.step += 1
        for motors, speeds in zip(self.motors, self.speeds, strict=True):
            data.ctrl[motors] = speeds

    def tick(self, poses: list[Pose]) -> None:
        """Record where the robots are, and decide how they move until the next tick."""
        number = self.step // self.every
        self.write([robot, *row(number, pose)] for robot, pose in enumerate(poses, 1))
        others = [[*poses[:robot], *poses[robot + 1 :]] for robot in range(len(poses))]
        self.speeds = [wheels(*command(own, rest, self.speed)) for own, rest in zip(poses, others, strict=True)]

    def write(self, rows: Iterable[Sequence[object]]) -> None:
        with Path("path.csv").open("a", newline="") as file:
            csv.writer(file).writerows(rows)

    def pose(self, place: Iterable[float]) -> Pose:
        """Return the pose of a body from its position and its quaternion."""
        x, y, _, w, i, j, k = map(float, place)
        return x, y, math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))


robots: list[InMujoco] = []


def control(model: Any, data: Any, random: Any) -> None:
    """Control all robots of a model; SIERRA's platform `mujoco` calls this before each step."""
    if not robots:
        robots.append(InMujoco(model))
    robots[0].act(data)
