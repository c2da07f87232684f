"""Start poses of robots, for the person who places them: those in the inputs of a run, or those in `[trials]`.

If a platform tells robots where they start (`sierra.design.platforms.base.Placing`), the person sees what is in the input of
the run. For other platforms, `[trials]` lists poses, or draws them from the run's seed.
"""

from __future__ import annotations

import json
import math
import random
from collections.abc import Mapping, Sequence

from sierra.design import platforms, robots
from sierra.design.platforms.base import Placing
from sierra.errors import ConfigError
from sierra.execution.plan import Plan
from sierra.extensions.trials.table import DrawnPoses, Trials
from sierra.model import BASE, Pose, Run, Value

TRIES = 10_000
"""Number of positions that are drawn for one robot until it is far enough from the others."""


def of_run(plan: Plan, run: Run, trials: Trials) -> tuple[Pose, ...]:
    """Return the start poses of a run, one per robot; none if none are declared. Raises ConfigError."""
    values = plan.batch.experiments[run.experiment].values
    return _of_inputs(plan, run) or declared(trials, run.seed, values)


def _of_inputs(plan: Plan, run: Run) -> tuple[Pose, ...]:
    """Return the start poses that the inputs of a run have."""
    platform = _placing(plan)
    if platform is None:
        return ()
    files, on_robots = plan.files(run), plan.batch.spec.robots is not None
    each = [own for place, own in robots.read(files) if place.number != BASE] if on_robots else [files]
    return tuple(pose for own in each for pose in platform.start_poses(dict(own)[run.names[0]]))


def _placing(plan: Plan) -> Placing | None:
    """Return the platform whose inputs tell robots where they start; None if the inputs of a plan do not."""
    refused = "" if plan.source else "this batch is executed with its recorded code; request its query instead"
    with plan.project.plugins(refused):
        platform = platforms.find(plan.project.config.platform, plan.project.config)
    known = plan.batch.spec.platform == plan.project.config.platform
    return platform if known and isinstance(platform, Placing) else None


def declared(trials: Trials, seed: int, values: Mapping[str, Value]) -> tuple[Pose, ...]:
    """Return the start poses that `[trials]` declares for a run with this seed and these values. Raises ConfigError.

    The same seed gives the same poses on every machine: Python's generator is seeded with a text, and only `random` is called,
    whose results never change.
    """
    if trials.draw_poses is None:
        return tuple(Pose(*pose) for pose in trials.poses)
    drawn, count = trials.draw_poses, _count(trials.draw_poses, values)
    generator = random.Random(f"poses {seed}")
    poses: list[Pose] = []
    for _ in range(count):
        poses.append(_free(drawn, poses, generator, count))
    return tuple(poses)


def as_json(poses: Sequence[Pose]) -> str | None:
    """Return poses as they are recorded: by robot (1, 2, …), x, y and the heading; None if there are none."""
    if not poses:
        return None
    return json.dumps({str(robot): [one for one in pose if one is not None] for robot, pose in enumerate(poses, 1)})


def _count(drawn: DrawnPoses, values: Mapping[str, Value]) -> int:
    if isinstance(drawn.count, int):
        return drawn.count
    count = values.get(drawn.count)
    if isinstance(count, int) and count > 0:
        return count
    if count is None:
        raise ConfigError(f"[trials.draw_poses] count: the query does not vary {drawn.count!r}; give a number, or vary it")
    raise ConfigError(f"[trials.draw_poses] count: {drawn.count} = {count!r} is not a number of robots")


def _free(drawn: DrawnPoses, others: Sequence[Pose], generator: random.Random, count: int) -> Pose:
    for _ in range(TRIES):
        x, y = (low + (high - low) * generator.random() for low, high in (drawn.x, drawn.y))
        pose = Pose(round(x, 3), round(y, 3), round(360 * generator.random(), 1))
        if all(math.dist(pose[:2], other[:2]) >= drawn.apart for other in others):
            return pose
    raise ConfigError(
        f"[trials.draw_poses] found no place for robot {len(others) + 1} of {count} that is {drawn.apart:g} m from the others; "
        "enlarge x and y, or make apart smaller"
    )
