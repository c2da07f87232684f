"""`sierra claims`: whether the claims of a paper hold on the recorded runs, or have become worse since a baseline."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJsonList
from sierra.cli.output import note, print_json, readable, table
from sierra.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sierra.api import Project
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
        typer.Argument(
            metavar="NAME",
            autocompletion=complete.claims,
            help="Claims in sierra.toml (default: all). With --keep: batches, or a package (default: the project now).",
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option("--against", metavar="BASELINE", help="Compare with this baseline, which --keep has written."),
    ] = None,
    keep: Annotated[
        str | None,
        typer.Option("--keep", metavar="BASELINE", help="Keep the results under this name, in sierra.baselines.json."),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option("--junit", metavar="FILE", help="Also write the verdicts as JUnit XML, for CI.")
    ] = None,
    register: Annotated[
        bool, typer.Option("--register", help="Only record the claims, so that runs executed later count as planned.")
    ] = False,
    as_json: AsJsonList = False,
) -> None:
    """Evaluate the claims of a paper on the recorded runs.

    A claim [claims.NAME] holds, does not hold, or can't be told: because its query has not been run, because too many runs
    have no value, or because the runs decide neither. Nothing is executed. p values of claims on one table of pairs are
    corrected together (Holm), also if only some are evaluated.

    The text of each claim is recorded when sierra run, paper or claims first sees it. A claim is planned if it was recorded
    before any execution that counts for it began, and exploratory otherwise. A changed claim is a new one.

    With --against, each claim is compared with a baseline. A value is a regression if the 95 % interval of its change is
    beyond the margin that the claim declares (regression), and none if it is within. Other claims are regressions if they held
    and do not hold now.

    With --keep, the values, intervals and numbers of runs that --against needs are written to sierra.baselines.json, which can
    be committed and used without the store; it does not count as source. A baseline of the same name is replaced. With batches
    or a package, each claim is evaluated on the batch with its query, whatever the code of that batch was.

    Exit status 0 means that all these claims hold, or with --against that none is a regression. It is 1 otherwise, also if one
    can't be told.

    \b
    Examples:
      sierra claims
      sierra claims faster eight_robots
      sierra claims --json
      sierra claims --keep v1
      sierra claims --keep published results.zip
      sierra claims --against v1 --junit claims.xml
      sierra claims --register
    """
    from sierra.cli.open_project import project

    if keep is not None:
        if against is not None or junit is not None or register or as_json:
            raise UsageError("--keep only writes a baseline; leave out --against, --junit, --register and --json")
        from sierra.cli.baseline import set_

        set_(keep, names)
        return
    opened = project()
    if register:
        if names or against is not None or junit is not None:
            raise UsageError("--register records all claims and evaluates none; leave out names, --against and --junit")
        _register(opened, as_json=as_json)
        return
    evaluated: Sequence[Evaluated | Changed]
    evaluated = opened.claims.evaluate(*(names or ())) if against is None else opened.claims.against(against, *(names or ()))
    report(evaluated, junit, as_json=as_json)


def report(evaluated: Sequence[Evaluated | Changed], junit: Path | None, *, as_json: bool) -> None:
    """Print claims, and write them as JUnit to a file if one is given; end with exit status 1 unless all are fine."""
    if junit is not None:
        from sierra.cli.junit import write_cases

        write_cases("claims", cases(evaluated), junit)
    if as_json:
        print_json(evaluated)
    else:
        _show(evaluated)
    if any(map(_outcome, evaluated)):
        raise typer.Exit(1)


def cases(found: Iterable[Evaluated | Changed]) -> list[Case]:
    """Return claims as test cases."""
    from sierra.cli.junit import Case

    return [Case(one.name, _outcome(one), str(one.verdict), _lines(one)) for one in found]


def _register(opened: Project, *, as_json: bool) -> None:
    """Record the claims, and print which are new; end with exit status 1 if one cannot be recorded."""
    registered = opened.claims.register()
    rows = [(name, "registered now") for name in registered.new] + [(name, "registered before") for name in registered.known]
    rows += [(name, f"not registered: {reason}") for name, reason in registered.refused.items()]
    if as_json:
        print_json([{"name": name, "registration": text} for name, text in rows])
    else:
        table(("claim", "registration"), rows)
    if registered.refused:
        raise typer.Exit(1)


def _outcome(one: Evaluated | Changed) -> Outcome:
    return OUTCOMES[str(one.verdict)]


def _lines(one: Evaluated | Changed) -> tuple[str, ...]:
    return (one.says, one.text, *one.notes, str(one.ground), *one.registration.lines)


def print_table(found: Sequence[Evaluated | Changed], grounds: Sequence[str]) -> None:
    """Print a line for each claim; `grounds` say what each rests on."""
    rows = [
        (one.name, str(one.verdict), str(one.registration.word), readable(one.text), one.n, ground)
        for one, ground in zip(found, grounds, strict=True)
    ]
    table(("claim", "verdict", "registered", "numbers", "n", "ground"), rows, right=("n",))


def _show(found: Sequence[Evaluated | Changed]) -> None:
    print_table(found, [str(one.ground) for one in found])
    for one in found:
        for line in (*one.notes, *one.registration.lines):
            note(f"{one.name}: {line}")
    counts = Counter(str(one.verdict) for one in found)
    note(", ".join(f"{count} of {len(found)}: {verdict}" for verdict, count in counts.items()))
