"""Figures of two columns of runs, with fitted curves.

A fit is a polynomial by least squares, after taking logarithms where its name says so. The interval of its mean at x is
ŷ ∓ t · s · √(v(x)), where t has n − p degrees of freedom, s² is the residual variance and v(x) = b(x)ᵀ (BᵀB)⁻¹ b(x) for the
basis b of the polynomial (Seber and Lee 2003, section 5.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from sierra.deliverables.figures import facets, sampled_runs, seaborn_plots, style
from sierra.deliverables.figures.facets import Panel, Panels
from sierra.deliverables.figures.style import Floats, Look
from sierra.errors import UsageError
from sierra.stats import student_t
from sierra.stats.words import of_run
from sierra.util.arrow_columns import numpy_of
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing

DEGREES = {"linear": 1, "quadratic": 2, "cubic": 3, "log": 1, "exp": 1, "power": 1}
LOG_X, LOG_Y = ("log", "power"), ("exp", "power")
POWERS = ("", "²", "³")
DIGITS = (4, 5, 6, 7)
"""The numbers of digits of an equation, until it is exact enough."""
EQUATIONS = 4
"""The largest number of equations in the small print."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted curve at some places, with the interval of its mean; NaN if there is none."""

    x: Floats
    y: Floats
    low: Floats
    high: Floats
    r2: float
    freedom: int
    """The number of points beyond those that the curve needs."""
    equation: str


def fitted(x: Floats, y: Floats, kind: str) -> Fit | None:
    """Return the curve through points; None if there are too few different places."""
    u, v = (np.log(x) if kind in LOG_X else x), (np.log(y) if kind in LOG_Y else y)
    degree = DEGREES[kind]
    if len(np.unique(u)) <= degree:
        return None
    middle, scale = float(u.mean()), float(np.ptp(u)) or 1.0
    basis = np.vander((u - middle) / scale, degree + 1)
    weights, *_ = np.linalg.lstsq(basis, v)
    at = np.linspace(u.min(), u.max(), 100)
    places = np.vander((at - middle) / scale, degree + 1)
    center = places @ weights
    rest, freedom = v - basis @ weights, len(u) - degree - 1
    total = float(((v - v.mean()) ** 2).sum())
    r2 = 1 - float((rest**2).sum()) / total if total else float("nan")
    half = np.full(len(at), np.nan)
    if freedom > 0:
        t = student_t.quantiles(0.975, freedom)[-1]
        spread = np.einsum("ij,jk,ik->i", places, np.linalg.inv(basis.T @ basis), places)
        half = t * np.sqrt(float((rest**2).sum()) / freedom * spread)
    back = np.exp if kind in LOG_Y else np.asarray
    ends = back(center - half), back(center + half)
    curve = np.polynomial.Polynomial(weights[::-1])(np.polynomial.Polynomial([-middle / scale, 1 / scale]))
    return Fit(np.exp(at) if kind in LOG_X else at, back(center), *ends, r2, freedom, _equation(kind, curve, u, center))


def _equation(kind: str, curve: np.polynomial.Polynomial, u: Floats, center: Floats) -> str:
    """Return the equation of a curve at places u, with values from `center`: `y = 2 + 0.5 x − 0.1 x²`.

    It has as many digits as the printed curve needs to be the drawn one, to 1 % of its height. If x is far from 0, its powers
    nearly cancel each other; the equation is then one of x minus a number.
    """
    height = float(np.ptp(center)) or float(np.abs(center).max()) or 1.0
    for offset in (0.0, float(f"{u.mean():.6g}")):
        moved, places = curve(np.polynomial.Polynomial([offset, 1.0])), u - offset
        sizes = np.abs(moved.coef) * np.abs(places).max() ** np.arange(len(moved.coef))
        factors = np.where(sizes > 1e-9 * np.abs(center).max(), moved.coef, 0.0)
        for digits in DIGITS:
            words = [style.number(factor, digits) for factor in factors.tolist()]
            printed = np.polynomial.Polynomial([float(word.replace("−", "-")) for word in words])
            if float(np.abs(printed(places) - moved(places)).max()) <= 0.01 * height:
                return _written(kind, words, offset)
    return _written(kind, words, offset)


def _written(kind: str, factors: Sequence[str], offset: float) -> str:
    """Return the equation with these factors of the powers, from 0 on, of x minus an offset."""
    x = "ln x" if kind in LOG_X else "x"
    if offset:
        x = f"({x} {'−' if offset > 0 else '+'} {style.number(abs(offset))})"
    first, *others = factors
    terms = (
        f" {'−' if word[0] == '−' else '+'} {word.lstrip('−')} {x}{power}"
        for word, power in zip(others, POWERS, strict=False)
        if word != "0"
    )
    return f"{'ln y' if kind in LOG_Y else 'y'} = {first}{''.join(terms)}"


def scatter(drawing: Drawing, fit: str) -> Figure:
    """Draw each run as a mark, and a curve for each series."""
    within = facets.panels(drawing, over_first=False)
    looks, every = style.looks(within.groups), sampled_runs.step(drawing)
    if not any(_series(panel, within, drawing, fit) for panel in within.panels):
        raise UsageError(f"logarithms need values above 0, but no {sampled_runs.noun(drawing)} has them in both columns")
    for panel in within.panels:
        series = _series(panel, within, drawing, fit)
        _marks(panel, series, looks, every)
        for group, (x, y) in series.items():
            if fit != "none" and (curve := fitted(x, y, fit)):
                _curve(panel, curve, looks[group])
    _scale(within, drawing)
    frame(drawing, within, looks)
    return within.figure


