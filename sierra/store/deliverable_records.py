"""The recorded deliverables of a batch, and their ids."""

from __future__ import annotations

from typing import Protocol

from sierra.errors import Damaged
from sierra.store.row_mapper import R
from sierra.store.row_types import DeliverableRow
from sierra.util.hashing import digest

IDENTIFYING = tuple(name for name in DeliverableRow._fields if name not in ("deliverable", "made", "lamport"))
"""The columns that the id is made from."""
LATEST = """
FROM deliverables WHERE batch = $b OR list_contains(batches, $b)
QUALIFY row_number() OVER (PARTITION BY kind, name, files ORDER BY lamport DESC, made DESC) = 1
ORDER BY kind, name, lamport DESC, made DESC
"""
"""The last record of each set of files that show a batch, alone or beside others."""


def deliverable_id(row: DeliverableRow) -> str:
    """Return the id that follows from a deliverable's columns."""
    return digest("deliverable", {name: getattr(row, name) for name in IDENTIFYING})


class Queryable(Protocol):
    """The store, or one state of it."""

    def select(self, kind: type[R], text: str, **parameters: object) -> list[R]:
        """Return the rows of one statement as instances of a row class."""


def rows(store: Queryable, text: str, **parameters: object) -> list[DeliverableRow]:
    """Return the records that a statement selects. Raises Damaged for one whose files and hashes do not belong together."""
    found = store.select(DeliverableRow, text, **parameters)
    for row in found:
        if len(row.files) != len(row.sha256s):
            raise Damaged(f"the record of {row.name!r} has {len(row.files)} files, but {len(row.sha256s)} hashes of files")
    return found


def latest(store: Queryable, batch: str) -> list[DeliverableRow]:
    """Return the last record of each file of the deliverables that show a batch, sorted by kind and name, from the last one on.

    A deliverable can have several records if it was made in several formats. Each has only the files that no later one has.
    Raises Damaged, as `rows` does.
    """
    taken: set[str] = set()
    newest = []
    for row in rows(store, f"SELECT * {LATEST}", b=batch):
        own = [(file, sha256) for file, sha256 in zip(row.files, row.sha256s, strict=True) if file not in taken]
        taken.update(row.files)
        if own:
            newest.append(row._replace(files=[file for file, _ in own], sha256s=[sha256 for _, sha256 in own]))
    return newest
