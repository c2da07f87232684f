"""How many elements a batch is dealt out to, and how long each may take; and why."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sierra.config import ClusterTable
from sierra.errors import ConfigError
from sierra.runners.schedulers import Bounds

ELEMENT_S = 450.0
"""What an element is to take, where that can be told: between 5 and 10 minutes. Shorter ones cost a scheduler more than they
compute (it starts a few a second), longer ones wait longer for a node, and lose more with it."""
UNKNOWN = 16
"""Elements where nobody knows how long runs take."""
SPARE = 3.0
"""Times the expected time that an element may take."""
LEAST_S = 600.0


@dataclass(frozen=True, slots=True)
class Size:
    """How a batch is dealt out."""

    elements: int
    wall_s: float | None
    """What each element may take; None is what the site says."""
    expected_s: float | None
    """What each is expected to take."""
    why: tuple[tuple[str, str], ...]
    """Settings, and why they are what they are."""


def size(count: int, seconds: float | None, table: ClusterTable, bounds: Bounds) -> Size:
    """How to deal `count` runs out, each expected to take so many seconds (None: nobody knows).

    Raises ConfigError for a time that the site does not allow.
    """
    if table.wall is not None and bounds.wall_s is not None and table.wall > bounds.wall_s:
        raise ConfigError(f"wall = {table.wall:g} s is more than the site allows, {bounds.wall_s:g} s; ask for less")
    elements, why = _elements(count, seconds, table)
    for most, whose in ((bounds.array, "the site's longest array"), (bounds.jobs, "the jobs that the site allows")):
        if most is not None and most < elements:
            elements, why = most, whose
    expected = None if seconds is None else math.ceil(count / elements / table.cpus) * seconds
    wall, told = _wall(expected, table, bounds)
    return Size(elements, wall, expected, (("elements", why), ("wall", told)))


def _elements(count: int, seconds: float | None, table: ClusterTable) -> tuple[int, str]:
    if table.elements is not None:
        return min(table.elements, count), "as sierra.toml says" if table.elements <= count else "there are no more runs"
    if seconds is None:
        return min(UNKNOWN, count), "nobody knows yet how long runs take"
    wanted = math.ceil(count * seconds / table.cpus / ELEMENT_S)
    return min(max(wanted, 1), count), f"runs took {seconds:.3g} s, and an element is to take 5 to 10 minutes"


def _wall(expected: float | None, table: ClusterTable, bounds: Bounds) -> tuple[float | None, str]:
    if table.wall is not None:
        return table.wall, "as sierra.toml says"
    if expected is None:
        return None, "the site's, as nobody knows yet how long runs take"
    wall = max(LEAST_S, SPARE * expected)
    if bounds.wall_s is not None and wall > bounds.wall_s:
        return bounds.wall_s, "all that the site allows; what is cut off is submitted again"
    return wall, f"{SPARE:g} times what is expected, at least {LEAST_S / 60:g} minutes"
