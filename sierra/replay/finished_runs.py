"""Executions of earlier calls that need not be repeated."""

from __future__ import annotations

from typing import NamedTuple

from sierra.ingest.recording_context import Context
from sierra.replay.find_record import Record
from sierra.replay.options import ReplayOptions
from sierra.store.store import Store


class Finished(NamedTuple):
    """A successful execution of an earlier call."""

    run: str
    execution: str
    session: str


FINISHED = """
SELECT run, max(execution) AS execution, arg_max(session, execution) AS session FROM executions
WHERE (purpose = 'replay' AND list_contains($sessions, session) OR list_contains($executions, execution))
  AND list_contains($runs, run) AND status = 'ok'
  AND programs = $programs AND environment = $environment AND ingest_rules = $rules
  AND isolation IS NOT DISTINCT FROM $isolation
GROUP BY run
"""
"""SQL: one of these executions for each run."""


def finished(store: Store, record: Record, options: ReplayOptions, context: Context) -> dict[str, Finished]:
    """Return the executions of earlier calls that count, by run: those that this replay would repeat."""
    if not (options.earlier or options.variation.finished):
        return {}
    rows = store.select(
        Finished,
        FINISHED,
        sessions=sorted(options.earlier),
        executions=sorted(options.variation.finished),
        runs=[one.run for one in record.runs],
        programs=context.programs,
        environment=context.environment,
        rules=context.ingest_rules,
        isolation=context.isolation and context.isolation.isolation,
    )
    return {row.run: row for row in rows}
