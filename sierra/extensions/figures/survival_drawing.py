"""Figures of times until an event: Kaplan-Meier curves, and the numbers of runs at risk below the axis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator

from sierra.deliverables.figures import facets, style
from sierra.deliverables.figures.facets import Panels
from sierra.deliverables.figures.style import Look
from sierra.deliverables.figures.timeseries import with_n
from sierra.errors import SierraError, UsageError
from sierra.stats.survival import Step, Time, curve
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

LINE = 7.5
"""The height of a line of the numbers at risk, in points."""
ROWS = 8
"""The largest number of curves whose numbers at risk are below the axis."""
LOW = 2.2
"""The height in inches that a figure of a fixed size must have for numbers at risk."""


def curves(drawing: Drawing) -> dict[int, tuple[Step, ...]]:
    """Return the curve of each experiment."""
    times: dict[int, list[Time]] = {}
    for row in drawing.rows["times"].to_pylist():
        times.setdefault(row["experiment"], []).append(Time(row["time"], row["reached"]))
    return {experiment: curve(runs) for experiment, runs in times.items()}


def notes(drawing: Drawing) -> list[str]:
    """Return notes on censored runs, and on runs and values that are not in the curves. Raises SierraError without events."""
    (counts,) = drawing.rows["counts"].to_pylist()
    reached = drawing.rows["times"].column("reached").to_pylist()
    censored, lost, missing = reached.count(False), counts["runs"] - len(reached), counts["missing"]
    threshold = f"{drawing.figure.threshold:.12g}"
    if drawing.time == "row" and len(set(drawing.rows["times"].column("time").to_pylist())) == 1:
        raise UsageError(
            f"table {drawing.figure.table!r} has no time, so all runs end at the same row; set time in [outputs.…] or "
            "[tables.…] to the column with the duration of each run"
        )
    if not any(reached):
        (column,) = drawing.figure.columns
        runs = counted(len(reached), "run")
        raise SierraError(f"{column} reaches the threshold {threshold} in none of {runs}; there is no event to draw")
    late = f"{censored} of {counted(len(reached), 'run')} never reached {threshold}, censored at the last time"
    return [
        *([late] if censored else []),
        *([f"{counted(lost, 'run')} without any value left out"] if lost else []),
        *([f"{counted(missing, 'missing value')} left out"] if missing else []),
    ]


def survival(drawing: Drawing) -> Figure:
    """Draw a step curve with its interval for each experiment, and a tick at each time at which runs are censored."""
    within = facets.panels(drawing, over_first=False)
    looks = style.looks(within.groups)
    for look in looks:
        look.pop("marker", None)
    known = curves(drawing)
    first = min(0.0, *(steps[0].time for steps in known.values()))
    last = max(steps[-1].time for steps in known.values())
    for panel in within.panels:
        for ordinal in panel.drawing.cells.keys() & known.keys():
            _curve(panel.plot, known[ordinal], first, looks[within.group(panel.drawing, ordinal)])
        panel.plot.set_ylim(0, 1.02)
        panel.plot.set_xlim(first, last + (last - first) * 0.03 if last > first else first + 1)
    _frame(drawing, within, looks, known)
    return within.figure


def _curve(plot: Axes, steps: tuple[Step, ...], first: float, look: Look) -> None:
    times = [first, *(step.time for step in steps)]
    plot.step(times, [1.0, *(step.remaining for step in steps)], where="post", **look)
    ends = [*(step.time for step in steps[1:]), steps[-1].time]  # each interval holds until the next step
    low, high = (np.repeat(np.array(side, dtype=float), 2) for side in zip(*((s.low, s.high) for s in steps), strict=True))
    between = np.column_stack(([step.time for step in steps], ends)).ravel()
    plot.fill_between(between, low, high, facecolor=look["color"], alpha=0.15, linewidth=0)
    censored = [step for step in steps if step.censored]
    places = [step.time for step in censored], [step.remaining for step in censored]
    plot.plot(*places, "|", color=look["color"], markersize=5, markeredgewidth=0.8)


def _frame(drawing: Drawing, within: Panels, looks: list[Look], known: Mapping[int, tuple[Step, ...]]) -> None:
    (column,), threshold = drawing.figure.columns, style.number(drawing.figure.threshold or 0.0)
    time = style.label(f"{drawing.time} until {column} ≥ {threshold}", drawing.units.get(drawing.time, ""))
    style.outer_labels(within.plots, drawing.figure.xlabel or time, drawing.figure.ylabel or "part of the runs not there yet")
    counts = [0] * len(within.groups.values)
    for ordinal, steps in known.items():
        group = within.group(drawing, ordinal)
        counts[group] = max(counts[group], steps[0].at_risk)
    names = style.names(within.groups.values)
    style.legend(within.figure, within.plots, within.groups, with_n(names, counts), style.lines(looks))
    if len(within.panels) == 1 and len(names) <= ROWS and (style.chosen().height or LOW) >= LOW:
        _at_risk(drawing, within, looks, known)


def _at_risk(drawing: Drawing, within: Panels, looks: list[Look], known: Mapping[int, tuple[Step, ...]]) -> None:
    """Write below the axis how many runs of each curve are known not to have reached the threshold before each tick."""
    (plot,) = within.plots
    low, high = drawing.figure.xlim or plot.get_xlim()
    ticks = [tick for tick in MaxNLocator(6).tick_values(low, high) if low <= tick <= high]
    plot.xaxis.set_major_locator(FixedLocator(ticks))
    names = style.names(within.groups.values, 16)
    rows = sorted((within.group(drawing, ordinal), ordinal) for ordinal in known)
    _below(plot, "runs at risk", (0, "axes fraction"), 0, "left")
    for line, (group, ordinal) in enumerate(rows, 1):
        if len(rows) > 1:
            _below(plot, names[group], (0, "axes fraction"), line, "right")
        for tick in ticks:
            count = next((step.at_risk for step in known[ordinal] if step.time >= tick), 0)
            _below(plot, str(count), (tick, "data"), line, "center")
    if style.chosen().height is None:
        within.figure.set_figheight(within.figure.get_figheight() + (len(rows) + 1) * LINE / 72)


def _below(plot: Axes, text: str, at: tuple[float, str], line: int, side: Literal["left", "center", "right"]) -> None:
    """Write a text in a line below the label of the x axis."""
    plot.annotate(
        text,
        (at[0], 0),
        (-10 if side == "right" else 0, -26 - LINE * line),
        xycoords=(at[1], "axes fraction"),
        textcoords="offset points",
        ha=side,
        va="top",
        fontsize=6,
        annotation_clip=False,
    )
