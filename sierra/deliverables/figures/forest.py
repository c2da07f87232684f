"""The figure of a comparison: differences with their intervals, one below the other or over time; or the sizes of effects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from sierra.deliverables.figures import style
from sierra.deliverables.figures.facets import MOST
from sierra.errors import UsageError
from sierra.stats.comparison.model import Effect, Pair, Verdict
from sierra.stats.words import of_run

if TYPE_CHECKING:
    from sierra.deliverables.comparison import Compared
    from sierra.stats.comparison.over_time import Band

ROW = 0.17
"""The height of a row in inches."""
ROWS = 80
"""The largest number of rows of one figure."""
FILLED = (Verdict.different, Verdict.both)


def forest(compared: Compared) -> Figure:
    """Draw the difference and its interval for each pair of groups; filled marks are differences that were shown.

    Raises UsageError if there are too many rows, or no difference is known.
    """
    if compared.effects:
        return _effects(compared.effects)
    if compared.bands:
        return _over_time(compared)
    pairs = [pair for pair in compared.pairs if pair.difference is not None]
    if not pairs:
        raise UsageError("no difference of two groups is known, so there is nothing to draw")
    figure, plot = _rows([_name(pair) for pair in pairs])
    plot.axvline(0, color="#333333", linewidth=0.8, linestyle=":")
    if (margin := compared.analysis.question.margin) is not None:
        plot.axvspan(-margin, margin, color=style.FAINT, alpha=0.15, linewidth=0)
    for place, pair in enumerate(pairs):
        _mark(plot, place, pair)
    unit = f" [{compared.unit}]" if compared.unit else ""
    plot.set_xlabel(style.shortened(f"difference of {of_run(compared.measure, compared.column)}{unit}", 48), loc="right")
    return figure


def _mark(plot: Axes, place: int, pair: Pair) -> None:
    colour = style.NAMED[0]
    if pair.low is not None and pair.high is not None:
        plot.plot([pair.low, pair.high], [place, place], color=colour, linewidth=1.2)
    face = colour if pair.verdict in FILLED else "white"
    plot.plot([pair.difference or 0.0], [place], "o", color=colour, markerfacecolor=face, markersize=4)


def _over_time(compared: Compared) -> Figure:
    """Draw the difference over time with its interval, a panel for each pair of groups."""
    if len(compared.bands) > MOST:
        raise UsageError(f"the figure needs {len(compared.bands)} panels, but at most {MOST} are possible")
    figure, plots = style.panels(len(compared.bands))
    for plot, band in zip(plots, compared.bands, strict=True):
        plot.axhline(0, color="#333333", linewidth=0.8, linestyle=":")
        plot.plot(band.times, band.mean, color=style.NAMED[0])
        plot.fill_between(band.times, band.low, band.high, color=style.NAMED[0], alpha=0.2, linewidth=0)
        style.title(plot, _name(band))
    unit = f" [{compared.unit}]" if compared.unit else ""
    style.outer_labels(plots, compared.time, f"difference of {compared.column}{unit}")
    return figure


def _effects(effects: Sequence[Effect]) -> Figure:
    figure, plot = _rows([style.shortened(effect.name, 44) for effect in effects])
    sizes = [effect.eta for effect in effects]
    plot.barh(np.arange(len(effects)), sizes, height=0.6, color=style.NAMED[0])
    plot.set_xlim(0, 1)
    plot.set_xlabel("partial η²")
    return figure


def _rows(names: Sequence[str]) -> tuple[Figure, Axes]:
    """Return a figure with a row for each name, the first one on top."""
    if len(names) > ROWS:
        raise UsageError(f"a figure of {len(names)} differences cannot be read; at most {ROWS} are possible")
    figure = style.blank(style.COLUMN, 0.6 + ROW * len(names))
    plot = figure.add_subplot()
    plot.set_yticks(range(len(names)), list(names), fontsize=6.5)
    plot.yaxis.set_minor_locator(NullLocator())
    plot.set_ylim(len(names) - 0.4, -0.6)
    plot.grid(visible=False, axis="y")
    return figure, plot


def _name(pair: Pair | Band) -> str:
    where = ", ".join(f"{name}={style.named(value, 16)}" for name, value in pair.point.items())
    return style.shortened(f"{where}: {pair.second} − {pair.first}" if where else f"{pair.second} − {pair.first}", 44)
