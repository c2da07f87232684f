"""Figures of classifiers, with runs as samples: confusion matrices, ROC, precision over recall, risk over coverage.

Each run gives one matrix or one curve. The figure shows their mean and its 95 % interval of Student's t over the runs. To join
the rows of all runs first would weigh runs by their number of rows, and would make intervals too narrow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sierra.deliverables.figures import facets, seaborn_plots, style
from sierra.deliverables.figures.style import Floats
from sierra.errors import SierraError, UsageError
from sierra.model import Axis
from sierra.stats import student_t
from sierra.util.arrow_columns import numpy_of
from sierra.util.text import counted, like, verb

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.deliverables.figures.drawing import Drawing

GRID = np.linspace(0, 1, 201)
CATEGORIES = 20
LEGIBLE = 8
AVERAGES = ("micro-average", "macro-average")
Curve = Callable[["pa.Table"], "tuple[Floats, float] | None"]
"""The values of one run's curve at GRID, and one number that sums it up; None if the run has no curve."""


def confusion(drawing: Drawing) -> Figure:
    """Draw the matrix of each experiment in a panel."""
    names = _categories(drawing)
    if len(names) > CATEGORIES:
        raise UsageError(f"there are {len(names)} categories, but at most {CATEGORIES} can be drawn; use where")
    parts = _experiments(drawing.rows["counts"])
    figure, plots = facets.experiments(drawing, parts)
    for ordinal, plot in plots.items():
        center, half = mean_of([rates(run, names) for run in _runs(parts[ordinal])])
        legible = len(names) <= (LEGIBLE if len(parts) == 1 else 4)
        seaborn_plots.cells(plot, center, _texts(center, half) if legible else None)
        shown, middles = style.names(names, 10), np.arange(len(names)) + 0.5
        plot.set_xticks(middles, shown, rotation=90 if style.is_crowded(plot, shown) else 0)
        plot.set_yticks(middles, shown)
        plot.tick_params(length=0)
        plot.grid(visible=False)
    truth, predicted = (style.label(name) for name in drawing.figure.columns)
    style.outer_labels(list(plots.values()), drawing.figure.xlabel or predicted, drawing.figure.ylabel or truth)
    return figure


def _texts(center: Floats, half: Floats) -> np.typing.NDArray[np.str_]:
    """Return the text of each cell: its mean, and half of its interval if there is one."""
    around = np.where(np.isfinite(half), np.char.add("\n±", np.char.mod("%.2f", half)), "")
    return np.char.add(np.char.mod("%.2f", center), around)


def rates(run: pa.Table, names: list[str]) -> Floats:
    """Return the parts of each true category (rows) that were taken for each category (columns); NaN for an absent one."""
    counts = np.zeros((len(names), len(names)))
    for row in run.to_pylist():
        counts[names.index(row["truth"]), names.index(row["predicted"])] += row["count"]
    totals = counts.sum(axis=1, keepdims=True)
    parts: Floats = np.divide(counts, totals, out=np.full_like(counts, np.nan), where=totals > 0)
    return parts


def accuracy(run: pa.Table) -> float:
    rows = run.to_pylist()
    right = sum(row["count"] for row in rows if row["truth"] == row["predicted"])
    return float(right / sum(row["count"] for row in rows))


def roc(drawing: Drawing, classes: Sequence[str] = ()) -> Figure:
    """Draw the true-positive rate over the false-positive rate."""
    draw = partial(_curves_of_classes, classes=classes) if classes else _curves
    return draw(drawing, roc_of, "false-positive rate", "true-positive rate", "AUC", diagonal=True)


def precision_recall(drawing: Drawing, classes: Sequence[str] = ()) -> Figure:
    """Draw the precision over the recall."""
    draw = partial(_curves_of_classes, classes=classes) if classes else _curves
    return draw(drawing, precision_of, "recall", "precision", "AP", diagonal=False)


def risk_coverage(drawing: Drawing) -> Figure:
    """Draw the mean loss over the part of the rows that are kept."""
    loss = style.label(drawing.figure.columns[0], drawing.units.get(drawing.figure.columns[0], ""))
    return _curves(drawing, risk_of, "coverage", f"mean {loss}", "AURC", diagonal=False)


def roc_of(run: pa.Table) -> tuple[Floats, float] | None:
    """Return the curve of one run, with straight lines through equal scores, and the area under it."""
    positive, count = style.column(run, "positive"), style.column(run, "count")
    negative = count - positive
    if not positive.sum() or not negative.sum():
        return None
    true = np.concatenate(([0.0], np.cumsum(positive) / positive.sum()))
    false = np.concatenate(([0.0], np.cumsum(negative) / negative.sum()))
    last = np.append(np.diff(false) > 0, True)  # of equal false-positive rates, the highest true-positive rate
    return np.interp(GRID, false[last], true[last]), float(np.trapezoid(true, false))


