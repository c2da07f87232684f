"""`sierra doctor --hosts`: check hosts over SSH."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from sierra.cli.doctor import OtherChecks
from sierra.errors import UsageError


def checked(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="HOST", help="With --hosts: robots of the fleet, or hosts as in `ssh HOST`.")
    ] = None,
    hosts: Annotated[
        bool, typer.Option("--hosts", help="Check hosts over SSH instead: those named, or the fleet of robots and all labs.")
    ] = False,
    link: Annotated[
        str | None, typer.Option("--link", metavar="NAME", help="With --hosts: the link to use, fabric or openssh.")
    ] = None,
) -> OtherChecks | None:
    from sierra.extensions.hosts import host_checks

    if hosts:
        return OtherChecks(partial(host_checks.all_checks, names or (), link))
    if names or link:
        raise UsageError("hosts are checked with --hosts, for example: sierra doctor --hosts robot1")
    return None
