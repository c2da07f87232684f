"""`sierra open`: read the records of a received package."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from sierra.cli import lazy_parameters
from sierra.cli.app import COMMANDS
from sierra.cli.app import FORMER as NAMES
from sierra.cli.lazy_commands import Commands
from sierra.util.text import counted, one_line

if TYPE_CHECKING:
    from typer._click.core import Command

    from sierra.packages.reading.received import Received

READING = ("ls", "show", "sql", "stats", "outputs", "compare", "diff", "why", "fsck")
"""Commands that read records, and execute nothing of the package."""
FORMER = {"files": NAMES["files"]}
OF_PACKAGES = {name: f"sierra.cli.open_results:{name}" for name in ("figures", "report", "claims")} | {
    "import": "sierra.cli.open_results:import_"
}
"""Commands that differ from those of projects: they read the package, which their context has."""


class Reading(lazy_parameters.Group):
    """The group of the commands that read a package."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = cast(
            "dict[str, Command]", Commands({name: COMMANDS[name] for name in READING} | OF_PACKAGES, "open ", FORMER)
        )


app = typer.Typer(name="open", cls=Reading, invoke_without_command=True, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.callback()
def open_(
    context: typer.Context,
    package: Annotated[Path, typer.Argument(metavar="FILE.zip", help="A package.", show_default=False)],
) -> None:
    """Show a package, or run a command that reads its records.

    Nothing of the package is executed. The records are checked, and extracted to your cache.

    \b
    Examples:
      sierra open results.zip
      sierra open results.zip ls
      sierra open results.zip sql "SELECT * FROM runs"
      sierra open results.zip claims
      sierra open results.zip figures --to figures
      sierra open results.zip report
      sierra open results.zip import
    """
    if context.invoked_subcommand == "import":  # it writes to the store of the project here
        context.obj = package
        return
    from sierra.cli import open_project
    from sierra.packages.reading import received

    opened = received.open_package(package)
    context.obj = opened
    context.with_resource(open_project.using(opened.project.root))
    if context.invoked_subcommand is None:
        print("\n".join(map(one_line, _lines(opened))))


def _lines(opened: Received) -> Iterator[str]:
    described = opened.manifest
    yield f"package {opened.id[:10]}: {described.title}, {described.date}"
    if described.redacted:
        yield "anonymous: hosts, folders, commits and times in its records are not the original ones"
    for batch in described.batches:
        runs = f"{counted(batch.runs, 'run')}, {batch.successful:,} successful"
        yield f"batch {batch.batch[:10]}: {batch.query} ({counted(batch.experiments, 'experiment')}, {runs})"
    for source in described.sources:
        yield f"source {source.tree}: {source.folder}"
    yield from described.notes
    yield from opened.notes
