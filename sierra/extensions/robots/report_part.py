"""The part of a report about robots: which ones executed the runs, their clocks and containers, and which were lost."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from sierra.deliverables.report.batch_state import BatchState
from sierra.deliverables.report.parts import Place, filled_table, note, sql, table
from sierra.util.html_elements import Markup, element
from sierra.util.text import digits_apart, short_number

ROBOTS = """
SELECT r.robot, r.robot_group AS part, string_agg(DISTINCT r.machine, ', ') AS machine,
       string_agg(DISTINCT r.firmware, ', ') AS firmware,
       string_agg(DISTINCT coalesce(i.version, i.engine), ', ') AS container,
       count(DISTINCT r.execution) AS executions, median(abs(r.start_skew_ns)) / 1e6 AS start_ms,
       max(abs(r.start_skew_ns)) / 1e6 AS latest_ms, max(abs(r.offset_end_ns - r.offset_start_ns)) / 1e6 AS drift_ms,
       min(r.battery_end) AS battery, string_agg(DISTINCT r.clock_remark, '; ') AS remark
FROM effective f JOIN robots r USING (execution) LEFT JOIN isolations i ON i.isolation = r.isolation
WHERE f.batch = $b GROUP BY r.robot, part ORDER BY part, r.robot
"""
"""The robots of the executions that count. Times are in milliseconds."""
ENDED_OTHERWISE = """
SELECT r.robot, r.status, coalesce(r.reason, '') AS reason, count(*) AS executions
FROM (SELECT DISTINCT run FROM batch_runs WHERE batch = $b) JOIN executions e USING (run) JOIN robots r USING (execution)
WHERE e.purpose = 'run' AND r.status <> 'ok' GROUP BY ALL ORDER BY executions DESC, r.robot, r.status, reason
"""
"""Robots whose parts of executions did not end well, also in executions that do not count."""
SHOWN = 200
"""The largest number of robots that are listed."""
HEADERS = (
    "robot",
    "group",
    "processor",
    "firmware",
    "container",
    "runs",
    "start off by [ms], median",
    "largest",
    "clock moved by at most [ms]",
    "lowest battery [%]",
    "remark on its clock",
)
NUMBERS = (5, 6, 7, 8, 9)


class _Robot(NamedTuple):
    robot: str
    part: str
    machine: str | None
    firmware: str | None
    container: str | None
    executions: int
    start_ms: float | None
    latest_ms: float | None
    drift_ms: float | None
    battery: float | None
    remark: str | None


class _Ended(NamedTuple):
    robot: str
    status: str
    reason: str
    executions: int


def lines(state: BatchState, position: Place) -> Iterator[Markup]:
    """Yield the elements about the robots of a batch; nothing if it has none."""
    if not state.shown.spec.robots:
        return
    robots = state.store.select(_Robot, ROBOTS, b=state.id)
    yield element(position.inner, "Robots")
    digits = [digits_apart(column, 3) for column in zip(*robots[:SHOWN], strict=True)]
    rows = [
        tuple(short_number(value, many) if isinstance(value, float) else value for value, many in zip(row, digits, strict=True))
        for row in robots[:SHOWN]
    ]
    yield filled_table(HEADERS, rows, "Robots of the executions that count", NUMBERS)
    if len(robots) > SHOWN:
        yield note(f"The first {SHOWN} of {len(robots)} robots are listed.")
    if any(row.start_ms is not None for row in robots):
        yield note("A start is off by the time from the common start to that of its program, by the submitting host's clock.")
    yield sql(ROBOTS, state.id)
    ended = state.store.select(_Ended, ENDED_OTHERWISE, b=state.id)
    if ended:
        headers = ("robot", "its part ended", "reason", "executions")
        yield table(headers, ended[:SHOWN], "Robots whose parts did not end well, also in executions that do not count", (3,))
        yield sql(ENDED_OTHERWISE, state.id)
