"""Poses in a plane that are drawn from the seed of a run: the same ones on every machine."""

from __future__ import annotations

import random
from collections.abc import Iterator

from sierra.errors import TemplateError
from sierra.util.lazy_definitions import dataclass

TRIES = 1000
"""Draws of a pose that keeps its distance, until an arena counts as full."""

PlanePose = tuple[float, float, float]
"""x and y in metres, and yaw in radians."""


@dataclass(frozen=True, slots=True)
class RandomPoses:
    """A rectangle in which poses are drawn from the seed of the run, at a distance from each other."""

    x: tuple[float, float]
    y: tuple[float, float]
    yaw: tuple[float, float]
    distance: float

    def drawn(self, seed: str, count: int) -> Iterator[PlanePose]:
        """Yield a number of poses; more of them do not change those before. Raises TemplateError if there is no space."""
        stream = random.Random(f"{seed}/poses")
        taken: list[PlanePose] = []
        for number in range(count):
            tries, others = (self._draw(stream) for _ in range(TRIES)), taken if self.distance else []
            pose = next((pose for pose in tries if all(self._is_apart(pose, other) for other in others)), None)
            if pose is None:
                raise TemplateError(
                    f"random_poses: number {number} found no place at a distance of {self.distance:g} m from {number} others; "
                    "use a larger rectangle, or a smaller distance"
                )
            taken.append(pose)
            yield pose

    def _draw(self, stream: random.Random) -> PlanePose:
        x, y, yaw = (round(stream.uniform(*limits), 4) for limits in (self.x, self.y, self.yaw))
        return x, y, yaw

    def _is_apart(self, pose: PlanePose, other: PlanePose) -> bool:
        return (pose[0] - other[0]) ** 2 + (pose[1] - other[1]) ** 2 >= self.distance**2
