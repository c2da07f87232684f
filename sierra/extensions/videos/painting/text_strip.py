"""The line of text that changes with each frame.

matplotlib draws a text in about 3 ms, which is more than all else in a frame. So each part of it is drawn once and kept: every
digit, and everything between two digits. All digits have the same width.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any
from unicodedata import bidirectional

import numpy as np
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from sierra.util.lazy_definitions import dataclass, regex

if TYPE_CHECKING:
    from sierra.extensions.videos.encode import Image

PARTS = regex(r"\d|\D+")
KEPT = 1000
"""The largest number of parts that are kept."""


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle of pixels; `top` and `left` belong to it, `bottom` and `right` do not."""

    top: int
    bottom: int
    left: int
    right: int

    def bbox(self, height: int) -> Bbox:
        """Return the rectangle as matplotlib counts, from below, in an image of this height."""
        return Bbox.from_extents(self.left, height - self.bottom, self.right, height - self.top)

    @property
    def pixels(self) -> tuple[slice, slice]:
        return slice(self.top, self.bottom), slice(self.left, self.right)


def _parts(text: str) -> list[str]:
    """Return the parts of a text from left to right; a text with letters of right-to-left scripts is one part."""
    mixed = any(bidirectional(letter) in ("R", "AL", "AN") for letter in text)
    return [text] if mixed else PARTS.findall(text)


class TextStrip:
    """Writes texts into frames, dark on the background of the scene."""

    def __init__(self, canvas: Any, text: Text, lines: Box, background: Image) -> None:
        """`text` is where texts begin, and not visible; `lines` are the pixels that they may use."""
        self._canvas, self._text = canvas, text
        self._rows = slice(lines.top, lines.bottom)
        self._empty = background[self._rows].copy()
        self._region = canvas.copy_from_bbox(lines.bbox(background.shape[0]))
        self._left = round(text.get_window_extent().x0)
        self._drawn = lru_cache(KEPT)(self._draw)

    def write(self, image: Image, text: str) -> None:
        """Write a text into a frame; what is too long is cut off."""
        strip, place = image[self._rows], self._left
        for part in _parts(text):
            pixels, width = self._drawn(part)
            window = strip[:, place - self._left :][:, : pixels.shape[1]]
            np.minimum(window, pixels[:, : window.shape[1]], out=window)
            place += width

    def _draw(self, part: str) -> tuple[Image, int]:
        """Return the pixels of a part with the margin at its left, and the number of pixels to the next part."""
        self._canvas.restore_region(self._region)
        self._text.set_text(part)
        self._text.set_visible(True)
        self._text.draw(self._canvas.get_renderer())
        pixels = np.asarray(self._canvas.buffer_rgba())[self._rows, :, :3]
        pixels = np.where(pixels == self._empty, 255, pixels).astype(np.uint8)  # only the text: notes may be near
        inked = np.flatnonzero((pixels < 255).any(axis=(0, 2)))
        width, _, _ = self._canvas.get_renderer().get_text_width_height_descent(part, self._text.get_fontproperties(), False)
        return pixels[:, : int(inked.max(initial=0)) + 1], round(width)
