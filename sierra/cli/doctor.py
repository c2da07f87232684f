"""`sierra doctor`: what is installed, what is missing, and the remedies."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import typer

from sierra.cli.arguments import AsJsonList
from sierra.cli.output import print_json
from sierra.config.extensions import given

if TYPE_CHECKING:
    from sierra.setup.doctor import Check


class OtherChecks(NamedTuple):
    """The checks that an option of an extension makes instead."""

    make: Callable[[], list[Check]]


def doctor(as_json: AsJsonList = False) -> None:
    """Show what is installed, what is missing, and how to fix it.

    The exit code is 3 if something that is needed is missing.

    \b
    Example:
      sierra doctor
    """
    from sierra.setup import doctor

    others = given(OtherChecks)
    checks = others[0].make() if others else doctor.all_checks()
    if as_json:
        print_json(checks)
    else:
        for check in checks:
            print(f"{check.state:8} {check.name}: {check.found}{f' -> {check.remedy}' if check.remedy else ''}")
    if any(check.state == "missing" for check in checks):
        raise typer.Exit(3)
