"""`sierra status`, `sierra attach`, `sierra cancel`: what was submitted to a cluster, from any shell, day or login node."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete

if TYPE_CHECKING:
    from sierra.execution.takeover import Cancelled


def status(
    prefix: Annotated[
        str | None,
        typer.Argument(
            metavar="HASH",
            autocompletion=complete.ids,
            help="A batch, or a session, by the beginning of its id (default: all).",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead.")] = False,
) -> None:
    """Say what is on clusters, and how it stands.

    What has finished of that is recorded first, where no other process follows. The scheduler is asked once for each session,
    how many elements are queued (and why, in its words) and how many are running. A session that is gone has ended with runs
    missing: sierra attach submits them again.

    \b
    Examples:
      sierra status
      sierra status 774d --json
    """
    from sierra.cli import open_project, render_status
    from sierra.cli.output import note, print_json

    found = open_project.project().status(prefix, say=note)
    if as_json:
        print_json([asdict(one) for one in found])
    elif found:
        render_status.show(found)
    else:
        print("nothing is on a cluster" if prefix is None else f"nothing of {prefix} is on a cluster")


def attach(
    prefix: Annotated[
        str,
        typer.Argument(
            metavar="HASH",
            autocompletion=complete.ids,
            help="A batch, or a session of `sierra status`, by the beginning of its id.",
        ),
    ],
    figures: Annotated[
        bool | None, typer.Option("--figures/--no-figures", help="Draw figures, or nothing (default: figures).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Follow to its end what is on a cluster and nobody follows.

    What finishes is recorded, what is lost is submitted again; then the figures are drawn, and all is summed up as by
    sierra run. Ctrl-C asks whether it is to go on by itself.

    \b
    Example:
      sierra attach 774d
    """
    from sierra.cli import open_project, render_summary
    from sierra.cli.output import note
    from sierra.cli.progress import watching
    from sierra.config import user

    project = open_project.project()
    drawn = user.load().figures if figures is None else figures
    with watching(quiet=as_json) as display:
        summary = project.attach(prefix, figures=drawn, watch=display.show, say=note, leave=display.leave)
    render_summary.tell(project, summary, {} if as_json else None)


def cancel(
    prefix: Annotated[
        str,
        typer.Argument(
            metavar="HASH",
            autocompletion=complete.ids,
            help="A batch, or a session of `sierra status`, by the beginning of its id.",
        ),
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead.")] = False,
) -> None:
    """Cancel what is on a cluster; what had finished is recorded.

    \b
    Example:
      sierra cancel 774d
    """
    from sierra.cli import open_project
    from sierra.cli.output import note, print_json

    done = open_project.project().cancel(prefix, say=note)
    if as_json:
        print_json([asdict(one) for one in done])
        return
    for one in done:
        print(_cancelled(one))


def _cancelled(one: Cancelled) -> str:
    from sierra.util.text import counted

    ending = f"; {one.ending} is still ending it" if one.ending else ""
    failed = f" ({one.failed} of them failed)" if one.failed else ""
    return f"session {one.session}: {counted(one.kept, 'run')} kept{failed}, {one.missing} not executed{ending}"
