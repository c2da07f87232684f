"""Find texts of a figure that are not fit for print: they overlap, leave the figure or read alike, by the renderer's boxes."""

from __future__ import annotations

import itertools
from collections import Counter
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

TOUCHING = 1.0
"""The number of pixels at 300 dpi by which two boxes may overlap: the boxes of letters have empty edges."""


def faults(figure: Figure) -> list[str]:
    """Return what is wrong with the texts of a figure, a line for each fault."""
    texts = _drawn(figure)
    corners = [_corners(text) for text in texts]
    outer = figure.bbox
    found = [
        f"{_said(text)} leaves the figure"
        for text, box in zip(texts, corners, strict=True)
        if box.min() < -TOUCHING or (box.max(axis=0) > (outer.x1 + TOUCHING, outer.y1 + TOUCHING)).any()
    ]
    for (one, first), (other, second) in itertools.combinations(zip(texts, corners, strict=True), 2):
        if _overlap(first, second):
            found.append(f"{_said(one)} overlaps {_said(other)}")
    for plot in figure.axes:
        inside = plot.get_window_extent().padded(-2)
        frame = np.array([(inside.x0, inside.y0), (inside.x1, inside.y0), (inside.x1, inside.y1), (inside.x0, inside.y1)])
        own = set(map(id, plot.findobj(Text)))
        for text, box in zip(texts, corners, strict=True):
            if id(text) not in own and _overlap(box, frame):
                found.append(f"{_said(text)} is on the data of a panel")
    return [*found, *_alike(figure, texts)]


def _alike(figure: Figure, texts: list[Text]) -> list[str]:
    """Return the titles of panels, and the ticks and entries of one axis or legend, that read the same."""
    drawn = set(map(id, texts))
    groups: list[list[Any]] = [[plot.title for plot in figure.axes]]
    groups += [axis.get_ticklabels() for plot in figure.axes for axis in (plot.xaxis, plot.yaxis)]
    groups += [legend.get_texts() for legend in figure.legends]
    counts = [Counter(text.get_text() for text in group if id(text) in drawn) for group in groups]
    return [f"{times} texts read {text!r}" for count in counts for text, times in count.items() if times > 1]


def _drawn(figure: Figure) -> list[Text]:
    """Draw the figure; return the texts that are drawn."""
    found: dict[int, Text] = {}
    draw = Text.draw

    def note(text: Text, renderer: Any, *more: Any, **others: Any) -> None:
        if text.get_visible() and text.get_text().strip():
            found[id(text)] = text
        draw(text, renderer, *more, **others)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Text, "draw", note)
        figure.canvas.draw()
    return list(found.values())


def _corners(text: Text) -> Any:
    """Return the four corners of a text in pixels; the box of a text that is turned has the same middle as its upright one."""
    whole = Text.get_window_extent(text)
    angle = text.get_rotation()
    text.set_rotation(0)
    upright = Text.get_window_extent(text)
    text.set_rotation(angle)
    half = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (upright.width / 2, upright.height / 2)
    turn = np.radians(angle)
    matrix = np.array([(np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))])
    return half @ matrix + ((whole.x0 + whole.x1) / 2, (whole.y0 + whole.y1) / 2)


def _overlap(first: Any, second: Any) -> bool:
    """Return whether two rectangles overlap: no side of them separates them."""
    for corners in (first, second):
        for k in range(2):
            side = corners[k + 1] - corners[k]
            if not (length := np.hypot(*side)):
                return False
            normal = np.array((-side[1], side[0])) / length
            one, other = first @ normal, second @ normal
            if min(one.max(), other.max()) - max(one.min(), other.min()) < TOUCHING:
                return False
    return True


def _said(text: Text) -> str:
    said = text.get_text()
    return repr(said if len(said) <= 40 else f"{said[:36]}…")
