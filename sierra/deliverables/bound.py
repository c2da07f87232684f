"""Deliverables that are bound to queries: they show the last batch of these queries, and no other batch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol, TypeVar

from sierra.config.project_file import Project
from sierra.errors import DamagedFile, SierraError
from sierra.execution.batches_of_queries import BatchesOfQueries
from sierra.store.batch_data import BatchData
from sierra.store.store import Store


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
    shown, notes = {}, []
    for name, declaration in declared.items():
        words = declaration.query
        try:
            if not words or (len(words) == 1 and batch in queries.last_of(words[0])):
                shown[name] = declaration
        except DamagedFile:
            raise
        except SierraError as error:
            notes.append(f"{name}: query: {error}")
    return shown, notes


def unbound(declared: Mapping[str, B]) -> dict[str, B]:
    """Return the declarations without a query."""
    return {name: declaration for name, declaration in declared.items() if not declaration.query}


def is_of_others(variables: Iterable[str], table: str, config: Project, store: Store, frame: BatchData) -> bool:
    """Check if a declaration without a query is about a variable or an output that only other batches have."""
    groups = {"controller": config.controllers, "scenario": config.scenarios}
    known = {*config.variables, *(name for name, declared in groups.items() if declared)}
    if known.intersection(variables) - {axis.name for axis in frame.axes()}:
        return True
    return bool(table) and table not in frame.names and table in store.outputs()
