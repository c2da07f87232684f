"""Confirmation before something is removed."""

from __future__ import annotations

import sys

import typer

from sierra.errors import UsageError


def agreed(lines: list[str], yes: bool, quiet: bool, what: str) -> bool:
    """Return whether to continue: true with --yes, else the answer on a terminal. Raises UsageError if there is neither."""
    if not yes and not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise UsageError(f"{what}: {'; '.join(lines)}; no terminal to confirm on; use --yes")
    if not quiet:
        print(f"{what}:\n" + "\n".join(f"  {line}" for line in lines))
    return yes or typer.confirm("continue?", default=False)
