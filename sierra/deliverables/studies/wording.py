"""Studies in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from sierra.model import Value
from sierra.store.row_types import LookIntervalRow

if TYPE_CHECKING:
    from sierra.deliverables.studies.study import Look


def of_point(values: Mapping[str, Value]) -> str:
    """Return the values of an experiment in words."""
    return ", ".join(f"{name}={value}" for name, value in values.items()) or "the experiment"


def of_schedule(schedule: Sequence[int]) -> str:
    """Return the schedule in words."""
    looks = "1 look" if len(schedule) == 1 else f"{len(schedule)} looks at most"
    return f"{looks}, with {', '.join(map(str, schedule))} runs per experiment"


def of_correction(alpha: float, level: float, looks: int) -> str:
    """Return the confidence of the intervals in words."""
    whole = f"{100 * (1 - alpha):.4g} %"
    if looks == 1:
        return f"the intervals have the level {whole}"
    return f"each interval has the level {100 * level:.4g} %, so that all {looks} looks together have {whole} (Bonferroni)"


def of_interval(interval: LookIntervalRow) -> str:
    """Return an interval and its limit in words."""
    column = interval.condition.partition(" < ")[0].removeprefix("ci(").removesuffix(")")
    if interval.value is None:
        return f"{column} has no value"
    if interval.half_width is None or interval.wanted is None:
        return f"{column} has no interval with {interval.n} runs"
    if interval.half_width == 0 and not interval.holds:
        return f"{column} is {interval.value:.6g} in all {interval.n} runs, and equal values show no width"
    relation = "<" if interval.holds else "≥"
    return f"{column} is {interval.value:.6g} ± {interval.half_width:.4g} ({relation} {interval.wanted:.4g})"


def of_worst(seen: Sequence[LookIntervalRow], experiments: Mapping[int, Mapping[str, Value]]) -> str:
    """Return in words how many intervals are too wide, with the one that is furthest from its limit."""
    wide = [interval for interval in seen if not interval.holds]
    worst = max(wide, key=_excess)
    count = f"{len(wide)} of {len(seen)} intervals" if len(seen) > 1 else "the interval"
    verb = "are" if len(wide) > 1 else "is"
    where = f" in {of_point(experiments[worst.ordinal])}" if len(experiments) > 1 else ""
    return f"{count} {verb} not narrow enough: {of_interval(worst)}{where}"


def _excess(interval: LookIntervalRow) -> float:
    if not interval.half_width or not interval.wanted:
        return float("inf")
    return interval.half_width / interval.wanted


def of_look(look: Look, experiments: Mapping[int, Mapping[str, Value]], of: int) -> str:
    """Return a look and its decision in one line."""
    row = look.row
    return f"look {row.number} of {of} ({row.runs} runs per experiment): {row.decision}: {row.reason}"
