"""The printed form of an estimate of cluster resources."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from sierra.cli.output import table
from sierra.util.text import counted, size

if TYPE_CHECKING:
    from sierra.runners.cluster.resource_estimate import Estimate


def show(proposal: Estimate, *, explain: bool, script: bool) -> None:
    """Print an estimate; with `explain` also the reasons for its settings, with `script` also the submission script."""

    for line in _lines(proposal):
        print(line)
    if explain:
        table(
            ("setting", "value", "reason"),
            [(one.name, "" if one.value is None else one.value, one.why) for one in proposal.settings],
        )
    if script and proposal.script is not None:
        print(f"submission script for {proposal.runner}:")
        print("".join(f"    {line}\n" for line in proposal.script.splitlines()), end="")


def _lines(proposal: Estimate) -> Iterator[str]:
    from sierra.execution.progress_display import duration

    tasks, runs = counted(proposal.array_tasks, "array task"), counted(proposal.longest, "run")
    cores = counted(proposal.cpus, "core")
    wall = "the site's default time" if proposal.wall_s is None else duration(proposal.wall_s)
    yield f"on {proposal.runner} ({proposal.scheduler}): {tasks} of up to {runs}, each {cores} for {wall}"
    most = "" if proposal.most_core_hours is None else f", at most {proposal.most_core_hours:.3g} (the requested time)"
    if proposal.core_hours is None:
        yield f"core-hours: unknown, no run has been timed yet{most}"
    else:
        yield f"core-hours: about {proposal.core_hours:.3g}{most}"
    wrote = "unknown size" if proposal.bytes is None else f"about {size(proposal.bytes)}"
    yield f"on the shared file system: about {proposal.files} files, {wrote}"
