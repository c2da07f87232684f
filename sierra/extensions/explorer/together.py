"""Several batches at once: a chart with all of them, and tests of their differences."""

from __future__ import annotations

import shlex
from collections.abc import Mapping

from sierra.config.deliverable_tables import Comparison, Figure
from sierra.config.project_file import LoadedProject
from sierra.config.validate import options
from sierra.deliverables import comparison, overlay
from sierra.deliverables.figures.drawing import Drawing
from sierra.deliverables.gallery import Gallery
from sierra.deliverables.report import comparisons
from sierra.deliverables.report.parts import Place
from sierra.errors import UsageError
from sierra.store.batch_data import BatchData
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.html_elements import element
from sierra.util.json_types import JsonView


def drawing(project: LoadedProject, store: Store, name: str, figure: Figure, frames: Mapping[str, BatchData]) -> Drawing:
    """Return one figure of several batches, as `sierra figures` draws it; `frames` are by the label of each batch.

    Raises SierraError for a kind of figure that shows one batch only, or batches that do not fit each other.
    """
    fitted = overlay.fitting(figure, declared=True)
    drawn = {label: Gallery(project, store, frame).drawing(name, fitted) for label, frame in frames.items()}
    return overlay.merged(drawn, overlay.BATCH)


def labelled(project: LoadedProject, store: Store, batches: list[str]) -> dict[str, str]:
    """Return the batches by their labels, as `sierra figures` and `sierra compare` name them."""
    if len(set(batches)) < max(2, len(batches)):
        raise UsageError("choose two batches or more, each of them once")
    return dict(zip(comparison.labels(project, store, batches), batches, strict=True))


def command(verb: str, groups: Mapping[str, str], *more: str) -> str:
    """Return the command that makes the same from these batches."""
    return shlex.join(("sierra", verb, *_words(groups), *more))


def declared(groups: Mapping[str, str], keys: Mapping[str, JsonView]) -> dict[str, JsonView]:
    """Return the keys of `[comparisons.NAME]` with these batches as its groups."""
    return {"groups": _words(groups), **keys}


def compared(project: LoadedProject, store: Store, name: str, groups: Mapping[str, str], keys: Mapping[str, JsonView]) -> str:
    """Return the comparison of batches as a section of a page, as reports have it. Raises the errors of `sierra compare`."""
    asked = options(Comparison, {**keys, "groups": ()}, "comparison")
    found = comparison.compare(project, store, name, groups, asked)
    section = comparisons.section([found], (), Place())
    return element("section", element("h2", section.title), section.body) if section else ""


def _words(groups: Mapping[str, str]) -> list[str]:
    return [short(batch) if label == short(batch) else f"{label}={short(batch)}" for label, batch in groups.items()]
