"""Estimate of what a batch would request from a cluster, and why. Nothing is submitted or written."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from sierra.config.cluster_table import ClusterTable
from sierra.errors import Missing
from sierra.model import Times
from sierra.runners import schedulers
from sierra.runners.cluster import submission_record
from sierra.runners.cluster.preflight_job import Preflight
from sierra.runners.cluster.sizing import TIMEOUT_S, Size, note_on_gpus, size
from sierra.runners.cluster.submission_record import UNFOLLOWED
from sierra.runners.schedulers.base import Bounds, Carries
from sierra.store.layout import SessionPaths
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted

FILES = 14
"""Number of files of a submission that does not depend on the number of elements; see `sierra.store.layout`."""
FILES_OF_ELEMENT = 3
"""Number of files of each element: its jobs, its result log and its output."""
SHOWN = (
    *("cpus", "memory", "gpus", "partition", "account", "qos", "constraint", "modules", "directives"),
    *("python", "scratch", "attempts", "cancelled"),
)
"""Settings of a cluster that are shown, in addition to the number of elements and their time."""
DEFAULTS = {
    "cpus": "default: one run at a time",
    "scratch": "$SLURM_TMPDIR, $TMPDIR or /tmp, whichever a node has",
    "python": "default",
    "attempts": "default",
}

PREFLIGHT = (
    "nodes were not checked within a day: the array tasks will wait (a dependency in the script) for a small job that does it"
)


CALIBRATES = (
    "{}: {} are executed first, and then decide the number of array tasks for the others; the number given here is used if no "
    "process waits for the first runs, or if no node starts them within {:g} s"
)
DEALT = (("array_tasks", "shares of decreasing size, of which each host takes one when another one has ended"),)
NO_DURATION, NEVER_TIMED = "the duration of runs is not known yet", "runs with these values were never timed"


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting of a cluster, and the reason for its value."""

    name: str
    value: str | float | None
    """None means the site's default."""
    why: str


@dataclass(frozen=True, slots=True)
class Estimate:
    """Description of what would be submitted."""

    runner: str
    scheduler: str
    """Name of the scheduler, with its version if that is known."""
    runs: int
    array_tasks: int
    longest: int
    """Number of runs of the largest element."""
    cpus: int
    wall_s: float | None
    """Seconds that each element requests; None means the site's limit, or none where no scheduler has limits."""
    expected_s: float | None
    """Seconds that each element is expected to take; None if this is unknown."""
    core_hours: float | None
    """Expected total of all runs."""
    most_core_hours: float | None
    """Upper bound: all requested time."""
    files: int
    """Approximate number of files on the shared file system. `bytes` is their size; it is None if the size of the runs' outputs
    is unknown."""
    bytes: int | None
    settings: tuple[Setting, ...]
    script: str | None
    """The complete job script; None if it depends on the scheduler's answer and the scheduler cannot be reached."""
    notes: tuple[str, ...]


