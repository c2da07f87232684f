"""`sierra collect`: record runs that another system has executed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli.arguments import AsJson, DrawFigures

if TYPE_CHECKING:
    from sierra.extensions.collect.collection import Collection

SHOWN = 5
"""The number of runs that are named."""


def collect(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The folder that sierra run --inputs wrote.")],
    trust: Annotated[
        bool,
        typer.Option("--trust", help="Let the executions count as if the programs of this machine had executed them."),
    ] = False,
    figures: DrawFigures = None,
    as_json: AsJson = False,
) -> None:
    """Record runs that another system has executed.

    It has executed them from the folder of sierra run --inputs. A run has ended if its folder has ended.json, which execute.sh
    in FOLDER writes. Its outputs are copied; FOLDER stays as it is. A run is refused if its input files or its command are not
    those that sierra run --inputs wrote. Runs that have not ended are counted; collect again when they have. Nothing is
    recorded twice.

    Nobody knows which programs have executed the runs. Statistics and figures use them until the query is executed here:
    sierra run executes all of its runs. With --trust, it reuses the collected ones.

    Exit status 1 means that a run has failed or was refused.

    \b
    Examples:
      sierra collect ../inputs
      sierra collect ../inputs --trust
      sierra collect ../inputs --json
    """
    from sierra.cli import render_summary
    from sierra.cli.open_project import project
    from sierra.cli.output import print_json
    from sierra.cli.progress import watching
    from sierra.config import user
    from sierra.extensions import collect as extension
    from sierra.util.lazy_definitions import replace

    opened = project()
    draws = user.load().figures if figures is None else figures
    with watching(quiet=as_json) as display:
        collection = extension.collect(opened, folder, trust=trust, figures=draws, observer=display)
    summary = collection.summary
    if summary is not None:
        summary = replace(summary, selected=None, left_out=0, notes=(*collection.notes, *summary.notes))
    if as_json:
        names = ("runs", "ended", "known", "failed", "waiting", "refused")
        more = {"collected": {name: getattr(collection, name) for name in names}}
        print_json(render_summary.answer(opened, summary, more) if summary else {"batch": collection.batch, **more})
    elif summary is not None:
        render_summary.print_text(opened, summary)
    if not as_json:
        _print(collection)
    if summary is not None and summary.interrupted:
        raise typer.Exit(130)
    if collection.failed or collection.refused:
        raise typer.Exit(1)


def _print(collection: Collection) -> None:
    from sierra.util.text import counted, few

    known = f", {collection.known} recorded before" if collection.known else ""
    failed = f", {collection.failed} failed" if collection.failed else ""
    print(f"collected from {collection.folder}: {collection.ended} of {counted(collection.runs, 'run')}{known}{failed}")
    if waiting := collection.waiting:
        print(f"{counted(len(waiting), 'run')} not ended: {few(list(waiting), SHOWN)}")
    for name, reason in list(collection.refused.items())[:SHOWN]:
        print(f"refused: {name}: {reason}")
    if len(collection.refused) > SHOWN:
        print(f"and {len(collection.refused) - SHOWN} more refused")
