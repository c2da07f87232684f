"""All commands, by name. Heavy libraries are imported only when a command runs."""

from __future__ import annotations

from typing import Annotated

import typer

from sierra.cli import (
    attach,
    cancel,
    diff,
    doctor,
    figures,
    files,
    fsck,
    gc,
    image,
    init,
    inputs,
    lazy_parameters,
    ls,
    outputs,
    replay,
    rm,
    run,
    schema,
    show,
    source,
    sql,
    stats,
    status,
    try_run,
    why,
)

EXIT_CODES = (
    "Exit codes: 0 success; 1 a run failed, results differ, or the store is damaged; "
    "2 usage error; 3 something required is missing; 130 interrupted."
)

app = typer.Typer(
    name="sierra",
    cls=lazy_parameters.Group,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=EXIT_CODES,
)


def _version(wanted: bool) -> None:
    if wanted:
        from sierra.version import __version__

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


for command in (
    init.init,
    try_run.try_,
    run.run,
    inputs.inputs,
    status.status,
    attach.attach,
    cancel.cancel,
    replay.replay,
    diff.diff,
    why.why,
    ls.ls,
    show.show,
    files.files,
    outputs.outputs,
    sql.sql,
    stats.stats,
    figures.figures,
    fsck.fsck,
    gc.gc,
    rm.rm,
    doctor.doctor,
    schema.schema,
):
    app.command(command.__name__.rstrip("_"), cls=lazy_parameters.Command)(command)

for group in (image.app, source.app):
    app.add_typer(group)
