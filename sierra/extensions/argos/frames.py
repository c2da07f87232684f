"""Rendering in ARGoS: its Qt visualization on a display of the run, with a camera path, grabs frames.

The visualization writes `frame_TICK.png` into the working directory and ends with the experiment. `argos3` must be built with
Qt. The camera has placements, each with the tick at which it is reached; between them, the camera moves or jumps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Annotated

from pydantic import Field, NonNegativeInt, model_validator

from sierra.config.capture_table import Capture
from sierra.config.field_types import Finite, Positive, Table
from sierra.design.platforms.base import Reader
from sierra.errors import ConfigError
from sierra.model import Add, Change, Remove
from sierra.util.text import like

FILES = "frame_{tick}.png"
VISUALIZATION = "/argos-configuration/visualization"
AROUND = (364, 272)
"""The width and the height of the tool bars and the log around the frame in the window, in pixels, in Qt 5."""
FOCAL_LENGTH, HALF_SENSOR = 20.0, 13.5
"""The focal length of a camera by default, and half the height of its sensor, in millimetres."""
ASPECT_RATIO = 4 / 3
"""The ratio of width and height for which ARGoS draws, whatever the size of a frame is."""
MOST = 12
"""The largest number of placements in ARGoS."""
ROUND = 8
"""The number of placements around the arena."""

Vector = tuple[Finite, Finite, Finite]


class Placement(Table):
    """One placement of a camera."""

    tick: NonNegativeInt = Field(0, description="the tick at which the camera is there")
    position: Vector = Field(description="position of the camera in metres")
    look_at: Vector = Field(description="the point that it looks at, in metres")
    up: Vector | None = Field(None, description="direction that is up in frames; default: up in the arena")

    def attributes(self) -> dict[str, str]:
        vectors = {"position": self.position, "look_at": self.look_at, "up": self.up}
        return {name: ",".join(map(_decimal, vector)) for name, vector in vectors.items() if vector is not None}


class Camera(Table):
    """A camera of `sierra video --capture`: its path through the arena."""

    path: Annotated[tuple[Placement, ...], Field(min_length=1, max_length=MOST)] = Field(
        description="its placements, in the order of their ticks; the first one is at tick 0"
    )
    interpolate: bool = Field(True, description="whether the camera moves from a placement to the next, or jumps")
    focal_length: Positive = Field(FOCAL_LENGTH, description="focal length of its lens, in millimetres")

    @model_validator(mode="after")
    def _in_order(self) -> Camera:
        ticks = [placement.tick for placement in self.path]
        if ticks[0] or any(later <= earlier for earlier, later in pairwise(ticks)):
            raise ValueError(f"the ticks of a path begin with 0 and ascend, not {', '.join(map(str, ticks))}")
        return self


def changes(
    document: Reader, capture: Capture, cameras: Mapping[str, Camera], center: Vector, sides: Vector, ticks: int, every: int
) -> Iterator[Change]:
    """Yield the changes with which a run grabs a frame every so many ticks. Raises ConfigError for an unknown camera.

    `center` is the centre of the arena and `sides` its size, in metres; `ticks` is the length of the run.
    """
    camera = _camera(capture.camera or "overhead", cameras, center, sides, ticks)
    if document.find(f"{VISUALIZATION}/self::*"):
        yield Remove(VISUALIZATION, why="sierra capture")
    yield Add("/argos-configuration", _xml(camera, capture.size, every), expect=1, why="sierra capture")


def _camera(name: str, cameras: Mapping[str, Camera], center: Vector, sides: Vector, ticks: int) -> Camera:
    """Return a declared camera, or one that sees the whole arena."""
    if name in cameras:
        return cameras[name]
    x, y, _ = center
    radius = 0.75 * math.hypot(*sides[:2])
    match name:
        case "overhead":
            height = 1.1 * max(sides[1] / 2, sides[0] / 2 / ASPECT_RATIO) * FOCAL_LENGTH / HALF_SENSOR
            return Camera(path=(Placement(position=(x, y, height), look_at=(x, y, 0), up=(0, 1, 0)),))
        case "corner":
            return Camera(path=(_aside(x, y, radius, 5 / 4 * math.pi, 0),))
        case "around":
            turn = (_aside(x, y, radius, 2 * math.pi * k / ROUND, max(ticks, ROUND) * k // ROUND) for k in range(ROUND + 1))
            return Camera(path=tuple(turn))
        case _:
            known = sorted({*cameras, "overhead", "corner", "around"})
            raise ConfigError(f"[capture] camera: there is no camera {name!r}; {like(name, known, 'there are')}")


def _aside(x: float, y: float, radius: float, angle: float, tick: int) -> Placement:
    """Return a placement beside the arena, from which the camera looks down at its centre."""
    position = (x + radius * math.cos(angle), y + radius * math.sin(angle), 0.7 * radius)
    return Placement(tick=tick, position=position, look_at=(x, y, 0))


def _xml(camera: Camera, size: tuple[int, int], every: int) -> str:
    lens = _decimal(camera.focal_length)
    placements, keyframes = [], []
    for index, placement in enumerate(camera.path):
        values = {"index": str(index), **placement.attributes(), "lens_focal_length": lens}
        attributes = " ".join(f'{name}="{value}"' for name, value in values.items())
        placements.append(f"<placement {attributes}/>")
        keyframes.append(f'<keyframe placement="{index}" step="{placement.tick}"/>')
    timeline = ("<interpolate/>" if camera.interpolate else "").join(keyframes)
    path = f"<timeline>{timeline}</timeline>" if len(keyframes) > 1 else ""
    width, height = window(size)
    grabbing = f'headless_grabbing="true" headless_frame_size="{width}x{height}" headless_frame_rate="{every}"'
    return (
        '<visualization><qt-opengl autoplay="true">'
        f"<camera><placements>{''.join(placements)}</placements>{path}</camera>"
        f'<frame_grabbing directory="." base_name="frame_" format="png" quality="100" {grabbing}/>'
        "</qt-opengl></visualization>"
    )


def window(size: tuple[int, int]) -> tuple[int, int]:
    """Return the width and height of the window whose frames have about this size. All are in pixels."""
    return size[0] + AROUND[0], size[1] + AROUND[1]


def _decimal(number: float) -> str:
    """Return a number without an exponent, with at most micrometres."""
    return f"{number:.6f}".rstrip("0").rstrip(".")
