"""The kinds of deliverables that extensions add."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Protocol

from sierra.config import extensions
from sierra.config.field_types import Table
from sierra.config.project_file import KEYS

if TYPE_CHECKING:
    from sierra.config.project_file import LoadedProject, Project
    from sierra.deliverables.record import Content
    from sierra.store.row_types import DeliverableRow
    from sierra.store.store import Store


class DeliverableKind(Protocol):
    """A kind of deliverables, under the name that records have. Its commands make and record them."""

    table: ClassVar[str]
    """The key of `sierra.toml` with their declarations, by name."""
    declaration: ClassVar[type[Table]]
    """The model of a declaration. If it has a key `table`, that is an output which needs no default figure."""
    remedy: ClassVar[str]
    """The advice for a deliverable that does not follow from the store any more, such as `make it again with: …`."""

    @staticmethod
    def content(project: LoadedProject, store: Store, row: DeliverableRow) -> Content:
        """Return the content that a recorded deliverable has now, by its definition and the data that the store has now."""


def find(kind: str) -> DeliverableKind | None:
    """Return a kind that an extension adds; None for another."""
    found: DeliverableKind | None = extensions.load("deliverables", kind) if kind in extensions.added("deliverables") else None
    return found


def shown_tables(config: Project) -> set[str]:
    """Return the outputs that declared deliverables of these kinds show. Without a declaration, nothing is imported."""
    keys = config.model_fields_set - KEYS
    kinds = filter(None, map(find, extensions.added("deliverables"))) if keys else ()
    return {str(getattr(declared, "table", "")) for kind in kinds for declared in config.added(kind.table, {}).values()}
