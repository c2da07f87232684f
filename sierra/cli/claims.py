"""`sierra claims`: whether the claims of a paper hold on the recorded runs, or have become worse since a baseline."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJsonList
from sierra.cli.output import note, print_json, readable, table

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sierra.cli.junit import Case
    from sierra.deliverables.claims.evaluate import Evaluated
    from sierra.deliverables.claims.regression import Changed

Outcome: TypeAlias = Literal["", "failure", "error"]
OUTCOMES: dict[str, Outcome] = {
    "holds": "",
    "does not hold": "failure",
    "no regression": "",
    "regression": "failure",
    "can't tell": "error",
}
"""The elements of JUnit for verdicts and changes; "": the test case passes."""


def claims(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", autocompletion=complete.claims, help="Claims in sierra.toml (default: all)."),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option("--against", metavar="BASELINE", help="Compare with this baseline: see sierra baseline set."),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option("--junit", metavar="FILE", help="Also write the verdicts as JUnit XML, for CI.")
    ] = None,
    as_json: AsJsonList = False,
) -> None:
    """Evaluate the claims of a paper on the recorded runs.

    A claim [claims.NAME] holds, does not hold, or can't be told: because its query has not been run, because too many runs
    have no value, or because the runs decide neither. Nothing is executed. p values are corrected for all claims of the
    project that tests decide (Holm), also if only some are evaluated.

    With --against, each claim is compared with a baseline. A value is a regression if the 95 % interval of its change is
    beyond the margin that the claim declares (regression), and none if it is within. Other claims are regressions if they held
    and do not hold now.

    Exit status 0 means that all these claims hold, or with --against that none is a regression. It is 1 otherwise, also if one
    can't be told.

    \b
    Examples:
      sierra claims
      sierra claims faster eight_robots
      sierra claims --json
      sierra claims --against v1 --junit claims.xml
    """
    from sierra.cli.open_project import project

    opened = project()
    found: Sequence[Evaluated | Changed]
    found = opened.claims(*(names or ())) if against is None else opened.claims_against(against, *(names or ()))
    report(found, junit, as_json=as_json)


def report(found: Sequence[Evaluated | Changed], junit: Path | None, *, as_json: bool) -> None:
    """Print claims, and write them as JUnit to a file if one is given; end with exit status 1 unless all are fine."""
    if junit is not None:
        from sierra.cli.junit import write_cases

        write_cases("claims", cases(found), junit)
    if as_json:
        print_json(found)
    else:
        _show(found)
    if any(map(_outcome, found)):
        raise typer.Exit(1)


def cases(found: Iterable[Evaluated | Changed]) -> list[Case]:
    """Return claims as test cases."""
    from sierra.cli.junit import Case

    return [Case(one.name, _outcome(one), str(one.verdict), _lines(one)) for one in found]


def _outcome(one: Evaluated | Changed) -> Outcome:
    return OUTCOMES[str(one.verdict)]


def _lines(one: Evaluated | Changed) -> tuple[str, ...]:
    return (one.says, one.text, *one.notes, str(one.ground))


def print_table(found: Sequence[Evaluated | Changed], grounds: Sequence[str]) -> None:
    """Print a line for each claim; `grounds` say what each rests on."""
    rows = [(one.name, str(one.verdict), readable(one.text), one.n, ground) for one, ground in zip(found, grounds, strict=True)]
    table(("claim", "verdict", "numbers", "n", "ground"), rows, right=("n",))


def _show(found: Sequence[Evaluated | Changed]) -> None:
    print_table(found, [str(one.ground) for one in found])
    for one in found:
        for line in one.notes:
            note(f"{one.name}: {line}")
    counts = Counter(str(one.verdict) for one in found)
    note(", ".join(f"{count} of {len(found)}: {verdict}" for verdict, count in counts.items()))
