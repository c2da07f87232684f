"""Remarks that people make on executions afterwards: that a trial is not valid, or valid after all, and notes.

A remark is a new row of the table `trials`; no row is ever changed. It repeats what the last row of the execution says, so that
the last row is complete. An execution that is not valid has the status `invalid` (see `sierra.store.views`): it is not
effective, and the next time that its batch is requested, its run is executed again.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import NamedTuple

from sierra.errors import NotFound, UsageError
from sierra.execution.sessions import Session
from sierra.store.lamport_clock import stamp
from sierra.store.row_types import TrialRow
from sierra.store.store import Store
from sierra.util.hashing import short


class _Marked(NamedTuple):
    execution: str
    batch: str


LAST = "SELECT * FROM trials WHERE execution = $e"
OF_EXECUTION = "SELECT execution, batch FROM executions WHERE execution = $id"
OF_RUN = """
SELECT execution, e.batch FROM effective c JOIN executions e USING (execution) WHERE c.run = $id ORDER BY c.lamport DESC
"""


def mark(
    store: Store,
    prefix: str,
    *,
    valid: bool | None = None,
    reason: str | None = None,
    note: str | None = None,
    operator: str | None = None,
) -> TrialRow:
    """Record a remark on the execution with an id, or on the effective execution of a run; return the new row.

    Arguments that are None change nothing. Raises NotFound if there is no such execution, UsageError if a trial becomes
    invalid without a reason.
    """
    execution, batch = _execution(store, prefix)
    if valid is False and not (reason or "").strip():
        raise UsageError("an invalid trial needs a reason, as in --reason 'robot 2 fell over'")
    for name, text in (("reason", reason), ("note", note), ("operator", operator)):
        if text is not None and ("\n" in text or "\r" in text):
            raise UsageError(f"{name}: use one line, not {text[:30]!r}")
    session = Session(store.paths, logged=False)
    try:
        session.take_number()
        last = next(iter(store.select(TrialRow, LAST, e=execution)), TrialRow(execution, datetime.now(UTC), None))
        row = last._replace(
            marked=datetime.now(UTC),
            valid=last.valid if valid is None else valid,
            reason=None if valid else _text(reason, last.reason),
            note=_text(note, last.note),
            operator=_text(operator, last.operator),
            lamport=stamp(session.number, session.id),
        )
        writer = store.writer(session.paths.segment, batch)
        writer.records([row])
        store.publish(writer)
        return row
    finally:
        session.close()


def _text(given: str | None, before: str | None) -> str | None:
    return before if given is None else given.strip() or None


def _execution(store: Store, prefix: str) -> _Marked:
    """Return the execution that is meant, and its own batch, among whose records the remark belongs. Raises NotFound."""
    found = store.identify(prefix)
    if found.kind not in ("execution", "run"):
        raise NotFound(f"{prefix!r} is a {found.kind}; name one execution, or a run (sierra show RUN lists its executions)")
    meant = store.select(_Marked, OF_EXECUTION if found.kind == "execution" else OF_RUN, id=found.id)
    if not meant:
        raise NotFound(f"run {short(found.id)} has no execution that counts; name an execution of it")
    return meant[0]
