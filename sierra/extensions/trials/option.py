"""`sierra run --operator`: the person who supervises trials."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from sierra.errors import UsageError
from sierra.extensions.trials.session import Supervision

if TYPE_CHECKING:
    from sierra.extensions.trials.supervisor import Supervisor
    from sierra.extensions.trials.table import Trials


def of_run(
    context: typer.Context,
    operator: Annotated[
        str | None, typer.Option("--operator", metavar="NAME", help="Who supervises the trials (default: it is asked).")
    ] = None,
) -> Supervision:
    """Return the supervision of the trials of `sierra run` at a terminal."""
    if operator is not None and context.params["inputs"] is not None:
        raise UsageError("--inputs executes nothing; leave out --operator")

    def find(trials: Trials) -> Supervisor | None:
        from sierra.extensions.trials import terminal

        return terminal.supervisor(trials, operator=operator, agreed=context.params["yes"])

    return Supervision(find, operator)
