"""`sierra diff`: differences between two recorded things, the ones that probably matter first."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.output import note, print_json, readable
from sierra.errors import UsageError
from sierra.util.lazy_definitions import regex

if TYPE_CHECKING:
    from sierra.explain.diff.compare import Comparison
    from sierra.explain.diff.model import Difference

PACKAGED = regex(r".+\.zip(:\w+)?")
"""A package, or a batch in one."""
ZIP = ".zip"
LINES = 6
"""The largest number of differences of one kind that are shown."""
DETAILS = 12
"""The largest number of lines that are shown of a patch, or of the details of one difference."""
WIDTH = 160
"""The largest length of such a line in characters."""
HEADS = ("diff --git ", "index ")
"""The beginnings of lines of a patch that are of no use to people."""


def diff(
    before: Annotated[
        str,
        typer.Argument(
            metavar="A",
            autocompletion=complete.ids,
            help="Id of a batch, experiment, run or execution; a prefix is enough. Or the name of a query, "
            "a package, FILE.zip, or a batch in one, FILE.zip:HASH.",
        ),
    ],
    after: Annotated[
        str,
        typer.Argument(
            metavar="B",
            autocompletion=complete.ids,
            help="Id of the same kind; a run can also be compared with an execution. Or a package.",
        ),
    ],
    patch: Annotated[bool, typer.Option("--patch", help="Show the whole patch and all other details.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text, with all details.")] = False,
) -> None:
    """Compare two batches, experiments, runs or packages.

    Differences that probably affect results come first: query, platform, command, image, programs, source, variables,
    inputs, rules, seeds, containers, the machine. Differences of the results come last. Nothing is executed; the comparison
    uses only the records. Two executions can be compared, too; for a run, its effective execution is. For packages, the
    metadata, batches, runs, sources, programs, environments and results of effective executions are compared. A batch of this
    project is compared with the batch of a package that has the same id, or with its only one.

    The exit code is 0 if nothing differs, and 1 if something does.

    \b
    Examples:
      sierra diff 9e1c c3e4
      sierra diff 9e1c c3e4 --patch
      sierra diff ours.zip theirs.zip
      sierra diff 9e1c theirs.zip
    """
    from sierra.cli.open_project import project

    if PACKAGED.fullmatch(before) or PACKAGED.fullmatch(after):
        if patch:
            raise UsageError("--patch shows patches of two records of a project; for packages, leave it out")
        _packages(before, after, as_json=as_json)
        return
    answer = project().records.diff(before, after)
    if as_json:
        print_json(_answer(answer))
    else:
        for line in lines(answer, everything=patch):
            print(line)
        for text in answer.notes:
            note(text)
    if answer.differences:
        raise typer.Exit(1)


def _packages(before: str, after: str, *, as_json: bool) -> None:
    """Compare two packages, which needs no project, or batches of which one is in a package."""
    from sierra.cli.open_project import project
    from sierra.packages.reading import differences
    from sierra.packages.reading.received import open_package
    from sierra.util.hashing import short
    from sierra.util.text import one_line

    whole = before.endswith(ZIP) and after.endswith(ZIP)
    if whole:
        sides = [differences.of_package(open_package(Path(path))) for path in (before, after)]
        answer = differences.compare(*sides)
    else:
        answer = project().packages.diff(before, after)
    if as_json:
        print_json(answer)
    else:
        kind = "package" if whole else "batch"
        print(f"{kind} {short(answer.before)} → {kind} {short(answer.after)}")
        for difference in answer.differences:
            print(one_line(f"{difference.kind}: {difference.line}"))
        print(f"the same: {', '.join(answer.same)}")
    if answer.differences:
        raise typer.Exit(1)


def _answer(answer: Comparison) -> dict[str, object]:
    return {
        "before": {"kind": answer.before.kind, "id": answer.before.id},
        "after": {"kind": answer.after.kind, "id": answer.after.id},
        "differences": [
            {
                "kind": difference.kind,
                "rank": difference.rank,
                "name": difference.name,
                "line": difference.line,
                "before": difference.was,
                "after": difference.now,
                "details": list(difference.details),
            }
            for difference in answer.differences
        ],
        "same": list(answer.same),
        "notes": list(answer.notes),
    }


def lines(answer: Comparison, *, everything: bool = False) -> Iterator[str]:
    """Yield the lines of the differences."""
    from sierra.util.hashing import short

    yield f"{answer.before.kind} {short(answer.before.id)} → {answer.after.kind} {short(answer.after.id)}"
    for _, alike in groupby(answer.differences, lambda difference: (difference.kind, difference.rank)):
        differences = list(alike)
        for difference in differences if everything else differences[:LINES]:
            yield from _difference_lines(difference, everything=everything)
        if len(differences) > LINES and not everything:
            yield f"  and {len(differences) - LINES} more of the kind {differences[0].kind} (--patch shows them)"
    names = ", ".join(answer.same)
    yield f"the same: {names}" if answer.differences else f"no difference in {names}"


def _difference_lines(one: Difference, *, everything: bool) -> Iterator[str]:
    yield readable(one.line)
    details = one.details if everything else [text for text in one.details if not text.startswith(HEADS)]
    for text in details if everything else details[:DETAILS]:
        line = readable(text.expandtabs())
        yield f"    {line if everything or len(line) <= WIDTH else f'{line[:WIDTH]}…'}".rstrip()
    if len(details) > DETAILS and not everything:
        yield f"    … {len(details) - DETAILS} more lines (--patch shows them)"
