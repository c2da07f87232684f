"""Videos of batches: their states at each time, drawn and encoded. `videos` is the function for Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.extensions.videos.render import Made


def videos(
    project: Project,
    *batches: str,
    names: Sequence[str] = (),
    jobs: int | None = None,
    progress: Callable[[int, int, str], None] = lambda done, frames, what: None,
) -> Made:
    """Make the videos `[videos.NAME]` of a batch, or of two side by side, all or those with these names.

    Batches are prefixes or names of queries, by default the last batch; of two, also as `LABEL=PREFIX`. Notes say what could
    not be shown, and which runs are not in a video; `complete` is False if a file could not be made. `jobs` is the number of
    files that are made at a time, by default the number of cores. `progress` receives the number of frames that are done, that
    of all frames of a video, and `frames read` or `frames drawn`. Raises NotFound, SierraError if a video that is named cannot
    be made.
    """
    from sierra.api import slots
    from sierra.extensions.videos import render

    if len(batches) > 2:
        raise UsageError(f"a video shows two batches at most, not {len(batches)}")
    found = project.groups_of(batches) if len(batches) == 2 else {"": project.batch(*batches)}
    return render.videos(project.loaded, project.store, found, names, jobs=slots(jobs), progress=progress)
