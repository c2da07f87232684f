"""`sierra gc`: remove what nothing needs."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli.arguments import AsJson, Yes
from sierra.cli.output import print_json
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.maintenance.gc import Collection


def gc(
    yes: Yes = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="Only show what would be done.")] = False,
    damaged: Annotated[
        bool,
        typer.Option("--damaged", help="Also remove segments that a repair moved aside, and sessions that cannot be recorded."),
    ] = False,
    raw: Annotated[
        bool, typer.Option("--raw", help="Also remove the bytes of files that became tables; the rows stay.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Remove unneeded files, and merge small ones.

    No recorded data is lost, except with --raw, which reports the loss. Git's refs/sierra/ stay, because other projects may
    share the repository. Without a terminal for the confirmation, --yes is required.

    \b
    Examples:
      sierra gc --dry-run
      sierra gc --yes
      sierra gc --raw --dry-run
    """
    from sierra.cli import open_project
    from sierra.cli.confirm import agreed
    from sierra.cli.progress import Display
    from sierra.maintenance.gc import text

    project = open_project.project()
    if dry_run:
        collection: Collection | None = project.maintenance.collection(damaged=damaged, raw=raw)
    else:
        collection = project.maintenance.collect(
            damaged=damaged,
            raw=raw,
            agree=lambda planned: agreed(text(planned), yes, as_json, "to be removed or merged"),
            observer=Display(),
        )
    if collection is None:
        print("nothing was done")
        raise typer.Exit(1)
    if as_json:
        print_json({"done": not dry_run, **asdict(collection)})
    else:
        _print(collection)
    if collection.unrecorded:
        raise typer.Exit(1)


def _print(found: Collection) -> None:
    from sierra.maintenance.gc import text

    print("\n".join(text(found)) or ("nothing was removed" if found.unrecorded else "nothing to remove: everything is needed"))
    if found.recovered:
        print(f"recorded {counted(found.recovered, 'finished execution')} of sessions that died")
    if found.left:
        print(f"old segments that are still being read: {found.left}; the next sierra gc removes them")
