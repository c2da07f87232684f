"""The contract of kinds of deliverables, and those that extensions add."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from sierra.config import extensions
from sierra.config.field_types import Table
from sierra.config.project_file import KEYS
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    from sierra.config.project_file import LoadedProject, Project
    from sierra.deliverables.gallery import Gallery
    from sierra.deliverables.record import Deliverable
    from sierra.store.row_types import DeliverableRow
    from sierra.store.store import Store


def as_written(declared: Table) -> dict[str, JsonView]:
    """Return the keys of a declaration that are written in `sierra.toml`."""
    return declared.model_dump(mode="json", exclude_unset=True, by_alias=True)


class FilesOfPaper(NamedTuple):
    """The files of a deliverable in the folder of a paper."""

    content: Deliverable
    names: tuple[str, ...]
    make: Callable[[], Mapping[str, bytes]]
    """Makes the files, by name."""


@dataclass(frozen=True, slots=True)
class DeliverableKind:
    """A kind of deliverables, under the name that records have. Its commands make and record them."""

    table: str
    """The key of `sierra.toml` with their declarations, by name; "" for a kind without declarations."""
    declaration: type[Table] | None
    """The model of a declaration. If it has a key `table`, that is an output which needs no default figure."""
    remedy: str
    """The advice for a deliverable that does not follow from the store any more, such as `make it again with: …`."""
    content: Callable[[LoadedProject, Store, DeliverableRow], Deliverable]
    """Returns the content that a recorded deliverable has now, by its definition and the data that the store has now."""
    version: int = 1
    """The version of the method that computes them; definitions have it as `version`."""
    recorded: Callable[[Any], Mapping[str, JsonView]] = as_written
    """Returns a declaration as definitions have it, under the name of the kind."""
    paper: Callable[[str, Any, Mapping[str, Gallery]], FilesOfPaper] | None = None
    """Returns the files of a declaration that is bound to queries, by its name and the data of the batches by label, which is
    empty for a single batch. None if papers have no such files. Raises SierraError if any of them cannot be made."""


def find(kind: str) -> DeliverableKind | None:
    """Return a kind that an extension adds; None for another."""
    loaded: DeliverableKind | None = extensions.load("deliverables", kind) if kind in extensions.added("deliverables") else None
    return loaded


class InPaper(NamedTuple):
    """A declared deliverable that is bound to queries, and so belongs to the paper."""

    kind: str
    table: str
    name: str
    query: tuple[str, ...]
    files: Callable[[Mapping[str, Gallery]], FilesOfPaper]


def bound(config: Project) -> Iterator[InPaper]:
    """Yield the deliverables of these kinds that belong to the paper. Without a declaration, nothing is imported."""
    for word in extensions.added("deliverables") if config.model_fields_set - KEYS else ():
        if (kind := find(word)) is not None and kind.paper is not None:
            for name, declared in config.added(kind.table, {}).items():
                if declared.query:
                    yield InPaper(word, kind.table, name, declared.query, partial(kind.paper, name, declared))


def shown_tables(config: Project) -> set[str]:
    """Return the outputs that declared deliverables of these kinds show. Without a declaration, nothing is imported."""
    keys = config.model_fields_set - KEYS
    kinds = filter(None, map(find, extensions.added("deliverables"))) if keys else ()
    return {str(getattr(declared, "table", "")) for kind in kinds for declared in config.added(kind.table, {}).values()}
