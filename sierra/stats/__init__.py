"""Statistics over runs, in SQL."""

from __future__ import annotations

from sierra.stats.aggregate import (
    HERE,
    STATISTICS,
    Coverage,
    at_times,
    by_experiment,
    by_time,
    compute,
    coverage,
    default_figures,
    is_rate,
    left_out,
    reduced,
    resampled,
)

__all__ = [
    "HERE",
    "STATISTICS",
    "Coverage",
    "at_times",
    "by_experiment",
    "by_time",
    "compute",
    "coverage",
    "default_figures",
    "is_rate",
    "left_out",
    "reduced",
    "resampled",
]
