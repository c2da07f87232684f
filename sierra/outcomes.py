"""What two executions wrote, compared file by file: bytes first, values where those differ."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from sierra.agreement import Agreement, Rules, Verdict, of_tables, of_texts
from sierra.config import Output
from sierra.store import Question, Store
from sierra.store.results import rows_of

Artifacts = Mapping[str, Mapping[str, Any]]
"""What one execution left, by path: rows of `artifacts`, without logs."""


def compare(
    question: Question, store: Store, recorded: str, found: str, declared: Mapping[str, Output]
) -> dict[str | None, Agreement]:
    """How far what the execution `found` wrote agrees with what `recorded` did, by path.

    `declared` says what is volatile and which tolerance holds. Raises Damaged where the store lacks one of them.
    """
    left = artifacts(question, (recorded, found))
    return of_artifacts(question, store, left[recorded], left[found], declared)


def artifacts(question: Question, executions: Iterable[str]) -> dict[str, Artifacts]:
    """What each of these executions left."""
    import pyarrow as pa

    left: dict[str, dict[str, Mapping[str, Any]]] = {execution: {} for execution in executions}
    question.register("compared", pa.table({"execution": pa.array(left, pa.string())}))
    statement = "SELECT a.* FROM artifacts a SEMI JOIN compared USING (execution) WHERE kind <> 'log'"
    for row in question.sql(statement).to_pylist():
        left[row["execution"]][row["path"]] = row
    return dict(left)


def of_artifacts(
    question: Question, store: Store, was: Artifacts, now: Artifacts, declared: Mapping[str, Output]
) -> dict[str | None, Agreement]:
    """As `compare`, of what is known of two executions."""
    agreements: dict[str | None, Agreement] = {}
    for path in sorted(was.keys() | now.keys()):
        if path not in now:
            agreements[path] = Agreement(Verdict.DIFFERENT, "was written, and is not there now", form=True)
        elif path not in was:
            agreements[path] = Agreement(Verdict.DIFFERENT, "was not written, and is there now", form=True)
        elif was[path]["sha256"] == now[path]["sha256"]:
            agreements[path] = Agreement(Verdict.IDENTICAL)
        else:
            agreements[path] = _output(question, store, was[path], now[path], declared)
    return agreements


def _output(
    question: Question, store: Store, was: Mapping[str, Any], now: Mapping[str, Any], declared: Mapping[str, Output]
) -> Agreement:
    """How far one output agrees, whose bytes differ."""
    rules = declared.get(was["output"] or "") or next((o for o in declared.values() if o.file == was["path"]), None)
    volatile = rules.volatile if rules else ()
    if was["kind"] == now["kind"] == "table":
        old, new = (rows_of(question, row["execution"], row["output"], _file(row)) for row in (was, now))
        return of_tables(old, new, Rules(rules.tolerance, volatile, rules.time, rules.ordered) if rules else Rules())
    if was["kind"] != now["kind"]:
        return Agreement(Verdict.DIFFERENT, f"was a {was['kind']} and is a {now['kind']}", form=True)
    return of_texts(store.object(was["sha256"]), store.object(now["sha256"]), volatile)


def _file(artifact: Mapping[str, Any]) -> str | None:
    """The file's name in its table, where a run writes several."""
    return artifact["path"] if json.loads(artifact["form"] or "{}").get("file", "") is None else None
