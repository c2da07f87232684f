"""`sierra show --files`: list recorded files, or write them out."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJson
from sierra.cli.lazy_commands import Beside
from sierra.cli.output import fields, note, print_json, readable, table
from sierra.config.extensions import given
from sierra.errors import UsageError
from sierra.util.text import counted, verb

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.store.export_recorded_files import Listing, Outcome
    from sierra.store.recorded_files import ChosenExecution

SPOOLED = 64 << 20
SHOWN_FAILURES = 20
WHICH = {
    "counts": "the effective one",
    "last": "the last one; none is effective",
    "asked": "the requested one",
    "none": "never executed",
}


def files(
    prefix: Annotated[
        str | None,
        typer.Argument(
            metavar="HASH",
            autocompletion=complete.ids,
            show_default=False,
            help="Id of anything that `sierra show` shows; a prefix is enough (default: the last batch).",
        ),
    ] = None,
    paths: Annotated[
        list[str] | None, typer.Argument(metavar="PATH", show_default=False, help="Listed paths, or glob patterns.")
    ] = None,
    to: Annotated[Path | None, typer.Option("--to", metavar="FOLDER", help="Write the files into this folder.")] = None,
    as_json: AsJson = False,
) -> None:
    """List recorded files, or write them out.

    Without PATH, lists the files. With PATH, writes the one file that matches to standard output. With --to, writes files to
    FOLDER/EXPERIMENT/NUMBER/: the run's input/, output/, stdout and stderr; existing files are not overwritten. The files of a
    run are those of its effective execution; if there is none, those of its last execution.

    The bytes of a file that became a table may have been dropped (raw = false, sierra gc --raw); sierra sql has its rows.

    \b
    Examples:
      sierra show 4fc1 --files
      sierra show 4fc1 swarm.csv
      sierra show 9e1c --to recorded
      sierra show 9e1c "*.csv" stderr --to recorded
    """
    from sierra.cli.open_project import given_or_last, project
    from sierra.store.export_recorded_files import extract, listing

    besides = given(Beside)
    if besides and to is None:
        raise UsageError(f"{besides[0].option} needs --to FOLDER")
    opened = project()
    listed = listing(
        opened.store, opened.records.id(given_or_last(prefix, opened)), paths or (), check=to is None and (as_json or not paths)
    )
    if to is not None:
        outcomes = list(extract(opened.store, listed, to))
        _doubt(opened, to)
        for beside in besides:
            beside.write(opened, [outcome for outcome in outcomes if not outcome.failure], to)
        _print_outcomes(listed, outcomes, to, named=bool(paths), as_json=as_json)
    elif as_json:
        print_json(_as_json(listed))
    elif paths:
        _print_one(opened, listed)
    else:
        _print(listed)


def _print_one(opened: Project, listed: Listing) -> None:
    """Write a file's content to standard output, after the whole file was checked against its record."""
    import shutil
    import tempfile

    from sierra.errors import Damaged
    from sierra.store.export_recorded_files import content

    if len(listed.files) > 1:
        raise UsageError(f"{len(listed.files)} files match; choose one file of one run, or write all of them with --to FOLDER")
    [file] = listed.files
    with tempfile.SpooledTemporaryFile(SPOOLED) as spooled:
        try:
            identical = content(opened.store, file, spooled)
        except Damaged as error:
            raise Damaged(f"{readable(file.path)}: {error}") from error
        if file.taken.which == "last" and file.kind != "input":
            note(f"{readable(file.path)} is from {_execution(file.taken)}")
        if not identical:
            note(f"{readable(file.path)}: {file.remark}")
        spooled.seek(0)
        sys.stdout.flush()
        shutil.copyfileobj(spooled, sys.stdout.buffer)
        sys.stdout.buffer.flush()


def _doubt(opened: Project, folder: Path) -> None:
    """Print a note if files in the project become part of its source, which would make all runs new."""

    target = folder.resolve()
    if target.is_relative_to(opened.root) and not opened.config.source.paths:
        note(f"{folder} is in the project, and changes its source (which makes the next runs new) unless git ignores it")


