"""`sierra rm`: delete batches, experiments, runs or executions."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJson, Yes
from sierra.cli.output import print_json
from sierra.util.text import counted, size

if TYPE_CHECKING:
    from sierra.maintenance.remove import Removal


def rm(
    prefixes: Annotated[
        list[str],
        typer.Argument(
            metavar="HASH",
            autocompletion=complete.ids,
            help="Ids of batches, studies, experiments, runs, executions or registered claims; prefixes are enough. Or "
            "names of queries.",
        ),
    ],
    yes: Yes = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="Only show what would be deleted.")] = False,
    as_json: AsJson = False,
) -> None:
    """Delete recorded batches, studies, runs or executions.

    First shows what will be deleted, and what stays because other batches contain it.

    A batch is deleted completely, and a study with the batches of its looks. For an experiment or a run, the executions are
    deleted, and are executed again when a query needs them. Runs of a deleted batch or experiment that other batches contain
    too keep their executions. Without a terminal for the confirmation, --yes is required.

    \b
    Examples:
      sierra rm 9e1c --dry-run
      sierra rm 9e1c c3e4 --yes
    """
    from sierra.cli import open_project
    from sierra.cli.confirm import agreed
    from sierra.cli.progress import Display

    def agree(removal: Removal) -> bool:
        return removal.nothing or agreed(_lines(removal), yes, as_json, "to be deleted permanently")

    project = open_project.project()
    if dry_run:
        removal: Removal | None = project.records.removal(*prefixes)
    else:
        removal = project.records.remove(*prefixes, agree=agree, observer=Display())
    if removal is None:
        print("nothing was deleted")
        raise typer.Exit(1)
    if as_json:
        print_json({"done": not dry_run, **asdict(removal)})
        return
    if dry_run:
        print("\n".join(_lines(removal)))
    else:
        batches = len(removal.batches)
        print(f"deleted: {batches} batch{'es' * (batches != 1)}, {counted(removal.executions, 'execution')}")
        if removal.left:
            print(f"old files that are still being read: {removal.left}; sierra gc removes them")


def _lines(removal: Removal) -> list[str]:
    from sierra.maintenance.remove import text

    found = [*text(removal), *([f"{size(removal.bytes)} of their output"] if removal.bytes else [])]
    return found if not removal.nothing else ["nothing to delete: there are no executions", *found]
