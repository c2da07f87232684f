"""Videos of batches: their states at each time, drawn and encoded; and frames that recorded runs render.

`videos` and `capture` are the functions for Python.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.execution.observer import Observer
    from sierra.extensions.videos.capture_runs import Captures
    from sierra.extensions.videos.render import RenderedVideos


def videos(
    project: Project,
    *batches: str,
    names: Sequence[str] = (),
    jobs: int | None = None,
    progress: Callable[[int, int, str], None] = lambda done, frames, what: None,
) -> RenderedVideos:
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
    if not batches and names:
        return _of_names(project, names, slots(jobs), progress)
    groups = project.comparisons.groups(batches) if len(batches) == 2 else {"": project.records.batch(*batches)}
    return render.videos(project.loaded, project.store, groups, names, jobs=slots(jobs), progress=progress)


def _of_names(project: Project, names: Sequence[str], jobs: int, progress: Callable[[int, int, str], None]) -> RenderedVideos:
    """Make the videos with these names, each of the last batches of its queries, or else of the last batch."""
    from sierra.deliverables import comparison
    from sierra.execution.batches_of_queries import BatchesOfQueries
    from sierra.extensions.videos import render, table

    declared, queries = table.declared(project.config), BatchesOfQueries(project.loaded, project.store)
    by_query: dict[tuple[str, ...], list[str]] = {}
    for name in names:
        by_query.setdefault(tuple(declared[name].query) if name in declared else (), []).append(name)
    rendered = []
    for words, some in by_query.items():
        batches = comparison.of_queries(queries, words) if words else {"": project.records.batch()}
        if len(batches) > 2:
            raise UsageError(f"[videos.{some[0]}] query: a video shows two batches at most, not {len(batches)}")
        rendered.append(render.videos(project.loaded, project.store, batches, some, jobs=jobs, progress=progress))
    return render.joined(rendered)


def capture(
    project: Project,
    prefix: str | None = None,
    *,
    runs: int = 1,
    jobs: int | None = None,
    runner: str = "local",
    engine: str | None = None,
    again: bool = False,
    observer: Observer | None = None,
    progress: bool | None = None,
) -> Captures:
    """Execute recorded runs once more with rendering, for their frames alone; compare the rest with the record.

    `prefix` is a batch, experiment, run or execution, or the name of a query, by default the last batch. `runs`: the number
    of runs of each experiment, the first ones. Runs whose frames are recorded are not executed `again`. `[capture]` and the
    platform say how runs render. Raises ConfigError if they do not, and the errors of `replay`.
    """
    from sierra.api import observer_for, slots
    from sierra.extensions.videos import capture_runs

    if prefix is None or prefix in project.config.queries:
        prefix = project.records.batch(prefix)
    options = capture_runs.CaptureOptions(slots(jobs), runs, runner, engine, again)
    return capture_runs.capture(project.loaded, project.store, prefix, options, observer or observer_for(progress))
