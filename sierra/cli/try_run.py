"""`sierra try`: execute one run without recording it, and list what it read and wrote."""

from __future__ import annotations

import codecs
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJson, Controller, EngineOfRuns, Scenario, Sets, TargetName
from sierra.cli.output import fields, note, print_json, table
from sierra.util.text import counted, few, size

if TYPE_CHECKING:
    from sierra.execution.trial import Trial

COLUMNS = 100
"""The width of what is printed where there is no terminal."""
NAMED = 8
"""The largest number of names in a line."""


def try_(
    query: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="CRITERIA",
            autocompletion=complete.criteria,
            help="Criteria, as for `sierra run`. Without any, the template is used as it is, except for the seed.",
        ),
    ] = None,
    controller: Controller = None,
    scenario: Scenario = None,
    sets: Sets = None,
    target: TargetName = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", metavar="N", min=0, help="Seed of the run (default: that of a batch's first run)."),
    ] = None,
    experiment: Annotated[
        int, typer.Option("--experiment", metavar="N", min=0, help="Experiment of the query; the first one is 0.")
    ] = 0,
    engine: EngineOfRuns = None,
    as_json: AsJson = False,
) -> None:
    """Execute one run without recording it.

    Prints what the program prints, while it runs. Then lists what the run read, its files, and the tables that they would
    become. Nothing is added to the store, and the run never counts as a result. Its folder stays until the next try. Ctrl-C
    ends the run. If the run needs a build, the build is recorded. The exit code is 1 if a batch would count the run as failed.

    \b
    Examples:
      sierra try
      sierra try population_size=4 --seed 7
      sierra try population_size.Log8 --experiment 3
      sierra try --set "//arena/@size=20"
      sierra try population_size=4 --target robots
    """
    from sierra.cli import open_project
    from sierra.cli.progress import Planning
    from sierra.design.query.grammar import setting
    from sierra.model import Status

    project = open_project.project()
    printer = Printer(to_stderr=as_json)
    trial = project.try_run(
        *(query or ()),
        controller=controller,
        scenario=scenario,
        sets=[setting(text) for text in sets or ()],
        target=target,
        seed=seed,
        experiment=experiment,
        engine=engine,
        observer=Planning(agreed=False, quiet=as_json),
        show=printer.show,
    )
    printer.end()
    if as_json:
        print_json(trial)
    else:
        for text in trial.notes:
            note(text)
        print_trial(trial)
    if trial.status is Status.INTERRUPTED:
        raise typer.Exit(130)
    if trial.status is not Status.OK:
        raise typer.Exit(1)


class Printer:
    """Prints what a program prints: its standard output and error go to this process's."""

    def __init__(self, *, to_stderr: bool) -> None:
        decoder = codecs.getincrementaldecoder("utf-8")
        self._decoders = {name: decoder("replace") for name in ("stdout", "stderr")}
        self._streams = {"stdout": sys.stderr if to_stderr else sys.stdout, "stderr": sys.stderr}
        self._last = {"stdout": "\n", "stderr": "\n"}

    def show(self, log: str, content: bytes) -> None:
        text = self._decoders[log].decode(content).replace("\r\n", "\n").replace("\r", "\n")
        if text:
            self._last[log] = text[-1]
            self._streams[log].write(text)
            self._streams[log].flush()

    def end(self) -> None:
        """End lines that the program has not ended."""
        for log, last in self._last.items():
            if last != "\n":
                self._streams[log].write("\n")


def print_trial(trial: Trial) -> None:
    """Print what a run did."""
    print("--")
    fields(dict(_facts(trial)), columns=COLUMNS)
    if trial.files:
        tables = any(file.table for file in trial.files)
        columns = ["file", "size", "table", "rows", "columns"] if tables else ["file", "size"]
        rows = [
            [
                file.path,
                size(file.bytes),
                file.table,
                file.rows,
                few([f"{name} ({kind})" for name, kind in file.columns.items()], COLUMNS // 20),
            ]
            for file in trial.files[: NAMED * 4]
        ]
        table(columns, [row[: len(columns)] for row in rows], right=["size", "rows"])
        if len(trial.files) > len(rows):
            print(f"and {len(trial.files) - len(rows)} more (--json has them all)")
    for line in _unread(trial):
        print(line)


def _facts(trial: Trial) -> Iterator[tuple[str, str]]:
    """Yield the names and texts of the lines about a run."""
    yield "result", str(trial.status) if trial.reason is None else f"{trial.status}: {trial.reason}"
    values = [f"{name}={value}" for name, value in trial.values.items() if name != "montecarlo"]
    yield "run", f"{' '.join(values) or 'the template as it is'}, seed {trial.seed}, not recorded"
    if trial.wall_s is not None:
        ended = f"signal {trial.signal}" if trial.signal else f"exit status {trial.exit_code}"
        yield "ended", f"{ended} after {trial.wall_s:.3g} s"
    if trial.used is None:
        yield "used", "not observed"
    else:
        yield "used", trial.used.words + (f" (incomplete: {trial.used.incomplete})" if trial.used.incomplete else "")
        yield "read", few(trial.used.files, NAMED) or "no file of the project"
    wrote = [
        counted(len({file.path for file in trial.files}), "file"),
        *(f"{name}: {size(length)}" for name, length in (trial.logs or {}).items()),
    ]
    yield "wrote", ", ".join(wrote)
    if trial.elsewhere:
        yield "elsewhere", f"{few(trial.elsewhere, NAMED)} (a batch does not record these files)"
    if trial.folder is not None:
        yield "folder", f"{_from_here(trial.folder)} (the next try replaces it)"


def _unread(trial: Trial) -> Iterator[str]:
    """Yield why files would not become tables."""
    from sierra.cli.render_outputs import unread_lines
    from sierra.model import Status

    if trial.status is not Status.OK and any(one.table is None for one in trial.files):
        yield "no file was read as a table, because the run failed"
    yield from unread_lines(1, trial.unread[:NAMED])
    if len(trial.unread) > NAMED:
        yield f"and {counted(len(trial.unread) - NAMED, 'more kind')} of files (--json has them all)"


def _from_here(folder: Path) -> str:
    return os.path.relpath(folder)
