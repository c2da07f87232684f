"""Lamport numbers of sessions: the next one is 1 more than the highest known number (see `sierra.store.lamport_clock`).

Segments never change, so each is read only once. A cache file in the store keeps the highest number of the segments that
were read and are not in the index. The file may be deleted, and it is ignored if its checksum is wrong.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable
from pathlib import Path

from sierra.errors import Damaged
from sierra.store.duckdb_file_io import read_parquet
from sierra.store.lamport_clock import HIGHEST, number_of
from sierra.store.layout import StorePaths
from sierra.store.schema import STAMPED
from sierra.store.segments import Segment
from sierra.store.store import Snapshot, Store
from sierra.util.fs import read_sealed, write_whole
from sierra.util.hashing import sealed


def following(paths: StorePaths, living: Iterable[int]) -> int:
    """Return the number for a session that begins now; `living` are the numbers of sessions that have not ended.

    Determine the living sessions before the call: a session that ends in between has recorded by then. Raises Damaged if the
    store cannot be read, or has a number that SIERRA never assigns.
    """
    highest = max((_recorded(paths), *living))
    if highest >= HIGHEST:
        raise Damaged(f"{paths.root}: there are records with the Lamport number {highest}, which SIERRA never assigns")
    return highest + 1


def _recorded(paths: StorePaths) -> int:
    """Return the highest number in all segments."""
    highest, seen = _load(paths.numbers)
    with Store(paths.root).snapshot() as snapshot:
        unindexed = snapshot.listing.rest
        new = [segment for segment in unindexed if segment.name not in seen]
        highest = max(highest, highest_of(snapshot, new), number_of(snapshot.highest_indexed(STAMPED, "lamport")))
    if new:
        _save(paths.numbers, highest, [segment.name for segment in unindexed])
    return highest


def highest_of(snapshot: Snapshot, segments: Iterable[Segment]) -> int:
    """Return the highest number in some segments; 0 if they have none."""
    files = [segment.files[table] for segment in segments for table in STAMPED if table in segment.files]
    if not files:
        return 0
    [(highest,)] = snapshot.run(f"SELECT max(lamport) FROM {read_parquet(files, schema={'lamport': 'BIGINT'})}")
    return 0 if highest is None else number_of(highest)


def _load(path: Path) -> tuple[int, set[str]]:
    """Return the highest number of the segments that were read, and their names."""
    kept = read_sealed(path)
    if not kept:
        return 0, set()
    highest, names = json.loads(kept)
    return highest, set(names)


def _save(path: Path, highest: int, segments: Iterable[str]) -> None:
    with contextlib.suppress(OSError):
        write_whole(path, sealed(json.dumps([highest, sorted(segments)]).encode()))
