"""`sierra figures`: draw a batch's figures again."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import TargetOfBatch
from sierra.cli.output import note, print_json


def figures(
    prefix: Annotated[
        str | None,
        typer.Argument(metavar="HASH", autocompletion=complete.batches, help="Batch id or prefix (default: the last batch)."),
    ] = None,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", autocompletion=complete.figures, help="One figure (default: all).")
    ] = None,
    target: TargetOfBatch = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list of files instead of text.")] = False,
) -> None:
    """Draw the figures of a batch again.

    Figures are drawn from recorded results; nothing is executed.

    \b
    Examples:
      sierra figures
      sierra figures 3f9a1c
      sierra figures --target robots
      sierra figures 3f9a1c swarm_coverage_summary
    """
    from sierra.cli.open_project import project

    opened = project()
    paths, notes = opened.draw(opened.batch(prefix, target=target), name)
    for text in notes:
        note(text)
    if as_json:
        print_json([str(path) for path in paths])
    else:
        for path in paths:
            print(from_here(path))


def from_here(path: str | os.PathLike[str]) -> str:
    """Return a path in its shortest form: relative to the working directory, or as it is."""
    whole = os.fspath(path)
    return min(os.path.relpath(whole), whole, key=len)
