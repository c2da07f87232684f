"""The section about failures: why runs have no result, the ends of their logs, and doubts about results."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from sierra.deliverables.report.batch_state import BatchState
from sierra.deliverables.report.parts import Place, Section, auto, note, sql, table
from sierra.execution.show_record import FAILURES
from sierra.execution.shown_records import Failed
from sierra.util.hashing import short
from sierra.util.html_elements import Markup, Node, element, joined
from sierra.util.text import counted

LAST = """
SELECT status, host, log_tail FROM executions WHERE run = $r AND purpose = 'run' ORDER BY lamport DESC LIMIT 1
"""
EARLIER = """
SELECT e.status, coalesce(e.reason, '') AS reason, count(*) AS executions
FROM (SELECT DISTINCT run FROM effective WHERE batch = $b) JOIN executions e USING (run)
WHERE e.purpose = 'run' AND e.status NOT IN ('ok', 'accepted') GROUP BY ALL ORDER BY executions DESC, e.status, reason
"""
REASONS, LINES, WIDTH = 20, 15, 400
"""The largest number of reasons, of lines of a log, and of characters of a line."""


class _Earlier(NamedTuple):
    status: str
    reason: str
    executions: int


class _Last(NamedTuple):
    status: str
    host: str
    log_tail: str | None


def section(state: BatchState, headings: Place) -> Section:
    """Return the section about failures, also if there are none."""
    return Section("failures", "Failures", joined(_lines(state, headings)))


def _lines(state: BatchState, headings: Place) -> Iterator[Markup]:
    failures = state.shown.failures
    if not failures:
        yield element("p", "No run failed." if not state.unexecuted else "No run that was executed failed.")
    for failure in failures[:REASONS]:
        yield _failure(state, failure, headings)
    if len(failures) > REASONS:
        runs = sum(failure.runs for failure in failures[REASONS:])
        yield note(f"{len(failures) - REASONS} more reasons, of {counted(runs, 'run')}: see sierra show {state.short}.")
    if failures:
        yield sql(FAILURES, state.id)
    yield from _earlier(state)
    for text in state.shown.notes:
        yield note(f"{text[:1].upper()}{text[1:]}.")
    if unlike := state.shown.nondeterminism:
        text = "gave other output when executed again; the table nondeterminism has them"
        yield note(f"{counted(len(unlike), 'run')} {text}.")


def _earlier(state: BatchState) -> Iterator[Markup]:
    """Yield a table of executions that did not succeed, of runs that another execution has completed."""
    rows = state.store.select(_Earlier, EARLIER, b=state.id)
    if rows:
        caption = "Executions that did not succeed, and whose runs succeeded when they were executed again"
        yield table(("ended", "reason", "executions"), rows[:REASONS], caption, (2,))
        yield sql(EARLIER, state.id)


def _failure(state: BatchState, failure: Failed, headings: Place) -> Markup:
    values = "".join(f"{name} = {value}, " for name, value in failure.values.items())
    where: list[Node] = ["for example ", element("code", short(failure.run)), f" ({values}run {failure.number})"]
    last = next(iter(state.store.select(_Last, LAST, r=failure.run)), None)
    if last:
        where.append(f" on {last.host}")
    return element(
        "article",
        element(headings.inner, f"{counted(failure.runs, 'run')}: ", auto(failure.reason)),
        element("p", *where, dir="auto"),
        _log(last.log_tail) if last and last.log_tail else note("It left no log."),
        class_="failure",
    )


def _log(tail: str) -> Markup:
    lines = [line.expandtabs()[:WIDTH] for line in tail.splitlines()[-LINES:]]
    return element("pre", "\n".join(lines), tabindex=0, role="group", aria_label="End of the log", dir="auto")
