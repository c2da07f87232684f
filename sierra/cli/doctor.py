"""`sierra doctor`: what is installed, what is missing, and the remedies."""

from __future__ import annotations

import typer

from sierra.cli.arguments import AsJsonList
from sierra.cli.output import print_json


def doctor(
    as_json: AsJsonList = False,
) -> None:
    """Show what is installed, what is missing, and how to fix it.

    \b
    Example:
      sierra doctor
    """
    from sierra.setup import doctor

    found = doctor.all_checks()
    if as_json:
        print_json(found)
    else:
        for check in found:
            print(f"{check.state:8} {check.name}: {check.found}{f' -> {check.remedy}' if check.remedy else ''}")
    if any(check.state == "missing" for check in found):
        raise typer.Exit(3)
