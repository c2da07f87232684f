"""`sierra open FILE.zip figures`, `report` and `claims`: what the records of a package show."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Annotated

import typer

from sierra.cli.arguments import AsJson, AsJsonList
from sierra.cli.output import note, print_json, readable, table


def figures(
    context: typer.Context,
    names: Annotated[list[str] | None, typer.Argument(metavar="NAME", help="Figures and tables (default: all).")] = None,
    to: Annotated[Path | None, typer.Option("--to", metavar="FOLDER", help="Write their files to this folder.")] = None,
    as_json: AsJsonList = False,
) -> None:
    """List the figures, tables and videos of a package, as they were made.

    Nothing is drawn. With --to, their files are written. Files that no record of the package knows are listed as not recorded.

    \b
    Examples:
      sierra open results.zip figures
      sierra open results.zip figures coverage --to figures
    """
    show(context, names, to, as_json=as_json)


def show(context: typer.Context, names: list[str] | None, to: Path | None, *, kind: str = "", as_json: bool) -> None:
    """List the deliverables of the package in the context: of one kind, by default all; with `to`, write their files there."""
    from sierra.packages.reading import drawn

    deliverables = drawn.find(context.obj, names or (), kind)
    paths = drawn.write(context.obj, deliverables, to) if to is not None else []
    if as_json:
        print_json(deliverables)
    elif to is not None:
        print("".join(f"{readable(str(path))}\n" for path in paths), end="")
    elif deliverables:
        rows = [(readable(row.name), row.kind, row.batch[:10], _formats(row.files)) for row in deliverables]
        table(("name", "kind", "batch", "formats"), rows)
    else:
        note(f"the package has no {kind or 'figure'}s")


def _formats(files: tuple[str, ...]) -> str:
    return readable(", ".join(PurePosixPath(file).suffix[1:] for file in files))


def report(
    context: typer.Context,
    to: Annotated[
        Path | None, typer.Option("--to", metavar="FILE", help="File to write (default: beside the package).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a report of the batches in a package.

    It is made from the records, as sierra report FILE.zip does; nothing of the package is executed. The package itself may have
    the file report.html, which its authors made.

    \b
    Example:
      sierra open results.zip report
    """
    from sierra.cli.progress import telling
    from sierra.cli.report import print_written
    from sierra.packages.reading import report as of_package

    with telling(quiet=as_json) as tell:
        written = of_package.write(context.obj, to, tell)
    print_written(written, as_json=as_json)


def claims(
    context: typer.Context,
    names: Annotated[list[str] | None, typer.Argument(metavar="NAME", help="Claims of the package (default: all).")] = None,
    junit: Annotated[
        Path | None, typer.Option("--junit", metavar="FILE", help="Also write the verdicts as JUnit XML, for CI.")
    ] = None,
    as_json: AsJsonList = False,
) -> None:
    """Evaluate the claims of a package on its recorded runs.

    Nothing of the package is executed: sierra reproduce executes its runs again. The claims are those of the sierra.toml in the
    package, and only its batches decide them.

    Exit status 0 means that all these claims hold. It is 1 otherwise, also if one can't be told.

    \b
    Example:
      sierra open results.zip claims
    """
    from sierra.cli.claims import report as print_verdicts
    from sierra.deliverables.claims import evaluate
    from sierra.packages.reading import received

    package: received.Received = context.obj
    among = received.batches(package.store)
    with package.project.plugins():
        verdicts = evaluate.evaluate(package.project, package.store, names or (), among=among)
    print_verdicts(verdicts, junit, as_json=as_json)


def import_(context: typer.Context, as_json: AsJson = False) -> None:
    """Add the batches of the package to the store here.

    Their runs come with executions and outputs. All files and records are checked first; nothing of the package is executed.
    Imported executions are never reused. They do not count in batches that were executed here, or that came in an earlier
    package: there, they stand beside the others.

    \b
    Examples:
      sierra open results.zip import
    """
    from sierra.cli.import_package import import_ as add

    add(context.obj, as_json)