def precision_of(run: pa.Table) -> tuple[Floats, float] | None:
    """Return the precision at each recall, and the average precision: Σ (Rₖ − Rₖ₋₁) · Pₖ."""
    positive, count = style.column(run, "positive"), style.column(run, "count")
    if not positive.sum():
        return None
    recall, precision = np.cumsum(positive) / positive.sum(), np.cumsum(positive) / np.cumsum(count)
    at = np.minimum(np.searchsorted(recall, GRID - 1e-12), len(recall) - 1)
    return precision[at], float((np.diff(recall, prepend=0.0) * precision).sum())


def risk_of(run: pa.Table) -> tuple[Floats, float] | None:
    """Return the mean loss of the rows with the highest scores, for each part of the rows, and its mean over all parts."""
    loss, count = style.column(run, "loss"), style.column(run, "count")
    coverage, risk = np.cumsum(count) / count.sum(), np.cumsum(loss) / np.cumsum(count)
    at = np.minimum(np.searchsorted(coverage, GRID - 1e-12), len(coverage) - 1)
    return risk[at], float((np.diff(coverage, prepend=0.0) * risk).sum())


def mean_of(samples: list[Floats]) -> tuple[Floats, Floats]:
    """Return the mean of the runs at each place, and half of its 95 % interval: NaN for fewer than two runs."""
    every = np.array(samples, dtype=float)
    known = np.isfinite(every)
    n = known.sum(axis=0)
    filled = np.where(known, every, 0.0)
    center = np.divide(filled.sum(axis=0), n, out=np.full(n.shape, np.nan), where=n > 0)
    squares = np.where(known, (every - center) ** 2, 0.0).sum(axis=0)
    t = np.array([np.nan, np.nan, *student_t.quantiles(0.975, max(1, len(samples) - 1))])[n]
    half = t * np.sqrt(np.divide(squares, n * (n - 1.0), out=np.full(n.shape, np.nan), where=n > 1))
    return center, half


def notes_on_confusion(drawing: Drawing) -> list[str]:
    """Return the accuracy of each experiment, and notes on rows that are left out."""
    notes = []
    parts = _experiments(drawing.rows["counts"])
    for ordinal in facets.ordered(drawing, parts):
        center, half = mean_of([np.array(accuracy(run)) for run in _runs(parts[ordinal])])
        notes.append(f"{float(center):.3f}" + (f" ± {float(half):.3f}" if np.isfinite(half) else ""))
    shown = ", ".join(notes[:6]) + (" …" if len(notes) > 6 else "")
    return [f"accuracy {shown}", *left_out_rows(drawing, "counts")]


def notes_on_curves(drawing: Drawing) -> list[str]:
    """Return notes on runs without a curve, and on rows that are left out."""
    runs = [run for part in _experiments(drawing.rows["scores"]).values() for run in _runs(part)]
    of = {"roc": roc_of, "pr": precision_of}[drawing.figure.kind]
    none = sum(of(run) is None for run in runs)
    if none == len(runs):
        raise SierraError("no run has positive and negative rows; the key `positive` says which value is positive")
    absent = [f"{none} of {len(runs)} runs without positive or negative rows left out"] if none else []
    return [*absent, *left_out_rows(drawing, "scores")]


def notes_on_classes(drawing: Drawing, classes: Sequence[str]) -> list[str]:
    """Return notes on rows of other classes, on runs that lack a class, and on rows that are left out.

    Raises SierraError for a class that no row has.
    """
    rows = {row["truth"]: row["count"] for row in drawing.rows["truths"].to_pylist()}
    column, scores = drawing.figure.columns[0], drawing.rows["scores"]
    if unknown := next((name for name in classes if not rows.get(name)), None):
        if unknown in rows:
            raise SierraError(
                f"classes: no row whose {column} is {unknown!r} has all scores; leave the class out, or see where"
            )
        known = like(unknown, [name for name in rows if name is not None], "there are")
        raise SierraError(f"classes: {unknown!r} is no value of {column}; {known}")
    others = sum(count for name, count in rows.items() if name is not None and name not in classes)
    runs = _runs(scores)
    lacking = sum(len(_of_classes(run, roc_of, len(classes))) < len(classes) for run in runs)
    total = drawing.rows["all"].column("count")[0].as_py()
    missing = total - sum(rows.values())
    return [
        "each class against the others",
        *([f"{counted(others, 'row')} of no class {verb(others, 'is', 'are')} negative for all"] if others else []),
        *([f"{lacking} of {len(runs)} runs lack rows of a class, and are not in the macro-average"] if lacking else []),
        *([f"{missing} rows without a value left out"] if missing else []),
    ]


def left_out_rows(drawing: Drawing, table: str) -> list[str]:
    """Return a note on the rows without a value."""
    missing = drawing.rows["all"].column("count")[0].as_py() - int(numpy_of(drawing.rows[table].column("count")).sum())
    return [f"{missing} rows without a value left out"] if missing else []


