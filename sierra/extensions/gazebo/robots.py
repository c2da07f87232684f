"""The copies of a robot in a world of Gazebo, each with a name and a place of its own.

A change gives the model the attribute `copies`, and, for places that are drawn, the world the attribute `seed`. Gazebo knows
neither: the world that a run gets has the copies in their place. `robot` becomes `robot_0`, `robot_1`, and so on.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from copy import deepcopy
from typing import Annotated
from xml.etree import ElementTree

from pydantic import Field

from sierra.plugin import Table, TemplateError
from sierra.util.text import short_number

COPIES, SEED = "copies", "seed"
TRIES = 10_000
"""Places that are drawn for one robot before the area counts as full."""
DIGITS = 6

Coordinate = Annotated[float, Field(allow_inf_nan=False)]
Start = (
    tuple[Coordinate, Coordinate]
    | tuple[Coordinate, Coordinate, Coordinate]
    | tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
)
Pose = tuple[float, float, float, float, float, float]


class Area(Table):
    """A rectangle in which robots start."""

    x: tuple[Coordinate, Coordinate] = Field(description="smallest and largest x, in m")
    y: tuple[Coordinate, Coordinate] = Field(description="smallest and largest y, in m")
    distance: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(
        0.0, description="smallest distance between the centres of two robots, in m"
    )
    yaw: Coordinate | None = Field(None, description="direction of all robots in radians; default: drawn too")


def written(document: bytes, starts: tuple[Start, ...], area: Area | None) -> bytes:
    """Return a world with the copies in the place of the model; a world without such a model stays as it is.

    Raises TemplateError if there are not enough places.
    """
    if f" {COPIES}=".encode() not in document:
        return document
    root = ElementTree.fromstring(document)  # noqa: S314 it is a template that was read and changed safely
    world = root.find("world")
    model = None if world is None else world.find(f"*[@{COPIES}]")
    if world is None or model is None:
        return document
    count, seed = int(model.attrib.pop(COPIES)), world.attrib.pop(SEED, None)
    first = _pose(model)
    places = drawn(count, int(seed or 0), area, first) if area else listed(count, starts, first)
    at = list(world).index(model)
    world.remove(model)
    for number, pose in enumerate(places):
        world.insert(at + number, _copy(model, number, pose))
    xml: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return xml + b"\n"


def listed(count: int, starts: tuple[Start, ...], first: Pose) -> Iterator[Pose]:
    """Yield the first places of a list; what they leave out is as in the pose of the model."""
    if count > len(starts):
        raise TemplateError(f"[platforms.gazebo] starts: {count} robots need {count} places, but there are {len(starts)}")
    for start in starts[:count]:
        x, y, *more = start
        z, roll, pitch, yaw = more if len(more) == 4 else (*first[2:5], *(more or first[5:]))
        yield x, y, z, roll, pitch, yaw


def drawn(count: int, seed: int, area: Area, first: Pose) -> Iterator[Pose]:
    """Yield places of robots that are uniform in an area, one after the other; those too close to others are drawn again.

    Only `random.random` is used: its numbers are the same in all versions of Python.
    """
    chance, placed = random.Random(seed).random, list[tuple[float, float]]()
    for number in range(count):
        for _ in range(TRIES):
            x, y = (low + (high - low) * chance() for low, high in (area.x, area.y))
            if all(math.hypot(x - other, y - another) >= area.distance for other, another in placed):
                break
        else:
            raise TemplateError(
                f"[platforms.gazebo] start_area: no place for robot {number + 1} of {count} at a distance of "
                f"{area.distance:g} m; use a larger area or a smaller distance"
            )
        placed.append((x, y))
        yaw = area.yaw if area.yaw is not None else math.pi * (2 * chance() - 1)
        yield round(x, DIGITS), round(y, DIGITS), *first[2:5], round(yaw, DIGITS)


def _copy(model: ElementTree.Element, number: int, start: Pose) -> ElementTree.Element:
    """Return a copy with its name and its place."""
    copy = deepcopy(model)
    name = copy.find("name")
    if copy.tag == "include" and name is not None:
        name.text = f"{(name.text or '').strip()}_{number}"
    else:
        copy.set("name", f"{copy.get('name')}_{number}")
    pose = copy.find("pose")
    if pose is None:
        pose = ElementTree.Element("pose")
        copy.insert(0, pose)
    pose.text = " ".join(short_number(value, 17) for value in start)
    return copy


def _pose(model: ElementTree.Element) -> Pose:
    """Return the place of the model in the world. Raises TemplateError if it is relative to another."""
    pose = model.find("pose")
    if pose is None:
        return (0.0,) * 6
    words = (pose.text or "").split()
    try:
        x, y, z, roll, pitch, yaw = map(float, words)
    except ValueError:
        raise TemplateError(f"the pose {' '.join(words)!r} of the model to copy must have six numbers") from None
    if pose.attrib:
        raise TemplateError(
            f"the pose of the model to copy has the attribute {next(iter(pose.attrib))!r}; use a pose without it"
        )
    return x, y, z, roll, pitch, yaw
