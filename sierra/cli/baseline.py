"""`sierra claims --keep`: keep the results of claims, for later comparisons."""

from __future__ import annotations

from typing import Annotated

import typer

from sierra.cli import complete, lazy_parameters
from sierra.cli.figures import from_here
from sierra.cli.output import note
from sierra.util.text import counted

app = typer.Typer(
    cls=lazy_parameters.Group,
    name="baseline",
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Keep the results of claims, for later comparisons.",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def baseline() -> None:
    """Keep the results of claims, for later comparisons."""


@app.command(name="set", cls=lazy_parameters.Command)
def set_(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the baseline.", show_default=False)],
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[BATCH...|FILE.zip]",
            autocompletion=complete.ids,
            help="Batches, or a package, whose results are kept (default: those of the project as it is now).",
        ),
    ] = None,
) -> None:
    """Write the results of claims to sierra.baselines.json, under a name.

    The file has the values, intervals and numbers of runs that sierra claims --against NAME needs, so it can be committed and
    used without the store. It does not count as source. A baseline of the same name is replaced.

    With batches or a package, each claim is evaluated on the batch with its query, whatever the code of that batch was. Claims
    without such a batch are left out.

    \b
    Examples:
      sierra claims --keep v1
      sierra claims --keep v1 9e1c
      sierra claims --keep published results.zip
    """
    from sierra.cli.open_project import project

    path, kept, left = project().claims.set_baseline(name, *(words or ()))
    if left:
        note(f"left out, because no batch decides them: {', '.join(left)}")
    print(f"{from_here(path)}: baseline {name} with {counted(len(kept), 'claim')}")
