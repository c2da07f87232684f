"""`sierra doctor`: what is installed, what is missing, and the remedies."""

from __future__ import annotations

from typing import Annotated

import typer


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead of text.")] = False,
) -> None:
    """Show what is installed, what is missing, and how to fix it.

    \b
    Example:
      sierra doctor
    """
    from dataclasses import asdict

    from sierra.cli.output import print_json
    from sierra.setup import doctor

    found = doctor.all_checks()
    if as_json:
        print_json([asdict(check) for check in found])
    else:
        for check in found:
            print(f"{check.state:8} {check.name}: {check.found}{f' -> {check.remedy}' if check.remedy else ''}")
    if any(check.state == "missing" for check in found):
        raise typer.Exit(3)
