"""Files of the index: the records of many segments in one file, so that a command does not look at each segment.

    index/<format>-<segments>-<digits>.duckdb

No answer depends on an index. It holds what the segments hold that it names, and can be thrown away at any time: whoever finds
none, or one that is damaged, reads the segments themselves. `<format>` changes with the tables and with what the index holds,
so that no other SIERRA's index is used. `<segments>` is the number of segments that it names. `<digits>` is the beginning of
the SHA-256 of the file: a file never changes, and its name is never used for other bytes.

A file is read as a whole, and hashed, before it is used, because the checksums of DuckDB's own format miss some damage. DuckDB
then reads exactly these bytes from memory: no lock is needed, and the file may be removed meanwhile. The state of a large
verified file is kept like that of the files of segments (see `sierra.store.verified_files`).
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from sierra.store.layout import StorePaths
from sierra.store.schema import RECORDED
from sierra.store.verified_files import begins_with
from sierra.util.fs import UNFINISHED_END, replacing
from sierra.util.hashing import sha256, sha256_file
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import read_regular
from sierra.util.scratch import remove_abandoned

FORMAT = 6
"""The number of the format of what an index holds besides the tables of records. It is raised with each change of that."""
NAME = regex(r"([0-9a-f]{8})-([0-9]{9})-([0-9a-f]{16})\.duckdb")
UNFINISHED = regex(rf"\.{NAME.pattern}{UNFINISHED_END}")
IN_MEMORY = 64 << 20
"""The size up to which an index is read into memory."""

PREFIX = "sierra-index-"
"""The beginning of the names of the temporary folders in which indexes are built, on a local disk: DuckDB locks its files."""

announce: Callable[[str], None] | None = None
"""Called with what a user should know: that an index is being built, if that takes some seconds, or cannot be built."""
_held: dict[str, IndexFile] = {}
"""The index that this process uses, by the store's folder of indexes."""


@dataclass(frozen=True)
class IndexFile:
    """A verified index. A copy in memory is freed when nobody uses it any more."""

    path: Path
    descriptor: int | None = None
    """A file in memory with the bytes that were verified; None for a file that is too large for that."""

    @property
    def readable(self) -> str:
        """The path by which DuckDB reads these bytes, also in a process that this one has started."""
        return str(self.path) if self.descriptor is None else f"/proc/{os.getpid()}/fd/{self.descriptor}"


@cache
def format_now() -> str:
    """Return the digits of the format that this SIERRA writes and reads."""
    tables = {name: [(column.name, column.type) for column in table.columns] for name, table in RECORDED.items()}
    return sha256(json.dumps([FORMAT, tables]).encode())[:8]


def published(folder: Path) -> list[Path]:
    """Return the indexes of the present format, first those of the most segments."""
    with contextlib.suppress(OSError):
        now = format_now()
        return sorted(
            (path for path in folder.iterdir() if (is_index := NAME.fullmatch(path.name)) and is_index[1] == now), reverse=True
        )
    return []


def best(paths: StorePaths) -> IndexFile | None:
    """Return the index of the most segments whose bytes are those that its name promises; None if there is none."""
    key = str(paths.index)
    for path in published(paths.index):
        held = _held.get(key)
        if held is not None and held.path == path and held.readable != str(path):
            return held
        with contextlib.suppress(OSError):
            if (index := verified(path)) is not None:
                _held[key] = index
                return index
    return None


def is_current(path: Path) -> bool:
    """Check that an index has the format that this SIERRA reads."""
    return path.name.startswith(f"{format_now()}-")


def verified(path: Path, *, anew: bool = False) -> IndexFile | None:
    """Return an index whose bytes are those that its name promises; else None. Raises OSError.

    `anew`: hash also a large one whose state is known.
    """
    digits = path.stem.rpartition("-")[2]
    if path.stat().st_size > IN_MEMORY or not hasattr(os, "memfd_create"):
        whole = sha256_file(path).startswith(digits) if anew else begins_with(path, digits)
        return IndexFile(path) if whole else None
    content = read_regular(path)
    if not sha256(content).startswith(digits):
        return None
    descriptor = os.memfd_create("sierra-index", os.MFD_CLOEXEC)
    index = IndexFile(path, descriptor)
    weakref.finalize(index, os.close, descriptor)
    with open(descriptor, "wb", closefd=False) as file:
        file.write(content)
    return index


def segments_of(path: Path) -> int:
    """Return the number of segments that an index names, from its own name."""
    return int(path.name.split("-")[1])


def publish(paths: StorePaths, segments: int, built: Path) -> Path:
    """Copy an index of so many segments into the store. Raises OSError."""
    paths.index.mkdir(exist_ok=True)
    path = paths.index / f"{format_now()}-{segments:09d}-{sha256_file(built)[:16]}.duckdb"
    with replacing(path) as unfinished:
        shutil.copyfile(built, unfinished)
    return path


def remove(path: Path) -> None:
    """Remove an index that cannot be used, or that is not needed any more; leave it if that is not allowed."""
    with contextlib.suppress(OSError):
        path.unlink()


def unfinished(paths: StorePaths) -> list[Path]:
    """Return indexes that were still being written; the end of their names is the id of the process."""
    with contextlib.suppress(OSError):
        return [path for path in paths.index.iterdir() if UNFINISHED.fullmatch(path.name)]
    return []


def useless(paths: StorePaths) -> list[Path]:
    """Return the indexes of other versions of SIERRA, and those that are damaged."""
    with contextlib.suppress(OSError):
        found = [path for path in paths.index.iterdir() if NAME.fullmatch(path.name) and path.is_file()]
        return [path for path in found if not is_current(path) or not _is_whole(path)]
    return []


def _is_whole(path: Path) -> bool:
    """Check that an index has the bytes that its name promises, or cannot be read now."""
    try:
        return verified(path) is not None
    except OSError:
        return True


def remove_all(paths: StorePaths) -> None:
    """Remove each index, because it holds what is to be removed from the store. Raises OSError."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        for path in paths.index.iterdir():
            is_index = NAME.fullmatch(path.name) or UNFINISHED.fullmatch(path.name)
            if is_index and (path.is_symlink() or not path.is_dir()):
                path.unlink(missing_ok=True)
    remove_abandoned(Path(tempfile.gettempdir()), PREFIX)  # a killed process has left one that it was building
