"""`sierra ls`: list the batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJsonList, Format, Long
from sierra.cli.output import print_json, table
from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.execution.list_batches import ListedBatch

OPTIONAL = ("controller", "scenario", "target", "overrides", "changed", "study", "package")
"""The columns that the table for people leaves out if they are empty."""


def ls(
    prefix: Annotated[
        str | None,
        typer.Argument(
            metavar="HASH",
            autocompletion=complete.sessions,
            help="With --jobs: batch id or session id; a prefix is enough (default: all).",
        ),
    ] = None,
    jobs: Annotated[bool, typer.Option("--jobs", help="List cluster jobs instead.")] = False,
    long: Long = False,
    format: Annotated[
        Format, typer.Option("--format", "-f", help="Output format; all except table have full ids and all columns.")
    ] = Format.table,
    as_json: AsJsonList = False,
) -> None:
    """List batches, most recent last, or cluster jobs.

    With --jobs, first records finished runs of sessions that no other process follows. Queries the scheduler once for each
    session: how many array tasks are queued (with the scheduler's reason), and how many are running. State "gone": the jobs
    ended with runs missing; sierra attach submits these runs again.

    \b
    Examples:
      sierra ls
      sierra ls --format csv
      sierra ls --jobs
      sierra ls --jobs 9e1c --json
    """
    as_json = as_json or format is Format.json
    if jobs:
        if format not in (Format.table, Format.json):
            raise UsageError("--jobs prints a table or JSON; leave out --format")
        from sierra.cli.open_project import refuse_in_package
        from sierra.cli.status import status

        refuse_in_package("--jobs", "asks schedulers, and records finished runs")
        status(prefix, long, as_json)
        return
    if prefix is not None:
        raise UsageError(f"without --jobs, all batches are listed; sierra show {prefix} shows one")
    from sierra.cli.open_project import project

    batches = project().batches
    if as_json:
        print_json(batches)
    elif format is Format.table:
        columns = _columns(batches, long=long)
        shown = {name: values for name, values in columns.items() if name not in OPTIONAL or any(values)}
        table(tuple(shown), zip(*shown.values(), strict=True), right=("experiments", "runs"), width=0 if long else None)
    else:
        import pyarrow as pa

        from sierra.cli.sql import Printable, write

        write(Printable.of_arrow(pa.table(_columns(batches, long=True))), format, None)


def _columns(batches: Sequence[ListedBatch], *, long: bool) -> dict[str, Sequence[object]]:
    """Return the columns of the list; with `long`, ids are not shortened."""
    from sierra.util.hashing import short

    return {
        "batch": [row.batch if long else short(row.batch) for row in batches],
        "submitted": [row.submitted or row.created for row in batches],
        "query": [row.query for row in batches],
        "controller": [row.controller or "" for row in batches],
        "scenario": [row.scenario or "" for row in batches],
        "target": [", ".join(row.targets) for row in batches],
        "overrides": [" ".join(row.overrides) for row in batches],
        "changed": [", ".join(row.changed) for row in batches],
        "study": [_looks(row) for row in batches],
        "package": [(row.package or "") if long else short(row.package or "") for row in batches],
        "experiments": [row.experiments for row in batches],
        "runs": [row.runs for row in batches],
        "state": [_state(row) for row in batches],
    }


def _looks(one: ListedBatch) -> str:
    from sierra.util.hashing import short

    return ", ".join(f"{short(look.study)} look {look.number}" for look in one.looks)


def _state(one: ListedBatch) -> str:
    from sierra.cli import ask_detach

    counts = {"failed": one.failed, "missing": one.missing}
    parts = [f"{count} {name}" for name, count in counts.items() if count] or ["complete"]
    parts += [f"on {session.runner} now ({ask_detach.named(session.jobs)})" for session in one.clusters]
    if one.nondeterministic:
        parts.append(f"{one.nondeterministic} not deterministic")
    return ", ".join(parts)
