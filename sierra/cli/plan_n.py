"""`sierra plan-n`: how many runs are needed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import MEASURES, Format, MeasureOfRun, OneColumn, OneOutput, Threshold
from sierra.cli.compare import PAIRED, Pairs
from sierra.cli.output import note, print_json
from sierra.cli.sql import Printable, write
from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.deliverables.power import RunsForPower
    from sierra.deliverables.sample_size import RunsNeeded


def plan_n(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[HASH...]",
            autocompletion=complete.comparisons,
            help="The pilot: a batch id or prefix (default: the last batch). For the power, also two batches to compare.",
        ),
    ] = None,
    half_width: Annotated[
        float | None,
        typer.Option("--half-width", "-w", metavar="W", help="Half of the interval's width, in its unit."),
    ] = None,
    difference: Annotated[
        float | None,
        typer.Option("--difference", "-d", metavar="D", help="The difference of two groups to find, in the column's unit."),
    ] = None,
    power: Annotated[
        float | None, typer.Option("--power", metavar="P", help="The probability of finding the difference (default: 0.8).")
    ] = None,
    runs: Annotated[
        int | None, typer.Option("--runs", metavar="N", help="Also print the power with N runs of each group.")
    ] = None,
    by: Annotated[
        str | None, typer.Option("--by", metavar="VARIABLE", help="Compare values of this variable within the batch.")
    ] = None,
    groups: Annotated[str | None, typer.Option("--groups", metavar="VALUE,VALUE", help="With --by: the two values.")] = None,
    paired: Annotated[
        Pairs | None, typer.Option("--paired", help="Compare runs with the same seed as pairs (default: if they correlate).")
    ] = None,
    alpha: Annotated[
        float | None, typer.Option("--alpha", metavar="P", help="Significance level of all tests together (default: 0.05).")
    ] = None,
    column: OneColumn = "",
    table: OneOutput = "",
    measure: MeasureOfRun = None,
    threshold: Threshold = None,
    format: Annotated[Format, typer.Option("--format", "-f", help="Output format.")] = Format.table,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
) -> None:
    """Compute how many runs an interval or a comparison needs.

    The recorded runs of a batch are the pilot.

    With --half-width, `runs` is the smallest number of runs for which the 95 % interval of the mean is mean ± W, if the pilot's
    standard deviation is the true one. The true one may be larger, so `safe_runs` is the number that is enough with a
    probability of 80 %.

    With --difference, two batches or --by, `runs` is the smallest number of runs of each group with which `sierra compare`
    finds the difference with a probability of 80 % (the power). The pilot is resampled, and tested as in `sierra compare`. The
    groups are two batches, two values of a variable, or each experiment and the same with the difference added.

    \b
    Examples:
      sierra plan-n --half-width 0.02 --column coverage
      sierra plan-n 518b -w 5 --measure time_to --threshold 0.5
      sierra plan-n 518b --difference 0.05 --column coverage
      sierra plan-n 518b 722b --difference 0.05 --power 0.9 --runs 20
      sierra plan-n --by controller --groups CRW,DPO
    """
    from sierra.cli.open_project import project

    reduction = MEASURES[measure] if measure else None
    options = {"--power": power, "--runs": runs, "--by": by, "--groups": groups, "--paired": paired, "--alpha": alpha}
    needed: RunsNeeded | RunsForPower
    if half_width is not None:
        given = [name for name, value in {"--difference": difference, **options}.items() if value is not None]
        if given or len(words or ()) > 1:
            raise UsageError(f"--half-width is about one mean; leave out {given[0] if given else 'the second batch'}")
        needed = project().studies.runs_needed(
            *(words or ()), half_width=half_width, column=column, table=table, measure=reduction, threshold=threshold
        )
    elif difference is None and not by and len(words or ()) < 2:
        raise UsageError("name --half-width W, or what to compare: --difference D, a second batch, or --by VARIABLE")
    else:
        needed = project().studies.runs_for_power(
            *(words or ()),
            difference=difference,
            power=0.8 if power is None else power,
            runs=runs,
            by=by,
            groups=[group.strip() for group in groups.split(",")] if groups else (),
            column=column,
            table=table,
            measure=reduction,
            threshold=threshold,
            paired=PAIRED[paired or Pairs.auto],
            alpha=0.05 if alpha is None else alpha,
        )
    for text in needed.notes:
        note(text)
    if as_json:
        print_json(needed)
        return
    write(Printable.of_arrow(needed.arrow()), format, None)
    if format is Format.table:
        print(f"\n{_conclusion(needed)}")


def _conclusion(needed: RunsNeeded | RunsForPower) -> str:
    """Return the answer in one line."""
    from sierra.deliverables.sample_size import RunsNeeded
    from sierra.stats.words import of_run

    if isinstance(needed, RunsNeeded):
        enough = "more than ten million" if needed.runs is None else needed.runs
        return f"for {of_run(needed.measure, needed.column)} ± {needed.half_width:g}: --runs {enough}"
    enough = "more than 2000" if needed.runs is None else needed.runs
    powers = (comparison.power_with for comparison in needed.comparisons)
    lowest = min((power for power in powers if power is not None), default=None)
    with_runs = ""
    if lowest is not None:
        with_runs = f"; with {needed.asked} runs, it is {'above 0.999' if lowest > 0.999 else f'{lowest:.3g} or more'}"
    return f"for a power of {needed.wanted:g}, {of_run(needed.measure, needed.column)}: --runs {enough}{with_runs}"
