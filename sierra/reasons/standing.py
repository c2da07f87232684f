"""Which executions count in which batch, and why no other does: the rule of the table `counting`, said in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sierra.difference.around import other_programs, other_rules
from sierra.difference.kinds import joined
from sierra.store import Question
from sierra.store.views import LATEST

SHOWN = 4


@dataclass(frozen=True, slots=True)
class Standing:
    """Runs of one batch for which the same holds."""

    batch: str
    runs: int
    counts: bool
    why: str
    run: str
    """One of them."""
    execution: str | None
    """Of that run: the one that counts, else its last one."""


STANDINGS = f"""{LATEST},
mine AS (SELECT DISTINCT batch, ordinal, run FROM members SEMI JOIN wanted USING (run) WHERE list_contains($batches, batch)),
counted AS (SELECT batch, ordinal, run, execution FROM counting WHERE list_contains($batches, batch)),
tried AS (
    SELECT run, arg_max({{'execution': execution, 'reason': coalesce(reason, status), 'programs': programs, 'reading': reading,
           'good': status = 'ok'}}, (status = 'ok', ended)) AS last
    FROM executions SEMI JOIN wanted USING (run) WHERE purpose = 'run' GROUP BY run
)
SELECT m.batch, c.execution IS NOT NULL AS counts, t.run IS NOT NULL AS tried, coalesce(t.last.good, false) AS good,
       CASE WHEN c.execution IS NULL AND NOT t.last.good THEN t.last.reason END AS reason,
       CASE WHEN c.execution IS NULL AND t.last.good THEN t.last.programs END AS programs,
       CASE WHEN c.execution IS NULL AND t.last.good THEN t.last.reading END AS reading,
       any_value(l.programs) AS now_programs, any_value(l.reading) AS now_reading, any_value(l.asked) AS asked,
       count(DISTINCT m.run) AS runs, min(m.run) AS run,
       arg_min(coalesce(c.execution, t.last.execution), m.run) AS execution
FROM mine m LEFT JOIN counted c USING (batch, ordinal, run) LEFT JOIN tried t ON t.run = m.run
LEFT JOIN latest l ON l.batch = m.batch
GROUP BY ALL ORDER BY max(l.asked) DESC, m.batch, runs DESC
"""  # noqa: S608 - of our own parts


def standings(question: Question, batches: list[str]) -> list[Standing]:
    """What holds for the runs in the table `wanted` in each of these batches, the last asked for first."""
    question.views.make(("members", "sessions", "executions", "counting"))
    rows = question.sql(STANDINGS, batches=batches).to_pylist()
    return [
        Standing(row["batch"], row["runs"], row["counts"], _why(question, row), row["run"], row["execution"]) for row in rows
    ]


def _why(question: Question, row: dict[str, Any]) -> str:
    if row["counts"]:
        return "the last good one with the programs and by the rules of the batch's last asking"
    if not row["tried"]:
        return "never executed"
    if not row["good"]:
        return f"none is good; the last one: {row['reason']}"
    return f"stale: the last good one was executed otherwise than the batch was last asked for: {_other(question, row)}"


def _other(question: Question, row: dict[str, Any]) -> str:
    return joined([*_differences(question, row)], SHOWN) or "which programs or rules is not recorded"


def _differences(question: Question, row: dict[str, Any]) -> Iterator[str]:
    if row["programs"] != row["now_programs"]:
        yield from (one.line for one in other_programs(question, [row["programs"]], [row["now_programs"]]))
    if row["reading"] != row["now_reading"]:
        yield from (one.line for one in other_rules(question, [row["reading"]], [row["now_reading"]]))
