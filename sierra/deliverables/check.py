"""Check whether figures and comparisons that were drawn still follow from the store."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from sierra.config.project_file import LoadedProject
from sierra.deliverables import comparison, record, render
from sierra.deliverables.record import Checked, Content, ShownDeliverable
from sierra.store.row_types import DeliverableRow
from sierra.store.store import Store


def check(project: LoadedProject, store: Store, batch: str) -> list[Checked]:
    """Return whether each recorded deliverable of a batch still follows from the store, in the order of kinds and names."""
    return list(record.checked(store, project.root, batch, partial(_again, project, store)))


def find(project: LoadedProject, store: Store, file: Path) -> ShownDeliverable:
    """Return the record of a file that SIERRA made. Raises NotFound, or SierraError if the file was changed."""
    return record.find(store, project.root, file, partial(_again, project, store))


def _again(project: LoadedProject, store: Store, row: DeliverableRow) -> Content:
    """Return the content of a deliverable by its recorded definition and the data that the store has now."""
    make = comparison.content if row.kind == comparison.KIND else render.content
    return make(project, store, row)
