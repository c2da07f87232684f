"""How many elements a batch is dealt out to, and how long each may take; and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sierra.config.project_file import ClusterTable
from sierra.errors import ConfigError
from sierra.model import Times
from sierra.runners.schedulers.base import Bounds

ELEMENT_S = 450.0
"""What an element is to take, where that can be told: between 5 and 10 minutes. Shorter ones cost a scheduler more than they
compute (it starts a few a second), longer ones wait longer for a node, and lose more with it."""
UNKNOWN = 16
"""Elements where nobody knows how long runs take, and nobody waits until some tell."""
FIRST = 2
"""Runs that go first and tell, where there are more than UNKNOWN: of those that were never timed, the first and the last."""
PROBES = 1
"""Jobs that go before all elements: the one that tries nodes out."""
SPARE, SPARE_OF_ESTIMATE = 3.0, 6.0
"""Times the expected time that an element may take; and where runs have values that were never timed."""
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
    first: tuple[int, ...] = ()
    """The places of runs that go first, as an element of their own: what they take decides how the others are dealt out."""


def size(count: int, times: Times | None, table: ClusterTable, bounds: Bounds, *, waits: bool = True) -> Size:
    """How to deal `count` runs out, which are expected to take these times (None: nobody knows).

    `waits`: whether somebody follows, and so waits for runs that go first. Raises ConfigError for a time that the site does
    not allow.
    """
    if table.wall is not None and bounds.wall_s is not None and table.wall > bounds.wall_s:
        where = bounds.whose.get("wall_s", "the site's")
        raise ConfigError(f"wall = {table.wall:g} s is more than the site allows, {bounds.wall_s:g} s ({where}); ask for less")
    first = _first(count, times) if waits and table.elements is None and count > UNKNOWN else ()
    seconds, how = (times.mean, times.how) if times else (None, "")
    elements, why = elements_of(count - len(first), seconds, table, bounds, before=bool(first), how=how)
    expected = longest(times.each, elements, table.cpus) if times else None
    spare = SPARE_OF_ESTIMATE if times and times.new else SPARE
    wall, told = _wall(expected, spare, table, bounds, waits=waits)
    return Size(elements, wall, expected, (("elements", why), ("wall", told)), first)


def longest(each: Sequence[float], elements: int, cpus: int) -> float:
    """Seconds that the longest of so many elements takes at most, where run k goes to element k mod `elements`."""
    shares = (each[number::elements] for number in range(min(elements, len(each))))
    return max(sum(share) / cpus + (1 - 1 / cpus) * max(share) for share in shares)


def _first(count: int, times: Times | None) -> tuple[int, ...]:
    """Of the runs whose time nobody knows, the first and the last, where there are more."""
    new = range(count) if times is None else times.new
    return (new[0], new[-1]) if len(new) > FIRST else ()


def elements_of(
    count: int, seconds: float | None, table: ClusterTable, bounds: Bounds, *, before: bool, how: str = ""
) -> tuple[int, str]:
    """How many elements so many runs are dealt out to, and why; `before`: whether there is one already, of the first runs.

    `seconds` is what a run takes in the mean, and `how` says where that comes from.
    """
    elements, why = _elements(count, seconds, table, how)
    array, jobs = bounds.array and max(bounds.array - before, 1), bounds.jobs and max(bounds.jobs - PROBES - before, 1)
    if array and array < elements:
        elements, why = array, f"the site's longest array{_whose(bounds, 'array')}"
    if jobs and jobs < elements:
        elements, why = jobs, f"the jobs that the site allows{_whose(bounds, 'jobs')}"
    return elements, why


def _whose(bounds: Bounds, name: str) -> str:
    return f" ({bounds.whose[name]})" if name in bounds.whose else ""


def _elements(count: int, seconds: float | None, table: ClusterTable, how: str) -> tuple[int, str]:
    if table.elements is not None:
        return min(table.elements, count), "as sierra.toml says" if table.elements <= count else "there are no more runs"
    if seconds is None:
        return min(UNKNOWN, count), "nobody knows yet how long runs take"
    wanted = math.ceil(count * seconds / table.cpus / ELEMENT_S)
    whence = f" ({how})" if how else ""
    return min(max(wanted, 1), count), f"runs take {seconds:.3g} s{whence}, and an element is to take 5 to 10 minutes"


def _wall(
    expected: float | None, spare: float, table: ClusterTable, bounds: Bounds, *, waits: bool
) -> tuple[float | None, str]:
    if table.wall is not None:
        return table.wall, "as sierra.toml says"
    if expected is None and not waits and bounds.wall_s is not None:
        return bounds.wall_s, "all that the site allows, as nobody knows yet how long runs take, and nobody follows"
    if expected is None:
        return None, "the site's, as nobody knows yet how long runs take"
    wall = max(LEAST_S, spare * expected)
    if bounds.wall_s is not None and wall > bounds.wall_s:
        return bounds.wall_s, f"all that the site allows{_whose(bounds, 'wall_s')}; what is cut off is submitted again"
    return wall, f"{spare:g} times what is expected, at least {LEAST_S / 60:g} minutes"
