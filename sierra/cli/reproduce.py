"""`sierra reproduce`: execute the runs of a received package again, and decide its claims."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli.arguments import AsJson, Jobs, Yes
from sierra.cli.output import note, print_json, readable
from sierra.cli.progress import Display, watching
from sierra.errors import Missing, UsageError
from sierra.util.text import one_line

if TYPE_CHECKING:
    from sierra.execution.observer import Progress
    from sierra.packages.reproduction.outcome import Reproduction, Statement

UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


def reproduce(
    package: Annotated[
        Path, typer.Argument(metavar="X.zip|FOLDER", help="A package, or the folder of an extracted one.", show_default=False)
    ],
    claim: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Only this claim. May be repeated.")] = None,
    budget: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Only runs that fit into 90s, 30m or 2h by the record. Touches each claim first."),
    ] = None,
    engine: Annotated[
        str | None,
        typer.Option(metavar="ENGINE", help="podman, apptainer, or none (default: as recorded, or one that works here)."),
    ] = None,
    runner: Annotated[
        str,
        typer.Option("--on", metavar="RUNNER", help="Where runs execute: local, slurm, pbs, or a cluster of yours."),
    ] = "local",
    jobs: Jobs = None,
    into: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder for the copy of the package and the report (default: X-reproduction, or FOLDER/reproduction).",
        ),
    ] = None,
    yes: Yes = False,
    as_json: AsJson = False,
    junit: Annotated[Path | None, typer.Option("--junit", metavar="FILE", help="Also write the verdicts as JUnit XML.")] = None,
) -> None:
    """Execute the runs of a package again, and decide its claims.

    All files are verified and copied first. Runs execute in the package's container without network. If they would execute on
    this machine without a container, or with access to the network or devices, you are asked first. Clusters are those of your
    own settings, not of the package. The verdicts and their grounds are in reproduction.md and reproduction.json.
    Figures, tables and numbers are made from the reproduced runs, and index.html shows them beside those of the package.

    Exit status 0 means that all outputs are as recorded and all claims hold, 1 that something differs or a claim does not hold
    or can't be told, 3 that something is missing.

    \b
    Examples:
      sierra reproduce results.zip
      sierra reproduce results.zip --claim faster --budget 30m
      sierra reproduce /media/dvd --into here --engine none --yes
      sierra reproduce results.zip --on slurm
    """
    from sierra.api import reproduce as execute
    from sierra.cli import junit as junit_file
    from sierra.cli.claims import cases

    seconds = None if budget is None else _seconds(budget)
    if junit is not None and not junit.parent.is_dir():
        raise Missing(f"{junit}: the folder {junit.parent} does not exist")
    with contextlib.ExitStack() as stack:
        display = _LateProgress(stack)
        done = execute(
            package,
            into=into,
            claims=claim or (),
            budget=seconds,
            jobs=jobs,
            engine=engine,
            runner=runner,
            agree=_agree(yes, as_json, display),
            observer=None if as_json else display,
        )
    if junit is not None:
        junit_file.write_reproduction(done, cases(done.claims), junit)
    if as_json:
        from sierra.packages.reproduction.report import as_json as values

        print_json(values(done))
    else:
        _show(done)
    if done.exit_code:
        raise typer.Exit(done.exit_code)


def _seconds(text: str) -> float:
    """Return a time such as `90s`, `30m` or `1.5h` in seconds. Raises UsageError."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smhd]?)", text.strip())
    if found is None or float(found[1]) <= 0:
        raise UsageError(f"--budget {text!r}: write a time as 90s, 30m or 2h")
    return float(found[1]) * UNITS[found[2]]


class _LateProgress(Display):
    """Shows progress only after `begin`, because a question needs the terminal."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self._stack = stack
        self._shown = Display()

    def begin(self) -> None:
        self._shown = self._stack.enter_context(watching(quiet=False))

    def progress(self, progress: Progress) -> None:
        self._shown.progress(progress)

    def notice(self, text: str) -> None:
        self._shown.notice(text)


def _agree(yes: bool, quiet: bool, display: _LateProgress) -> Callable[[Statement], None]:
    """Return the function that prints what would be executed, asks for it if necessary, and then begins to show progress."""

    def agree(statement: Statement) -> None:
        ask(statement)
        if not quiet:
            display.begin()

    def ask(statement: Statement) -> None:
        if not quiet:
            note("this executes:")
            for line in statement.lines:
                note(f"  {line}")
        if yes or not statement.must_ask:
            return
        why = "programs of the package would not be isolated from this machine"
        if quiet or not (sys.stdin.isatty() and sys.stderr.isatty()):
            listed = f" ({'; '.join(line.strip() for line in statement.lines)})" if quiet else ""
            raise Missing(f"{why}{listed}; there is no terminal to ask on: use --yes if you trust the package")
        if not typer.confirm(f"{why}: execute them?", default=False, err=True):
            raise Missing("nothing was executed")

    return agree


def _show(done: Reproduction) -> None:
    from sierra.cli.claims import print_table
    from sierra.packages.reproduction.report import executed

    for batch in done.batches:
        print(readable(f"batch {batch.planned.batch[:10]} ({batch.planned.query}): {batch.verdict}"))
    for line in done.left_out:
        print(readable(line))
    if done.claims:
        print_table(done.claims, [f"{claim.ground} ({executed(done, claim.batches)})" for claim in done.claims])
    print(one_line(done.verdict))
    print(f"report: {done.folder / ('index.html' if done.drawn else 'reproduction.md')}")
