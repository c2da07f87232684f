"""What is recorded, as folders that appear whole: one rename publishes all that was recorded at one time.

    segments/<batch, 12 digits>-<16 digits>/
        MANIFEST                      SHA-256 and name of each file, as `sha256sum -c` reads it
        executions.parquet …          records, a file for each table
        output.<table>.parquet …      what the runs wrote, a file for each output; where some have other columns
                                      than others, output.<table>~2.parquet … for these

The last 16 digits are the beginning of the SHA-256 of MANIFEST, so that a segment's name vouches for all in
it. A segment is written beside its target, synced and renamed; a name that exists holds the same content.
Nothing here is ever changed. Folders of any number of processes and hosts can be added at once.
"""

from __future__ import annotations

import errno
import itertools
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sierra.errors import Missing
from sierra.hashing import sha256, sha256_file
from sierra.store.tables import arrow_schema

MANIFEST = "MANIFEST"
OUTPUT = "output."
SUFFIX = ".parquet"


@dataclass(frozen=True, slots=True)
class Segment:
    """One folder of records: the beginning of its batch's id, and its Parquet files by name."""

    batch: str
    files: Mapping[str, str]

    def outputs(self) -> Iterator[tuple[str, str]]:
        """What the runs wrote: the table's name and the file, of each file."""
        for name, path in self.files.items():
            if name.startswith(OUTPUT):
                yield name.removeprefix(OUTPUT).partition("~")[0], path


def is_first_part(path: str) -> bool:
    """Whether a file of an output holds those of its rows that have the usual columns."""
    return "~" not in Path(path).name


def listed(folder: Path) -> Iterator[Segment]:
    """All segments that are there now, in the order of their names."""
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.is_dir())
    except FileNotFoundError:
        return
    for name in names:
        with os.scandir(folder / name) as entries:
            files = {e.name.removesuffix(SUFFIX): e.path for e in entries if e.name.endswith(SUFFIX)}
        yield Segment(name.partition("-")[0], files)


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

    def publish(self, segments: Path) -> bool:
        """Sync all, and rename; True if there was anything to publish."""
        files = sorted(self.folder.iterdir())
        if not files:
            self.folder.rmdir()
            return False
        with disk_errors(self.folder):
            manifest = "".join(f"{sha256_file(file)}  {file.name}\n" for file in files).encode()
            (self.folder / MANIFEST).write_bytes(manifest)
            for file in (*files, self.folder / MANIFEST, self.folder):
                sync(file)
            target = segments / f"{self._batch}-{sha256(manifest)[:16]}"
            try:
                self.folder.rename(target)
            except OSError as error:
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                    raise
                shutil.rmtree(self.folder)
            sync(segments)
        return True


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
