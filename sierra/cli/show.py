"""`sierra show`: show a batch, an experiment, a run, an execution or a study."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJson, Long
from sierra.cli.output import cell, fields, fitting, members, print_json, readable, short_id, table
from sierra.config.extensions import GIVEN
from sierra.errors import UsageError
from sierra.util.text import counted, few

if TYPE_CHECKING:
    from sierra.deliverables.check import ShownDeliverable
    from sierra.deliverables.studies.study import Outcome
    from sierra.execution.shown_records import Failed, FirmwareOfBatch, ShownBatch, ShownBuild, ShownExecution, ShownIsolation
    from sierra.provenance.commits_between import Known

SHOWN_REASONS = 10
MORE = 4
"""The largest number of column names that are printed if the columns do not fit the terminal."""
OPTIONAL = ("named_inputs", "shared_files", "robots")
"""Columns of a spec that are left out if they are NULL."""
APART = (
    "build",
    "failures",
    "firmware",
    "notes",
    "programs",
    "environment",
    "image",
    "isolations",
    "isolation",
    "host_access",
    "history",
    "around",
    "ports",
)
"""The parts of a batch or an execution that are printed in forms of their own, after the others."""
AT_MOST = {"attempts": 20, "channels": 20, "captures": 20, "nondeterminism": 10, "verdicts": 20}
"""The largest number of shown rows, for tables that may be as long as a batch."""
SQL_LINES = 20
"""The largest number of lines of SQL that are printed without `--long`."""


def show(
    prefix: Annotated[
        str | None,
        typer.Argument(
            metavar="HASH|FILE",
            autocompletion=complete.anything,
            show_default=False,
            help="Id, as `sierra ls` prints it; a prefix is enough. Or the name of a query, or a figure's file (default: the "
            "last batch).",
        ),
    ] = None,
    paths: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="PATH", show_default=False, help="Recorded files of this record: listed paths, or glob patterns."
        ),
    ] = None,
    listed: Annotated[bool, typer.Option("--files", help="List the recorded files.")] = False,
    to: Annotated[
        Path | None, typer.Option("--to", metavar="FOLDER", help="Write the recorded files into this folder.")
    ] = None,
    long: Long = False,
    as_json: AsJson = False,
) -> None:
    """Show a record, its files, or what a figure's file shows.

    A record is a batch, experiment, run, execution, session, study or registered claim. For a batch and a session, this
    includes the path of the log file, which lists the events while runs executed. For a file that SIERRA made, it includes the
    SQL and whether the store would still give the same data.

    With --files, lists the recorded files. With PATH, writes the one file that matches to standard output. With --to, writes
    files to FOLDER/EXPERIMENT/NUMBER/: the run's input/, output/, stdout and stderr; existing files are not overwritten. The
    files of a run are those of its effective execution; if there is none, those of its last execution. The bytes of a file that
    became a table may have been dropped (raw = false, sierra gc --raw); sierra sql has its rows.

    \b
    Examples:
      sierra show
      sierra show 722b00
      sierra show 722b00 --long
      sierra show 722b00 --files
      sierra show 4fc1 swarm.csv
      sierra show 722b00 "*.csv" stderr --to recorded
      sierra show figures/722b00d418/swarm_coverage_summary.pdf
    """
    from sierra.cli.open_project import given_or_last, project
    from sierra.execution.around import described
    from sierra.execution.shown_records import ShownBatch, ShownExecution, ShownRun
    from sierra.store.spec_rows import run_spec

    if listed or paths or to is not None or GIVEN.get():
        from sierra.cli.files import files

        if long or (listed and (paths or to is not None)):
            raise UsageError(
                "--files lists files as they are; leave out --long, PATH and --to" if listed else "leave out --long"
            )
        files(prefix, paths, to, as_json)
        return
    if prefix is not None and (os.sep in prefix or "." in prefix) and Path(prefix).exists():
        _print_deliverable(project().deliverables.find(prefix), long=long, as_json=as_json)
        return
    opened = project()
    shown = opened.records.show(given_or_last(prefix, opened))
    record = shown.as_dict()
    if as_json:
        print_json(record)
        return
    match shown:
        case ShownBatch():
            spec = {name: value for name, value in shown.spec._asdict().items() if value is not None or name not in OPTIONAL}
            spec.pop("robots", None)
            record["spec"] = {**_without_parts(spec), **described(run_spec(shown.spec))}
            _print_record(_without_parts(record), long=long)
            _print_firmware(shown.firmware)
            if shown.build:
                _print_build(shown.build)
            if shown.history:
                _print_commit(shown.history)
            _print_host(shown, shown.spec.host_access, shown.isolations)
            _print_failures(shown.failures)
            for text in shown.notes:
                print(f"\nnote: {readable(text)}")
        case ShownExecution():
            _print_record(_without_parts(record), long=long)
            _print_host(shown, shown.host_access, [shown.isolation] if shown.isolation else [])
        case _ if shown.kind == "study":
            from sierra.cli.run_until import print_study

            print_study(cast("Outcome", shown), long=long)
        case _:
            _print_record(record, long=long)
    if isinstance(shown, ShownRun | ShownExecution):
        print(f"\nsierra show {str(record[shown.kind])[:10]} --files lists its files; PATH prints one, --to FOLDER writes them")


def _print_deliverable(shown: ShownDeliverable, *, long: bool, as_json: bool) -> None:
    """Print what a file shows, and whether it still follows from the store."""
    record = shown.as_dict()
    if as_json:
        print_json(record)
        return
    for name in ("sql", "problem"):
        record.pop(name)
    print(f"state: {readable(shown.problem or 'follows from the store')}\n")
    _print_record(record, long=long)
    lines = shown.row.sql.splitlines()
    if len(lines) > SQL_LINES and not long:
        print(f"\nsql: {len(lines)} lines, which --long prints")
        return
    print("\nsql:")
    for line in lines:
        print(f"  {readable(line)}")


def _without_parts(record: Mapping[str, object]) -> dict[str, object]:
    return {name: value for name, value in record.items() if name not in APART}


def _print_host(shown: ShownBatch | ShownExecution, reach: Sequence[str], isolations: Sequence[ShownIsolation]) -> None:
    """Print the image, isolation, programs and environment of executions."""
    from sierra.cli.render_environment import print_environment, print_image, print_isolation, print_programs

    if shown.image:
        print_image(shown.image, reach)
        for isolation in isolations:
            print_isolation(isolation)
        if not isolations and shown.kind == "execution":
            print("\nisolation: none, executed directly on the host")
    if shown.programs:
        print_programs(shown.programs)
    if shown.environment:
        print_environment(shown.environment)


def _print_firmware(versions: Sequence[FirmwareOfBatch]) -> None:
    """Print the versions of the firmware of a batch in a line, if it differs between runs."""
    if versions:
        each = [f"{one.firmware} ({counted(one.robots, 'robot')}, {counted(one.runs, 'run')})" for one in versions]
        print(f"\nfirmware differs between runs: {readable(', '.join(each))}")


def _print_build(build: ShownBuild) -> None:
    """Print the build whose products the batch used, in two lines."""
    from sierra.util.hashing import short

    row = build.row
    by = f" by {row.compiler}" if row.compiler else ""
    products = few([f"{one.name} ({short(one.sha256)})" for one in build.products], MORE)
    print()
    print(readable(f"build {short(row.build)}: {' '.join(row.command)}, on {row.host}, {cell(row.ended)}{by}"))
    print(readable(f"  {products}"))


def _print_commit(known: Known) -> None:
    """Print the recorded commit as the repository has it now."""

    print("\ncommit, as in the repository now:")
    facts = {
        "subject": known.commit.subject,
        "author": f"{known.commit.author}, {known.commit.date:%Y-%m-%d}",
        "described": known.described,
        "branches/tags": ", ".join(known.branches) or "none",
        "remote": known.remote or "none",
    }
    fields(facts, "  ")


def _print_failures(failures: Sequence[Failed]) -> None:
    """Print the reasons why runs failed, a line each."""

    if failures:
        print("\nfailures:")
    for failure in failures[:SHOWN_REASONS]:
        values = "".join(f"{name}={cell(value)}, " for name, value in failure.values.items())
        example = f"run {failure.run[:10]} ({values}number {failure.number})"
        print(f"  {counted(failure.runs, 'run')}: {readable(failure.reason)}, e.g. {example}")
    if len(failures) > SHOWN_REASONS:
        runs = sum(failure.runs for failure in failures[SHOWN_REASONS:])
        print(f"  and {len(failures) - SHOWN_REASONS} more reasons, {runs} runs (--json has them all)")


def _print_record(record: Mapping[str, object], *, long: bool) -> None:
    """Print plain values first, then tables and logs. Ids are short unless `long`, except the id of the shown record."""

    def cut(value: object) -> object:
        return value if long else short_id(value)

    nested = {name: value for name, value in record.items() if isinstance(value, list | tuple) or members(value) is not None}
    plain = {name: value for name, value in record.items() if name not in nested and name != "log_tail"}
    fields({name: value if name == record["kind"] else cut(value) for name, value in plain.items()})
    for name, value in nested.items():
        if (inner := members(value)) is not None:
            print(f"\n{name}:")
            fields({key: cut(item) for key, item in inner.items()}, "  ")
        elif isinstance(value, list | tuple) and value:
            print(f"\n{name}:")
            rows = [row for item in value if (row := members(item)) is not None]
            if rows:
                _print_rows(name, rows, cut, long=long)
            else:
                print("  " + ", ".join(map(str, value)))
    if record.get("log_tail"):
        print(f"\nlog:\n{record['log_tail']}")


def _print_rows(name: str, records: Sequence[Mapping[str, object]], cut: Callable[[object], object], *, long: bool) -> None:
    columns = list(dict.fromkeys(key for row in records for key in row if key != "log_tail"))
    most = AT_MOST.get(name, len(records))
    rows = [[cut(row.get(column)) for column in columns] for row in records[:most]]
    wide = len(columns) if long else fitting(columns, rows)
    table(columns[:wide], [row[:wide] for row in rows], width=0 if long else None)
    if wide < len(columns):
        print(f"(and {few(columns[wide:], MORE)}, in --json)")
    if len(records) > most:
        print(f"and {len(records) - most} more (--json has them all)")
