"""The picture around the states: title, axes, colour bar and notes are drawn once, and each frame adds only what changes.

The states of matrices are pasted by NumPy; other states are drawn by matplotlib on the same background. The text at the bottom
has the time and the number of runs.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from sierra.deliverables.figures import style
from sierra.errors import UsageError
from sierra.extensions.videos.painting.text_strip import Box, TextStrip
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.extensions.videos.encode import Image
    from sierra.extensions.videos.tracks import State

DPI = 100
LINE = 0.2
"""The height of a line of text at the bottom, in inches."""
SMALLEST = 60
"""The smallest width and height of a panel with its title, in pixels."""
THINNEST = 4
"""The smallest width and height of what a panel shows, in pixels."""
LARGEST = 4096
"""The largest width and height of a video, in pixels."""
CROWDED = 9
"""The largest number of panels with numbers on their axes."""
EMPTY = "#E6E6E6"


class Painter(Protocol):
    """Draws the states of one kind in the panels of a scene."""

    def prepare(self, figure: Figure, plots: Sequence[Axes]) -> None:
        """Draw everything that is the same in all frames, before the layout is computed."""

    def paint(self, image: Image, panel: int, box: Box, state: State) -> None:
        """Paint a state into the pixels of a panel."""


@dataclass(frozen=True, slots=True)
class Words:
    """The texts of a scene."""

    title: str
    panels: Sequence[str]
    """The title of each panel; empty if there is only one."""
    notes: str
    """Notes for the viewer, in small print."""


class Scene:
    """The frames of one video. To be made and used under `settings`."""

    def __init__(self, size: tuple[int, int], words: Words, painter: Painter) -> None:
        """`size`: width and height in pixels, both even."""
        self._painter = painter
        self._figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI)
        figure = self._figure
        self._canvas = canvas_of(figure)
        count = len(words.panels)
        across = columns(count, size)
        _check_room(size, count, across)
        grid = figure.subplots(-(-count // across), across, squeeze=False).ravel().tolist()
        self.plots: list[Axes] = grid[:count]
        for plot in grid[count:]:
            plot.remove()
        painter.prepare(figure, self.plots)
        inches = size[0] / DPI / across
        for plot, title in zip(self.plots, words.panels, strict=True):
            plot.set_facecolor(EMPTY)
            plot.grid(visible=False)
            plot.set_title(style.shortened(title, max(12, int(inches / 0.065))), fontsize=7)
            plot.text(0.5, 0.5, "no data", transform=plot.transAxes, ha="center", va="center", fontsize=8, color=style.FAINT)
        self._write(words)
        self._canvas.draw()
        self._background = self._pixels()
        self._strip = TextStrip(self._canvas, self._text, self._lines, self._background)
        self._boxes = [self._box(plot) for plot in self.plots]
        if any(min(box.right - box.left, box.bottom - box.top) < THINNEST for box in self._boxes):
            raise UsageError(_no_room(count, size))

    def _write(self, words: Words) -> None:
        figure = self._figure
        width, height = figure.get_size_inches()
        notes = style.wrapped(words.notes, width, 6) if words.notes else ""
        below = LINE + 0.11 * (notes.count("\n") + 1 if notes else 0)
        above = 0.0
        if words.title:
            above = 0.22
            figure.text(
                0.5, 1 - 0.04 / height, style.shortened(words.title, int(width / 0.075)), va="top", ha="center", fontsize=9
            )
        if notes:
            figure.text(0.01, 0.03 / height, notes, va="bottom", ha="left", fontsize=6, color=style.FAINT)
        bottom = (below - LINE + 0.04) / height
        self._text = figure.text(0.01, bottom, "", va="bottom", ha="left", fontsize=8, visible=False)
        self._lines = Box(math.floor((height - below) * DPI), math.ceil((height - below + LINE) * DPI), 0, round(width * DPI))
        rect = (0.0, below / height, 1.0, 1 - (below + above) / height)
        try:
            ConstrainedLayoutEngine(w_pad=0.04, h_pad=0.04, hspace=0.02, wspace=0.02, rect=rect, compress=True).execute(figure)
        except UserWarning as error:  # an error within `settings`
            raise UsageError(_no_room(len(self.plots), (round(width * DPI), round(height * DPI)))) from error

    def _pixels(self) -> Image:
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _box(self, plot: Axes) -> Box:
        """Return the pixels within the frame of a panel."""
        extent, high = plot.get_window_extent(), self._background.shape[0]
        return Box(
            math.ceil(high - extent.y1) + 1,
            math.floor(high - extent.y0) - 1,
            math.ceil(extent.x0) + 1,
            math.floor(extent.x1) - 1,
        )

    def boxes(self) -> Sequence[Box]:
        """Return the pixels of each panel."""
        return self._boxes

    def frame(self, text: str, states: Sequence[State | None]) -> Image:
        """Return the frame of these states, one for each panel."""
        image = self._background.copy()
        for panel, state in enumerate(states):
            if state is not None:
                self._painter.paint(image, panel, self._boxes[panel], state)
        self._strip.write(image, text)
        return image


def canvas_of(figure: Figure) -> Any:
    """Return a canvas; matplotlib publishes no types for it."""
    return FigureCanvasAgg(figure)


def _check_room(size: tuple[int, int], count: int, across: int) -> None:
    """Raise UsageError if panels would be too small to be seen."""
    wide, high = size[0] / across, size[1] / -(-count // across)
    if min(wide, high) < SMALLEST:
        raise UsageError(_no_room(count, size))


def _no_room(count: int, size: tuple[int, int]) -> str:
    return f"{counted(count, 'panel')} and the notes do not fit into {size[0]} × {size[1]} pixels; increase size, or show fewer"


@contextlib.contextmanager
def settings() -> Iterator[None]:
    """Apply the settings of figures; a layout that does not fit is an error."""
    with style.settings():
        warnings.filterwarnings("error", message="constrained_layout not applied")
        yield


def columns(count: int, size: tuple[int, int]) -> int:
    """Return the number of columns of panels, so that panels are about squares."""
    found = min(range(1, count + 1), key=lambda n: (abs(math.log((size[0] / n) / (size[1] / -(-count // n)))), n))
    return 1 if count == 1 else found


@dataclass(frozen=True, slots=True)
class Scale:
    """A scale of colours, the same in all frames."""

    low: float
    high: float
    palette: str
    label: str
    panels: tuple[int, ...]
    """The panels that have it."""
    beyond: tuple[bool, bool] = (False, False)
    """True if values are below the lowest, and above the highest colour."""


def add_scale(figure: Figure, plots: Sequence[Axes], scale: Scale) -> None:
    """Draw the bar of a scale beside its panels."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    mapped = ScalarMappable(Normalize(scale.low, scale.high), colormaps[scale.palette])
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[scale.beyond]
    bar = figure.colorbar(mapped, ax=list(plots), pad=0.02, fraction=0.06, aspect=24, extend=extend)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=6, length=2)
    bar.set_label(style.shortened(scale.label, 40))


