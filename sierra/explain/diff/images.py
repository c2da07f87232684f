"""Differences of container images by content, and of the host access of runs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from sierra.containers import images
from sierra.containers.container_setup import other_host_access
from sierra.containers.images import record
from sierra.containers.images.diff import Change, files, packages
from sierra.containers.images.image import AnyImage, ImageVariants, every
from sierra.errors import Damaged, NotFound
from sierra.explain.diff.load_sides import ComparedRuns
from sierra.explain.diff.model import ARROW, Difference, changed
from sierra.provenance.dependency_model import mentioned
from sierra.store.row_types import ImageRow
from sierra.store.store import Snapshot, Store
from sierra.util.text import few

SHOWN = 8
DETAILS = 1000
"""Maximum number of packages or files in the details."""


def image(snapshot: Snapshot, store: Store, before: ComparedRuns, after: ComparedRuns, root: Path) -> Iterator[Difference]:
    """Yield differences of the image (its id, packages, variables and files) and of the host access of runs."""
    was, now = (side.spec.image for side in (before, after))
    if was != now:
        known = _Images(snapshot, store, after.plan.image if after.plan else None)
        old, new = map(known.row, (was, now))
        yield Difference("image", "image", f"image: {known.called(was, old)} {ARROW} {known.called(now, new)}", was, now)
        if old and new:
            yield from _by_processor(known, old, new, mentioned(after.spec.command, root))
    before_reach, reach = (side.spec.host_access for side in (before, after))
    if changes := other_host_access(before_reach, reach):
        yield Difference("image", "host_access", f"host access of runs: {', '.join(changes)}", before_reach, reach)


class _Images:
    """The recorded images, and those of a plan, which may not be recorded yet."""

    def __init__(self, snapshot: Snapshot, store: Store, planned: AnyImage | None) -> None:
        self._snapshot, self._store = snapshot, store
        self._names = {planned_image.id: planned_image.name for planned_image in every(planned)}
        self._rows: dict[str, ImageRow] = {}
        self._listings: dict[str | None, bytes] = {}
        for planned_image in every(planned):
            if contents := images.contents(store.paths, planned_image):
                row = self._rows[planned_image.id] = contents.row()
                self._listings[row.files] = contents.listing
        if isinstance(planned, ImageVariants):
            self._rows[planned.id] = record.row(planned)

    def row(self, identity: str | None) -> ImageRow | None:
        """Return the row of an image; None if it is unknown."""
        rows = self._snapshot.select(ImageRow, "SELECT * FROM images WHERE image = $i", i=identity)
        return rows[0] if rows else self._rows.get(identity or "")

    def called(self, identity: str | None, row: ImageRow | None) -> str:
        """Return the name and the id of an image."""
        if identity is None:
            return "none"
        name = row.name if row else self._names.get(identity)
        return f"{name} ({images.short(identity)})" if name else f"{images.short(identity)} (not recorded)"

    def files(self, row: ImageRow) -> bytes:
        """Return the list of an image's files. Raises NotFound or Damaged."""
        return self._listings.get(row.files) or self._store.object(row.files or "")


def _by_processor(known: _Images, old: ImageRow, new: ImageRow, words: frozenset[str]) -> Iterator[Difference]:
    """Yield differences of two images; of images for several processors, for each processor that both have."""
    was, now = record.variants(old), record.variants(new)
    if not (was or now):
        yield from _inside(known, old, new, words)
        return
    yield Difference("image", "variants", f"images by processor: {', '.join(record.changes(was, now))}", was, now)
    for processor in record.changed(was, now):
        before, after = known.row(was[processor]), known.row(now[processor])
        if before and after:
            for difference in _inside(known, before, after, words):
                yield replace(difference, line=f"{processor}: {difference.line}")


def _inside(known: _Images, old: ImageRow, new: ImageRow, words: frozenset[str]) -> Iterator[Difference]:
    """Yield differences of the contents of two images, the most important first."""
    yield from changed("image", "architecture", old.architecture, new.architecture)
    was, now = (json.loads(row.packages or "{}") for row in (old, new))
    for manager, changes in packages(was, now, words).items():
        yield _difference(manager, f"{manager} packages of the image", changes)
    yield from changed("image", "variables", old.variables, new.variables, called="variables of the image")
    yield _files(known, old, new)


def _files(known: _Images, old: ImageRow, new: ImageRow) -> Difference:
    called = "files of the image"
    try:
        changes = files(*map(known.files, (old, new)))
    except (NotFound, Damaged):
        return Difference("image", "files", f"{called}: the list of files is not in the store", old.files, new.files)
    if not changes:
        return Difference("image", "files", f"{called}: no differences", old.files, new.files)
    return _difference("files", called, changes)


def _difference(name: str, called: str, changes: Sequence[Change]) -> Difference:
    texts = [change.text for change in changes]
    count = "1 differs" if len(changes) == 1 else f"{len(changes)} differ"
    details = (*texts[:DETAILS], *([f"and {len(texts) - DETAILS} more"] if len(texts) > DETAILS else []))
    was, now = ({one.name: getattr(one, side) for one in changes[:DETAILS]} for side in ("was", "now"))
    return Difference("image", name, f"{called}: {count}: {few(texts, SHOWN)}", was, now, details if len(texts) > SHOWN else ())
