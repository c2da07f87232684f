"""Deliverables that are bound to queries: they show the last batch of these queries, and no other batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, TypeVar

from sierra.errors import DamagedFile, SierraError
from sierra.execution.batches_of_queries import BatchesOfQueries


class Bindable(Protocol):
    """A declaration of `sierra.toml` with the key `query`."""

    @property
    def query(self) -> Sequence[str]:
        """The queries whose last batches it shows; empty if it shows any batch."""


B = TypeVar("B", bound=Bindable)


def of_batch(declared: Mapping[str, B], queries: BatchesOfQueries, batch: str) -> tuple[dict[str, B], list[str]]:
    """Return the declarations that show a batch: those without a query, and those of whose only query it is the last batch.

    Also return notes on queries that are invalid.
    """
    found, notes = {}, []
    for name, one in declared.items():
        try:
            if not one.query or (len(one.query) == 1 and batch in queries.last_of(one.query[0])):
                found[name] = one
        except DamagedFile:
            raise
        except SierraError as error:
            notes.append(f"{name}: query: {error}")
    return found, notes
