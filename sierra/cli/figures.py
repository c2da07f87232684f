"""`sierra figures`: draw a batch's figures again."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.output import note, print_json, readable
from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.deliverables.record import Checked


def figures(
    prefix: Annotated[
        str | None,
        typer.Argument(metavar="HASH", autocompletion=complete.batches, help="Batch id or prefix (default: the last batch)."),
    ] = None,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", autocompletion=complete.figures, help="One figure (default: all).")
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(
            "--target",
            metavar="NAME[,NAME...]",
            autocompletion=complete.targets,
            help="The last batch of this target instead; several targets are drawn together.",
        ),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Draw nothing; check that drawn figures still follow from the store.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list of files instead of text.")] = False,
) -> None:
    """Draw the figures of a batch again.

    Figures are drawn from recorded results; nothing is executed. With several targets, the last batches of one query are drawn
    together, with a line for each target: those of the query of HASH, or of the last query for any of these targets. Their runs
    must be pairs, with the same values and seeds. With --check, nothing is drawn: exit status 1
    means that a file was changed or removed since it was drawn, or that the store has other data now.

    \b
    Examples:
      sierra figures
      sierra figures 3f9a1c
      sierra figures --target robots
      sierra figures --target sim,robots
      sierra figures 3f9a1c swarm_coverage_summary
      sierra figures 3f9a1c --check
    """
    from sierra.cli.open_project import project

    opened = project()
    if check:
        if name is not None:
            raise UsageError("--check checks all figures of a batch; leave out the figure's name")
        _check(opened.check_figures(opened.batch(prefix, target=target)), as_json=as_json)
        return
    if target is not None and "," in target:
        paths, notes = opened.draw_together(target.split(","), prefix, name)
    else:
        paths, notes = opened.draw(opened.batch(prefix, target=target), name)
    for text in notes:
        note(text)
    if as_json:
        print_json([str(path) for path in paths])
    else:
        for path in paths:
            print(from_here(path))


def _check(found: Sequence[Checked], *, as_json: bool) -> None:
    """Print the state of each figure; end with exit status 1 if one does not follow from the store."""
    if as_json:
        print_json([asdict(one) for one in found])
    else:
        for one in found:
            print(f"{one.name}: {readable(one.problem or 'follows from the store')}")
        if not found:
            note("no figure of this batch has been drawn; draw them with: sierra figures")
    if any(one.problem for one in found):
        raise typer.Exit(1)


def from_here(path: str | os.PathLike[str]) -> str:
    """Return a path in its shortest form: relative to the working directory, or as it is."""
    whole = os.fspath(path)
    return min(os.path.relpath(whole), whole, key=len)
