"""The text of a frame is composed of parts, and looks as if matplotlib had drawn it as a whole."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sierra.deliverables.figures import style
from sierra.extensions.videos.painting.text_strip import Box, TextStrip

LINES = Box(20, 40, 0, 300)


def whole(text: str) -> np.ndarray:
    """Return the pixels of a text that matplotlib draws as a whole."""
    figure = Figure(figsize=(3, 0.5), dpi=100)
    figure.text(0.01, 0.3, text, va="bottom", fontsize=8)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@pytest.mark.parametrize("text", ["tick = 457", "clock = 0.1123 s, n = 10, 12", "-3e-05", "שעה = 7", "x" * 90 + "1"])
def test_composed_text_is_where_whole_text_is(text: str) -> None:
    with style.settings():
        figure = Figure(figsize=(3, 0.5), dpi=100)
        written = figure.text(0.01, 0.3, "", va="bottom", fontsize=8, visible=False)
        canvas = FigureCanvasAgg(figure)  # type: ignore[no-untyped-call]
        canvas.draw()
        background = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        strip = TextStrip(canvas, written, LINES, background)
        first, again, expected = background.copy(), background.copy(), whole(text)
        strip.write(first, "888888")
        strip.write(again, text)
    ours, theirs = (np.flatnonzero((image < 200).any(axis=(0, 2))) for image in (again, expected))
    assert abs(int(ours[-1]) - int(theirs[-1])) <= 4
    assert ours[0] == theirs[0]
    rows = [np.flatnonzero((image < 200).any(axis=(1, 2))) for image in (again, expected)]
    assert (rows[0][0], rows[0][-1]) == (rows[1][0], rows[1][-1])


def test_notes_below_the_text_are_not_repeated() -> None:
    with style.settings():
        figure = Figure(figsize=(3, 0.5), dpi=100)
        written = figure.text(0.01, 0.3, "", va="bottom", fontsize=8, visible=False)
        canvas = FigureCanvasAgg(figure)  # type: ignore[no-untyped-call]
        canvas.draw()
        background = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        background[38:40, 3:6] = 0
        strip = TextStrip(canvas, written, LINES, background)
        image = background.copy()
        strip.write(image, "k = 123456")
    assert (image[38:40, 8:] == background[38:40, 8:]).all()
