"""Check whether figures, comparisons, videos and reports that were made still follow from the store."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import cache, partial
from pathlib import Path

from sierra.config.project_file import LoadedProject
from sierra.deliverables import comparison, comparison_figure, declared_tables, record, render
from sierra.deliverables.comparison import Compared
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.record import Checked, Content, ShownDeliverable
from sierra.deliverables.report import recorded as reports
from sierra.deliverables.report.make import Source
from sierra.deliverables.report.results import REPORT
from sierra.deliverables.videos import render as videos
from sierra.deliverables.videos.prepare import KIND as VIDEO
from sierra.store.row_types import DeliverableRow
from sierra.store.samples import Frame
from sierra.store.store import Store

Between = Callable[[str], Compared]
"""A function that makes a declared comparison of several batches, for the reports that show it."""


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
    """Return the content of a deliverable by its recorded definition and the data that the store has now."""
    if row.kind == comparison.KIND:
        return comparison_figure.content(project, store, row)
    if row.kind == declared_tables.KIND:
        return declared_tables.content(project, store, row.name, row.definition, row.batches)
    if row.kind == VIDEO:
        return videos.content(project, store, row)
    if row.kind == REPORT:
        return reports.again(Source(project, store, between), row)
    return render.content(project, store, row, shared)
