"""Figures of runs with many columns: points of a plane, by principal components or t-SNE."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from sierra.deliverables.figures import facets, style
from sierra.deliverables.figures.pairs import lacking
from sierra.deliverables.figures.style import Floats, Look
from sierra.errors import NotInstalled, UsageError
from sierra.extensions.figures import embedding_methods as methods
from sierra.util.text import few

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing
    from sierra.extensions.figures.embedding import EmbeddingOptions

FEWEST = 3
"""The smallest number of runs; fewer always lie on a line."""
MOST = 5000
"""The largest number of runs for t-SNE, which takes about a minute for them."""
EXTRA = "pip install 'sierra-experiments[embedding]'"


def notes(drawing: Drawing, options: EmbeddingOptions) -> list[str]:
    """Return notes on the method, and on the columns and runs that are not in the figure."""
    perplexity = _perplexity(drawing, options)
    columns = list(drawing.tables)
    used = methods.varying(_values(drawing))
    constant = [name for index, name in enumerate(columns) if index not in used]
    components = f"principal components of {len(used)} columns, with their % of the variance"
    return [
        components if perplexity is None else f"t-SNE, perplexity {perplexity:.3g}; axes have no unit",
        *lacking(drawing),
        *([f"the same in all runs and left out: {few(constant, 3)}"] if constant else []),
    ]


def embedding(drawing: Drawing, options: EmbeddingOptions) -> Figure:
    """Draw each run as a mark. All panels share one plane."""
    perplexity = _perplexity(drawing, options)
    values = _values(drawing)
    table = methods.standardised(values[:, methods.varying(values)])
    if perplexity is None:
        plane = methods.principal_components(table)
        points = plane.points
        names = [f"PC {k} ({style.number(100 * part, 3)} %)" for k, part in enumerate(plane.explained, 1)]
    else:
        points, names = _tsne(table, perplexity), ["t-SNE 1", "t-SNE 2"]
    within = facets.panels(drawing, over_first=False)
    looks: list[Look] = [Look(marker="o") | look | Look(linestyle="none") for look in style.looks(within.groups)]
    ordinals = _ordinals(drawing)
    size = 3.5 if len(points) <= 200 else 1.5
    for panel in within.panels:
        for ordinal in panel.drawing.cells:
            look, mine = looks[within.group(panel.drawing, ordinal)], points[ordinals == ordinal]
            panel.plot.plot(mine[:, 0], mine[:, 1], **look, alpha=0.8, markeredgewidth=0, markersize=size)
    style.outer_labels(within.plots, drawing.figure.xlabel or names[0], drawing.figure.ylabel or names[1])
    style.legend(within.figure, within.plots, within.groups, style.names(within.groups.values), style.lines(looks))
    return within.figure


def _perplexity(drawing: Drawing, options: EmbeddingOptions) -> float | None:
    """Return the perplexity of t-SNE for this number of runs; None for principal components."""
    if options.method == "pca" or drawing.runs is None:
        return None
    others: int = drawing.runs.num_rows - 1
    return min(options.perplexity, max(1.0, others / 3))


def _values(drawing: Drawing) -> Floats:
    """Return the columns of the runs that have a value in all of them. Raises UsageError if there are too few for a plane."""
    if drawing.runs is None:
        raise TypeError("an embedding needs the values of its runs")
    names = ["value", *(f"value_{number}" for number in range(2, len(drawing.tables) + 1))]
    table = np.column_stack([style.column(drawing.runs, name) for name in names])
    if len(table) < FEWEST:
        raise UsageError(f"an embedding needs {FEWEST} runs with values in all columns, but there are {len(table)}")
    if len(methods.varying(table)) < 2:
        raise UsageError("an embedding needs two columns in which runs differ, but there are fewer")
    return table


def _ordinals(drawing: Drawing) -> Floats:
    if drawing.runs is None:
        raise TypeError("an embedding needs the values of its runs")
    return style.column(drawing.runs, "experiment")


def _tsne(table: Floats, perplexity: float) -> Floats:
    if len(table) > MOST:
        raise UsageError(f"t-SNE of {len(table)} runs takes too long; at most {MOST} are possible; use pca, or where")
    try:
        return methods.tsne(table, perplexity)
    except ImportError as error:
        raise NotInstalled(f"scikit-learn is not installed; {EXTRA}") from error
