"""The painter of networks: lines or arrows as wide as their weight, and nodes with the colour of their value.

A hollow node has no edge. Names of a few nodes are written if their places do not change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from sierra.deliverables.figures import style
from sierra.deliverables.figures.node_layout import NAMED
from sierra.extensions.videos.painting.scene import DPI, Scale, add_scale, canvas_of

if TYPE_CHECKING:
    from sierra.extensions.videos.encode import Image
    from sierra.extensions.videos.painting.text_strip import Box
    from sierra.extensions.videos.tracks import Floats, State

Places = Mapping[str, tuple[float, float]]
NODE, HEAD = 4.5, 7.0
"""The radius of a node and the length of an arrow's head, in pixels."""
NO_VALUE = "#BBBBBB"


@dataclass(frozen=True)
class Look:
    """The parts of all frames of networks."""

    nodes: Sequence[str]
    places: Places | None
    """The places of a layout; None if each state has positions."""
    limits: tuple[tuple[float, float], tuple[float, float]]
    """The limits of x and of y."""
    labels: tuple[str, str] | None
    """The labels of the axes; None without axes."""
    directed: bool
    widest: float
    """The weight of the widest edge; 0 if edges have no weight."""
    scale: Scale | None
    """The colours of nodes by their value."""


class NetworkPainter:
    """Paints networks with the same limits, widths and colours in all frames and panels."""

    def __init__(self, look: Look) -> None:
        self.look = look
        self._sheets: dict[Box, _Sheet] = {}

    def prepare(self, figure: Figure, plots: Sequence[Axes]) -> None:
        for plot in plots:
            plot.set_xlim(*self.look.limits[0])
            plot.set_ylim(*self.look.limits[1])
            plot.set_aspect("equal")
            plot.tick_params(labelsize=7 if len(plots) == 1 else 5)
            if self.look.labels is None:
                plot.set_xticks([])
                plot.set_yticks([])
                plot.spines[:].set_visible(False)
        if self.look.labels:
            style.outer_labels(plots, *self.look.labels)
        if self.look.scale:
            add_scale(figure, plots, self.look.scale)

    def paint(self, image: Image, panel: int, box: Box, state: State) -> None:
        del panel
        if box not in self._sheets:
            self._sheets[box] = _Sheet(self.look, box)
        image[box.pixels] = self._sheets[box].drawn(state)


class _Sheet:
    """The pixels of a panel, on which matplotlib draws networks in units of pixels."""

    def __init__(self, look: Look, box: Box) -> None:
        self._look = look
        self._size = box.right - box.left, box.bottom - box.top
        figure = Figure(figsize=(self._size[0] / DPI, self._size[1] / DPI), dpi=DPI, facecolor="white")
        self._canvas = canvas_of(figure)
        self._plot = plot = figure.add_axes((0, 0, 1, 1))
        plot.set_xlim(0, self._size[0])
        plot.set_ylim(0, self._size[1])
        plot.set_axis_off()
        self._lines = LineCollection([], colors=style.FAINT)
        self._heads = PolyCollection([], facecolors=style.FAINT, edgecolors="none")
        self._dots = plot.scatter([], [], s=(2 * NODE * 72 / DPI) ** 2, linewidths=1.0)
        for artist in (self._lines, self._heads):
            plot.add_collection(artist, autolim=False)
        fixed = look.places
        self._fixed = None if fixed is None else self._in_pixels(np.array([fixed[name] for name in look.nodes]))
        self._canvas.draw()
        self._empty = self._canvas.copy_from_bbox(figure.bbox)
        self._names = self._written()

    def _written(self) -> Image | None:
        """Return the names of nodes on white; None if there are too many, or if their places change."""
        if self._fixed is None or len(self._look.nodes) > NAMED:
            return None
        outward = self._fixed - self._fixed.mean(axis=0)  # where fewer edges are
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
        for name, (x, y) in zip(self._look.nodes, (self._fixed + outward * (NODE + 8)).tolist(), strict=True):
            text = style.shortened(name, 12)
            self._plot.draw_artist(self._plot.text(x, y, text, ha="center", va="center", fontsize=6))
        return self._pixels().copy()

    def _pixels(self) -> Image:
        return np.asarray(self._canvas.buffer_rgba())[..., :3]

    def drawn(self, state: State) -> Image:
        """Return the pixels of a network."""
        nodes, edges = state[0], state[1]
        places = self._fixed if self._fixed is not None else self._in_pixels(nodes[:, :2])
        ends = edges[:, :2].astype(int)
        starts, stops = places[ends[:, 0]], places[ends[:, 1]]
        self._lines.set_segments(list(np.stack([starts, stops], axis=1)))
        widest = self._look.widest
        self._lines.set_linewidth((0.4 + 2.0 * np.abs(edges[:, 2]) / widest).tolist() if widest else 0.8)
        self._heads.set_verts(list(_heads(starts, stops)) if self._look.directed else [])
        known = np.isfinite(places).all(axis=1)
        colours = self._colours(nodes[:, 2])
        joined = np.isin(np.arange(len(nodes)), ends)[:, None]
        self._dots.set_offsets(places[known])
        self._dots.set_edgecolor(colours[known].tolist())
        self._dots.set_facecolor(np.where(joined | bool(self._look.scale), colours, 1.0)[known].tolist())
        self._canvas.restore_region(self._empty)
        for artist in (self._lines, self._heads, self._dots):
            self._plot.draw_artist(artist)
        return self._pixels() if self._names is None else np.minimum(self._pixels(), self._names)

    def _in_pixels(self, places: Floats) -> Floats:
        low, high = np.array(self._look.limits).T
        found: Floats = (places - low) / (high - low) * self._size
        return found

    def _colours(self, values: Floats) -> Floats:
        from matplotlib import colormaps
        from matplotlib.colors import to_rgba

        scale = self._look.scale
        if scale is None:
            return np.tile(to_rgba(style.named_colours()[0]), (len(values), 1))
        part = np.clip((values - scale.low) / (scale.high - scale.low), 0, 1)
        shown: Any = colormaps[scale.palette](np.nan_to_num(part))
        return np.where(np.isfinite(values)[:, None], shown, to_rgba(NO_VALUE))


def _heads(starts: Floats, stops: Floats) -> Floats:
    """Return the triangles at the ends of arrows, before the discs of the nodes: edges × 3 × 2."""
    length = np.maximum(np.linalg.norm(stops - starts, axis=1, keepdims=True), 1e-9)
    along = (stops - starts) / length
    beside = along[:, ::-1] * (1, -1)
    tips = stops - along * (NODE + 1)
    feet = tips - along * HEAD
    return np.stack([tips, feet + beside * HEAD / 2, feet - beside * HEAD / 2], axis=1)
