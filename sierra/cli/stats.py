"""`sierra stats`: the numbers that figures are drawn from."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import Format, Measure, MeasureOfRun, TargetOfBatch, Threshold, names_of_given
from sierra.cli.sql import Printable, write, write_text
from sierra.errors import UsageError


class Times(StrEnum):
    """The times of the rows."""

    own = "own"
    carry = "carry"
    linear = "linear"


class Shown(StrEnum):
    """The format of the statistics."""

    table = "table"
    csv = "csv"
    json = "json"
    parquet = "parquet"
    markdown = "markdown"
    latex = "latex"
    html = "html"


PAPER = (Shown.markdown, Shown.latex, Shown.html)
"""The formats of tables for papers."""


def named(words: Sequence[str]) -> tuple[str, ...]:
    """Return the names in words that separate them by commas."""
    names = tuple(name.strip() for word in words for name in word.split(","))
    if not all(names):
        raise UsageError("--statistic: a name is empty; write, for example, --statistic median,q90")
    return names


def stats(
    output: Annotated[
        str | None,
        typer.Argument(
            metavar="OUTPUT",
            autocompletion=complete.tables,
            help="The output or derived table, as listed by SHOW TABLES in SQL. With --models: one model (default: all).",
        ),
    ] = None,
    column: Annotated[
        str | None, typer.Argument(metavar="COLUMN", autocompletion=complete.columns, help="A column of the output.")
    ] = None,
    batch: Annotated[
        str | None,
        typer.Option(
            "--batch",
            "-b",
            metavar="HASH",
            autocompletion=complete.batches,
            help="Batch id or prefix (default: the last batch).",
        ),
    ] = None,
    target: TargetOfBatch = None,
    measure: MeasureOfRun = None,
    threshold: Threshold = None,
    times: Annotated[
        Times | None,
        typer.Option(
            "--times", help="Print a row for each time: the runs' own, or common times (values carried, interpolated)."
        ),
    ] = None,
    statistic: Annotated[
        list[str] | None,
        typer.Option(
            "--statistic",
            "-s",
            metavar="NAME",
            help="Print only these, each with its interval: mean, median, iqm, sd, iqr, mad, range, quantiles such as q90, "
            "or a plug-in (several: separated by commas, or repeated).",
        ),
    ] = None,
    where: Annotated[
        str, typer.Option("--where", metavar="CONDITION", help="Use only the rows that fulfil this SQL condition.")
    ] = "",
    format: Annotated[
        Shown,
        typer.Option(
            "--format", "-f", help="Output format; markdown, latex and html: a table for papers, with rounded numbers."
        ),
    ] = Shown.table,
    caption: Annotated[str, typer.Option("--caption", metavar="TEXT", help="Caption of a table for papers.")] = "",
    label: Annotated[
        str, typer.Option("--label", metavar="NAME", help="Label of a table for papers, such as tab:coverage.")
    ] = "",
    file: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write the result to a file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Same as --format json.")] = False,
    with_models: Annotated[bool, typer.Option("--models", help="Compare the models of sierra.toml with the data.")] = False,
) -> None:
    """Compute statistics of a column over runs of each experiment.

    Prints n, mean, sd, the 95 % interval of the mean (low, high), median, quartiles, whiskers, range, the interquartile mean
    (iqm) with its interval, and the number of missing or infinite values, or of runs that never reached the threshold. A column
    of true and false is a rate: its interval is Wilson's, as the column `interval` shows. So is a column of 0 and 1 that
    `rates` in [outputs.OUTPUT] names.

    With --measure time_to, runs that never reach the threshold are not dropped: km_median and restricted_mean count them
    as censored at their last time. With --times own, the Kaplan-Meier curve is printed: the part of the runs that has not
    reached the threshold.

    With --models, the predictions of [models.NAME] are compared with the data, experiment by experiment. A deviation is the
    model's value minus the mean of the runs. bias is the mean deviation, rmse the root of the mean square of deviations, and
    largest the deviation of the largest absolute value, at a time for a model over time. They are taken over the points that
    the model and the data have in common (compared): one, or all such times. inside counts the points whose 95 % interval of
    the mean contains the model. n is the number of runs. This executes the command of a model. Exit status 1 means that a model
    has no prediction.

    Controllers and scenarios are shown by their labels; csv, json and parquet have their names.

    \b
    Examples:
      sierra stats swarm coverage
      sierra stats swarm coverage -b 9e1c --format latex -o coverage.tex
      sierra stats distances distance        # made by [tables.distances]
      sierra stats swarm coverage --measure time_to --threshold 0.5
      sierra stats swarm coverage --measure time_to --threshold 0.5 --times own
      sierra stats swarm coverage --statistic median,q90
      sierra stats swarm coverage --where "tick >= 100" --measure mean
      sierra stats swarm coverage --times own --format csv -o coverage.csv
      sierra stats --models mean_field -b 722b00
    """
    from sierra.cli.open_project import project
    from sierra.deliverables.run_statistics import WITH_TIMES, StatisticsResult

    if with_models:
        others = {"COLUMN": column, "--measure": measure, "--threshold": threshold, "--times": times, "--statistic": statistic}
        others |= {"--where": where}
        if refused := names_of_given({**others, "--caption": caption, "--label": label}):
            raise UsageError(f"--models compares all that a model predicts; leave out {refused}")
        if format.value not in set(Format):
            raise UsageError(f"--models has no table for papers; use --format {', '.join(Format)}")
        from sierra.cli.models import models
        from sierra.cli.open_project import refuse_in_package

        refuse_in_package("--models", "executes the commands of models")
        models(batch, output, target, Format(format.value), file, as_json)
        return
    if output is None or column is None:
        raise UsageError(
            "name an OUTPUT and a COLUMN, as in: sierra stats swarm coverage; SHOW TABLES in SQL lists the outputs"
        )
    if (measure is Measure.time_to) != (threshold is not None):
        raise UsageError("--measure time_to and --threshold X must be used together")
    if times and measure and (measure, times) not in WITH_TIMES:
        raise UsageError("--times gives a row for each time, --measure one for each experiment; choose one of them")
    reduced = measure.value if measure else None if times else "auto"
    format = Shown.json if as_json else format
    if (caption or label) and format not in PAPER:
        raise UsageError("--caption and --label need a table for papers: --format latex, markdown or html")
    opened = project()
    table = opened.statistics(
        opened.records.batch(batch, target=target),
        output,
        column,
        measure=reduced,
        threshold=threshold,
        times=times and times.value,
        statistics=named(statistic or (["mean"] if format in PAPER else [])),
        where=where,
    )
    if format in PAPER:
        write_text(opened.paper.table(table, format.value, caption=caption, label=label), file)
    else:
        shown = table.with_labels() if format is Shown.table and isinstance(table, StatisticsResult) else table
        write(Printable.of_arrow(shown.arrow), Format(format.value), file)
