"""`sierra open FILE.zip import`: add the records of a package to the store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli.arguments import AsJson
from sierra.cli.output import print_json
from sierra.util.text import counted, one_line

if TYPE_CHECKING:
    from sierra.packages.reading.imports import Imported


STATES = {
    True: "its executions count",
    False: "its executions stand beside those that count",
    None: "all its executions were made here",
}


def import_(
    package: Annotated[Path, typer.Argument(metavar="FILE.zip", help="A package.", show_default=False)],
    as_json: AsJson = False,
) -> None:
    """Add the batches of a package to the store.

    Their runs come with executions and outputs. All files and records are checked first; nothing of the package is executed.
    Imported executions are never reused. They do not count in batches that were executed here, or that came in an earlier
    package: there, they stand beside the others.

    \b
    Examples:
      sierra open results.zip import
    """
    from sierra.cli.open_project import project
    from sierra.cli.progress import Display

    done = project().packages.import_records(package, observer=Display())
    if as_json:
        print_json(done)
    else:
        _print(done)


def _print(done: Imported) -> None:
    known = f", {done.known:,} in the store before" if done.known else ""
    replays = f", {done.replays:,} of replays or captures left out" if done.replays else ""
    studies = f", {done.studies:,} of studies left out" if done.studies else ""
    print(one_line(f"package {done.package[:10]}: {done.title}"))
    print(f"{counted(done.executions, 'execution')} added{known}{replays}{studies}")
    for batch in done.batches:
        state = STATES[batch.counts]
        print(one_line(f"batch {batch.batch[:10]}: {batch.query} ({counted(batch.runs, 'run')}): {state}"))
