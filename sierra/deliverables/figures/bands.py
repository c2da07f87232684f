"""Bands: the center of a figure and the interval around it, as statistics, as columns, and in words.

The center is a statistic by name, as `sierra stats --statistic` has them, with the interval that it brings. Other intervals
show the spread of the runs: `center ∓ sd`, `median ∓ mad`, quantiles, or the smallest and the largest value.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sierra.config.deliverable_tables import Figure
from sierra.config.statistic_names import quantile
from sierra.stats.needs import Needs, Over
from sierra.stats.words import named
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True)
class Spread:
    """An interval that shows the spread of the runs."""

    formula: str
    """The formula of its columns: the name of a file in `sierra/stats/statistics/`."""
    words: str
    ends: tuple[str, str] = ("band_low", "band_high")
    """The columns of its ends."""
    half: str = ""
    """The column with its distance from the center to both sides; empty if the formula has the ends."""


SPREADS = {
    "sd": Spread("sd", "± one standard deviation", half="sd"),
    "mad": Spread("mad", "± one median absolute deviation", half="mad"),
    "iqr": Spread("quartiles", "quartiles", ("q1", "q3")),
    "range": Spread("range", "smallest to largest value", ("min", "max")),
}


def needs(figure: Figure, *, over: Over = "experiments", columns: int | None = 1, some: str = "") -> Needs:
    """Return what a kind with centers and intervals needs. The arguments are those of `Needs`."""
    band, spread = band_of(figure), SPREADS.get(band_of(figure))
    levels = tuple(map(quantile, figure.quantiles)) if band == "quantiles" else ()
    formulas = (spread.formula,) if spread else ()
    return Needs(formulas, (figure.center, *levels), over=over, columns=columns, shows=_words(figure), some=some)


def center_only(figure: Figure, *, over: Over = "experiments", columns: int | None = 1, none: str = "△") -> Needs:
    """Return what a kind needs that shows centers without intervals."""
    return Needs(chosen=(figure.center,), over=over, columns=columns, shows=named(figure.center), none=none)


def columns(figure: Figure) -> tuple[str, str, str]:
    """Return the names of the columns of the center, and of the lower and the upper end of its interval."""
    band, center = band_of(figure), figure.center
    if band == "quantiles":
        low, high = figure.quantiles
        return center, quantile(low), quantile(high)
    return (center, *SPREADS[band].ends) if band in SPREADS else (center, f"{center}_low", f"{center}_high")


def with_ends(table: pa.Table, figure: Figure) -> pa.Table:
    """Return statistics with the columns of the ends of the interval."""
    spread = SPREADS.get(band_of(figure))
    if spread is None or not spread.half or spread.half not in table.column_names:
        return table
    import pyarrow.compute as pc

    center, half = table.column(figure.center), table.column(spread.half)
    ends = pc.subtract(center, half), pc.add(center, half)
    for name, values in zip(spread.ends, ends, strict=True):
        table = table.append_column(name, values)
    return table


def _words(figure: Figure) -> str:
    """Return what the marks are if the interval is not the center's own; else "", because it depends on the data."""
    band = band_of(figure)
    if band == "quantiles":
        low, high = (f"{level * 100:.6g}" for level in figure.quantiles)
        return f"{named(figure.center)}, quantiles of {low} % and {high} %"
    return f"{named(figure.center)}, {SPREADS[band].words}" if band in SPREADS else ""


def band_of(figure: Figure) -> str:
    return figure.band or ("iqr" if figure.center == "median" else "ci")
