"""Segments: folders of records that appear as a whole, by one rename.

    segments/<batch, 12 digits>-<16 digits>/
        MANIFEST                      SHA-256 and name of each file, as `sha256sum -c` reads it
        executions.parquet …          records, a file for each table
        output.<table>.parquet …      rows that the runs wrote, a file for each output; rows with other columns are in
                                      output.<table>~2.parquet …

The last 16 digits are the beginning of the SHA-256 of MANIFEST. So a segment's name verifies all of its files. A segment is
written outside the folder `segments`, synced, and renamed to its final name. If that name exists already, it has the same
content. Segments never change. Any number of processes and hosts can add segments at the same time.

Rows are merged or removed by writing new segments that replace old ones. The replacement must take effect at one moment,
by one rename. For this, a segment may have two more files, listed in MANIFEST like all others:

    REPLACES    names of segments, one per line; they are ignored as long as this segment exists
    AFTER       the name of a segment; this one is ignored until that segment exists

A single new segment names the segments that it replaces. Several new segments are published first, each with AFTER naming
a last segment, which has nothing but REPLACES. Replaced segments can be removed at any later time (see
`sierra.store.compaction`). A segment that replaces another one also names the segments that the other one replaced. A line
that is not a segment's name has no effect.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from sierra.errors import DamagedFile, Missing
from sierra.store.parquet_writer import write
from sierra.store.row_types import TABLES
from sierra.store.schema import sql_types
from sierra.store.verified_files import MANIFEST as MANIFEST
from sierra.store.verified_files import changed, hash_written, verify
from sierra.util.fs import inside
from sierra.util.hashing import sha256
from sierra.util.regular_files import open_regular

FORMAT = "sierra store 4\n"
"""The format of segments and of their role in the store. It is raised whenever an older SIERRA would misread it."""
IMPORTED = "imported_sessions"
"""The table of the sessions that came in packages."""
OUTPUT = "output."
SUFFIX = ".parquet"
NOTICED = frozenset(("objects.parquet", "images.parquet"))
"""Files with contents that records name by a hash: whatever needs a lost one says that it is missing."""
REPLACES = "REPLACES"
AFTER = "AFTER"
MARK_BYTES = 16 << 20
"""The limit on the bytes that are read from REPLACES."""
SETTLED_NS = 2_000_000_000
"""The age of the last change of a folder after which a further change certainly gives it another time."""

_known: dict[str, tuple[int, Segment]] = {}
"""Segments without REPLACES and AFTER that were read, and the time of their folders' last change, by path."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A folder of records: the beginning of its batch's id, and its Parquet files by name."""

    batch: str
    files: Mapping[str, str]
    name: str = ""
    replaces: frozenset[str] = frozenset()
    after: str | None = None
    missing: tuple[str, ...] = ()
    """Names of the files in MANIFEST that do not exist, or that of MANIFEST itself if it does not exist or has changed."""
    marks: tuple[str, ...] = ()
    """The paths of REPLACES and AFTER, as far as they exist."""

    def outputs(self) -> Iterator[tuple[str, str]]:
        """Yield the table name and the path of each file that holds rows of an output."""
        for name, path in self.files.items():
            if name.startswith(OUTPUT):
                yield name.removeprefix(OUTPUT).partition("~")[0], path


def is_whole(segment: Segment, folder: Path) -> bool:
    """Return True; raise Damaged if a segment has lost a file whose rows would be missing without a word.

    A segment whose MANIFEST has changed has lost that.
    """
    for name in segment.missing:
        if name not in NOTICED:
            path = folder / segment.name / name
            raise DamagedFile(changed(str(path)) if path.exists() else f"{path} is missing: run sierra fsck --repair")
    return True


def is_first_part(path: str) -> bool:
    """Check if a file of an output holds the rows with the usual columns."""
    return "~" not in Path(path).name


def listed(folder: Path) -> list[Segment]:
    """Return all segments that are not ignored, in the order of their names. Raises Damaged if a damaged file may hide one.

    The Parquet files are verified when they are read, see `sierra.store.duckdb_file_io`.
    """
    found = list(on_disk(folder))
    verify(mark for segment in found for mark in segment.marks)
    hidden = out_of_date(found)
    return [segment for segment in found if segment.name not in hidden]


def out_of_date(segments: Sequence[Segment]) -> set[str]:
    """Return the names of ignored segments: replaced, or waiting for a segment that does not exist."""
    names = {segment.name for segment in segments}
    waiting = {segment.name for segment in segments if segment.after is not None and segment.after not in names}
    replaced = {name for segment in segments if segment.name not in waiting for name in segment.replaces}
    return waiting | (replaced & names)


def on_disk(folder: Path) -> Iterator[Segment]:
    """Yield all existing segments, ignored or not, in the order of their names."""
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.is_dir())
    except FileNotFoundError:
        return
    for name in names:
        with contextlib.suppress(FileNotFoundError):  # another process removed it meanwhile
            yield _segment(f"{folder}/{name}", name)


def _segment(folder: str, name: str) -> Segment:
    """Return a segment as it is now. A command looks at all segments many times, and reads each folder once."""
    changed = os.stat(folder).st_mtime_ns  # noqa: PTH116 - for speed
    known = _known.get(folder)
    if known is not None and known[0] == changed:
        return known[1]
    segment = _read(folder, name)
    if segment.after is None and not segment.replaces and time.time_ns() - changed > SETTLED_NS:
        _known[folder] = changed, segment
    return segment


def _read(folder: str, name: str) -> Segment:
    with os.scandir(folder) as entries:
        paths = {entry.name: entry.path for entry in entries}
    files = {file.removesuffix(SUFFIX): path for file, path in paths.items() if file.endswith(SUFFIX)}
    replaces = frozenset(_lines(paths[REPLACES])) if REPLACES in paths else frozenset()
    after = next(iter(_lines(paths[AFTER])), "") if AFTER in paths else None
    marks = tuple(paths[mark] for mark in (REPLACES, AFTER) if mark in paths)
    return Segment(name.partition("-")[0], files, name, replaces, after, _missing(paths, name), marks)


def _missing(paths: Mapping[str, str], segment: str) -> tuple[str, ...]:
    """Return the names in MANIFEST that are not among these paths; that of MANIFEST if it is not the segment's."""
    text = _beginning(paths[MANIFEST]) if MANIFEST in paths else b""
    if sha256(text)[:16] != segment.rpartition("-")[2]:
        return (MANIFEST,)
    names = (line.partition("  ")[2] for line in _split(text))
    return tuple(name for name in names if name not in paths)


