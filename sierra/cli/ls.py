"""`sierra ls`: list the batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import typer


def ls(
    long: Annotated[bool, typer.Option("--long", help="Show full ids, and do not shorten text to fit the terminal.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead of text.")] = False,
) -> None:
    """List batches, most recent last.

    \b
    Example:
      sierra ls
    """
    from sierra.cli.open_project import project
    from sierra.cli.output import print_json, table
    from sierra.util.hashing import short

    batches = project().batches
    if as_json:
        print_json(batches)
        return
    columns = {
        "batch": [row["batch"] if long else short(row["batch"]) for row in batches],
        "submitted": [row["submitted"] or row["created"] for row in batches],
        "query": [row["query"] for row in batches],
        **_where_any("controller", [row["controller"] or "" for row in batches]),
        **_where_any("scenario", [row["scenario"] or "" for row in batches]),
        **_where_any("overrides", [" ".join(row["overrides"]) for row in batches]),
        **_where_any("changed", [", ".join(row["changed"]) for row in batches]),
        **{name: [row[name] for row in batches] for name in ("experiments", "runs")},
        "state": [_state(row) for row in batches],
    }
    table(tuple(columns), zip(*columns.values(), strict=True), right=("experiments", "runs"), width=0 if long else None)


def _where_any(name: str, texts: Sequence[str]) -> dict[str, Sequence[str]]:
    """Return a column as a dictionary; an empty dictionary if all its texts are empty."""
    return {name: texts} if any(texts) else {}


def _state(row: dict[str, Any]) -> str:
    from sierra.cli import ask_detach

    parts = [f"{row[name]} {name}" for name in ("failed", "missing") if row[name]] or ["complete"]
    parts += [f"on {one['runner']} now ({ask_detach.named(one['jobs'])})" for one in row["clusters"]]
    if row["nondeterministic"]:
        parts.append(f"{row['nondeterministic']} not deterministic")
    return ", ".join(parts)
