"""Runs that another system has executed from the folder of `sierra run --inputs`: `collect` records them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import os

    from sierra.api import Project
    from sierra.execution.observer import Observer
    from sierra.extensions.collect.collection import Collection


def collect(
    project: Project,
    folder: str | os.PathLike[str],
    *,
    trust: bool = False,
    figures: bool = True,
    observer: Observer | None = None,
    progress: bool | None = None,
) -> Collection:
    """Record the runs of a folder that have ended, and draw the figures.

    `folder` is the one that `sierra run --inputs` wrote. `trust`: the executions count as if the programs of this machine had
    executed them; otherwise, runs of the same query are executed here when it is requested. `observer` and `progress` are as in
    `Project.run`. Raises UsageError if this project does not have the batch of the folder, Missing if a file cannot be read.
    """
    from sierra.extensions.collect import collection

    return collection.collect(project, Path(folder), trust=trust, figures=figures, observer=observer, progress=progress)
