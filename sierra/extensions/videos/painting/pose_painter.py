"""The painter of poses: a disc at each place, and a line in the direction of the heading, with smooth edges.

Robots that are told apart have colours, and trails that fade; if there are few of them, they have numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from sierra.deliverables.figures import style

if TYPE_CHECKING:
    import numpy.typing as npt

    from sierra.extensions.videos.encode import Image
    from sierra.extensions.videos.painting.text_strip import Box
    from sierra.extensions.videos.tracks import Floats, State

    Place: TypeAlias = tuple[float, float]

RADIUS, LENGTH, WIDTH = 3.5, 10.0, 1.0
"""The radius of a disc, and the length and half the width of the line of a heading, in pixels."""
SMALLEST, ROOM = 0.4, 0.045
"""The smallest part of these sizes in small panels, and the part of a panel that a heading may need."""
WHITE = 255.0
NUMBERED = 30
"""The largest number of robots that have numbers."""
SHORT = 3
"""The largest length of a name that is shown instead of a number."""
LEFT = 0.92
"""The part of the colour of a trail that is left after a frame."""


def marks(robots: Sequence[str]) -> list[str]:
    """Return the texts beside robots: their names, or their places among these if a name is long; none for many robots."""
    if len(robots) > NUMBERED:
        return []
    names = all(len(name) <= SHORT and name.isascii() for name in robots)
    return list(robots) if names else [str(k + 1) for k in range(len(robots))]


class PosePainter:
    """Paints the poses of one film, in the same limits in all frames and panels, in the order of time.

    `robots` are the names of the robots, if a column tells them apart.
    """

    def __init__(
        self, xlim: tuple[float, float], ylim: tuple[float, float], labels: tuple[str, str], robots: Sequence[str] = ()
    ) -> None:
        self.xlim, self.ylim, self._labels = xlim, ylim, labels
        self._colours = [np.array(to_rgb(colour)) * WHITE for colour in style.NAMED]
        self._marks = list(map(_written, marks(robots)))
        self._trails: dict[int, npt.NDArray[np.float32]] = {}
        self._last: dict[int, dict[int, Place]] = {}

    def prepare(self, figure: Figure, plots: Sequence[Axes]) -> None:
        del figure
        for plot in plots:
            plot.set_xlim(*self.xlim)
            plot.set_ylim(*self.ylim)
            plot.set_aspect("equal")
            plot.tick_params(labelsize=7 if len(plots) == 1 else 5)
        style.outer_labels(plots, *self._labels)

    def paint(self, image: Image, panel: int, box: Box, state: State) -> None:
        pixels, poses = image[box.pixels], state[0]
        high, wide = pixels.shape[:2]
        x = (poses[:, 0] - self.xlim[0]) / (self.xlim[1] - self.xlim[0]) * wide
        y = (self.ylim[1] - poses[:, 1]) / (self.ylim[1] - self.ylim[0]) * high
        heading = poses[:, 2] if poses.shape[1] > 2 else np.full(len(poses), np.nan)
        number = np.nan_to_num(state[1], nan=-1).astype(int) if len(state) > 1 else np.full(len(poses), -1)
        inside = (x >= 0) & (x <= wide) & (y >= 0) & (y <= high)
        places = list(zip(x[inside].tolist(), y[inside].tolist(), strict=True))
        robots = number[inside].tolist()
        scale = min(1.0, max(SMALLEST, ROOM * max(high, wide) / LENGTH))
        pixels[:] = self._trail(panel, pixels.shape, dict(zip(robots, places, strict=True)), WIDTH * scale)
        for centre, angle, robot in zip(places, heading[inside].tolist(), robots, strict=True):
            _line(pixels, centre, centre, RADIUS * scale, self._colour(robot))
            if math.isfinite(angle):
                tip = centre[0] + LENGTH * scale * math.cos(angle), centre[1] - LENGTH * scale * math.sin(angle)
                _line(pixels, centre, tip, WIDTH * max(scale, 0.7), self._colour(robot))
        for (right, down), robot in zip(places, robots, strict=True):
            if 0 <= robot < len(self._marks):
                _stamp(pixels, self._marks[robot], right + 5 * scale, down - 5 * scale)

    def _trail(self, panel: int, shape: tuple[int, ...], places: dict[int, Place], width: float) -> npt.NDArray[np.uint8]:
        """Return a panel with the trails only. A robot without a place in the last frame, or that jumped, has no line there."""
        trails = self._trails.get(panel)
        trails = np.full(shape, WHITE, np.float32) if trails is None else WHITE - (WHITE - trails) * np.float32(LEFT)
        last = self._last.get(panel, {})
        for robot, place in places.items():
            if robot >= 0 and robot in last and math.dist(place, last[robot]) < min(shape[:2]) / 2:
                _line(trails, last[robot], place, width, (self._colour(robot) + WHITE) / 2)
        self._trails[panel], self._last[panel] = trails, places
        return trails.astype(np.uint8)

    def _colour(self, robot: int) -> Floats:
        colour: Floats = self._colours[max(robot, 0) % len(self._colours)]
        return colour


def _line(pixels: npt.NDArray[Any], start: Place, end: Place, radius: float, colour: Floats) -> None:
    """Blend a line with round ends into an image; of no length, it is a disc."""
    (left, right), (top, bottom) = (sorted(pair) for pair in zip(start, end, strict=True))
    rows = slice(max(0, int(top - radius - 1)), max(0, int(bottom + radius + 2)))
    columns = slice(max(0, int(left - radius - 1)), max(0, int(right + radius + 2)))
    window = pixels[rows, columns]
    down, across = np.mgrid[: window.shape[0], : window.shape[1]] + 0.5
    x, y = across + columns.start - start[0], down + rows.start - start[1]
    dx, dy = end[0] - start[0], end[1] - start[1]
    along = np.clip((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-9), 0, 1)
    alpha = np.clip(radius + 0.5 - np.hypot(x - along * dx, y - along * dy), 0, 1)[..., None]
    window[:] = np.round(window * (1 - alpha) + colour * alpha)


def _written(text: str) -> Floats:
    """Return the pixels of a short text, from 0 to 1."""
    font = ImageFont.load_default(10)
    _, _, wide, high = font.getbbox(text)
    sheet = Pillow.new("L", (math.ceil(wide), math.ceil(high)))
    ImageDraw.Draw(sheet).text((0, 0), text, fill=int(WHITE), font=font)
    written: Floats = np.asarray(sheet) / WHITE
    return written


def _stamp(pixels: Image, text: Floats, left: float, bottom: float) -> None:
    """Write a text into a panel, dark, and nowhere cut if the panel has room for it."""
    (high, wide), (rows, columns) = text.shape, pixels.shape[:2]
    top, begin = max(0, min(int(bottom) - high, rows - high)), max(0, min(int(left), columns - wide))
    window = pixels[top : top + high, begin : begin + wide]
    window[:] = np.round(window * (1 - text[: window.shape[0], : window.shape[1], None]))
