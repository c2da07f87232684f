"""`sierra open FILE.zip report`: write the report of a package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sierra.cli.arguments import AsJson


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
