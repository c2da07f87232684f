"""`sierra doctor`: what is installed, what is missing, and the remedies."""

from __future__ import annotations

from typing import Annotated

import typer

from sierra.cli.arguments import AsJsonList
from sierra.cli.output import print_json


def doctor(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="HOST", help="With --hosts: robots of the fleet, or hosts as in `ssh HOST`."),
    ] = None,
    hosts: Annotated[
        bool, typer.Option("--hosts", help="Check hosts over SSH instead: those named, or the fleet of the runner robots.")
    ] = False,
    link: Annotated[
        str | None, typer.Option("--link", metavar="NAME", help="With --hosts: the link to use, fabric or openssh.")
    ] = None,
    as_json: AsJsonList = False,
) -> None:
    """Show what is installed, what is missing, and how to fix it.

    The exit code is 3 if something that is needed is missing.

    \b
    Example:
      sierra doctor
      sierra doctor --hosts robot1 robot2
    """
    from sierra.errors import UsageError
    from sierra.setup import doctor, host_checks

    if not hosts and (names or link):
        raise UsageError("hosts are checked with --hosts, for example: sierra doctor --hosts robot1")
    found = host_checks.all_checks(names or (), link) if hosts else doctor.all_checks()
    if as_json:
        print_json(found)
    else:
        for check in found:
            print(f"{check.state:8} {check.name}: {check.found}{f' -> {check.remedy}' if check.remedy else ''}")
    if any(check.state == "missing" for check in found):
        raise typer.Exit(3)
