"""What is recorded, as folders that appear whole: one rename publishes all that was recorded at one time.

    segments/<batch, 12 digits>-<16 digits>/
        MANIFEST                      SHA-256 and name of each file, as `sha256sum -c` reads it
        executions.parquet …          records, a file for each table
        output.<table>.parquet …      what the runs wrote, a file for each output; where some have other columns
                                      than others, output.<table>~2.parquet … for these

The last 16 digits are the beginning of the SHA-256 of MANIFEST, so that a segment's name vouches for all in
it. A segment is written beside its target, synced and renamed; a name that exists holds the same content.
Nothing here is ever changed. Folders of any number of processes and hosts can be added at once.

Rows are merged, or removed, by writing new segments in the place of old ones. So that this happens at one moment, which
is one rename, a segment may have two files more, listed in MANIFEST as all others:

    REPLACES    names of segments, a line each, that do not count any more, as long as this one is there
    AFTER       the name of a segment: this one counts only once that is there

One new segment names those that it replaces. Of several, each is published first, to count AFTER a last one, which has
nothing but REPLACES. To remove what is replaced is only tidying up, at any later time (see `sierra.store.compaction`); who
replaces a segment also names what that has replaced. A line that is no segment's name means nothing.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sierra.errors import Missing
from sierra.store.schema import arrow_schema
from sierra.util.fs import inside
from sierra.util.hashing import sha256, sha256_file

FORMAT = "sierra store 3\n"
"""Of what segments hold, and of what it means that they lie there. Raised whenever an older SIERRA would read it wrongly."""
READABLE = (FORMAT, "sierra store 2\n")
"""Formats that are read. A store of an older one is of the newest as soon as a segment is added; what its records lack is
NULL."""
MANIFEST = "MANIFEST"
OUTPUT = "output."
SUFFIX = ".parquet"
REPLACES = "REPLACES"
AFTER = "AFTER"
MARK_BYTES = 16 << 20
"""More is read of no REPLACES."""


@dataclass(frozen=True, slots=True)
class Segment:
    """One folder of records: the beginning of its batch's id, and its Parquet files by name."""

    batch: str
    files: Mapping[str, str]
    name: str = ""
    replaces: frozenset[str] = frozenset()
    after: str | None = None

    def outputs(self) -> Iterator[tuple[str, str]]:
        """What the runs wrote: the table's name and the file, of each file."""
        for name, path in self.files.items():
            if name.startswith(OUTPUT):
                yield name.removeprefix(OUTPUT).partition("~")[0], path


def is_first_part(path: str) -> bool:
    """Whether a file of an output holds those of its rows that have the usual columns."""
    return "~" not in Path(path).name


def listed(folder: Path) -> Iterator[Segment]:
    """All segments that count now, in the order of their names."""
    found = list(on_disk(folder))
    hidden = out_of_date(found)
    yield from (segment for segment in found if segment.name not in hidden)


def out_of_date(segments: Sequence[Segment]) -> set[str]:
    """The names of those that do not count: replaced, or waiting for one that is not there."""
    names = {segment.name for segment in segments}
    waiting = {segment.name for segment in segments if segment.after is not None and segment.after not in names}
    replaced = {name for segment in segments if segment.name not in waiting for name in segment.replaces}
    return waiting | (replaced & names)


def on_disk(folder: Path) -> Iterator[Segment]:
    """All segments that are there, whether they count or not, in the order of their names."""
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.is_dir())
    except FileNotFoundError:
        return
    for name in names:
        with contextlib.suppress(FileNotFoundError):  # somebody has tidied it up meanwhile
            yield _segment(folder / name)


def _segment(folder: Path) -> Segment:
    with os.scandir(folder) as entries:
        paths = {entry.name: entry.path for entry in entries}
    files = {name.removesuffix(SUFFIX): path for name, path in paths.items() if name.endswith(SUFFIX)}
    replaces = frozenset(_lines(paths[REPLACES])) if REPLACES in paths else frozenset()
    after = next(iter(_lines(paths[AFTER])), "") if AFTER in paths else None
    return Segment(folder.name.partition("-")[0], files, folder.name, replaces, after)


def _lines(path: str) -> list[str]:
    with Path(path).open("rb") as file:
        return file.read(MARK_BYTES).decode("utf-8", "replace").splitlines()


class Writer:
    """A segment that is being written, in `folder`; `publish` makes it appear among the others."""

    def __init__(self, folder: Path, batch: str) -> None:
        self.folder = folder
        self._batch = batch[:12]
        shutil.rmtree(folder, ignore_errors=True)
        with disk_errors(folder):
            folder.mkdir(parents=True)

    def path(self, name: str) -> Path:
        """Where the Parquet file of that name belongs, for whoever writes it itself."""
        return self.folder / (name + SUFFIX)

    def rows(self, name: str, rows: Iterable[Mapping[str, Any]]) -> None:
        """Records of one table; nothing is written where there are none."""
        import pyarrow as pa

        rows = list(rows)
        if rows:
            self.table(name, pa.Table.from_pylist(rows, schema=arrow_schema(name)))

    def table(self, name: str, table: Any) -> None:
        """An Arrow table, as it is."""
        self.tables(name, (table,))

    def tables(self, name: str, parts: Iterable[Any]) -> None:
        """Arrow tables of one schema, one after the other: a row group each. There must be one at least."""
        import pyarrow.parquet as pq

        parts = iter(parts)
        first = next(parts)
        with disk_errors(self.folder), pq.ParquetWriter(self.path(name), first.schema, compression="zstd") as writer:
            for part in itertools.chain((first,), parts):
                writer.write_table(part)

    def mark(self, name: str, lines: Iterable[str]) -> None:
        """Write REPLACES or AFTER."""
        with disk_errors(self.folder):
            (self.folder / name).write_text("".join(f"{line}\n" for line in lines))

    def seal(self) -> str:
        """Write MANIFEST and sync all; the name that the segment will have. Nothing may be written after that."""
        with disk_errors(self.folder):
            files = sorted(file for file in self.folder.iterdir() if file.name != MANIFEST)
            text = manifest(files)
            (self.folder / MANIFEST).write_bytes(text)
            for file in (*files, self.folder / MANIFEST, self.folder):
                sync(file)
        return f"{self._batch}-{sha256(text)[:16]}"

    def publish(self, segments: Path) -> bool:
        """Sync all, and rename; True if there was anything to publish."""
        if not any(self.folder.iterdir()):
            self.folder.rmdir()
            return False
        with disk_errors(self.folder):
            _raise_format(segments.with_name("format"))
            target = inside(segments, self.seal())
            try:
                self.folder.rename(target)
            except OSError as error:
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                    raise
                shutil.rmtree(self.folder)
            sync(segments)
        return True


def _raise_format(path: Path) -> None:
    """Have a store say that it is of the newest format. The file stays in its place, because it is a lock, too."""
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        if file.read(len(FORMAT) + 1).decode("utf-8", "replace") in READABLE[1:]:
            with path.open("r+b") as changed:
                changed.write(FORMAT.encode())
                os.fsync(changed.fileno())


def manifest(files: Iterable[Path]) -> bytes:
    """What MANIFEST says of these files, which are in the order of their names."""
    return "".join(f"{sha256_file(file)}  {file.name}\n" for file in files).encode()


def sync(path: Path) -> None:
    """Force a file or a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class disk_errors:
    """Turns what a full or forbidden disk raises into Missing, naming the folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError):
            reason = error.strerror or str(error)
            raise Missing(f"cannot write to {self._folder}: {reason}") from error
