"""`sierra plan-n`: how many runs are needed."""

from __future__ import annotations

from typing import Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import MEASURES, MeasureOfRun, OneColumn, OneOutput, Threshold
from sierra.cli.output import note, print_json
from sierra.cli.sql import Format, Printable, write


def plan_n(
    prefix: Annotated[
        str | None,
        typer.Argument(
            metavar="HASH", autocompletion=complete.batches, help="The pilot: a batch id or prefix (default: the last batch)."
        ),
    ] = None,
    half_width: Annotated[
        float, typer.Option("--half-width", "-w", metavar="W", help="Half of the interval's width, in the column's unit.")
    ] = ...,  # type: ignore[assignment]
    column: OneColumn = "",
    table: OneOutput = "",
    measure: MeasureOfRun = None,
    threshold: Threshold = None,
    format: Annotated[Format, typer.Option("--format", "-f", help="Output format.")] = Format.table,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
) -> None:
    """Compute how many runs an interval of a certain width needs.

    The recorded runs of a batch are the pilot. `runs` is the smallest number of runs for which the 95 % interval of the mean is
    mean ± W, if the pilot's standard deviation is the true one. The true one may be larger, so `safe_runs` is the number that
    is enough with a probability of 80 %.

    \b
    Examples:
      sierra plan-n --half-width 0.02 --column coverage
      sierra plan-n 518b -w 5 --measure time_to --threshold 0.5
    """
    from sierra.cli.open_project import project

    found = project().runs_needed(
        prefix,
        half_width=half_width,
        column=column,
        table=table,
        measure=MEASURES[measure] if measure else None,
        threshold=threshold,
    )
    for text in found.notes:
        note(text)
    if as_json:
        print_json(found)
        return
    write(Printable.of_arrow(found.arrow()), format, None)
    if format is Format.table:
        enough = "more than ten million" if found.runs is None else found.runs
        print(f"\nfor {found.measure} {found.column} ± {found.half_width:g}: --runs {enough}")
