"""Statistics and their intervals in the words of captions."""

from __future__ import annotations

from collections.abc import Collection

from sierra.config.statistic_names import percent

NAMES = {
    "iqm": "interquartile mean",
    "sd": "standard deviation",
    "iqr": "interquartile range",
    "mad": "median absolute deviation",
}
MEASURES = {"mean": "mean of the rows of", "time_mean": "mean over time of"}
METHODS = {"t": "Student's t", "trimmed t": "t of a trimmed mean"}
WILSON = "Wilson"


def named(statistic: str) -> str:
    """Return the name of a statistic, as in `interquartile mean` and `90 % quantile`."""
    of_quantile = percent(statistic)
    return NAMES.get(statistic, statistic) if of_quantile is None else f"{of_quantile:g} % quantile"


def of_run(measure: str, column: str) -> str:
    """Return the words for the value of a run, as in `final coverage` and `mean of the rows of coverage`."""
    return f"{MEASURES.get(measure, measure)} {column}"


def plural(statistic: str) -> str:
    """Return the name of several values of a statistic."""
    name = named(statistic)
    return f"{name}s" if name in ("mean", "median", "interquartile mean") or name.endswith("quantile") else f"values of {name}"


def interval(methods: Collection[str]) -> str:
    """Return the words for intervals by these methods."""
    if not methods:
        return "no interval"
    if set(methods) == {WILSON}:
        return "Wilson's 95 % CI of a rate"
    return f"95 % CI ({', '.join(METHODS.get(method, method) for method in sorted(methods))})"
