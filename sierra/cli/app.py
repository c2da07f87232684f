"""All commands, by name. A command's module is imported when the command is used, heavy libraries when it runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from sierra.cli import lazy_parameters
from sierra.cli.lazy_commands import Commands

if TYPE_CHECKING:
    from typer._click.core import Command

EXIT_CODES = (
    "Exit codes: 0 success; 1 a run failed, results differ, or the store is damaged; "
    "2 usage error; 3 something required is missing; 130 interrupted."
)

COMMANDS = {
    "init": "sierra.cli.init:init",
    "try": "sierra.cli.try_run:try_",
    "run": "sierra.cli.run:run",
    "inputs": "sierra.cli.inputs:inputs",
    "status": "sierra.cli.status:status",
    "attach": "sierra.cli.attach:attach",
    "cancel": "sierra.cli.cancel:cancel",
    "replay": "sierra.cli.replay:replay",
    "diff": "sierra.cli.diff:diff",
    "compare": "sierra.cli.compare:compare",
    "plan-n": "sierra.cli.plan_n:plan_n",
    "why": "sierra.cli.why:why",
    "ls": "sierra.cli.ls:ls",
    "show": "sierra.cli.show:show",
    "files": "sierra.cli.files:files",
    "outputs": "sierra.cli.outputs:outputs",
    "trial": "sierra.cli.trial:app",
    "sql": "sierra.cli.sql:sql",
    "stats": "sierra.cli.stats:stats",
    "figures": "sierra.cli.figures:figures",
    "paper": "sierra.cli.paper:paper",
    "report": "sierra.cli.report:report",
    "models": "sierra.cli.models:models",
    "claims": "sierra.cli.claims:claims",
    "baseline": "sierra.cli.baseline:app",
    "cite": "sierra.cli.cite:cite",
    "package": "sierra.cli.package:package",
    "open": "sierra.cli.open:app",
    "reproduce": "sierra.cli.reproduce:reproduce",
    "import": "sierra.cli.import_package:import_",
    "fsck": "sierra.cli.fsck:fsck",
    "gc": "sierra.cli.gc:gc",
    "rm": "sierra.cli.rm:rm",
    "doctor": "sierra.cli.doctor:doctor",
    "schema": "sierra.cli.schema:schema",
    "image": "sierra.cli.image:app",
    "source": "sierra.cli.source:app",
}
"""The functions and groups of all commands, in the order of `sierra --help`."""


class All(lazy_parameters.Group):
    """The group of all commands."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = cast("dict[str, Command]", Commands(COMMANDS))  # typer only reads it


app = typer.Typer(
    name="sierra",
    cls=All,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=EXIT_CODES,
)


def _version(wanted: bool) -> None:
    if wanted:
        from sierra.util.version import __version__

        typer.echo(f"sierra {__version__}")
        raise typer.Exit


def _listen(context: typer.Context, level: int) -> int:
    """Print messages to standard error until the command has ended: events at level 1, also details at level 2."""
    if level:
        from sierra.util import lazy_logger
        from sierra.util.log_handlers import Stderr, listen

        context.call_on_close(listen(Stderr(lazy_logger.INFO if level == 1 else lazy_logger.DEBUG)))
    return level


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", help="Print the version.", callback=_version, is_eager=True)] = False,
    verbose: Annotated[
        int,
        typer.Option(
            "-v",
            "--verbose",
            count=True,
            callback=_listen,
            show_default=False,
            help="Log events to standard error; -vv: also commands and runs.",
        ),
    ] = 0,
) -> None:
    """From a research question to results that anyone can verify.

    \b
    Example:
      sierra init --example swarm demo
      cd demo
      sierra try
      sierra run population_size.Log8
      sierra sql "SHOW TABLES"
    """