def _marks(panel: Panel, series: dict[int, tuple[Floats, Floats]], looks: list[Look], every: int) -> None:
    if not series:
        return
    kept = {group: sampled_runs.places(len(x), every) for group, (x, _) in series.items()}
    x, y = (np.concatenate([pair[axis][kept[group]] for group, pair in series.items()]) for axis in (0, 1))
    places = np.repeat(list(kept), [len(some) for some in kept.values()])
    most = max(len(some) for some in kept.values())
    seaborn_plots.marks(panel.plot, x, y, places, looks, size=3.0 if most <= 200 else 1.5)


def _curve(panel: Panel, curve: Fit, look: Look) -> None:
    """Draw a curve with its interval. It is not seaborn's `regplot`, which estimates the interval from random samples."""
    panel.plot.plot(curve.x, curve.y, color=look["color"], linestyle=look.get("linestyle", "-"))
    if not sampled_runs.is_of_rows(panel.drawing):  # rows of a run depend on each other: their interval would be too narrow
        panel.plot.fill_between(curve.x, curve.low, curve.high, facecolor=look["color"], alpha=0.15, linewidth=0)


def _scale(within: Panels, drawing: Drawing) -> None:
    """Make the axes logarithmic that the figure declares to be so."""
    for plot in within.plots:
        for name, log in (("x", drawing.figure.log_x), ("y", drawing.figure.log_y)):
            if log:
                plot.set(**{f"{name}scale": "log"})
                style.log_ticks(*((plot.xaxis, *plot.get_xlim()) if name == "x" else (plot.yaxis, *plot.get_ylim())))


def notes(drawing: Drawing, fit: str) -> list[str]:
    """Return notes on the runs that are left out, and how well the curves fit."""
    within_log = [*_left_out(drawing, fit), *sampled_runs.notes(drawing, "by their ids")]
    if fit == "none":
        return within_log
    curves = _fits(drawing, fit)
    without = sum(curve is None for _, curve in curves)
    few = [f"no curve for {without} series with too few different values"] if without else []
    said = [f"{name and f'{name}: '}{curve.equation}{_goodness(curve)}" for name, curve in curves if curve is not None]
    more = [f"{len(said) - EQUATIONS} more equations"] if len(said) > EQUATIONS else []
    return [*within_log, *few, *said[:EQUATIONS], *more]


def _goodness(curve: Fit) -> str:
    """Return how well a curve fits; "" for values that are all the same, of which nothing is to be explained."""
    if not curve.freedom:
        return " (through all points)"
    return f", R² = {curve.r2:.3f}" if np.isfinite(curve.r2) else ""


def _left_out(drawing: Drawing, fit: str) -> list[str]:
    """Return a note on runs without both values, and on those that a logarithm cannot show."""
    runs = sampled_runs.table(drawing)
    x, y = style.column(runs, "value"), style.column(runs, "value_2")
    bad = int((~_usable(drawing, x, y, fit)).sum())
    what = f"{sampled_runs.noun(drawing)}s"
    lost = [] if sampled_runs.is_of_rows(drawing) else lacking(drawing)
    return [*lost, *([f"log scale: {bad} of {len(x)} {what} not above 0 left out"] if bad else [])]


def lacking(drawing: Drawing) -> list[str]:
    """Return a note on runs that have a value in some of the columns only."""
    if drawing.runs is None:
        raise TypeError(f"a {drawing.figure.kind} figure needs the values of its runs")
    most = max(int(numpy_of(table.column("n")).sum()) for table in drawing.tables.values())
    what = "both values" if len(drawing.tables) == 2 else "a value in each column"
    lost = most - drawing.runs.num_rows
    return [f"{lost} runs without {what} left out"] if lost > 0 else []


def _fits(drawing: Drawing, fit: str) -> list[tuple[str, Fit | None]]:
    """Return the curve of each series of each panel, with the name of the series."""
    within = facets.panels(drawing, over_first=False)
    names = style.names(within.groups.values)
    series = [f"{style.axis_label(within.groups)} = {name}" if len(names) > 1 else "" for name in names]
    return [
        (", ".join(filter(None, (panel.plot.get_title(), series[group]))), fitted(x, y, fit))
        for panel in within.panels
        for group, (x, y) in _series(panel, within, drawing, fit).items()
    ]


def _usable(drawing: Drawing, x: Floats, y: Floats, fit: str) -> np.typing.NDArray[np.bool_]:
    above_x = (x > 0) | (not (drawing.figure.log_x or fit in LOG_X))
    above_y = (y > 0) | (not (drawing.figure.log_y or fit in LOG_Y))
    usable: np.typing.NDArray[np.bool_] = above_x & above_y
    return usable


def _series(panel: Panel, within: Panels, drawing: Drawing, fit: str) -> dict[int, tuple[Floats, Floats]]:
    """Return the values of the runs of each series that can be drawn."""
    runs = sampled_runs.table(panel.drawing)
    x, y = style.column(runs, "value"), style.column(runs, "value_2")
    good = _usable(drawing, x, y, fit)
    places = np.array([within.group(panel.drawing, ordinal) for ordinal in runs.column("experiment").to_pylist()], dtype=int)
    return {int(group): (x[good & (places == group)], y[good & (places == group)]) for group in np.unique(places[good])}


def frame(drawing: Drawing, within: Panels, looks: list[Look]) -> None:
    rows, measure = sampled_runs.is_of_rows(drawing), drawing.figure.measure
    words = ((column, column if rows else of_run(measure, column)) for column in drawing.figure.columns)
    names = [style.label(word, drawing.units.get(column, "")) for column, word in words]
    style.outer_labels(within.plots, drawing.figure.xlabel or names[0], drawing.figure.ylabel or names[1])
    entries = style.names(within.groups.values)
    marks = [look | Look(linestyle="none") if "marker" in look else look for look in looks]
    style.legend(within.figure, within.plots, within.groups, entries, style.lines(marks))
