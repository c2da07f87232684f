"""The two things that are compared, each with all that the store has of it as a whole; runs stand in a temporary table.

A run stands for its execution that counts (else its last one) in the batch that was last asked for; an experiment likewise.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sierra.errors import UsageError
from sierra.hashing import short
from sierra.store import Found, Question
from sierra.store.files import Taken, take_as

BEFORE, AFTER = "before", "after"
ONE = ("run", "execution")
"""What is one run."""


@dataclass(frozen=True, slots=True)
class Side:
    """One of the two."""

    found: Found
    table: str
    """Its runs: the columns of `sierra.store.files.Taken`, and `seed`, `input`, `others`, `result`."""
    runs: int
    batch: Mapping[str, Any]
    recipe: Mapping[str, Any]
    session: Mapping[str, Any]
    """The asking that it is seen from: of a batch or an experiment the last one; empty where that is not recorded."""
    source: Mapping[str, Any]
    """The state of the code, as far as that asking, or else any, says it; empty where no source counts."""
    cells: Mapping[int, Mapping[str, Any]]
    """The values of each experiment, by its place in the batch; a controller or scenario of the whole batch among them."""

    @property
    def is_one(self) -> bool:
        return self.found.kind in ONE

    @property
    def called(self) -> str:
        return f"{self.found.kind} {short(self.found.id)}"


def check(before: Found, after: Found) -> None:
    """Raises UsageError where two things are of kinds that have nothing to compare."""
    if before.kind != after.kind and not (before.kind in ONE and after.kind in ONE):
        raise UsageError(
            f"{short(before.id)} is a {before.kind} and {short(after.id)} a {after.kind}; compare two of one kind, "
            "or a run with an execution"
        )


def gather(question: Question, found: Found, table: str) -> Side:
    """All that the store has of one of the two."""
    batch_id = take_as(question, found, f"{table}_taken")
    question.views.make(("members", "executions", "sessions", "sources", "recipes", "batches", "experiments", "replays"))
    question.run(
        f"CREATE TEMP TABLE {table} AS SELECT t.*, m.seed, m.input, m.others, e.result "  # noqa: S608 - our own names
        f"FROM {table}_taken t "
        "JOIN (SELECT DISTINCT ordinal, number, run, seed, input, others FROM members WHERE batch = $b) m "
        "USING (ordinal, number, run) LEFT JOIN executions e ON e.execution = t.execution",
        {"b": batch_id},
    )
    question.run(f"DROP TABLE {table}_taken")
    [batch] = _rows(question, "SELECT * FROM batches WHERE batch = $b", b=batch_id)
    [recipe] = _rows(question, "SELECT * FROM recipes WHERE recipe = $r", r=batch["recipe"])
    recipe["variables"] = json.loads(recipe["variables"])
    session = _session(question, found, batch_id)
    return Side(
        found=found,
        table=table,
        runs=question.run(f"SELECT count(*) FROM {table}")[0][0],  # noqa: S608
        batch=batch,
        recipe=recipe,
        session=session,
        source=_source(question, recipe["source"], session.get("source")),
        cells=_cells(question, batch, table),
    )


def _rows(question: Question, text: str, **parameters: Any) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = question.sql(text, **parameters).to_pylist()
    return rows


def _session(question: Question, found: Found, batch: str) -> dict[str, Any]:
    if found.kind == "execution":
        of = "session = (SELECT session FROM executions WHERE execution = $i)"
        identity = found.id
    else:
        of, identity = "batch = $i", batch
    rows = _rows(question, f"SELECT * FROM sessions WHERE {of} ORDER BY ended DESC LIMIT 1", i=identity)  # noqa: S608
    return rows[0] if rows else {}


def _source(question: Question, tree: str | None, known: str | None) -> dict[str, Any]:
    rows = _rows(
        question, "SELECT * FROM sources WHERE tree = $t ORDER BY source <> $s NULLS LAST LIMIT 1", t=tree, s=known or ""
    )
    return rows[0] if rows else {}


def _cells(question: Question, batch: Mapping[str, Any], table: str) -> dict[int, dict[str, Any]]:
    whole = {name: batch[name] for name in ("controller", "scenario") if batch[name] is not None}
    rows = _rows(
        question,
        f"SELECT * FROM experiments WHERE batch = $b AND ordinal IN (SELECT ordinal FROM {table}) ORDER BY ordinal",  # noqa: S608
        b=batch["batch"],
    )
    return {row["ordinal"]: {**whole, **{name: row[name] for name in batch["axes"]}} for row in rows}


BOTH = """
CREATE TEMP VIEW both_sides AS
SELECT b.ordinal, b.number, a.ordinal AS now_ordinal, a.number AS now_number, b.run AS was, a.run AS now,
       b.execution AS was_executed, a.execution AS now_executed, b.seed AS was_seed, a.seed AS now_seed,
       (b.input, b.others) IS DISTINCT FROM (a.input, a.others) AS other_input,
       b.result IS DISTINCT FROM a.result AS other_result
FROM {before} b JOIN pairs p ON p.was = b.ordinal JOIN {after} a ON a.ordinal = p.now {same}
"""


def pair(question: Question, before: Side, after: Side) -> list[tuple[int, int]]:
    """The experiments that both have, by their places, and their runs as the temporary view `both_sides`.

    What is one experiment is paired with whatever it is compared with. An axis that only one batch has, with one value, and a
    controller or a scenario that is no axis of either, keep no experiments apart.
    """
    import pyarrow as pa

    if before.found.kind != "batch":
        pairs = [(next(iter(before.cells)), next(iter(after.cells)))]
    else:
        names = list(_telling(before, after))
        places = {tuple(cell.get(name) for name in names): ordinal for ordinal, cell in after.cells.items()}
        keys = {ordinal: tuple(cell.get(name) for name in names) for ordinal, cell in before.cells.items()}
        pairs = [(ordinal, places[key]) for ordinal, key in keys.items() if key in places]
    columns = {name: pa.array([pair[at] for pair in pairs], pa.int64()) for at, name in enumerate(("was", "now"))}
    question.register("pairs", pa.table(columns))
    same = "" if before.is_one else "AND a.number = b.number"
    question.run(BOTH.format(before=before.table, after=after.table, same=same))
    return pairs


def _telling(before: Side, after: Side) -> Iterator[str]:
    """The axes by which experiments are told apart."""
    for name in dict.fromkeys((*before.batch["axes"], *after.batch["axes"])):
        values = [{cell.get(name) for cell in side.cells.values()} for side in (before, after)]
        if {None} not in values or any(len(several) > 1 for several in values):
            yield name


def takens(question: Question, side: Side, places: Sequence[tuple[int, int]]) -> list[Taken]:
    """Some of a side's runs, by the places of their experiments and their numbers, in that order."""
    columns = "experiment, ordinal, number, run, execution, status, which"
    statement = f"SELECT {columns} FROM {side.table} WHERE ordinal = $o AND number = $n"  # noqa: S608
    return [Taken(*question.run(statement, {"o": ordinal, "n": number})[0]) for ordinal, number in places]
