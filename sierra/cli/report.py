"""`sierra report`: write one page about batches, with everything that a reader needs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.output import note, print_json, readable
from sierra.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from sierra.deliverables.report.files import Written

PACKAGED = ".zip"
"""The ending of packages."""


def report(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[HASH... | FILE.zip]",
            autocompletion=complete.batches,
            help="Batch ids, prefixes or names of queries (default: the last batch); or one package.",
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="All batches; of more than 50, only the list.")] = False,
    to: Annotated[
        Path | None,
        typer.Option("--to", metavar="FILE", help="File to write (default: in figures/reports; of a package: beside it)."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
) -> None:
    """Write a report: one page of HTML about batches.

    It tells their whole story: the question, the design, figures, tables, comparisons, claims, failures, the environment, and
    how to cite and to replay. It is one file, which loads nothing from elsewhere. A file that exists is replaced only if it is
    a report.

    Nothing in a package is executed.

    \b
    Examples:
      sierra report
      sierra report 722b00 --to report.html
      sierra report 722b00 518b72
      sierra report --all
      sierra report results.zip
    """
    from sierra.cli.progress import telling

    with telling(quiet=as_json) as tell:
        written = _written(words or [], to, tell, every=every)
    print_written(written, as_json=as_json)


def print_written(written: Written, *, as_json: bool) -> None:
    """Print the file of a report, and notes on what it lacks."""
    from sierra.cli.figures import from_here

    for text in written.notes:
        note(text)
    if as_json:
        print_json({"file": str(written.file), "batches": written.batches, "notes": written.notes})
    else:
        print(readable(from_here(written.file)))


def _written(words: list[str], to: Path | None, tell: Callable[[str], None], *, every: bool) -> Written:
    """Write the report of batches, or of a package."""
    if not any(word.endswith(PACKAGED) for word in words):
        from sierra.cli.open_project import project

        return project().deliverables.report(*words, every=every, to=to, tell=tell)
    if len(words) > 1 or every:
        raise UsageError("name one package alone: its report has all its batches")
    from sierra.api import report_package

    return report_package(words[0], to=to, tell=tell)
