"""Number of elements that a batch is sharded into, the time limit of each, and the reasons.

If nobody knows how long runs take, a few runs execute first (calibration), and their times decide the number of elements. The
first runs are element 0 of their session, and their results are used like any others. The other runs wait in one file
(`SessionPaths.rest`). They are submitted when one of these happens:

- The first runs have ended.
- The first runs have lasted as long as an element should take, which tells enough.
- No process waits any more, because no node became free or because the following process leaves. Then the number of elements is
  the one for unknown durations.

The next process that follows the session continues this. If the submitting process is killed before that, only the first runs
have been submitted.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError
from sierra.model import Times
from sierra.runners.schedulers.base import Bounds
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted
from sierra.worker.devices import runs_at_once

ELEMENT_S = 450.0
"""Seconds that an element should take, if this can be estimated: between 5 and 10 minutes. Shorter elements cost a scheduler
more time than they compute, because it starts only a few per second. Longer ones wait longer for a node, and lose more with it.
"""
UNKNOWN = 16
"""Number of elements if nobody knows how long runs take, and no process waits for a calibration."""
FIRST = 2
"""Number of runs that go first for calibration, if there are more than UNKNOWN: the first and the last of those never timed."""
PROBES = 1
"""Number of jobs that go before all elements: the preflight job."""
SPARE, SPARE_OF_ESTIMATE = 3.0, 6.0
"""Factors between the expected time of an element and its limit; the second is for runs with values that were never timed."""
LEAST_S = 600.0
TIMEOUT_S = 120.0
"""Seconds that the first runs wait for a node."""


@dataclass(frozen=True, slots=True)
class Size:
    """Number and time limits of a batch's elements."""

    elements: int
    wall_s: float | None
    """Time limit of each element; None means the site's."""
    expected_s: float | None
    """Expected time of each element."""
    why: tuple[tuple[str, str], ...]
    """Names of settings, each with the reason for its value."""
    first: tuple[int, ...] = ()
    """Places of the runs that go first, as an element of their own. Their times decide how the others are sharded."""


def size(
    count: int,
    times: Times | None,
    table: ClusterTable,
    bounds: Bounds,
    *,
    waits: bool = True,
    gpus: float | None = None,
    cores: int = 1,
) -> Size:
    """Return how `count` runs with these expected times (None: unknown) are sharded.

    `waits` is true if a process follows, and so can wait for the runs that go first. `gpus` and `cores` are the most that a run
    holds: see `sierra.model.Limits`. Raises ConfigError for a time that the site does not allow, for runs that take longer than
    an array task may, and for runs that request more cores or GPUs than it has.
    """
    slots = runs_of_element(table, gpus, cores)
    if table.wall is not None and bounds.wall_s is not None and table.wall > bounds.wall_s:
        where = bounds.whose.get("wall_s", "the site's limit")
        raise ConfigError(f"wall = {table.wall:g} s is more than the site allows, {bounds.wall_s:g} s ({where}); request less")
    _check_longest(times, table, bounds)
    first = _first(count, times) if waits and table.array_tasks is None and count > UNKNOWN else ()
    seconds, how = (times.mean, times.how) if times else (None, "")
    elements, why = elements_of(count - len(first), seconds, table, bounds, slots=slots, before=bool(first), how=how)
    expected = longest(times.each, elements, slots) if times else None
    spare = SPARE_OF_ESTIMATE if times and times.new else SPARE
    wall, wall_why = _wall(expected, spare, table, bounds, waits=waits)
    return Size(elements, wall, expected, (("array_tasks", why), ("wall", wall_why)), first)


def _check_longest(times: Times | None, table: ClusterTable, bounds: Bounds) -> None:
    """Raise ConfigError if a run takes longer than an array task may: it did so there, or elsewhere and `wall` is not set.

    Nodes may be faster than where a run was timed. Whoever sets `wall` vouches for that. Runs with checkpoints may take longer.
    """
    allowed = bounds.wall_s if table.wall is None else table.wall
    if times is None or allowed is None or times.continues:
        return
    limit = f"{allowed:g} s (wall)" if table.wall is not None else f"{allowed:g} s{_whose(bounds, 'wall_s')}"
    if times.there is not None and times.there > allowed:
        enough = (
            "raise wall"
            if bounds.wall_s is None or times.there < bounds.wall_s
            else "use a partition that allows more, or {checkpoint} in the command"
        )
        raise ConfigError(f"a run took {times.there:.0f} s there before, and an array task may take {limit}: {enough}")
    if table.wall is None and (measured := times.measured) is not None and measured > allowed:
        cure = f"use a partition that allows more, or set wall = {allowed:g} if a run takes less there"
        raise ConfigError(f"a run took {measured:.0f} s, and an array task may take {limit}: {cure}")