def _execution(run: ChosenExecution) -> str:
    from sierra.util.hashing import short

    if run.execution is None:
        return "never executed; only the input is recorded"
    return f"execution {short(run.execution)} ({run.status}), {WHICH[run.which]}"


def _print(listed: Listing) -> None:
    from sierra.util.hashing import short

    several = len(listed.runs) > 1
    owner = ("experiment", "number", "run", "execution", "status") if several else ()
    if not several:
        [run] = listed.runs
        fields({"run": run.run, "experiment": run.experiment, "number": run.number, "files from": _execution(run)})
        print()
    rows: list[Sequence[object]] = []
    for file in listed.files:
        run = file.taken
        mine = (short(run.experiment), run.number, short(run.run), short(run.execution or ""), run.status) if several else ()
        rows.append((*mine, readable(file.path), file.kind, file.bytes, short(file.sha256 or ""), file.remark))
    table((*owner, "path", "kind", "bytes", "sha256", "remark"), rows, right=("number", "bytes"))
    for line in _doubtful(listed.runs) if several else ():
        print(line)


def _doubtful(runs: Iterable[ChosenExecution]) -> Iterable[str]:
    which = [run.which for run in runs]
    if count := which.count("last"):
        yield f"{counted(count, 'run')} without an effective execution: files of the last execution"
    if count := which.count("none"):
        yield f"{counted(count, 'run')} never executed: only the input is recorded"


def _print_outcomes(listed: Listing, outcomes: Sequence[Outcome], folder: Path, *, named: bool, as_json: bool) -> None:
    """Print the files that were written, and the failures. Exit with code 1 if there are failures.

    A table of which the store has only the rows is one if its path was `named`.
    """

    failures = [outcome for outcome in outcomes if outcome.failure and (named or not outcome.file.is_dropped)]
    if as_json:
        print_json({"folder": str(folder), **_as_json(listed, {id(outcome.file): outcome for outcome in outcomes})})
    else:
        _summary(listed, outcomes, folder)
    for outcome in failures[:SHOWN_FAILURES]:
        print(f"sierra: {readable(outcome.path)}: {outcome.failure}", file=sys.stderr)
    if len(failures) > SHOWN_FAILURES:
        print(f"sierra: and {counted(len(failures) - SHOWN_FAILURES, 'more file')} not written", file=sys.stderr)
    if failures:
        raise typer.Exit(1)


def _summary(listed: Listing, outcomes: Sequence[Outcome], folder: Path) -> None:
    written = [outcome for outcome in outcomes if not outcome.failure]
    dropped = sum(outcome.file.is_dropped for outcome in outcomes)
    cut = sum(outcome.file.kind == "log" and not outcome.identical for outcome in written)
    runs = counted(len({outcome.file.taken for outcome in written}), "run")
    print(f"{counted(len(written), 'file')} of {runs} written to {folder}")
    if dropped:
        print(f"{counted(dropped, 'table')} not written: the store has only {verb(dropped, 'its', 'their')} rows (sierra sql)")
    if cut:
        print(f"{counted(cut, 'log')} shortened when recorded: only the beginning and the end are written")
    for line in _doubtful(listed.runs):
        print(line)


def _as_json(listed: Listing, outcomes: dict[int, Outcome] | None = None) -> dict[str, object]:
    names = ("experiment", "ordinal", "number", "run", "execution", "status", "which")
    files: dict[ChosenExecution, list[object]] = {run: [] for run in listed.runs}
    for file in listed.files:
        entry = {name: getattr(file, name) for name in ("path", "kind", "bytes", "kept", "sha256", "output", "rows", "remark")}
        if outcomes is not None:
            outcome = outcomes[id(file)]
            entry |= {"written": None if outcome.failure else outcome.path, "failure": outcome.failure}
            entry |= {"identical": None if outcome.failure else outcome.identical}
        files[file.taken].append(entry)
    runs = [{**{name: getattr(run, name) for name in names}, "files": files[run]} for run in files]
    return {"kind": listed.kind, "id": listed.id, "runs": runs}
