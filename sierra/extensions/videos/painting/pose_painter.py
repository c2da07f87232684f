"""The painter of poses: a disc at each place, and a line in the direction of the heading, with smooth edges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from sierra.deliverables.figures import style

if TYPE_CHECKING:
    from sierra.extensions.videos.encode import Image
    from sierra.extensions.videos.painting.text_strip import Box
    from sierra.extensions.videos.tracks import Floats, State

RADIUS, LENGTH, WIDTH = 3.5, 10.0, 1.0
"""The radius of a disc, and the length and half the width of the line of a heading, in pixels."""
REACH = int(LENGTH) + 2
WHITE = 255


class PosePainter:
    """Paints poses, in the same limits in all frames and panels."""

    def __init__(self, xlim: tuple[float, float], ylim: tuple[float, float], labels: tuple[str, str]) -> None:
        self.xlim, self.ylim, self._labels = xlim, ylim, labels
        self._colour = np.array(to_rgb(style.NAMED[0])) * 255

    def prepare(self, figure: Figure, plots: Sequence[Axes]) -> None:
        del figure
        for plot in plots:
            plot.set_xlim(*self.xlim)
            plot.set_ylim(*self.ylim)
            plot.set_aspect("equal")
            plot.tick_params(labelsize=7 if len(plots) == 1 else 5)
        if len(plots) == 1:
            plots[0].set_xlabel(style.shortened(self._labels[0], 60))
            plots[0].set_ylabel(style.shortened(self._labels[1], 40))

    def paint(self, image: Image, panel: int, box: Box, state: State) -> None:
        del panel
        pixels = image[box.pixels]
        pixels[:] = WHITE
        (poses,) = state
        high, wide = pixels.shape[:2]
        x = (poses[:, 0] - self.xlim[0]) / (self.xlim[1] - self.xlim[0]) * wide
        y = (self.ylim[1] - poses[:, 1]) / (self.ylim[1] - self.ylim[0]) * high
        heading = poses[:, 2] if poses.shape[1] > 2 else np.full(len(poses), np.nan)
        inside = (x >= 0) & (x <= wide) & (y >= 0) & (y <= high)
        for place in zip(x[inside].tolist(), y[inside].tolist(), heading[inside].tolist(), strict=True):
            self._stamp(pixels, *place)

    def _stamp(self, pixels: Image, x: float, y: float, heading: float) -> None:
        """Blend one robot into the pixels of a panel."""
        top, left = max(0, int(y) - REACH), max(0, int(x) - REACH)
        window = pixels[top : int(y) + REACH + 1, left : int(x) + REACH + 1]
        down, right = np.mgrid[: window.shape[0], : window.shape[1]] + 0.5
        alpha = _covered(right + left - x, y - down - top, heading)[..., None]
        window[:] = np.round(window * (1 - alpha) + self._colour * alpha).astype(np.uint8)


def _covered(right: Floats, up: Floats, heading: float) -> Floats:
    """Return the part of each pixel that a robot covers, by the distance of its center from the robot."""
    covered: Floats = np.clip(RADIUS + 0.5 - np.hypot(right, up), 0, 1)
    if np.isfinite(heading):
        along = np.clip(right * np.cos(heading) + up * np.sin(heading), 0, LENGTH)
        beside = np.hypot(right - along * np.cos(heading), up - along * np.sin(heading))
        covered = np.maximum(covered, np.clip(WIDTH + 0.5 - beside, 0, 1))
    return covered
