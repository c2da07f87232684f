"""Bands: the center of a figure and the interval around it, as statistics, as columns, and in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sierra.config.deliverable_tables import Figure
from sierra.stats.aggregate import CENTERS

if TYPE_CHECKING:
    import pyarrow as pa

COLUMNS = {"mean": ("mean", "low", "high"), "median": ("median", "q1", "q3"), "iqm": ("iqm", "iqm_low", "iqm_high")}
"""The columns of the center and of the ends of its own interval."""
OTHERS = {
    "sd": ("sd", ("sd_low", "sd_high"), "± one standard deviation"),
    "iqr": ("quartiles", ("q1", "q3"), "quartiles"),
    "range": ("range", ("min", "max"), "smallest to largest value"),
}
"""Other intervals by name: the statistic, the columns of the ends, and the words."""
NAMES = {"mean": "mean", "median": "median", "iqm": "interquartile mean"}


def statistics(figure: Figure) -> tuple[str, ...]:
    """Return the statistics of the center and of its interval."""
    center, spread = CENTERS[figure.center]
    return (center, OTHERS[figure.band][0] if figure.band in OTHERS else spread)


def columns(figure: Figure) -> tuple[str, str, str]:
    """Return the names of the columns of the center, and of the lower and the upper end of its interval."""
    center, low, high = COLUMNS[figure.center]
    return (center, *OTHERS[figure.band][1]) if figure.band in OTHERS else (center, low, high)


def with_ends(table: pa.Table, figure: Figure) -> pa.Table:
    """Return statistics with the columns of the ends of the interval."""
    if figure.band != "sd" or "sd" not in table.column_names:
        return table
    import pyarrow.compute as pc

    center, sd = table.column(columns(figure)[0]), table.column("sd")
    return table.append_column("sd_low", pc.subtract(center, sd)).append_column("sd_high", pc.add(center, sd))


def words(figure: Figure) -> str:
    """Return what the marks are if the interval is not the center's own; else "", because it depends on the data."""
    return f"{NAMES[figure.center]}, {OTHERS[figure.band][2]}" if figure.band in OTHERS else ""
