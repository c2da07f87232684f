"""The figure of a comparison: differences with their intervals, one below the other or over time; or the sizes of effects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from sierra.deliverables.figures import style
from sierra.deliverables.figures.facets import MOST
from sierra.errors import UsageError
from sierra.stats.comparison.model import Pair, Verdict
from sierra.stats.words import of_run

if TYPE_CHECKING:
    from sierra.deliverables.comparison import Compared
    from sierra.stats.comparison.over_time import Band

ROW, LINE = 0.18, 0.115
"""The height of a row, and of each further line of its label, in inches."""
SIZE = 6.5
"""The size of the labels in points."""
LABELS = 0.33
"""The part of the width that labels may take."""
ROWS = 80
"""The largest number of rows of one figure."""
FILLED = (Verdict.different, Verdict.both)


def forest(compared: Compared) -> Figure:
    """Draw the difference and its interval for each pair of groups; filled marks are differences that were shown.

    Raises UsageError if there are too many rows, or no difference is known.
    """
    if compared.effects:
        return _effects(compared)
    if compared.bands:
        return _over_time(compared)
    pairs = [pair for pair in compared.pairs if pair.difference is not None]
    if not pairs:
        raise UsageError("no difference of two groups is known, so there is nothing to draw")
    figure, plot, places = _rows(_labels(compared, pairs))
    plot.axvline(0, color="#333333", linewidth=0.8, linestyle=":")
    if (margin := compared.analysis.question.margin) is not None:
        plot.axvspan(-margin, margin, color=style.FAINT, alpha=0.15, linewidth=0)
    for y, pair in zip(places, pairs, strict=True):
        _mark(plot, y, pair)
    unit = f" [{compared.unit}]" if compared.unit else ""
    plot.set_xlabel(style.wrapped(f"difference of {of_run(compared.measure, compared.column)}{unit}", _width(), 8), loc="right")
    return figure


def _labels(compared: Compared, pairs: Sequence[Pair]) -> list[tuple[str, str]]:
    """Return heading and label of each row: the variables' values and the groups; if all have the same groups, the reverse."""
    labels = [_words(compared, pair) for pair in pairs]
    if len({groups for _, groups in labels}) == 1 and all(point for point, _ in labels):
        return [(groups, point) for point, groups in labels]
    return labels


def _words(compared: Compared, pair: Pair | Band) -> tuple[str, str]:
    """Return the values of the variables of two groups, and the names of both."""
    known = compared.asked.labels
    values = {name: known.get(str(value)) or style.named(value, 200, 12) for name, value in pair.point.items()}
    groups = f"{known.get(pair.second, pair.second)} − {known.get(pair.first, pair.first)}"
    return ", ".join(f"{name.replace('_', ' ')} = {value}" for name, value in values.items()), groups


def _mark(plot: Axes, y: float, pair: Pair) -> None:
    colour = style.NAMED[0]
    if pair.low is not None and pair.high is not None:
        plot.plot([pair.low, pair.high], [y, y], color=colour, linewidth=1.2)
    face = colour if pair.verdict in FILLED else "white"
    plot.plot([pair.difference or 0.0], [y], "o", color=colour, markerfacecolor=face, markersize=4)


def _over_time(compared: Compared) -> Figure:
    """Draw the difference over time with its interval, a panel for each pair of groups."""
    if len(compared.bands) > MOST:
        raise UsageError(f"the figure needs {len(compared.bands)} panels, but at most {MOST} are possible")
    figure, plots = style.panels(len(compared.bands))
    for plot, band in zip(plots, compared.bands, strict=True):
        plot.axhline(0, color="#333333", linewidth=0.8, linestyle=":")
        plot.plot(band.times, band.mean, color=style.NAMED[0])
        plot.fill_between(band.times, band.low, band.high, color=style.NAMED[0], alpha=0.2, linewidth=0)
        style.title(plot, ": ".join(filter(None, _words(compared, band))))
    unit = f" [{compared.unit}]" if compared.unit else ""
    style.outer_labels(plots, compared.time, f"difference of {compared.column}{unit}")
    return figure


def _effects(compared: Compared) -> Figure:
    figure, plot, places = _rows([("", compared.asked.labels.get(effect.name, effect.name)) for effect in compared.effects])
    sizes = [effect.eta for effect in compared.effects]
    plot.barh(places, sizes, height=ROW * 0.6, color=style.NAMED[0])
    plot.set_xlim(0, 1)
    plot.set_xlabel("partial η²")
    return figure


def _rows(labels: Sequence[tuple[str, str]]) -> tuple[Figure, Axes, list[float]]:
    """Return a figure with a row for each heading and label, the first one on top, and the places of the rows, in inches."""
    if len(labels) > ROWS:
        raise UsageError(f"a figure of {len(labels)} differences cannot be read; at most {ROWS} are possible")
    figure = style.blank(style.COLUMN, 1)
    plot = figure.add_subplot()
    places: list[float] = []
    lines, before, y = [], "", 0.05
    for heading, label in labels:
        if heading != before:
            y = _heading(plot, heading, y)
            before = heading
        lines.append(style.wrapped(label, LABELS * figure.get_figwidth(), SIZE, 9))
        high = ROW + LINE * lines[-1].count("\n")
        places.append(y + high / 2)
        y += high
    if style.chosen().height is None:
        figure.set_figheight(0.75 + y)
    plot.set_yticks(places, lines, fontsize=SIZE)
    plot.yaxis.set_minor_locator(NullLocator())
    plot.set_ylim(y + 0.05, 0)
    plot.grid(visible=False, axis="y")
    return figure, plot, places


def _heading(plot: Axes, text: str, y: float) -> float:
    """Write a heading above the rows that follow, beside their labels; return where they begin."""
    words = style.wrapped(text, _width(), SIZE, 9)
    behind = {"facecolor": "white", "linewidth": 0, "pad": 1}
    plot.text(0.01, y + 0.03, words, va="top", fontsize=SIZE, transform=plot.get_yaxis_transform(), bbox=behind)
    return y + ROW + LINE * words.count("\n")


def _width() -> float:
    """Return the width in inches that remains beside the labels."""
    return (style.chosen().width or style.COLUMN) * (0.95 - LABELS)