def propose(
    name: str,
    scheduler: str,
    table: ClusterTable,
    work: Path,
    *,
    count: int,
    times: Times | None,
    each: float | None,
    beside: tuple[int, int],
    waits: bool,
    gpus: float | None = None,
    cores: int = 1,
) -> Estimate:
    """Return what `count` runs with these expected times would request from a cluster.

    Each run leaves `each` bytes and holds `gpus` GPUs and `cores` cores. `waits` is true if a process would follow. `work` is
    the folder of sessions. `beside` are the files and bytes that do not depend on the number of elements. If the scheduler
    cannot be reached, the estimate lacks the limits of the site. Raises ConfigError for a refused request.
    """
    shares = _shares(scheduler, table, count, times)
    is_probed = not shares and Preflight(name, table, SessionPaths(work / "SESSION")).is_needed()
    notes = [PREFLIGHT] if is_probed else []
    version, bounds = _site(scheduler, table, notes)
    if shares:
        sized = Size(len(shares), None, None, DEALT)
    else:
        sized = size(count, times, table, bounds, waits=waits, gpus=gpus, cores=cores)
    if not shares and (note := note_on_gpus(table, gpus)):
        notes.append(note)
    requested = table.model_copy(update={"wall": sized.wall_s})
    unknown = NEVER_TIMED if times else NO_DURATION
    notes += [CALIBRATES.format(unknown, counted(len(sized.first), "run"), TIMEOUT_S)] if sized.first else []
    notes += [] if waits or shares else [UNFOLLOWED]
    files, carried = beside
    return Estimate(
        runner=name,
        scheduler=version or scheduler,
        runs=count,
        array_tasks=sized.elements,
        longest=max(shares, default=math.ceil((count - len(sized.first)) / sized.elements)),
        cpus=table.cpus,
        wall_s=sized.wall_s,
        expected_s=sized.expected_s,
        core_hours=sum(times.each) / 3600 if times else None,
        most_core_hours=None if sized.wall_s is None else sized.elements * table.cpus * sized.wall_s / 3600,
        files=files + FILES + FILES_OF_ELEMENT * (sized.elements + bool(sized.first)),
        bytes=None if each is None else carried + round(count * each),
        settings=tuple(_settings(sized, times, table, bounds)),
        script=_script(scheduler, requested, sized, SessionPaths(work / "SESSION"), notes),
        notes=tuple(dict.fromkeys(notes)),
    )


def _shares(scheduler: str, table: ClusterTable, count: int, times: Times | None) -> Sequence[int]:
    """Return the numbers of runs of the elements of a scheduler that carries files to its hosts; nothing for others."""
    carrier = schedulers.find(scheduler)(table)
    return carrier.sizes(times.each if times else (1.0,) * count) if isinstance(carrier, Carries) else ()


def _site(scheduler: str, table: ClusterTable, notes: list[str]) -> tuple[str | None, Bounds]:
    """Return the scheduler's version and the site's limits; None and empty limits if it does not answer."""
    requested = schedulers.find(scheduler)(table)
    try:
        return requested.version(), requested.bounds()
    except Missing as error:
        notes.append(f"{error}; the site's limits are unknown")
        return None, Bounds()


def _settings(sized: Size, times: Times | None, table: ClusterTable, bounds: Bounds) -> list[Setting]:
    """Return all requested settings, and the site's limits."""
    values: dict[str, float | None] = {"array_tasks": sized.elements, "wall": sized.wall_s}
    settings = [Setting(name, values.get(name), why) for name, why in sized.why]
    if times:
        took = f"{min(times.each):.3g} to {max(times.each):.3g} s, mean {times.mean:.3g} s"
        settings.append(Setting("time of a run", took, times.how))
    if sized.first:
        unknown = NEVER_TIMED if times else NO_DURATION
        settings.append(Setting("first runs", len(sized.first), f"{unknown}: measured by these runs"))
    for name in SHOWN:
        value = getattr(table, name)
        shown = ", ".join(value) or None if isinstance(value, tuple) else value
        if why := "set in sierra.toml" if name in table.model_fields_set else DEFAULTS.get(name):
            settings.append(Setting(name, shown, why))
    return [*settings, *_allowed(bounds)]


def _allowed(bounds: Bounds) -> Iterator[Setting]:
    names = {"array": "longest array", "jobs": "jobs at a time", "running": "jobs that run at a time", "wall_s": "longest wall"}
    for name, shown in names.items():
        if (value := getattr(bounds, name)) is not None:
            yield Setting(shown, value, ": ".join(filter(None, ("the site's limit", bounds.whose.get(name)))))


def _script(scheduler: str, table: ClusterTable, sized: Size, session: SessionPaths, notes: list[str]) -> str | None:
    elements = tuple(range(bool(sized.first), sized.elements + bool(sized.first)))
    request = submission_record.elements_request(session, "sierra-SESSION", elements, table)
    try:
        return schedulers.find(scheduler)(table).script(request)
    except Missing as error:
        notes.append(f"{error}; so the script cannot be shown")
        return None
