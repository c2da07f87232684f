"""`sierra ls --jobs`: show the state of cluster jobs."""

from __future__ import annotations

from typing import Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJsonList, Long
from sierra.cli.output import print_json


def status(
    prefix: Annotated[
        str | None,
        typer.Argument(
            metavar="HASH",
            autocompletion=complete.sessions,
            help="Batch id or session id; a prefix is enough (default: all).",
        ),
    ] = None,
    long: Long = False,
    as_json: AsJsonList = False,
) -> None:
    """Show the state of cluster jobs.

    First records finished runs of sessions that no other process follows. Queries the scheduler once for each session: how many
    array tasks are queued (with the scheduler's reason), and how many are running. State "gone": the jobs ended with runs
    missing; sierra attach submits these runs again.

    \b
    Examples:
      sierra ls --jobs
      sierra ls --jobs 9e1c --json
    """
    from sierra.cli import open_project, render_status
    from sierra.cli.progress import Display

    sessions = open_project.project().jobs.status(prefix, observer=Display())
    if as_json:
        print_json(sessions)
    elif sessions:
        render_status.show(sessions, long=long)
    else:
        print("no cluster jobs" if prefix is None else f"no cluster jobs of {prefix}")
