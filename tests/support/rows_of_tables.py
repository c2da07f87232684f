"""Stores of a few rows that no run has written, for tests of statements."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from sierra.store.row_types import TABLES
from sierra.store.schema import TIME, sql_types
from sierra.store.store import Store

MOMENT = datetime(2026, 1, 1, tzinfo=UTC)
EMPTY: dict[str, Any] = {"BIGINT": 0, "DOUBLE": 0.0, "BOOLEAN": True, "VARCHAR[]": [], "BLOB": b"", TIME: MOMENT}


def filled(kind: type[NamedTuple], /, **values: Any) -> NamedTuple:
    """Return a row with these values, and others of the right types."""
    return kind(**{name: EMPTY.get(sql, "") for name, sql in sql_types(TABLES[kind]).items()} | values)


def store(root: Path, rows: Sequence[NamedTuple]) -> Store:
    """Return a new store with these rows."""
    made = Store.create(root)
    writer = made.writer(root / "new", "a")
    for kind in dict.fromkeys(map(type, rows)):
        writer.records(row for row in rows if type(row) is kind)
    made.publish(writer)
    return Store(root)
