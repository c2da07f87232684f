"""`sierra claims`: whether the claims of a paper hold on the recorded runs."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJsonList
from sierra.cli.output import note, print_json, readable, table
from sierra.errors import Missing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sierra.deliverables.claims.evaluate import Evaluated


def claims(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", autocompletion=complete.claims, help="Claims in sierra.toml (default: all)."),
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

    Exit status 0 means that all these claims hold, 1 that one does not or can't be told.

    \b
    Examples:
      sierra claims
      sierra claims faster eight_robots
      sierra claims --json
      sierra claims --junit claims.xml
    """
    from sierra.cli.open_project import project
    from sierra.deliverables.claims.model import Verdict

    found = project().claims(*(names or ()))
    if junit is not None:
        _write(found, junit)
    if as_json:
        print_json(found)
    else:
        _show(found)
    if any(one.verdict is not Verdict.holds for one in found):
        raise typer.Exit(1)


def _show(found: Sequence[Evaluated]) -> None:
    rows = [(one.name, str(one.verdict), readable(one.text), one.n, str(one.ground)) for one in found]
    table(("claim", "verdict", "numbers", "n", "ground"), rows, right=("n",))
    for one in found:
        for line in one.notes:
            note(f"{one.name}: {line}")
    counts = Counter(str(one.verdict) for one in found)
    note(", ".join(f"{count} of {len(found)}: {verdict}" for verdict, count in counts.items()))


def _write(found: Sequence[Evaluated], file: Path) -> None:
    from sierra.cli import junit

    try:
        junit.write_claims(found, file)
    except OSError as error:
        raise Missing(f"{file}: cannot be written: {error.strerror}") from error
