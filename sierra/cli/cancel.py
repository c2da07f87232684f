"""`sierra cancel`: cancel cluster jobs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sierra.cli.arguments import AsJsonList, ClusterId
from sierra.cli.output import print_json
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.execution.takeover import Cancelled


def cancel(
    prefix: ClusterId = None,
    as_json: AsJsonList = False,
) -> None:
    """Cancel cluster jobs. Finished runs are recorded.

    Without HASH, exactly one batch must have cluster jobs.

    \b
    Examples:
      sierra cancel
      sierra cancel 9e1c
    """
    from sierra.cli import open_project
    from sierra.cli.progress import Display

    project = open_project.project()
    chosen = open_project.last_on_cluster(project, only=True) if prefix is None else prefix
    done = project.jobs.cancel(chosen, observer=Display())
    if as_json:
        print_json(done)
        return
    for batch in done:
        print(_cancelled(batch))


def _cancelled(one: Cancelled) -> str:
    ending = f"; {one.ending} is still cancelling its jobs" if one.ending else ""
    failed = f" ({one.failed} of them failed)" if one.failed else ""
    return f"session {one.session}: {counted(one.kept, 'run')} kept{failed}, {one.missing} not executed{ending}"
