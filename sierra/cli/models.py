"""`sierra stats --models`: how far models are from the data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import Format, TargetOfBatch
from sierra.cli.output import note
from sierra.cli.sql import Printable, write


def models(
    prefix: Annotated[
        str | None,
        typer.Argument(metavar="HASH", autocompletion=complete.batches, help="Batch id or prefix (default: the last batch)."),
    ] = None,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", autocompletion=complete.models, help="One model (default: all).")
    ] = None,
    target: TargetOfBatch = None,
    format: Annotated[Format, typer.Option("--format", "-f", help="Output format.")] = Format.table,
    file: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write the result to a file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Same as --format json.")] = False,
) -> None:
    """Compare models with the data of a batch.

    The predictions of [models.NAME] are compared with the data, experiment by experiment.
    A deviation is the model's value minus the mean of the runs. bias is the mean deviation, rmse the root of the mean square
    of deviations, and largest the deviation of the largest absolute value, at a time for a model over time. They are taken
    over the points that the model and the data have in common (compared): one, or all such times. inside counts the points
    whose 95 % interval of the mean contains the model. n is the number of runs.

    This executes the command of a model. Exit status 1 means that a model has no prediction.

    \b
    Examples:
      sierra stats --models
      sierra stats --models mean_field -b 722b00
      sierra stats --models -b 722b00 --format csv -o models.csv
    """
    from sierra.cli.open_project import project

    opened = project()
    errors = opened.deliverables.model_errors(opened.records.batch(prefix, target=target), name)
    write(Printable.of_arrow(errors.table), Format.json if as_json else format, file)
    for called, reason in errors.failed.items():
        note(f"model {called} has no prediction: {reason}")
    if errors.failed:
        raise typer.Exit(1)
