"""`sierra open FILE.zip claims`: whether the claims of a package hold on its recorded runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sierra.cli.arguments import AsJsonList
from sierra.cli.claims import report


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
    from sierra.deliverables.claims import evaluate
    from sierra.packages.reading import received

    package: received.Received = context.obj
    among = received.batches(package.store)
    report(evaluate.evaluate(package.project, package.store, names or (), among=among), junit, as_json=as_json)