def _curves(drawing: Drawing, of: Curve, xlabel: str, ylabel: str, summed: str, *, diagonal: bool) -> Figure:
    """Draw the mean of the runs' curves of each experiment with its band."""
    within = facets.panels(drawing, over_first=False)
    looks = style.looks(within.groups)
    entries = style.names(within.groups.values)
    for panel in within.panels:
        for ordinal, part in _experiments(panel.drawing.rows["scores"]).items():
            curves = [curve for run in _runs(part) if (curve := of(run)) is not None]
            if not curves:
                continue
            group = within.group(panel.drawing, ordinal)
            look = looks[group]
            look.pop("marker", None)
            area = _mean_curve(panel.plot, curves, look)
            if len(within.panels) == 1:
                entries[group] += f" ({summed} {area})"
        _frame(panel.plot, diagonal=diagonal, parts=summed != "AURC")
    style.outer_labels(within.plots, drawing.figure.xlabel or xlabel, drawing.figure.ylabel or ylabel)
    for look in looks:
        look.pop("marker", None)
    style.legend(within.figure, within.plots, within.groups, entries, style.lines(looks))
    return within.figure


def _curves_of_classes(
    drawing: Drawing, of: Curve, xlabel: str, ylabel: str, summed: str, *, diagonal: bool, classes: Sequence[str]
) -> Figure:
    """Draw the mean of the runs' curves of each class, and of their averages, in a panel for each experiment."""
    parts, together = _experiments(drawing.rows["scores"]), _experiments(drawing.rows["micro"])
    figure, plots = facets.experiments(drawing, parts)
    axis = Axis("# class", (*classes, *AVERAGES), label=drawing.figure.columns[0].replace("_", " "))
    looks = style.looks(Axis(axis.name, tuple(classes)))
    looks += [{"color": "black", "linestyle": line} for line in (":", "-")]
    entries = style.names([drawing.figure.labels.get(str(value), value) for value in axis.values])
    for ordinal, plot in plots.items():
        by_run = [_of_classes(run, of, len(classes)) for run in _runs(parts[ordinal])]
        curves = [[run_curves[index] for run_curves in by_run if index in run_curves] for index in range(len(classes))]
        curves.append([curve for run in _runs(together[ordinal]) if (curve := of(run)) is not None])
        whole = [[*run_curves.values()] for run_curves in by_run if len(run_curves) == len(classes)]
        curves.append([(np.mean([c for c, _ in all_], axis=0), float(np.mean([area for _, area in all_]))) for all_ in whole])
        for index, (class_curves, look) in enumerate(zip(curves, looks, strict=True)):
            look.pop("marker", None)
            if class_curves:
                area = _mean_curve(plot, class_curves, look)
                entries[index] += f" ({summed} {area})" if len(plots) == 1 else ""
        _frame(plot, diagonal=diagonal, parts=True)
    style.outer_labels(list(plots.values()), drawing.figure.xlabel or xlabel, drawing.figure.ylabel or ylabel)
    style.legend(figure, list(plots.values()), axis, entries, style.lines(looks))
    return figure


def _of_classes(run: pa.Table, of: Curve, count: int) -> dict[int, tuple[Floats, float]]:
    """Return the curve of each class against the others in one run, by the number of the class, if it has one."""
    numbers = numpy_of(run.column("class"))
    curves = ((place, of(run.filter(numbers == place))) for place in range(count))
    return {place: curve for place, curve in curves if curve is not None}


def _mean_curve(plot: Axes, found: Sequence[tuple[Floats, float]], look: style.Look) -> str:
    """Draw the mean of curves of runs with its band; return the mean of their areas with half of its interval."""
    center, half = mean_of([curve for curve, _ in found])
    plot.plot(GRID, center, **look)
    plot.fill_between(GRID, center - half, center + half, facecolor=look["color"], alpha=0.18, linewidth=0)
    area, around = mean_of([np.array(number) for _, number in found])
    return f"{float(area):.3f}" + (f" ± {float(around):.3f}" if np.isfinite(around) else "")


def _frame(plot: Axes, *, diagonal: bool, parts: bool) -> None:
    """Set the limits of axes of which x, and y if it has `parts`, goes from 0 to 1."""
    if diagonal:
        plot.plot([0, 1], [0, 1], color="#999999", linewidth=0.6, linestyle=":")
    plot.set_xlim(-0.01, 1.01)
    if parts:
        plot.set_ylim(-0.01, 1.02)


def _categories(drawing: Drawing) -> list[str]:
    """Return all categories: numbers in their order, else names in alphabetical order."""
    table = drawing.rows["counts"]
    names = {*table.column("truth").to_pylist(), *table.column("predicted").to_pylist()}
    try:
        return sorted(names, key=float)
    except ValueError:
        return sorted(names)


def _experiments(table: pa.Table) -> dict[int, pa.Table]:
    ordinals = numpy_of(table.column("experiment"))
    return {int(ordinal): table.filter(ordinals == ordinal) for ordinal in np.unique(ordinals)}


def _runs(table: pa.Table) -> list[pa.Table]:
    runs = np.array(table.column("run").to_pylist())
    return [table.filter(runs == run) for run in dict.fromkeys(runs.tolist())]