def runs_of_element(table: ClusterTable, gpus: float | None, cores: int) -> int:
    """Return how many runs an element executes at a time if each holds so much. Raises ConfigError if it has not enough."""
    if table.cpus < cores:
        raise ConfigError(
            f"runs request {cores} cores each ([limits] cores), but an array task has {table.cpus}; set cpus = {cores} or more"
        )
    return min(table.cpus // cores, slots_of(table, gpus))


def slots_of(table: ClusterTable, gpus: float | None) -> int:
    """Return how many runs of one core an array task executes at a time. Raises ConfigError if it has too few GPUs for one."""
    if gpus is None:
        return table.cpus
    if (table.gpus or 0) < gpus:
        has = "an array task has none" if table.gpus is None else f"an array task has {table.gpus}"
        each = f"{gpus:g} GPU{'s' if gpus > 1 else ''} each ([limits] gpus)"
        raise ConfigError(f"runs request {each}, but {has}; set gpus = {math.ceil(gpus)} or more")
    return min(table.cpus, runs_at_once(table.gpus or 0, gpus))


def note_on_gpus(table: ClusterTable, gpus: float | None) -> str:
    """Return a note if cores or GPUs of an array task are not used, because the others do not suffice; empty if all are."""
    if gpus is None or table.gpus is None:
        return ""
    fit = runs_at_once(table.gpus, gpus)
    slots = min(table.cpus, fit)
    executes = f"an array task executes {counted(slots, 'run')} at a time"
    if fit < table.cpus:
        return f"{executes}: its GPUs suffice for no more ([limits] gpus = {gpus:g}), although it has {table.cpus} cores"
    used = min(table.gpus, math.ceil(slots * max(gpus, 1)))
    if used < table.gpus:
        return (
            f"{executes}, which use {used} of its {table.gpus} GPUs; request fewer, or more cpus, of which each executes a run"
        )
    return ""


def longest(each: Sequence[float], elements: int, slots: int) -> float:
    """Return an upper bound for the seconds of the longest element, if run k goes to element k mod `elements`."""
    shares = (each[number::elements] for number in range(min(elements, len(each))))
    return max(sum(share) / slots + (1 - 1 / slots) * max(share) for share in shares)


def _first(count: int, times: Times | None) -> tuple[int, ...]:
    """Return the places of the first and the last run of unknown duration, if there are more than two."""
    new = range(count) if times is None else times.new
    return (new[0], new[-1]) if len(new) > FIRST else ()


def elements_of(
    count: int, seconds: float | None, table: ClusterTable, bounds: Bounds, *, slots: int, before: bool, how: str = ""
) -> tuple[int, str]:
    """Return the number of elements for `count` runs, `slots` at a time in each, and the reason for it.

    `seconds` is the mean time of a run, and `how` says where it comes from. `before` is true if there is already one element,
    of the first runs.
    """
    elements, why = _elements(count, seconds, table, slots, how)
    array, jobs = bounds.array and max(bounds.array - before, 1), bounds.jobs and max(bounds.jobs - PROBES - before, 1)
    if array and array < elements:
        elements, why = array, f"the longest array that the site allows{_whose(bounds, 'array')}"
    if jobs and jobs < elements:
        elements, why = jobs, f"the number of jobs that the site allows{_whose(bounds, 'jobs')}"
    return elements, why


def _whose(bounds: Bounds, name: str) -> str:
    return f" ({bounds.whose[name]})" if name in bounds.whose else ""


def _elements(count: int, seconds: float | None, table: ClusterTable, slots: int, how: str) -> tuple[int, str]:
    if table.array_tasks is not None:
        return min(table.array_tasks, count), "set in sierra.toml" if table.array_tasks <= count else "one for each run"
    if seconds is None:
        return min(UNKNOWN, count), "the duration of runs is not known yet"
    wanted = math.ceil(count * seconds / slots / ELEMENT_S)
    whence = f" ({how})" if how else ""
    return min(max(wanted, 1), count), f"runs take {seconds:.3g} s{whence}, and an array task should take 5 to 10 minutes"


def _wall(
    expected: float | None, spare: float, table: ClusterTable, bounds: Bounds, *, waits: bool
) -> tuple[float | None, str]:
    if table.wall is not None:
        return table.wall, "set in sierra.toml"
    if expected is None and not waits and bounds.wall_s is not None:
        return bounds.wall_s, "the site's limit, because the duration of runs is not known yet and no process follows"
    if expected is None:
        return None, "the site's default, because the duration of runs is not known yet"
    wall = max(LEAST_S, spare * expected)
    if bounds.wall_s is not None and wall > bounds.wall_s:
        return bounds.wall_s, f"the site's limit{_whose(bounds, 'wall_s')}; runs that it cuts off are submitted again"
    return wall, f"{spare:g} times the expected time, at least {LEAST_S / 60:g} minutes"


@dataclass(frozen=True, slots=True)
class Timing:
    """The result of a calibration."""

    seconds: float | None
    """Duration of a run in seconds; None if the first runs could not tell."""
    how: str
    """The explanation for the user."""


def timing(durations: Iterable[float | None], waited: float, lasted: float | None, *, over: bool) -> Timing | None:
    """Return the result of a calibration; None as long as more may be learned.

    `durations` are those of the first runs that have ended; None for one that failed. The first runs were submitted `waited`
    seconds ago and began `lasted` seconds ago; None: they have not begun. `over`: all have ended, or were given up.
    """
    good = [seconds for seconds in durations if seconds is not None]
    if over:
        seconds = sum(good) / len(good) if good else None
        return Timing(seconds, "the first runs have failed" if seconds is None else f"the first runs took {seconds:.3g} s")
    if lasted is None and waited > TIMEOUT_S:
        return Timing(None, f"no node was available for the first runs within {TIMEOUT_S:g} s")
    if lasted is None or lasted <= ELEMENT_S:
        return None
    seconds = (sum(good) + lasted) / (len(good) + 1)
    return Timing(seconds, f"one of the first runs has not ended within {ELEMENT_S:g} s")
