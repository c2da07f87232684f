"""`sierra status`: show the state of cluster jobs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from sierra.cli import complete


def status(
    prefix: Annotated[
        str | None,
        typer.Argument(
            metavar="HASH",
            autocompletion=complete.sessions,
            help="A batch, or a session, by the beginning of its id (default: all).",
        ),
    ] = None,
    long: Annotated[bool, typer.Option("--long", help="Show whole ids, and cut no text to the width of the terminal.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead.")] = False,
) -> None:
    """Show the state of cluster jobs.

    What has finished of that is recorded first, where no other process follows. The scheduler is asked once for each session,
    how many elements are queued (and why, in its words) and how many are running. A session that is gone has ended with runs
    missing: sierra attach submits them again.

    \b
    Examples:
      sierra status
      sierra status 774d --json
    """
    from sierra.cli import open_project, render_status
    from sierra.cli.output import print_json
    from sierra.cli.progress import Display

    found = open_project.project().status(prefix, observer=Display())
    if as_json:
        print_json([asdict(one) for one in found])
    elif found:
        render_status.show(found, long=long)
    else:
        print("nothing is on a cluster" if prefix is None else f"nothing of {prefix} is on a cluster")
