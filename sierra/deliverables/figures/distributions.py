"""Figures of the distribution of runs: step curves, and outlines of histograms."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sierra.deliverables.figures import facets, sampled_runs, seaborn_plots, style
from sierra.deliverables.figures.facets import Panels
from sierra.deliverables.figures.style import Floats, Look
from sierra.deliverables.figures.timeseries import with_n
from sierra.errors import UsageError
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

BAND = float(np.sqrt(np.log(2 / 0.05) / 2))
"""The half-width of the 95 % band of Dvoretzky, Kiefer and Wolfowitz times √n (Massart 1990)."""
DENSE = 5
"""The smallest number of runs for which a density is drawn."""
MOST_BINS = 200


def ecdf(drawing: Drawing, *, interval: bool) -> Figure:
    """Draw a step curve for each experiment, with its band."""
    within = facets.panels(drawing, over_first=False)
    looks, every = _lines(within), sampled_runs.step(drawing)
    values = _all(drawing)
    low, high = _range(values[values > 0] if drawing.figure.log_x else values, "log_x" if drawing.figure.log_x else "")
    margin = (high - low) * 0.04
    for panel in within.panels:
        for ordinal, runs in sampled_runs.values(panel.drawing).items():
            look = looks[within.group(panel.drawing, ordinal)]
            places = sampled_runs.places(len(runs), every)
            # ends without weight extend the curve over the complete axis
            x = np.concatenate(([low - margin], runs[places], [high + margin]))
            weights = np.concatenate(([0.0], np.diff(places, prepend=-1), [0.0]))
            seaborn_plots.steps(panel.plot, x, weights, look)
            if interval:
                _band(panel.plot, runs[places], (places + 1) / len(runs), BAND / np.sqrt(len(runs)), look)
        panel.plot.set_ylim(0, 1.02)
        if drawing.figure.log_x:
            panel.plot.set_xscale("log", nonpositive="mask")
            style.log_ticks(panel.plot.xaxis, low, high)
            panel.plot.set_xlim(low / 1.1, high * 1.1)
        else:
            panel.plot.set_xlim(low - margin, high + margin)
    _frame(drawing, within, looks, drawing.figure.ylabel or "part of the runs")
    return within.figure


def _band(plot: Axes, values: Floats, part: Floats, half: float, look: Look) -> None:
    """Draw a band around a step curve. Beyond the runs it is constant; there it would only cover those of the others."""
    ends = np.clip(part - half, 0, 1), np.clip(part + half, 0, 1)
    plot.fill_between(values, *ends, step="post", facecolor=look["color"], alpha=0.15, linewidth=0)


def histogram(drawing: Drawing, bins: int, *, density: bool) -> Figure:
    """Draw the outline of a histogram for each experiment; all have the same bins."""
    within = facets.panels(drawing, over_first=False)
    looks, at = _lines(within), edges(drawing, bins)
    for panel in within.panels:
        for ordinal, runs in sampled_runs.values(panel.drawing).items():
            look, (counts, _) = looks[within.group(panel.drawing, ordinal)], np.histogram(runs, at)
            seaborn_plots.bins(panel.plot, counts, at, look, density=density)
        panel.plot.set_ylim(bottom=0)
    _frame(
        drawing, within, looks, drawing.figure.ylabel or ("density" if density else f"number of {sampled_runs.noun(drawing)}s")
    )
    return within.figure


def edges(drawing: Drawing, bins: int) -> Floats:
    """Return the edges of the bins of all experiments."""
    values = _all(drawing)
    low, high = _range(values, "")
    if bins:
        return np.linspace(low, high, bins + 1)
    bin_edges = np.histogram_bin_edges(values, "fd", (low, high))
    at: Floats = bin_edges if len(bin_edges) <= MOST_BINS else np.linspace(low, high, MOST_BINS + 1)
    return at if len(at) > 2 else np.linspace(low, high, 6)


def not_above_0(drawing: Drawing) -> list[str]:
    """Return a note on the runs that a logarithmic x axis cannot show."""
    values = _all(drawing)
    bad = int((values <= 0).sum()) if drawing.figure.log_x else 0
    return [f"log scale: {bad} of {counted(len(values), 'run')} not above 0, left of the axis"] if bad else []


def has_density(values: Floats) -> bool:
    """Return whether there are enough different values for a density, with a variance that is neither 0 nor too large."""
    with np.errstate(over="ignore", under="ignore"):
        return len(values) >= DENSE and 0 < float(np.var(values)) < np.inf


def _all(drawing: Drawing) -> Floats:
    return np.concatenate([*sampled_runs.values(drawing).values(), np.empty(0)])


def _range(values: Floats, log: str) -> tuple[float, float]:
    if not len(values):
        raise UsageError(f"{log} needs values above 0, but there are none")
    low, high = float(values.min()), float(values.max())
    return (low, high) if low < high else (low - abs(low) * 0.1 - 1e-9, high + abs(high) * 0.1 + 1e-9)


def _lines(within: Panels) -> list[Look]:
    looks = style.looks(within.groups)
    for look in looks:
        look.pop("marker", None)
    return looks


def value_label(drawing: Drawing) -> str:
    """Return the label of the values, which are on the x axis here."""
    from dataclasses import replace

    if sampled_runs.is_of_rows(drawing):
        [column] = drawing.figure.columns
        return drawing.figure.xlabel or style.label(column, drawing.units.get(column, ""))
    plain = replace(drawing, figure=drawing.figure.model_copy(update={"ylabel": ""}))
    return drawing.figure.xlabel or style.value_label(plain)


def _frame(drawing: Drawing, within: Panels, looks: list[Look], ylabel: str) -> None:
    style.outer_labels(within.plots, value_label(drawing), ylabel)
    counts = [0] * len(within.groups.values)
    for ordinal, values in sampled_runs.values(drawing).items():
        group = within.group(drawing, ordinal)
        counts[group] = max(counts[group], len(values))
    entries = with_n(style.names(within.groups.values), counts)
    style.legend(within.figure, within.plots, within.groups, entries, style.lines(looks))
