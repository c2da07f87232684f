"""Figures of the distribution of runs: step curves, outlines of histograms, and ridges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from sierra.deliverables.figures import facets, style
from sierra.deliverables.figures.facets import Panels
from sierra.deliverables.figures.style import Floats, Look
from sierra.deliverables.figures.timeseries import with_n
from sierra.errors import UsageError
from sierra.util.arrow_columns import numpy_of

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

BAND = float(np.sqrt(np.log(2 / 0.05) / 2))
"""The half-width of the 95 % band of Dvoretzky, Kiefer and Wolfowitz times √n (Massart 1990)."""
DENSE = 5
"""The smallest number of runs for which a density is drawn."""
RIDGES = 24
"""The largest number of ridges in a panel."""
OVERLAP = 1.6
"""The height of the highest ridge; the distance between two ridges is 1."""
MOST_BINS = 200


def ecdf(drawing: Drawing, *, interval: bool) -> Figure:
    """Draw a step curve for each experiment, with its band."""
    within = facets.panels(drawing, over_first=False)
    looks = _lines(within)
    every = _all(drawing)
    low, high = _range(every[every > 0] if drawing.figure.log_x else every, "log_x" if drawing.figure.log_x else "")
    margin = (high - low) * 0.04
    for panel in within.panels:
        for ordinal, values in runs(panel.drawing).items():
            x = np.concatenate(([low - margin], np.sort(values), [high + margin]))
            part = np.concatenate(([0.0], np.arange(1, len(values) + 1) / len(values), [1.0]))
            look = looks[within.group(panel.drawing, ordinal)]
            panel.plot.step(x, part, where="post", **look)
            if interval:
                # beyond the runs the band is constant; there it would only cover those of the others
                half, own = BAND / np.sqrt(len(values)), slice(1, -1)
                ends = np.clip(part[own] - half, 0, 1), np.clip(part[own] + half, 0, 1)
                panel.plot.fill_between(x[own], *ends, step="post", facecolor=look["color"], alpha=0.15, linewidth=0)
        panel.plot.set_ylim(0, 1.02)
        if drawing.figure.log_x:
            panel.plot.set_xscale("log", nonpositive="mask")
            panel.plot.set_xlim(low / 1.1, high * 1.1)
        else:
            panel.plot.set_xlim(low - margin, high + margin)
    _frame(drawing, within, looks, drawing.figure.ylabel or "part of the runs")
    return within.figure


def histogram(drawing: Drawing, bins: int, *, density: bool) -> Figure:
    """Draw the outline of a histogram for each experiment; all have the same bins."""
    within = facets.panels(drawing, over_first=False)
    looks, at = _lines(within), edges(drawing, bins)
    for panel in within.panels:
        for ordinal, values in runs(panel.drawing).items():
            look = looks[within.group(panel.drawing, ordinal)]
            counts, _ = np.histogram(values, at, density=density)
            panel.plot.stairs(counts, at, color=look["color"], linestyle=look.get("linestyle", "-"), linewidth=1.0)
            panel.plot.stairs(counts, at, facecolor=look["color"], fill=True, alpha=0.12, linewidth=0)
        panel.plot.set_ylim(bottom=0)
    _frame(drawing, within, looks, drawing.figure.ylabel or ("density" if density else "number of runs"))
    return within.figure


def ridge(drawing: Drawing) -> Figure:
    """Draw the densities of the experiments one above the other, with the same scale."""
    within = facets.panels(drawing, over_first=False)
    count = len(within.groups.values)
    if count > RIDGES:
        raise UsageError(f"the figure needs {count} ridges, but at most {RIDGES} are possible; use where, facet, or kind ecdf")
    within.figure.set_figheight(max(within.figure.get_figheight(), 0.8 + 0.24 * count))
    shapes = {o: _density(values) for o, values in runs(drawing).items()}
    top = max((float(shape[1].max()) for shape in shapes.values() if shape), default=1.0)
    colours = style.colours(within.groups) if count > 1 else [style.named_colours()[0]]
    for panel in within.panels:
        for ordinal, values in runs(panel.drawing).items():
            place = within.group(panel.drawing, ordinal)
            base, shape = count - 1 - place, shapes[ordinal]
            colour, above = colours[place], 2 + place / count
            if shape:
                x, y = shape[0], base + shape[1] / top * OVERLAP
                panel.plot.fill_between(x, base, y, facecolor=colour, alpha=0.35, linewidth=0, zorder=above)
                panel.plot.plot(x, y, color=colour, linewidth=0.8, zorder=above)
            panel.plot.plot(values, np.full(len(values), base), "|", color=colour, markersize=3, alpha=0.6, zorder=above)
            panel.plot.plot([np.median(values)] * 2, [base, base + 0.35], color=colour, linewidth=1.4, zorder=above)
        names = style.names(within.groups.values, 22)
        panel.plot.set_yticks(range(count - 1, -1, -1), names)
        panel.plot.set_ylim(-0.25, count - 1 + OVERLAP + 0.15)
    style.outer_labels(within.plots, _value_label(drawing), drawing.figure.ylabel or style.axis_label(within.groups))
    return within.figure


def runs(drawing: Drawing) -> Mapping[int, Floats]:
    """Return the values of the runs by experiment, in ascending order; experiments without a value are not in it."""
    if drawing.runs is None:
        raise TypeError(f"a {drawing.figure.kind} figure needs the values of its runs")
    ordinals = numpy_of(drawing.runs.column("experiment"))
    values = style.column(drawing.runs, "value")
    return {int(ordinal): np.sort(values[ordinals == ordinal]) for ordinal in np.unique(ordinals)}


def edges(drawing: Drawing, bins: int) -> Floats:
    """Return the edges of the bins of all experiments."""
    values = _all(drawing)
    low, high = _range(values, "")
    if bins:
        return np.linspace(low, high, bins + 1)
    found = np.histogram_bin_edges(values, "fd", (low, high))
    at: Floats = found if len(found) <= MOST_BINS else np.linspace(low, high, MOST_BINS + 1)
    return at if len(at) > 2 else np.linspace(low, high, 6)


def not_above_0(drawing: Drawing) -> list[str]:
    """Return a note on the runs that a logarithmic x axis cannot show."""
    values = _all(drawing)
    bad = int((values <= 0).sum()) if drawing.figure.log_x else 0
    return [f"log scale: {bad} of {len(values)} runs not above 0 are left of the axis"] if bad else []


def without_density(drawing: Drawing) -> list[str]:
    few = sum(_density(values) is None for values in runs(drawing).values())
    return [f"{few} without a density: fewer than {DENSE} runs, or all equal"] if few else []


def _all(drawing: Drawing) -> Floats:
    return np.concatenate([*runs(drawing).values(), np.empty(0)])


def _range(values: Floats, log: str) -> tuple[float, float]:
    if not len(values):
        raise UsageError(f"{log} needs values above 0, but there are none")
    low, high = float(values.min()), float(values.max())
    return (low, high) if low < high else (low - abs(low) * 0.1 - 1e-9, high + abs(high) * 0.1 + 1e-9)


def _density(values: Floats) -> tuple[Floats, Floats] | None:
    """Return the points of a density (Gaussian, bandwidth of Scott); None for few or equal values."""
    if len(values) < DENSE or not values.min() < values.max():
        return None
    width = float(values.std(ddof=1)) * len(values) ** -0.2
    at = np.linspace(values.min() - 2 * width, values.max() + 2 * width, 120)
    shape: Floats = np.exp(-0.5 * ((at[:, None] - values) / width) ** 2).sum(axis=1) / (
        len(values) * width * np.sqrt(2 * np.pi)
    )
    return at, shape


def _lines(within: Panels) -> list[Look]:
    looks = style.looks(within.groups)
    for look in looks:
        look.pop("marker", None)
    return looks


def _value_label(drawing: Drawing) -> str:
    """Return the label of the values, which are on the x axis here."""
    from dataclasses import replace

    plain = replace(drawing, figure=drawing.figure.model_copy(update={"ylabel": ""}))
    return drawing.figure.xlabel or style.value_label(plain)


def _frame(drawing: Drawing, within: Panels, looks: list[Look], ylabel: str) -> None:
    style.outer_labels(within.plots, _value_label(drawing), ylabel)
    counts = [0] * len(within.groups.values)
    for ordinal, values in runs(drawing).items():
        place = within.group(drawing, ordinal)
        counts[place] = max(counts[place], len(values))
    entries = with_n(style.names(within.groups.values), counts)
    style.legend(within.figure, within.plots, within.groups, entries, looks)
