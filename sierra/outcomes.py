"""What two executions wrote, compared file by file: bytes first, values where those differ."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from sierra.agreement import Agreement, Verdict, of_tables, of_texts
from sierra.config import Output
from sierra.store import Question, Store
from sierra.store.results import rows_of


def compare(
    question: Question, store: Store, recorded: str, found: str, declared: Mapping[str, Output]
) -> dict[str | None, Agreement]:
    """How far what the execution `found` wrote agrees with what `recorded` did, by path.

    `declared` says what is volatile and which tolerance holds. Raises Damaged where the store lacks one of them.
    """
    was, now = (_artifacts(question, execution) for execution in (recorded, found))
    agreements: dict[str | None, Agreement] = {}
    for path in sorted(was.keys() | now.keys()):
        if path not in now:
            agreements[path] = Agreement(Verdict.DIFFERENT, "was written, and is not there now")
        elif path not in was:
            agreements[path] = Agreement(Verdict.DIFFERENT, "was not written, and is there now")
        elif was[path]["sha256"] == now[path]["sha256"]:
            agreements[path] = Agreement(Verdict.IDENTICAL)
        else:
            agreements[path] = _output(question, store, (recorded, was[path]), (found, now[path]), declared)
    return agreements


def _artifacts(question: Question, execution: str) -> dict[str, dict[str, Any]]:
    rows = question.sql(
        "SELECT path, kind, output, sha256, form FROM artifacts WHERE execution = $e AND kind <> 'log'", e=execution
    ).to_pylist()
    return {row["path"]: row for row in rows}


def _output(
    question: Question,
    store: Store,
    was: tuple[str, Mapping[str, Any]],
    now: tuple[str, Mapping[str, Any]],
    declared: Mapping[str, Output],
) -> Agreement:
    """How far one output agrees, whose bytes differ."""
    name = was[1]["output"]
    rules = declared.get(name or "") or next((o for o in declared.values() if o.file == was[1]["path"]), None)
    volatile = rules.volatile if rules else ()
    if was[1]["kind"] == now[1]["kind"] == "table":
        old, new = (rows_of(question, execution, row["output"], _file(row)) for execution, row in (was, now))
        return of_tables(old, new, rules.tolerance if rules else {}, volatile)
    if was[1]["kind"] != now[1]["kind"]:
        return Agreement(Verdict.DIFFERENT, f"was a {was[1]['kind']} and is a {now[1]['kind']}")
    return of_texts(store.object(was[1]["sha256"]), store.object(now[1]["sha256"]), volatile)


def _file(artifact: Mapping[str, Any]) -> str | None:
    """The file's name in its table, where a run writes several."""
    return artifact["path"] if json.loads(artifact["form"] or "{}").get("file", "") is None else None
