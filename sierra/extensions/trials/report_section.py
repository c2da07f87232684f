"""The section about supervised trials: who supervised them, and which ones do not count and why."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import NamedTuple

from sierra.deliverables.report.batch_state import BatchState
from sierra.deliverables.report.parts import Section, facts, filled_table, note, sql
from sierra.util.hashing import short
from sierra.util.html_elements import Markup, element, joined
from sierra.util.text import counted, few

TRIALS = """
SELECT e.run, m.number, t.marked, t.operator, t.arena, t.order_rule, t.valid, t.stopped, e.status, t.reason, t.note,
       t.execution IN (SELECT execution FROM effective WHERE batch = $b) AS counts
FROM trials t JOIN executions e USING (execution)
JOIN (SELECT run, min((ordinal, number)) AS at, arg_min(number, (ordinal, number)) AS number FROM batch_runs WHERE batch = $b
      GROUP BY run) m USING (run)
WHERE e.purpose = 'run' ORDER BY m.at, t.marked, t.execution
"""
"""All trials of the batch's runs, also those that do not count."""
SHOWN = 200
"""The largest number of trials that are listed."""


class _Trial(NamedTuple):
    run: str
    number: int
    marked: datetime
    operator: str | None
    arena: str | None
    order_rule: str | None
    valid: bool | None
    stopped: bool | None
    status: str
    reason: str | None
    note: str | None
    counts: bool

    @property
    def invalid(self) -> bool:
        return self.valid is False

    @property
    def is_remarkable(self) -> bool:
        """True if a reader must know of it: it does not count, was stopped, did not succeed, or has a note."""
        return not self.counts or bool(self.stopped) or bool(self.note)


def section(state: BatchState) -> Section | None:
    """Return the section about trials; None if nobody supervised any."""
    found = state.store.select(_Trial, TRIALS, b=state.id)
    return Section("trials", "Trials", joined(_lines(state, found))) if found else None


def _lines(state: BatchState, trials: Sequence[_Trial]) -> Iterator[Markup]:
    invalid, stopped = sum(trial.invalid for trial in trials), sum(bool(trial.stopped) for trial in trials)
    text = f"{counted(len(trials), 'trial')}, of which {invalid:,} {'is' if invalid == 1 else 'are'} not valid"
    yield element("p", f"{text}. The operator stopped {stopped:,}. Trials that are not valid are in no number.")
    named = {"operators": [trial.operator for trial in trials], "arenas": [trial.arena for trial in trials]}
    named["order"] = [trial.order_rule for trial in trials]
    yield facts({name: few(list(dict.fromkeys(filter(None, values))), SHOWN) for name, values in named.items()})
    remarkable = [trial for trial in trials if trial.is_remarkable]
    if remarkable:
        headers = ("run", "number", "ended", "decided", "operator", "counts", "stopped", "reason", "note")
        rows = [_row(trial) for trial in remarkable[:SHOWN]]
        yield filled_table(headers, rows, "Trials that do not count, were stopped, did not succeed, or have a note", (1,))
    if len(remarkable) > SHOWN:
        yield note(f"The first {SHOWN} of {len(remarkable)} are listed.")
    yield sql(TRIALS, state.id)


def _row(one: _Trial) -> tuple[str | int | None, ...]:
    counts = "yes" if one.counts else "no"
    decided = f"{one.marked:%Y-%m-%d %H:%M}"
    stopped = "yes" if one.stopped else ""
    return (short(one.run), one.number, one.status, decided, one.operator, counts, stopped, one.reason, one.note)
