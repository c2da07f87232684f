"""Extracting batches: a new store with some batches of a store, and nothing that belongs only to others.

Segments of which nothing is left out are copied byte for byte. Of others, new segments with the remaining rows are written.
So the new store depends only on the records and the libraries that write Parquet, and not on time or names of processes.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection
from pathlib import Path

from sierra.errors import NotFound
from sierra.maintenance import remove
from sierra.store.compaction import groups, touched, write_kept
from sierra.store.segments import disk_errors
from sierra.store.store import Snapshot, Store
from sierra.store.study_records import looks
from sierra.store.verified_files import verify

LEAN = ("SET threads = 1", "SET allocator_flush_threshold = '8MB'")
"""Settings of DuckDB with which statements on 100,000 runs need less memory, and give it back when they have ended."""


def extract(store: Store, batches: Collection[str], root: Path, claims: Collection[str] = ()) -> Store:
    """Write a store with these batches and registered claims (full ids) to the new folder `root`, and return it.

    Later records are left out.

    Raises NotFound for a batch that the store does not have, Missing if the disk is full, Damaged for unreadable segments.
    """
    with store.snapshot() as snapshot:
        if unknown := sorted(set(batches) - set(snapshot.values(str, "SELECT batch FROM batches"))):
            raise NotFound(f"the store has no batch {unknown[0][:10]}")
        other = Store.create(root)
        other.rules = store.rules
        other.settings = LEAN
        for setting in LEAN:
            snapshot.run(setting)
        drop = remove.rows_of(snapshot, store, _others(snapshot, store, batches, claims))
        changed = touched(snapshot, snapshot.segments, drop)
        changed += [segment for segment in snapshot.segments if segment.renamed and segment not in changed]
        names = {segment.name for segment in changed}
        for segment in snapshot.segments:
            if segment.name not in names:
                verify(segment.files.values())
                _copy(store.paths.segments / segment.name, other)
        for number, group in enumerate(groups(changed)):
            writer = other.writer(root / "work" / str(number), group[0].batch)
            write_kept(group, drop, writer)
            other.publish(writer)
    return other


def _others(snapshot: Snapshot, store: Store, batches: Collection[str], claims: Collection[str]) -> dict[str, set[str]]:
    """Return the ids of all other batches and claims, and of the studies that have no look at one of these batches."""
    named: dict[str, set[str]] = {kind: set() for kind in remove.KINDS}
    named["batch"] = set(snapshot.values(str, "SELECT batch FROM batches")) - set(batches)
    named["claim"] = set(snapshot.values(str, "SELECT DISTINCT claim FROM registered_claims")) - set(claims)
    for study in snapshot.values(str, "SELECT study FROM studies"):
        if not any(look.batch in batches for look in looks(store, study)):
            named["study"].add(study)
    return named


def _copy(segment: Path, other: Store) -> None:
    with disk_errors(other.paths.segments):
        shutil.copytree(segment, other.paths.segments / segment.name, copy_function=link_or_copy)


def link_or_copy(source: str, target: str) -> None:
    """Give a file that never changes a second name, or copy it if the file system has no second names."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