def _lines(path: str) -> list[str]:
    return _split(_beginning(path))


def _beginning(path: str) -> bytes:
    with open_regular(path) as file:
        return file.read(MARK_BYTES)


def _split(text: bytes) -> list[str]:
    return text.decode("utf-8", "replace").splitlines()


class Writer:
    """A segment that is being written in `folder`; `publish` adds it to the store."""

    def __init__(self, folder: Path, batch: str) -> None:
        self.folder = folder
        self.batch = batch[:12]
        shutil.rmtree(folder, ignore_errors=True)
        with disk_errors(folder):
            folder.mkdir(parents=True)

    def path(self, name: str) -> Path:
        """Return the path for the Parquet file of this name, for callers that write it themselves."""
        return self.folder / (name + SUFFIX)

    def rows(self, name: str, rows: Iterable[Mapping[str, object]]) -> None:
        """Write records of one table; write no file if there are none. Raises ValueError for a column that it has not."""
        columns = sql_types(name)
        rows = list(rows)
        for row in rows:
            if not row.keys() <= columns.keys():
                raise ValueError(f"the table {name} has no column {min(row.keys() - columns.keys())!r}")
        self.table(name, columns, ([row.get(column) for column in columns] for row in rows))

    def records(self, rows: Iterable[NamedTuple]) -> None:
        """Write records of one table, which their class decides; write no file if there are none."""
        rows = iter(rows)
        first = next(rows, None)
        if first is not None:
            name = TABLES[type(first)]
            self.table(name, sql_types(name), itertools.chain((first,), rows))

    def table(self, name: str, columns: Mapping[str, str], rows: Iterable[Sequence[object]]) -> None:
        """Write rows whose columns have these SQL types; write no file if there are none."""
        write(self.path(name), columns, rows)

    def mark(self, name: str, lines: Iterable[str]) -> None:
        """Write REPLACES or AFTER."""
        with disk_errors(self.folder):
            (self.folder / name).write_text("".join(f"{line}\n" for line in lines))

    def seal(self) -> str:
        """Write MANIFEST, sync all files, and return the segment's future name. Nothing may be written afterwards."""
        with disk_errors(self.folder):
            files = sorted(file for file in self.folder.iterdir() if file.name != MANIFEST)
            text = manifest(files)
            (self.folder / MANIFEST).write_bytes(text)
            for file in (*files, self.folder / MANIFEST, self.folder):
                sync(file)
        return f"{self.batch}-{sha256(text)[:16]}"

    def publish(self, segments: Path) -> bool:
        """Sync all files and rename the folder. Return False if it was empty."""
        if not any(self.folder.iterdir()):
            self.folder.rmdir()
            return False
        with disk_errors(self.folder):
            target = inside(segments, self.seal())
            try:
                self.folder.rename(target)
            except OSError as error:
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                    raise
                shutil.rmtree(self.folder)
            sync(segments)
        return True


def manifest(files: Iterable[Path]) -> bytes:
    """Return the content of MANIFEST for these files, which must be sorted by name."""
    return "".join(f"{hash_written(file)}  {file.name}\n" for file in files).encode()


def sync(path: Path) -> None:
    """Force a file or a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class disk_errors:
    """A context manager that turns errors of a full or read-only disk into Missing, with the folder's name."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError):
            reason = error.strerror or str(error)
            raise Missing(f"cannot write to {self._folder}: {reason}") from error
