"""`sierra cancel`: cancel cluster jobs."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete

if TYPE_CHECKING:
    from sierra.execution.takeover import Cancelled


def cancel(
    prefix: Annotated[
        str,
        typer.Argument(
            metavar="HASH",
            autocompletion=complete.sessions,
            help="Batch id, or session id from `sierra status`; a prefix is enough.",
        ),
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead of text.")] = False,
) -> None:
    """Cancel cluster jobs. Finished runs are recorded.

    \b
    Example:
      sierra cancel 774d
    """
    from sierra.cli import open_project
    from sierra.cli.output import print_json
    from sierra.cli.progress import Display

    done = open_project.project().cancel(prefix, observer=Display())
    if as_json:
        print_json([asdict(one) for one in done])
        return
    for one in done:
        print(_cancelled(one))


def _cancelled(one: Cancelled) -> str:
    from sierra.util.text import counted

    ending = f"; {one.ending} is still cancelling its jobs" if one.ending else ""
    failed = f" ({one.failed} of them failed)" if one.failed else ""
    return f"session {one.session}: {counted(one.kept, 'run')} kept{failed}, {one.missing} not executed{ending}"
