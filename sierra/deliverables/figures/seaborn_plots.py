"""The home of seaborn and pandas: what the statistical kinds of figures paint into axes that SIERRA made.

Both are loaded by the first function that is called, because that takes two seconds. They come with the extra `figures`.

Each function gets numbers that SIERRA computed, or the values of runs, and looks that SIERRA chose. seaborn adds no legend, no
label and no statistic to them but densities. Its random numbers are always the same, and its figures are never shown, so that
the same data give the same bytes.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.typing import ColorType

from sierra.deliverables.figures.style import Floats, Look
from sierra.errors import NotInstalled
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    import pandas as pd

Ints = npt.NDArray[np.int_]

WIDTH = 0.8
"""The width of all groups at one place, where 1 is the distance of two places."""
GAP = 0.125
"""The part of a group's width that stays empty."""
LINES = "#333333"
BOX, VIOLIN = 0.45, 0.3
"""The strength of the colours of boxes and of densities."""


@dataclass(frozen=True, slots=True)
class Grouped:
    """Values at places 0, 1, 2, … of an axis, with the number of their group."""

    place: Ints
    group: Ints
    value: Floats

    def frame(self) -> pd.DataFrame:
        import pandas as pd

        return pd.DataFrame({"place": self.place, "group": self.group, "value": self.value})


@dataclass(frozen=True, slots=True)
class GroupAxes:
    """Axes with groups side by side: each group has a colour, and there are `places` places."""

    plot: Axes
    places: int
    colours: Sequence[ColorType]


def boxes(axes: GroupAxes, summaries: Grouped) -> None:
    """Draw boxes. Each has five values in `summaries`: the ends of the whiskers, the quartiles, and the median.

    The quartiles of five numbers are the second and the fourth, so that seaborn draws exactly these numbers.
    """
    look = {"saturation": 1, "linecolor": LINES, "linewidth": 0.7, "medianprops": {"linewidth": 1.6}}
    _side_by_side("boxplot", axes, summaries, BOX, width=WIDTH, gap=GAP, whis=(0, 100), **look)


def violins(axes: GroupAxes, values: Grouped) -> None:
    """Draw densities from the smallest to the largest value, all of the same width: Gaussian kernels, bandwidth of Scott.

    On a logarithmic axis they are the densities of the logarithms.
    """
    look = {"saturation": 1, "linewidth": 0, "inner": None}
    _side_by_side("violinplot", axes, values, VIOLIN, width=WIDTH, gap=GAP, density_norm="width", cut=0, **look)


def dots(axes: GroupAxes, values: Grouped, *, size: float, jitter: float, marker: str = "o") -> None:
    """Draw a dot of `size` points for each value, moved aside by at most `jitter` (of the distance of two places)."""
    _side_by_side("stripplot", axes, values, 1, size=size, marker=marker, jitter=jitter or False, alpha=0.7, linewidth=0)


def _side_by_side(function: str, axes: GroupAxes, values: Grouped, strength: float, **look: object) -> None:
    """Call one of seaborn's categorical functions; `strength` is 1 for the colours of the groups, less for lighter ones."""
    if not len(values.value):
        return
    with _seaborn(axes.plot) as seaborn:
        getattr(seaborn, function)(
            values.frame(),
            x="place",
            y="value",
            hue="group",
            order=list(range(axes.places)),
            hue_order=list(range(len(axes.colours))),
            palette=[tinted(colour, strength) for colour in axes.colours],
            dodge=True,
            legend=False,
            ax=axes.plot,
            **look,
        )


def steps(plot: Axes, values: Floats, weights: Floats, look: Look) -> None:
    """Draw the part of all weights up to each value, as a step curve."""
    with _seaborn(plot) as seaborn:
        seaborn.ecdfplot(x=values, weights=weights, ax=plot, **look)


def bins(plot: Axes, counts: Floats, edges: Floats, look: Look, *, density: bool) -> None:
    """Draw the outline of a histogram whose bins have these counts, filled in a light colour."""
    outline = {"linestyle": look.get("linestyle", "-"), "linewidth": 1.0, "alpha": 0.12}
    with _seaborn(plot) as seaborn:
        seaborn.histplot(
            x=(edges[:-1] + edges[1:]) / 2,
            weights=counts,
            bins=edges.tolist(),
            stat="density" if density else "count",
            element="step",
            color=look["color"],
            ax=plot,
            **outline,
        )


