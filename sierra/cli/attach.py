"""`sierra attach`: reattach to a detached batch."""

from __future__ import annotations

from sierra.cli.arguments import AsJson, ClusterId, DrawFigures
from sierra.cli.output import print_json


def attach(
    prefix: ClusterId = None,
    figures: DrawFigures = None,
    as_json: AsJson = False,
) -> None:
    """Reattach to a detached batch and wait for it.

    Finished runs are recorded, and lost runs are submitted again. At the end, the figures are drawn, and the summary is
    printed as by sierra run. Ctrl-C asks whether to detach from the jobs or to cancel them.

    \b
    Examples:
      sierra attach
      sierra attach 9e1c
    """
    from sierra.cli import open_project, render_summary
    from sierra.cli.progress import watching
    from sierra.config import user

    project = open_project.project()
    chosen = open_project.last_on_cluster(project) if prefix is None else prefix
    drawn = user.load().figures if figures is None else figures
    with watching(quiet=as_json) as display:
        summary = project.jobs.attach(chosen, figures=drawn, observer=display)
    if as_json:
        render_summary.print_notes(summary)
        print_json(render_summary.answer(project, summary, {}))
    else:
        render_summary.print_text(project, summary)
    render_summary.leave([summary])
