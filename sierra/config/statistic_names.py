"""Names of statistics: those of plug-ins, and quantiles such as `q90`."""

from __future__ import annotations

from sierra.config.plugin_registry import STATISTICS
from sierra.util.lazy_definitions import regex

CENSORED = ("km_median", "restricted_mean")
"""The statistics of times of which some are censored; they need all times of an experiment, and are no plug-ins."""
QUANTILE = regex(r"q(\d+)(\.\d+)?")


def percent(name: str) -> float | None:
    """Return the percentage of a quantile; None for another name. Raises ValueError for one that is ambiguous or impossible."""
    match = QUANTILE.fullmatch(name)
    if match is None:
        return None
    digits, rest = match[1], match[2] or ""
    if len(digits) == 1 and not rest:
        quartile = {"1": "25", "2": "50", "3": "75"}.get(digits)
        other = f"q{quartile} for the quartile, or " if quartile else ""
        raise ValueError(f"statistic {name!r} is ambiguous; write {other}q0{digits} for the quantile of {digits} %")
    value = float(digits + rest)
    if not 0 < value < 100:
        raise ValueError(f"statistic {name!r}: the percentage of a quantile must be between 0 and 100, as in q90")
    return value


def quantile(part: float) -> str:
    """Return the name of a quantile, such as `q05` for 0.05 and `q97.5` for 0.975."""
    whole, _, rest = f"{part * 100:.10f}".rstrip("0").partition(".")
    return f"q{whole:0>2}{f'.{rest}' if rest else ''}"


def complaint(name: str) -> str:
    """Return what is wrong with the name of a statistic, in one line; empty if nothing is."""
    try:
        if percent(name) is not None or name in STATISTICS.shipped or name in STATISTICS.names():
            return ""
    except ValueError as error:
        return str(error)
    if name in CENSORED:
        return f"{name!r} is for tables and `sierra stats`; a figure of kind survival shows the curve"
    known = ", ".join(STATISTICS.names())
    return f"unknown statistic {name!r}; known are {known}, and quantiles such as q05 or q97.5 (percent)"
