"""Check whether figures, comparisons, reports and other deliverables that were made still follow from the store."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from functools import cache, partial
from pathlib import Path

from sierra.config.field_types import Table
from sierra.config.project_file import LoadedProject
from sierra.deliverables import comparison, comparison_figure, declared_tables, kinds, overlay, record, render
from sierra.deliverables.comparison import Compared
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.record import Checked, Content, ShownDeliverable
from sierra.deliverables.report import recorded as reports
from sierra.deliverables.report.make import Source
from sierra.deliverables.report.results import REPORT
from sierra.errors import SierraError
from sierra.store.row_types import DeliverableRow
from sierra.store.samples import Frame
from sierra.store.store import Store
from sierra.util.json_types import JsonView

Between = Callable[[str], Compared]
"""A function that makes a declared comparison of several batches, for the reports that show it."""
LABELS = ("targets", "batches", "labels")
"""The keys of definitions with the names of several batches, which then are in the name of the files, too."""


def check(
    project: LoadedProject, store: Store, batch: str, between: Between | None = None, *, without: Collection[str] = ()
) -> list[Checked]:
    """Return whether each recorded deliverable of a batch still follows from the store, in the order of kinds and names.

    `without` are kinds that are not checked.
    """
    with Frame(store, batch) as frame:
        gallery = cache(partial(Gallery, project, store, frame, only=frame.names))
        again = partial(_again, project, store, between, shared=gallery)
        return list(record.checked(frame, project.root, batch, again, without))


def find(project: LoadedProject, store: Store, file: Path, between: Between | None = None) -> ShownDeliverable:
    """Return the record of a file that SIERRA made. Raises NotFound, or SierraError if the file was changed."""
    return record.find(store, project.root, file, partial(_again, project, store, between))


def _again(
    project: LoadedProject,
    store: Store,
    between: Between | None,
    row: DeliverableRow,
    shared: Callable[[], Gallery] | None = None,
) -> Content:
    """Return the content that a deliverable has now, by its declaration, or by its recorded one if there is none any more."""
    row = _as_declared(project, row)
    if row.kind == comparison.KIND:
        return comparison_figure.content(project, store, row)
    if row.kind == declared_tables.KIND:
        return declared_tables.content(project, store, row.name, row.definition, row.batches)
    if row.kind == REPORT:
        return reports.again(Source(project, store, between), row)
    if kind := kinds.find(row.kind):
        return kind.content(project, store, row)
    if row.kind != render.KIND:
        raise SierraError(f"the extension that makes deliverables of kind {row.kind!r} is not installed")
    return render.content(project, store, row, shared)


def _as_declared(project: LoadedProject, row: DeliverableRow) -> DeliverableRow:
    """Return a record with the declaration that `sierra.toml` has now; as it is, if there is none of this name."""
    with record.parsing(row.name):
        definition = json.loads(row.definition)
        labels = next((definition[key] for key in LABELS if key in definition), ())
        for name, declared in _declarations(project, row.kind).items():
            if row.name == (overlay.name_of(name, labels) if len(labels) > 1 else name):
                return row._replace(definition=json.dumps({**definition, row.kind: declared}))
    return row


def _declarations(project: LoadedProject, kind: str) -> dict[str, JsonView]:
    """Return the declarations of a kind of deliverable by name, as records have them."""
    config = project.config
    if kind == comparison.KIND:
        found = {name: one.model_dump(mode="json") for name, one in config.comparisons.items()}
        return {name: {**one, "groups": one["groups"] if one["by"] else []} for name, one in found.items()}
    own: dict[str, Mapping[str, Table]] = {render.KIND: config.figures, declared_tables.KIND: config.paper_tables}
    added = kinds.find(kind)
    tables = config.added(added.table, {}) if added else own.get(kind, {})
    return {name: one.model_dump(mode="json", exclude_unset=True, by_alias=True) for name, one in tables.items()}
