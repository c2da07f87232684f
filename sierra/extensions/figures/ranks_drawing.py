"""Critical-difference diagrams: mean ranks of groups on a line, and bars that join groups that were not shown to differ."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sierra.deliverables.figures import bands, style
from sierra.errors import UsageError
from sierra.extensions.figures.block_ranks import Ranking, ranking
from sierra.stats.words import of_run
from sierra.util.text import counted, few

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing
    from sierra.extensions.figures.ranks import CriticalDifferenceOptions

MOST = 20
"""The largest number of groups."""
LINE = 0.17
"""The height of a name in inches; the unit of the diagram's vertical axis."""
FURTHER = 0.68
"""The height of each further line of a name, in the height of its first one."""
SIDE = 0.29
"""The part of the width that names may take on each side."""
BAR = 0.45
"""The distance of two bars, in the height of a name."""
EXACT = 10
"""The number of blocks up to which the p value of Friedman's test is a rough one."""
Blocks = dict[tuple[object, ...], dict[object, float]]
"""The value of each group, by block."""


def blocks(drawing: Drawing, within: Literal["experiments", "seeds"]) -> Blocks:
    """Return the values that are ranked: the center of each experiment, or the value of each run."""
    group, *others = (axis.name for axis in drawing.axes)
    (table,) = drawing.tables.values()
    if "never" in table.column_names and (never := sum(table.column("never").to_pylist())):
        runs = counted(never, "run")
        raise UsageError(f"{runs} never reached the threshold, and censored times have no ranks; draw kind survival")
    if drawing.runs is None:
        raise TypeError("a critical_difference figure needs the values of its runs")
    center, *_ = bands.columns(drawing.figure)
    seeds = within == "seeds"
    by_block: Blocks = {}
    for row in (drawing.runs if seeds else table).to_pylist():
        at, value = drawing.cells[row["experiment"]], row["value" if seeds else center]
        key = (*(at[name] for name in others), *([row["seed"]] if seeds else []))
        if value is not None:
            by_block.setdefault(key, {})[at[group]] = value
    return by_block


def ranked(drawing: Drawing, options: CriticalDifferenceOptions) -> Ranking:
    """Return the ranking over the blocks in which all groups have a value. Raises UsageError for fewer than two of them."""
    by_block, axis = blocks(drawing, options.within(drawing.axes)), drawing.axes[0]
    names = dict(zip(axis.values, style.names(axis.values, 60), strict=True))
    if len(names) > MOST:
        raise UsageError(f"ranks of {len(names)} groups cannot be read; at most {MOST} are possible; use where")
    if empty := [name for value, name in names.items() if not any(value in block for block in by_block.values())]:
        raise UsageError(f"no value of {few(empty, 3)}, so groups cannot be ranked; leave out such groups by where")
    complete = [block for block in by_block.values() if len(block) == len(names)]
    if len(complete) < 2:
        raise UsageError(
            f"ranks need two blocks or more in which each group has a value, but there {'is one' if complete else 'is none'}"
        )
    values = np.array([[block[value] for value in names] for block in complete], dtype=float)
    result = ranking(list(names.values()), values, options.test, options.alpha, best_is_high=options.better == "high")
    return replace(result, left_out=len(by_block) - len(complete))


def notes(drawing: Drawing, options: CriticalDifferenceOptions) -> list[str]:
    """Return notes on the blocks, the tests, and all that the bars do not say."""
    ranks = ranked(drawing, options)
    tests = f"Friedman p = {style.number(ranks.p, 2)}" if ranks.p is not None else ""
    pairs = "Wilcoxon's signed-rank test, Holm" if ranks.critical is None else f"Nemenyi CD = {style.number(ranks.critical, 3)}"
    shown = ", ".join(filter(None, (counted(ranks.blocks, "block"), tests, pairs, f"α = {ranks.alpha:g}")))
    beside = [f"{ranks.groups[group]} and {ranks.groups[other]}" for group, other in ranks.beside]
    return [
        shown,
        "bars join groups that were not shown to differ",
        *([f"{ranks.blocks} blocks are too few to show any difference"] if not ranks.enough else []),
        *(["p is approximate for few blocks"] if ranks.p is not None and ranks.blocks <= EXACT and ranks.enough else []),
        *([f"nor were {few(beside, 3)}"] if beside else []),
        *([f"{counted(ranks.left_out, 'block')} without a value of each group left out"] if ranks.left_out else []),
    ]


