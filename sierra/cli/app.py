"""All commands, by name. A command's module is imported when the command is used, heavy libraries when it runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from sierra.cli import lazy_parameters
from sierra.cli.lazy_commands import Commands

if TYPE_CHECKING:
    from typer._click.core import Command, Context
    from typer._click.formatting import HelpFormatter

EXIT_CODES = (
    "Exit codes: 0 success; 1 a run failed, results differ, or the store is damaged; "
    "2 usage error; 3 something required is missing; 130 interrupted."
)

GROUPS = {
    "Run": {
        "init": "sierra.cli.init:init",
        "try": "sierra.cli.try_run:try_",
        "run": "sierra.cli.run:run",
        "attach": "sierra.cli.attach:attach",
        "cancel": "sierra.cli.cancel:cancel",
        "replay": "sierra.cli.replay:replay",
        "image": "sierra.cli.image:app",
        "doctor": "sierra.cli.doctor:doctor",
    },
    "Look": {
        "ls": "sierra.cli.ls:ls",
        "show": "sierra.cli.show:show",
        "why": "sierra.cli.why:why",
        "diff": "sierra.cli.diff:diff",
        "sql": "sierra.cli.sql:sql",
        "stats": "sierra.cli.stats:stats",
        "compare": "sierra.cli.compare:compare",
        "plan-n": "sierra.cli.plan_n:plan_n",
        "outputs": "sierra.cli.outputs:outputs",
        "schema": "sierra.cli.schema:schema",
    },
    "Deliver": {
        "figures": "sierra.cli.figures:figures",
        "report": "sierra.cli.report:report",
        "claims": "sierra.cli.claims:claims",
        "paper": "sierra.cli.paper:paper",
    },
    "Share": {
        "package": "sierra.cli.package:package",
        "open": "sierra.cli.open:app",
        "reproduce": "sierra.cli.reproduce:reproduce",
        "source": "sierra.cli.source:app",
    },
    "Keep": {
        "fsck": "sierra.cli.fsck:fsck",
        "gc": "sierra.cli.gc:gc",
        "rm": "sierra.cli.rm:rm",
    },
}
"""The functions and groups of all commands, by what they are for, in the order of `sierra --help`."""
COMMANDS = {name: place for commands in GROUPS.values() for name, place in commands.items()}
FORMER = {
    "status": ("sierra.cli.status:status", "ls --jobs"),
    "files": ("sierra.cli.files:files", "show --files"),
    "inputs": ("sierra.cli.inputs:inputs", "run --inputs"),
    "models": ("sierra.cli.models:models", "stats --models"),
    "baseline": ("sierra.cli.baseline:app", "claims --keep"),
    "cite": ("sierra.cli.cite:cite", "package --cite"),
    "import": ("sierra.cli.import_package:import_", "open FILE.zip import"),
}
"""Former names of commands, which no help shows: the function, and what has replaced it. They go in version 0.2."""


class All(lazy_parameters.Group):
    """The group of all commands."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = cast("dict[str, Command]", Commands(COMMANDS, former=FORMER))  # typer only reads it

    def format_commands(self, ctx: Context, formatter: HelpFormatter) -> None:
        """Write a section for each group of commands."""
        from sierra.config.extensions import sections

        added = sections()
        for title, own in GROUPS.items():
            names = [*own, *(name for name, section in added.items() if section == title and name in self.commands)]
            rows = [(name, self.commands[name].get_short_help_str(formatter.width)) for name in names]
            with formatter.section(title):
                formatter.write_dl(rows)


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
