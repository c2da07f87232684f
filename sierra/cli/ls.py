"""`sierra ls`: list the batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sierra.cli.arguments import AsJsonList, Long
from sierra.cli.output import print_json, table

if TYPE_CHECKING:
    from sierra.execution.list_batches import ListedBatch


def ls(
    long: Long = False,
    as_json: AsJsonList = False,
) -> None:
    """List batches, most recent last.

    \b
    Example:
      sierra ls
    """
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
