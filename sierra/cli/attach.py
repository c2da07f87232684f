"""`sierra attach`: reattach to a detached batch."""

from __future__ import annotations

from typing import Annotated

import typer

from sierra.cli import complete


def attach(
    prefix: Annotated[
        str,
        typer.Argument(
            metavar="HASH",
            autocompletion=complete.sessions,
            help="A batch, or a session of `sierra status`, by the beginning of its id.",
        ),
    ],
    figures: Annotated[
        bool | None, typer.Option("--figures/--no-figures", help="Draw figures, or nothing (default: figures).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Reattach to a detached batch and wait for it.

    What finishes is recorded, what is lost is submitted again; then the figures are drawn, and all is summed up as by
    sierra run. Ctrl-C asks whether it is to go on by itself.

    \b
    Example:
      sierra attach 774d
    """
    from sierra.cli import open_project, render_summary
    from sierra.cli.progress import watching
    from sierra.config import user

    project = open_project.project()
    drawn = user.load().figures if figures is None else figures
    with watching(quiet=as_json) as display:
        summary = project.attach(prefix, figures=drawn, observer=display)
    render_summary.tell(project, summary, {} if as_json else None)
