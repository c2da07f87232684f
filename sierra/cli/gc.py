"""`sierra gc`: remove what nothing needs."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from sierra.maintenance.gc import Collection


def gc(
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="Only say what would be done.")] = False,
    damaged: Annotated[bool, typer.Option("--damaged", help="Also the segments that sierra fsck --repair put aside.")] = False,
    raw: Annotated[
        bool, typer.Option("--raw", help="Also the bytes of files that became tables; the rows of the tables stay.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Remove what nothing needs, and merge small files.

    Nothing that was recorded is lost, but with --raw, which says what is. Git's refs/sierra/ stay, because other projects may
    share the repository. Where there is no terminal to ask on, --yes is needed.

    \b
    Examples:
      sierra gc --dry-run
      sierra gc --yes
      sierra gc --raw --dry-run
    """
    from sierra.cli import open_project
    from sierra.cli.confirm import agreed
    from sierra.cli.output import print_json
    from sierra.maintenance.gc import text

    project = open_project.project()
    if dry_run:
        found: Collection | None = project.collection(damaged=damaged, raw=raw)
    else:
        found = project.collect(
            damaged=damaged, raw=raw, agree=lambda found: agreed(text(found), yes, as_json, "to be tidied up")
        )
    if found is None:
        print("nothing was done")
        raise typer.Exit(1)
    if as_json:
        print_json({"done": not dry_run, **asdict(found)})
        return
    print("\n".join(text(found)) or "nothing: there is only what is needed")
    if found.recovered:
        print(f"{found.recovered} executions that had finished are recorded now")
    if found.left:
        print(f"{found.left} old segments are still being read; the next sierra gc removes them")
