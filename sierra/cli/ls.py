"""`sierra ls`: list the batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.arguments import AsJsonList, Long
from sierra.cli.output import print_json, table
from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.execution.list_batches import ListedBatch


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
    as_json: AsJsonList = False,
) -> None:
    """List batches, most recent last, or cluster jobs.

    With --jobs, first records finished runs of sessions that no other process follows. Queries the scheduler once for each
    session: how many array tasks are queued (with the scheduler's reason), and how many are running. State "gone": the jobs
    ended with runs missing; sierra attach submits these runs again.

    \b
    Examples:
      sierra ls
      sierra ls --jobs
      sierra ls --jobs 9e1c --json
    """
    if jobs:
        from sierra.cli.open_project import refuse_in_package
        from sierra.cli.status import status

        refuse_in_package("--jobs", "asks schedulers, and records finished runs")
        status(prefix, long, as_json)
        return
    if prefix is not None:
        raise UsageError(f"without --jobs, all batches are listed; sierra show {prefix} shows one")
    from sierra.cli.open_project import project
    from sierra.util.hashing import short

    batches = project().batches
    if as_json:
        print_json(batches)
        return
    columns: dict[str, Sequence[object]] = {
        "batch": [one.batch if long else short(one.batch) for one in batches],
        "submitted": [one.submitted or one.created for one in batches],
        "query": [one.query for one in batches],
        **_where_any("controller", [one.controller or "" for one in batches]),
        **_where_any("scenario", [one.scenario or "" for one in batches]),
        **_where_any("target", [", ".join(one.targets) for one in batches]),
        **_where_any("overrides", [" ".join(one.overrides) for one in batches]),
        **_where_any("changed", [", ".join(one.changed) for one in batches]),
        **_where_any("study", [_looks(one) for one in batches]),
        **_where_any("package", [(one.package or "") if long else short(one.package or "") for one in batches]),
        "experiments": [one.experiments for one in batches],
        "runs": [one.runs for one in batches],
        "state": [_state(one) for one in batches],
    }
    table(tuple(columns), zip(*columns.values(), strict=True), right=("experiments", "runs"), width=0 if long else None)


def _where_any(name: str, texts: Sequence[str]) -> dict[str, Sequence[str]]:
    """Return a column as a dictionary; an empty dictionary if all its texts are empty."""
    return {name: texts} if any(texts) else {}


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