def density(plot: Axes, values: Floats, colour: ColorType, zorder: float) -> PolyCollection:
    """Draw a density, filled, and return it: Gaussian kernels with the bandwidth of Scott."""
    with _seaborn(plot) as seaborn:
        seaborn.kdeplot(
            x=values, ax=plot, bw_method="scott", cut=2, fill=True, color=colour, alpha=0.35, linewidth=0.8, zorder=zorder
        )
    shape = plot.collections[-1]
    if not isinstance(shape, PolyCollection):
        raise TypeError("seaborn did not draw a density")
    return shape


def marks(plot: Axes, x: Floats, y: Floats, series: Ints, looks: Sequence[Look], *, size: float) -> None:
    """Draw a mark of `size` points for each pair of values, in the colour and the shape of its series."""
    everyone = list(range(len(looks)))
    with _seaborn(plot) as seaborn:
        import pandas as pd

        seaborn.scatterplot(
            pd.DataFrame({"x": x, "y": y, "series": series}),
            x="x",
            y="y",
            hue="series",
            style="series",
            hue_order=everyone,
            style_order=everyone,
            palette=[look["color"] for look in looks],
            markers=[look.get("marker", "o") for look in looks],
            s=size**2,
            alpha=0.7,
            linewidth=0,
            legend=False,
            ax=plot,
        )


def cells(plot: Axes, values: Floats, texts: npt.NDArray[np.str_] | None) -> None:
    """Draw a matrix of parts from 0 to 1, the first row on top, with a text in each cell that has a value."""
    with _seaborn(plot) as seaborn, _undrawn(plot):
        seaborn.heatmap(
            values,
            vmin=0,
            vmax=1,
            cmap="Blues",
            annot=texts,
            fmt="",
            annot_kws={"size": 6},
            linewidths=0.5,
            linecolor="white",
            cbar=False,
            xticklabels=False,
            yticklabels=False,
            ax=plot,
        )


def tinted(colour: ColorType, strength: float) -> tuple[float, ...]:
    """Return a colour mixed with white: `strength` is the part of the colour."""
    return tuple(1 - strength * (1 - part) for part in to_rgb(colour))


@contextmanager
def _seaborn(plot: Axes) -> Iterator[Any]:
    """Yield seaborn, without its known warnings and with the same random numbers each time; then remove its labels.

    Raises NotInstalled if seaborn or pandas is not installed.
    """
    with warnings.catch_warnings(), mpl.rc_context(), _seeded():
        # 0.13.2 calls `Axes.bxp(vert=…)`, and functions of pandas with `copy=…`
        warnings.filterwarnings("ignore", "vert: bool was deprecated", mpl.MatplotlibDeprecationWarning)
        yield _loaded()
        plot.set(xlabel="", ylabel="")


def _loaded() -> Any:
    try:
        import seaborn
        from pandas.errors import Pandas4Warning
    except ModuleNotFoundError as error:
        raise NotInstalled(
            f"statistical figures need the packages seaborn and pandas, but {error.name} is not installed; "
            "pip install 'sierra-experiments[figures]'"
        ) from error
    warnings.simplefilter("ignore", Pandas4Warning)
    return seaborn


@contextmanager
def _seeded() -> Iterator[None]:
    """Give NumPy's global generator, which seaborn uses, the same state each time, and restore it afterwards."""
    before = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(before)


@contextmanager
def _undrawn(plot: Axes) -> Iterator[None]:
    """Give the figure a canvas that draws nothing.

    `heatmap` draws the complete figure to see whether its labels overlap, once for each panel; but it makes no labels here.
    """
    figure = plot.get_figure(root=True)
    if figure is None:
        raise TypeError("these axes belong to no figure")
    before = figure.canvas
    FigureCanvasBase(figure)
    try:
        yield
    finally:
        figure.set_canvas(before)
