"""`sierra compare`: compare groups of runs by tests."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from textwrap import fill, wrap
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sierra.cli import complete
from sierra.cli.arguments import MEASURES, Format, Long, MeasureOfRun, OneColumn, OneOutput, Threshold, names_of_given
from sierra.cli.figures import from_here
from sierra.cli.output import note, print_json, terminal_width
from sierra.cli.output import table as table_of
from sierra.cli.sql import Printable, write, write_text
from sierra.cli.stats import PAPER, Shown
from sierra.errors import Missing, UsageError

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.deliverables.comparison import Compared
    from sierra.stats.comparison.model import Pair


WIDEST = 100
"""The largest number of columns of what is printed on a terminal."""


class Pairs(StrEnum):
    """The choices for runs with the same seed: pairs, independent, or pairs if that helps."""

    auto = "auto"
    yes = "yes"
    no = "no"


PAIRED: dict[Pairs, bool | Literal["auto"]] = {Pairs.auto: "auto", Pairs.yes: True, Pairs.no: False}


def compare(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME | HASH...]",
            autocompletion=complete.comparisons,
            help="A comparison in sierra.toml; or batches: ids, prefixes, names of queries, or packages (FILE.zip or "
            "FILE.zip:HASH), each also as LABEL=HASH (default: the last batch).",
        ),
    ] = None,
    by: Annotated[
        str | None,
        typer.Option(
            "--by",
            metavar="VARIABLE[,VARIABLE...]",
            help="Within one batch: the variable whose values are compared; several give main effects and interactions.",
        ),
    ] = None,
    groups: Annotated[
        str | None, typer.Option("--groups", metavar="VALUE,VALUE[,...]", help="With --by: only these values, in this order.")
    ] = None,
    against: Annotated[
        str | None, typer.Option("--against", metavar="GROUP", help="Compare all other groups with this one only.")
    ] = None,
    column: OneColumn = "",
    table: OneOutput = "",
    measure: MeasureOfRun = None,
    threshold: Threshold = None,
    over_time: Annotated[
        bool, typer.Option("--over-time", help="Draw the difference over time; test the mean of each run's rows.")
    ] = False,
    method: Annotated[
        str | None,
        typer.Option(
            "--method",
            metavar="NAME",
            autocompletion=complete.comparison_methods,
            help="How groups are tested: signed_rank, friedman, rank_sum, kruskal, mcnemar, fisher, log_rank, aligned_ranks, "
            "or a plug-in (default: what suits the data).",
        ),
    ] = None,
    paired: Annotated[
        Pairs | None, typer.Option("--paired", help="Compare runs with the same seed as pairs (default: if they correlate).")
    ] = None,
    margin: Annotated[
        float | None,
        typer.Option("--margin", metavar="X", help="Also test whether groups differ by less than X, in the column's unit."),
    ] = None,
    alpha: Annotated[
        float | None, typer.Option("--alpha", metavar="P", help="Significance level of all tests together (default: 0.05).")
    ] = None,
    figure: Annotated[
        bool, typer.Option("--figure/--no-figure", help="Draw the figure of differences (default) or not.")
    ] = True,
    format: Annotated[
        Shown,
        typer.Option(
            "--format",
            "-f",
            help="Output format; markdown, latex and html: table, text and figure for papers, with rounded numbers.",
        ),
    ] = Shown.table,
    caption: Annotated[str, typer.Option("--caption", metavar="TEXT", help="Caption of a table for papers.")] = "",
    label: Annotated[
        str, typer.Option("--label", metavar="NAME", help="Label of a table for papers, such as tab:speeds.")
    ] = "",
    junit: Annotated[
        Path | None,
        typer.Option("--junit", metavar="FILE", help="With --margin: also write JUnit XML; groups that differ are failures."),
    ] = None,
    file: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write the result to a file.")] = None,
    long: Long = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object with everything instead of text.")] = False,
) -> None:
    """Compare groups of runs by tests, with sizes and intervals.

    The groups are batches, or the values of a variable in one batch, such as controllers. Prints a table with a row for each
    test, and the conclusions in at most five sentences; draws a figure of the differences. With --long, the table has all
    columns and digits, and the text is the paragraph that the formats for papers have.

    Runs with the same seed are pairs, if that helps. Each two groups are compared by Wilcoxon's signed-rank test (pairs) or by
    the Mann-Whitney test; rates by McNemar's exact test (pairs) or by Fisher's. The p values are corrected for all pairs of the
    report (Holm). A test of all of more than two groups is shown beside them, and decides about no pair. A difference is the
    second group minus the first, as estimated by Hodges and Lehmann; of rates, with Newcombe's interval. If no difference is
    shown, groups need not be equal: --margin tests for equivalence.

    \b
    Examples:
      sierra compare 518b 722b --column coverage
      sierra compare slow=518b fast=722b --measure mean --margin 0.05
      sierra compare --by controller --against CRW
      sierra compare 518b --by noise,population_size
      sierra compare 518b 722b --measure time_to --threshold 0.5
      sierra compare slow=518b fast=722b --over-time
      sierra compare speeds --format latex -o speeds.tex
      sierra compare 518b published.zip --margin 0.05 --junit differences.xml
    """
    from sierra.cli.open_project import project

    format = Shown.json if as_json else format
    if (caption or label) and format not in PAPER:
        raise UsageError("--caption and --label need a format for papers: --format latex, markdown or html")
    opened = project()
    given: dict[str, object] = {
        "--by": by,
        "--groups": groups,
        "--against": against,
        "--column": column,
        "--table": table,
        "--measure": measure,
        "--threshold": threshold,
        "--over-time": over_time or None,
        "--method": method,
        "--paired": paired,
        "--margin": margin,
        "--alpha": alpha,
    }
    names = list(words or [])
    if names and names[0] in opened.config.comparisons:
        if options := names_of_given(given):
            raise UsageError(f"sierra.toml declares the comparison {names[0]!r}; leave out {options}, or change it there")
        if len(names) > 2:
            raise UsageError(f"the comparison {names[0]!r} takes one batch at most, not {len(names) - 1}")
        compared = opened.comparisons.declared(*names)
    else:
        compared = opened.comparisons.make(
            *names,
            by=_list(by),
            groups=_list(groups),
            column=column,
            table=table,
            measure=MEASURES[measure] if measure else None,
            threshold=threshold,
            over_time=over_time,
            method=method or "auto",
            paired=PAIRED[paired or Pairs.auto],
            against=against,
            margin=margin,
            alpha=0.05 if alpha is None else alpha,
        )
    if junit is not None:
        _write_cases(compared, junit)
    drawn, refused = _drawn(opened, compared) if figure else ([], "")
    for text in compared.notes:
        note(text)
    if format in PAPER:
        folder = None if file is None else file.parent
        text = opened.comparisons.text(compared, format.value, figures=drawn, folder=folder, caption=caption, label=label)
        write_text(text, file)
    else:
        _show(compared, Format(format.value), file, drawn, as_json=as_json, long=long)
    if refused:
        note(f"no figure: {refused}")


def _write_cases(compared: Compared, file: Path) -> None:
    """Write a test case for each pair: equivalent groups pass, different ones fail. Raises UsageError without a margin."""
    from sierra.cli.junit import Case, write_cases
    from sierra.stats.comparison.model import Verdict

    if compared.analysis.question.margin is None:
        raise UsageError("--junit needs a margin, because a test that finds no difference does not show that groups are equal")
    cases = [
        Case(
            ", ".join([*(f"{name}={value}" for name, value in pair.point.items()), f"{pair.second} − {pair.first}"]),
            ""
            if pair.verdict in (Verdict.equivalent, Verdict.both)
            else "failure"
            if pair.verdict is Verdict.different
            else "error",
            str(pair.verdict),
            (_numbers(pair),),
        )
        for pair in compared.pairs
    ]
    write_cases("compare", cases, file)


def _numbers(pair: Pair) -> str:
    parts = {"difference": pair.difference, "low": pair.low, "high": pair.high, "p": pair.p_adjusted}
    parts["p of equivalence"] = pair.p_equivalent_adjusted
    return f"{pair.test}: " + ", ".join(f"{name} = {value:.6g}" for name, value in parts.items() if value is not None)


def _show(compared: Compared, format: Format, file: Path | None, drawn: list[Path], *, as_json: bool, long: bool) -> None:
    if as_json and file is None:
        print_json(_answer(compared, drawn))
        return
    if format is Format.table and file is None and not long:
        _print_table(compared)
    else:
        write(Printable.of_arrow(compared.arrow()), format, file)
    if format is Format.table or file is not None:
        text = compared.text if long else compared.brief
        width = min(terminal_width(), WIDEST)
        print(f"\n{fill(text, width, break_long_words=False, break_on_hyphens=False) if width else text}")
        for path in drawn:
            print(from_here(path))
        if not long:
            note("--long shows all columns, digits and sentences")


def _print_table(compared: Compared) -> None:
    """Print the table for papers, and the note below it."""
    from sierra.deliverables.comparison_text import paper_table
    from sierra.deliverables.paper_tables import as_text

    shown = paper_table(compared)
    numbers = [header for index, header in enumerate(shown.headers) if index not in shown.texts]
    width = min(terminal_width() or WIDEST, WIDEST)
    table_of(
        shown.headers,
        [["" if cell is None else as_text(cell) for cell in row] for row in shown.rows],
        right=numbers,
        width=width,
    )
    print("\n".join(wrap(shown.note, width)))


def _drawn(opened: Project, found: Compared) -> tuple[list[Path], str]:
    """Return the files of the figure, or the reason why there is none."""
    try:
        return opened.comparisons.draw(found), ""
    except (UsageError, Missing) as error:
        return [], str(error)


def _answer(compared: Compared, drawn: list[Path]) -> dict[str, object]:
    return {
        "name": compared.name,
        "batches": compared.batches,
        "table": compared.table,
        "column": compared.column,
        "measure": compared.measure,
        "unit": compared.unit,
        "groups": compared.analysis.groups,
        "method": compared.analysis.method,
        "version": compared.analysis.version,
        "alpha": compared.analysis.question.alpha,
        "margin": compared.analysis.question.margin,
        "paired": compared.analysis.pairing.paired,
        "pairing": compared.analysis.pairing.reason,
        "correlation": compared.analysis.pairing.correlation,
        "tests": compared.analysis.tests,
        "omnibus": compared.omnibus,
        "pairs": compared.pairs,
        "effects": compared.effects,
        "text": compared.text,
        "notes": [*compared.notes, *compared.analysis.notes, *compared.analysis.limits],
        "figures": list(map(str, drawn)),
    }


def _list(text: str | None) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()] if text else []
