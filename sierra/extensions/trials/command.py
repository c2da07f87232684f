"""`sierra trial`: remarks on executions that people supervised."""

from __future__ import annotations

from typing import Annotated

import typer

from sierra.cli import complete, lazy_parameters
from sierra.util.hashing import short

app = typer.Typer(
    cls=lazy_parameters.Group,
    name="trial",
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Mark trials as invalid or valid, and add notes.",
    context_settings={"help_option_names": ["-h", "--help"]},
)

Execution = Annotated[
    str,
    typer.Argument(
        metavar="EXECUTION",
        autocompletion=complete.ids,
        help="The execution, or a run: its effective execution.",
        show_default=False,
    ),
]
Reason = Annotated[str, typer.Option("--reason", help="Why the trial does not count, in one line.", show_default=False)]
Note = Annotated[str | None, typer.Option("--note", help="A note, in one line.", show_default=False)]
Operator = Annotated[str | None, typer.Option("--operator", help="Who supervised the trial.", show_default=False)]


@app.callback()
def trial() -> None:
    """Mark trials as invalid or valid, and add notes."""


@app.command(cls=lazy_parameters.Command)
def invalid(execution: Execution, reason: Reason, note: Note = None, operator: Operator = None) -> None:
    """Mark an execution as an invalid trial: it is kept, but does not count.

    No statistic and no figure uses it any more, and the next request of its batch executes its run again. The mark is a new
    record; nothing is changed or deleted.

    \b
    Examples:
      sierra trial invalid EXECUTION --reason "robot 2 was switched off"
      sierra trial invalid EXECUTION --reason "wrong arena" --operator Ada
    """
    marked = _mark(execution, valid=False, reason=reason, note=note, operator=operator)
    print(f"execution {short(marked)}: invalid ({reason.strip()}); request its batch again to execute its run once more")


@app.command(cls=lazy_parameters.Command)
def valid(execution: Execution, note: Note = None, operator: Operator = None) -> None:
    """Mark an execution as a valid trial again, so that it counts if it succeeded.

    \b
    Example:
      sierra trial valid EXECUTION --note "the robot only lost its hat"
    """
    print(f"execution {short(_mark(execution, valid=True, note=note, operator=operator))}: valid")


@app.command(cls=lazy_parameters.Command)
def note(
    execution: Execution,
    text: Annotated[str, typer.Argument(metavar="NOTE", help="The note, in one line.", show_default=False)],
    operator: Operator = None,
) -> None:
    """Add a note to an execution; the last note counts.

    \b
    Example:
      sierra trial note EXECUTION "the floor was wet"
    """
    print(f"execution {short(_mark(execution, note=text, operator=operator))}: {text.strip()}")


def _mark(
    execution: str, *, valid: bool | None = None, reason: str | None = None, note: str | None, operator: str | None
) -> str:
    from sierra.cli.open_project import project
    from sierra.extensions.trials import mark_trial

    return str(mark_trial(project(), execution, valid=valid, reason=reason, note=note, operator=operator).execution)