class MatrixPainter:
    """Paints matrices, row 0 above. Cells without a value are grey."""

    def __init__(
        self, up: npt.NDArray[np.float64], across: npt.NDArray[np.float64], labels: tuple[str, str], scales: Sequence[Scale]
    ) -> None:
        """`up`, `across`: the numbers of rows and columns; `labels`: their names; each panel has one of the scales."""
        self._up, self._across, self._labels, self.scales = up, across, labels, scales
        self._of = {panel: scale for scale in scales for panel in scale.panels}
        self._tables = {scale: _colours(scale) for scale in scales}
        self._places: dict[Box, tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]] = {}
        self._size = (0, 0)

    def prepare(self, figure: Figure, plots: Sequence[Axes]) -> None:
        high, wide = len(self._up), len(self._across)
        self._size = _size(figure)
        for plot in plots:
            plot.set_xlim(-0.5, wide - 0.5)
            plot.set_ylim(high - 0.5, -0.5)
            if 1 / 8 <= high / wide <= 8:
                plot.set_aspect("equal")
            for set_ticks, values in ((plot.set_xticks, self._across), (plot.set_yticks, self._up)):
                shown = style.thinned(len(values), 8 if len(plots) == 1 else 4)
                set_ticks(shown, [style.number(float(values[k])) for k in shown])
            plot.tick_params(labelsize=7 if len(plots) == 1 else 5)
            if len(plots) > CROWDED:
                plot.tick_params(bottom=False, left=False, labelbottom=False, labelleft=False)
        style.outer_labels(plots, self._labels[1], self._labels[0])
        for scale in self.scales:
            add_scale(figure, [plots[panel] for panel in scale.panels], scale)

    def paint(self, image: Image, panel: int, box: Box, state: State) -> None:
        (values,) = state
        scale = self._of[panel]
        if box not in self._places:
            self._check_cells(box)
            self._places[box] = _cells(box.bottom - box.top, len(self._up)), _cells(box.right - box.left, len(self._across))
        rows, places = self._places[box]
        colours = self._tables[scale][_shades(values.astype(np.float64), scale)]
        image[box.pixels] = np.take(np.take(colours, places, axis=1), rows, axis=0)  # whole rows are copied last: faster

    def _check_cells(self, box: Box) -> None:
        """Raise UsageError if there are more cells than pixels, because some would not be seen."""
        cells, pixels = (len(self._up), len(self._across)), (box.bottom - box.top, box.right - box.left)
        factor = max(many / few for many, few in zip(cells, pixels, strict=True))
        if factor > 1:
            wide, high = (math.ceil(1.02 * factor * side / 20) * 20 for side in self._size)
            fits = max(wide, high) <= LARGEST
            hint = f"set size = [{wide}, {high}]" if fits else "make fewer cells by sql, or show fewer panels"
            panel = f"a panel of {pixels[0]} × {pixels[1]} pixels"
            raise UsageError(f"{cells[0]} × {cells[1]} cells do not fit into {panel}, so some would not be seen; {hint}")


def _size(figure: Figure) -> tuple[int, int]:
    """Return the width and the height of a figure in pixels."""
    width, height = figure.get_size_inches()
    return round(width * DPI), round(height * DPI)


def _cells(pixels: int, cells: int) -> npt.NDArray[np.intp]:
    """Return the cell that each of a row of pixels belongs to."""
    return ((np.arange(pixels) + 0.5) * cells / pixels).astype(np.intp)


LEVELS = 256
"""The number of colours of a scale; another one, the last, is for cells without a value."""


def _colours(scale: Scale) -> Image:
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    table = colormaps[scale.palette](np.linspace(0, 1, LEVELS))[:, :3]
    every = np.vstack([table, np.full((1, 3), to_rgb("#BBBBBB"))])
    return np.round(every * 255).astype(np.uint8)


def _shades(values: npt.NDArray[np.float64], scale: Scale) -> npt.NDArray[np.intp]:
    """Return the place of each value in the table of colours."""
    finite = np.isfinite(values)
    part = (np.where(finite, values, scale.low) - scale.low) / (scale.high - scale.low)
    shades = np.clip(part * LEVELS, 0, LEVELS - 1).astype(np.intp)
    return np.where(finite, shades, LEVELS)
