"""`sierra rm`: delete batches, experiments, runs or executions."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete

if TYPE_CHECKING:
    from sierra.maintenance.remove import Removal


def rm(
    prefixes: Annotated[
        list[str],
        typer.Argument(
            metavar="HASH...",
            autocompletion=complete.ids,
            help="Batches, experiments, runs or executions, by the beginning of their ids.",
        ),
    ],
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="Only say what would be deleted.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Delete recorded batches, experiments, runs or executions.

    What goes, and what stays because others have it, is said first.

    A batch goes whole; of an experiment or a run, what was executed goes, and is executed again when it is asked for. Runs of a
    batch or an experiment that others have too keep their executions. Where there is no terminal to ask on, --yes is needed.

    \b
    Examples:
      sierra rm 774d --dry-run
      sierra rm 774d 03ab --yes
    """
    from sierra.cli import open_project
    from sierra.cli.confirm import agreed
    from sierra.cli.output import print_json

    def agree(found: Removal) -> bool:
        return found.nothing or agreed(_lines(found), yes, as_json, "to be deleted, for good")

    project = open_project.project()
    if dry_run:
        removal: Removal | None = project.removal(*prefixes)
    else:
        removal = project.remove(*prefixes, agree=agree)
    if removal is None:
        print("nothing was deleted")
        raise typer.Exit(1)
    if as_json:
        print_json({"done": not dry_run, **asdict(removal)})
        return
    if dry_run:
        print("\n".join(_lines(removal)))
    else:
        print(f"deleted: {len(removal.batches)} batches, {removal.executions} executions")
        if removal.left:
            print(f"{removal.left} old files are still being read; sierra gc removes them")


def _lines(removal: Removal) -> list[str]:
    from sierra.cli.output import size
    from sierra.maintenance.remove import text

    found = [*text(removal), *([f"{size(removal.bytes)} that these wrote"] if removal.bytes else [])]
    return found if not removal.nothing else ["nothing: there is no execution of it", *found]
