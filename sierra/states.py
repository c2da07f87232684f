"""What the store has of each run of a plan: a good execution, or why there must be one."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

from sierra.plans import Plan, context
from sierra.store import Question, Store


@dataclass(frozen=True, slots=True)
class State:
    """What the store has of a run: good, or why it must execute."""

    good: bool
    why: str
    executions: int = 0


def is_answered(plan: Plan, store: Store) -> bool:
    """Whether the last asking of all was this one, by the same programs and rules, and every run is good: nothing is to do."""
    now = context(plan)
    with store.ask() as question:
        question.views.make(("sessions",))
        last = question.run("SELECT arg_max(batch, ended), arg_max(programs, ended), arg_max(rules, ended) FROM sessions")
        same = last == [(plan.batch.id, now.programs, now.rules)]
        return same and all(state.good for state in states(plan, question).values())


def states(plan: Plan, asked: Store | Question | None) -> dict[str, State]:
    """What the store has of each run of the batch."""
    runs = dict.fromkeys((run.id for run in plan.batch.runs), State(False, "new"))
    if asked is None:
        return runs
    import pyarrow as pa

    seen: dict[tuple[Any, ...], State] = {}
    with asked.ask() if isinstance(asked, Store) else contextlib.nullcontext(asked) as question:
        question.register("asked", pa.table({"run": list(runs)}))
        question.run("SET threads = 1")  # of 100,000 runs, each thread would hold its own
        question.views.make(("executions",))
        parameters = {"programs": plan.programs.id, "reading": context(plan).reading}
        for run, *found in question.each(STATES, parameters):
            key = tuple(found)
            runs[run] = seen.get(key) or seen.setdefault(key, _state(*found))
    return runs


STATES = """
SELECT run, bool_or(ok AND programs = $programs AND reading = $reading), bool_or(ok AND reading = $reading),
       bool_or(ok), arg_max(reason, ended), count(*)
FROM (SELECT *, status = 'ok' AS ok FROM executions) e JOIN asked USING (run)
WHERE purpose = 'run' GROUP BY run
"""


def _state(good: bool, same_reading: bool, ever: bool, reason: str | None, executions: int) -> State:
    if good:
        return State(True, "reused", executions)
    if same_reading:
        return State(False, "executed with other programs", executions)
    return State(False, "[outputs] or [success] have changed" if ever else f"failed: {reason}", executions)