def diagram(drawing: Drawing, options: CriticalDifferenceOptions) -> Figure:
    """Draw the ranks, and for Nemenyi's test the critical difference. The best groups are on the left."""
    ranks = ranked(drawing, options)
    count = len(ranks.groups)
    left = -(-count // 2)
    below = 0.7 + BAR * len(ranks.bars)
    top = 2.4 if ranks.critical is not None else 0.2
    figure = style.blank(style.COLUMN)
    names = [
        style.wrapped(f"{name} ({rank:.2f})", SIDE * figure.get_figwidth(), 7, 5)
        for name, rank in zip(ranks.groups, ranks.ranks, strict=True)
    ]
    rows = [*range(left), *reversed(range(count - left))]
    high = [
        1 + FURTHER * max(name.count("\n") for name, at in zip(names, rows, strict=True) if at == row) for row in range(left)
    ]
    if style.chosen().height is None:
        figure.set_figheight(0.55 + LINE * (top + below + sum(high)))
    plot = figure.add_subplot()
    plot.set_xlim(1, count)
    plot.set_ylim(-below - sum(high), top)
    _axis(plot, drawing)
    if ranks.critical is not None:
        _critical(plot, ranks.critical, count)
    for index, (name, rank, row) in enumerate(zip(names, ranks.ranks, rows, strict=True)):
        _group(plot, name, rank, -below - sum(high[:row]) - high[row] / 2, at=1 if index < left else count)
    for line, (start, end) in enumerate(ranks.bars, 1):
        ends = [ranks.ranks[start] - 0.012 * count, ranks.ranks[end] + 0.012 * count]
        plot.plot(ends, [-BAR * line] * 2, color="black", linewidth=2.4, solid_capstyle="butt", clip_on=False)
    return figure


def _axis(plot: Axes, drawing: Drawing) -> None:
    plot.spines[:].set_visible(False)
    plot.spines["top"].set_visible(True)
    plot.spines["top"].set_position(("data", 0))
    plot.xaxis.set_ticks_position("top")
    plot.xaxis.set_label_position("bottom")
    plot.xaxis.set_major_locator(MaxNLocator(10, integer=True))
    plot.set_yticks([])
    plot.grid(visible=False)
    (column,) = drawing.tables
    measure = style.value_label(drawing) if drawing.figure.measure == "time_to" else of_run(drawing.figure.measure, column)
    name = style.label(drawing.axes[0].name, given=drawing.axes[0].label)
    plot.set_xlabel(style.shortened(f"mean rank of {name} by {measure} (1: best)", 52))


def _critical(plot: Axes, critical: float, count: int) -> None:
    """Draw the critical difference as a line with its name, above the axis; one that is too long ends in an arrow."""
    long = critical > count - 1
    ends = "->" if long else "|-|,widthA=0.25,widthB=0.25"
    line = {"arrowstyle": ends, "shrinkA": 0, "shrinkB": 0, "linewidth": 0.8}
    plot.annotate("", (min(1 + critical, float(count)), 1.4), (1, 1.4), arrowprops=line, annotation_clip=False)
    plot.text(1, 1.6, f"CD = {style.number(critical, 3)}", fontsize=6.5, va="bottom")


def _group(plot: Axes, name: str, rank: float, y: float, at: float) -> None:
    """Draw the line from a group's rank to its name beside the diagram."""
    plot.plot([rank, rank, at], [0, y, y], color="#333333", linewidth=0.7, clip_on=False)
    left = at == 1
    plot.annotate(
        name,
        (at, y),
        (-3 if left else 3, 0),
        textcoords="offset points",
        ha="right" if left else "left",
        va="center",
        fontsize=7,
        annotation_clip=False,
    )
