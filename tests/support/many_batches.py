"""A store with very many batches: records in the form of `sierra run`, without outputs."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from sierra.store.row_mapper import without_facts
from sierra.store.row_types import BatchRow, SessionRow
from sierra.store.store import Store
from sierra.util.hashing import sha256

EACH = 1000
"""The number of batches of a segment: SIERRA writes one, and joins segments later."""
BEGAN = datetime(2026, 1, 1, tzinfo=UTC)


def make(root: Path, count: int) -> None:
    """Make the store of a project with this many batches: one run each, which was not executed."""
    store = Store.create(root / ".sierra")
    for first in range(0, count, EACH):
        rows = range(first, min(first + EACH, count))
        writer = store.writer(store.paths.work / "made", _id(first))
        writer.records([_record(BatchRow, row) for row in rows])
        writer.records([_record(SessionRow, row, session=_id(row)) for row in rows])
        store.publish(writer)


def _id(row: int) -> str:
    return sha256(str(row).encode())


def _record(kind: type[NamedTuple], row: int, **more: object) -> NamedTuple:
    """Return a record of a batch; all other columns are empty, 0 or its time."""
    now = BEGAN + timedelta(minutes=row)
    given = {"batch": _id(row), "query": f"population_size={row}", "lamport": row, "runs": 1, "missing": 1, **more}
    empty = {str: "", int: 0, bool: False, list[str]: [], datetime: now}
    columns = {name: without_facts(hint) for name, hint in kind.__annotations__.items()}
    return kind(**{name: given.get(name, empty.get(column)) for name, column in columns.items()})
