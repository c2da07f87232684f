"""Segments: folders of records that appear as a whole, by one rename.

    segments/<batch, 12 digits>-<16 digits>/
        MANIFEST                      SHA-256 and name of each file, as `sha256sum -c` reads it
        executions.parquet …          records, a file for each table
        output.<number>.parquet …     rows that the runs wrote, a file for each output; rows with other columns are in
                                      output.<number>~2.parquet …
        OUTPUTS                       the tables of these files: `<number> <name as JSON>`, one per line

A file's name never comes from a user's name, which may be too long for one. The name of the table is also in the file's own
metadata (`duckdb_file_io.TABLE`). Up to format 4, the file of a table was `output.<table>.parquet`, and there was no OUTPUTS.

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
import json
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sierra.errors import DamagedFile, Missing
from sierra.store.duckdb_file_io import TABLE
from sierra.store.layout import StorePaths
from sierra.store.parquet_writer import write
from sierra.store.row_types import TABLES
from sierra.store.schema import sql_types
from sierra.store.verified_files import MANIFEST as MANIFEST
from sierra.store.verified_files import are_sound, changed, hash_written, lost, verify
from sierra.util.fs import UNFINISHED_END, inside, is_gone
from sierra.util.hashing import sha256
from sierra.util.lazy_definitions import dataclass, regex, replace
from sierra.util.regular_files import open_regular
from sierra.util.shortage import lacking

if TYPE_CHECKING:
    import pyarrow.parquet as pq

FORMAT = "sierra store 5\n"
"""The format of segments and of their role in the store. It is raised whenever an older SIERRA would misread it."""
FORMER = "sierra store 4\n"
"""The format that is read too, and that the first session which writes replaces."""
FORMATS = (FORMAT, FORMER)
IMPORTED = "imported_sessions"
"""The table of the sessions that came in packages."""
OUTPUT = "output."
SUFFIX = ".parquet"
NOTICED = frozenset(("objects.parquet", "images.parquet"))
"""Files with contents that records name by a hash: whatever needs a lost one says that it is missing."""
NAME = regex(r"[0-9a-f]{12}-([0-9a-f]{16})")
"""The pattern of a segment's name."""
NUMBERED = regex(r"output\.([1-9][0-9]{0,8})((?:~[0-9]+)?)")
OUTPUTS = "OUTPUTS"
REPLACES = "REPLACES"
AFTER = "AFTER"
MARKS = (MANIFEST, OUTPUTS, REPLACES, AFTER)
"""The files of a segment that are no tables."""
MARK_BYTES = 16 << 20
"""The limit on the bytes that are read from one of them."""
SETTLED_NS = 2_000_000_000
"""The age of the last change of a folder after which a further change certainly gives it another time."""

_known: dict[str, tuple[int, Segment]] = {}
"""Segments without REPLACES and AFTER that were read, and the time of their folders' last change, by path."""

_names: dict[str, tuple[int, list[str]]] = {}
"""The names in folders of segments, with the time of the folders' last change, by path."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A folder of records: the beginning of its batch's id, and its Parquet files by name.

    The name of an output's file is `output.<table>`, whatever the file itself is called.
    """

    batch: str
    files: Mapping[str, str]
    name: str = ""
    replaces: frozenset[str] = frozenset()
    after: str | None = None
    missing: tuple[str, ...] = ()
    """Names of the files in MANIFEST that do not exist, or that of MANIFEST itself if it does not exist or has changed.

    Also OUTPUTS, if it does not name the table of each output's file.
    """
    marks: tuple[str, ...] = ()
    """The paths of OUTPUTS, REPLACES and AFTER, as far as they exist."""
    renamed: bool = False
    """True if OUTPUTS is lost or has changed, and the names of tables are those that the files have in themselves."""

    def outputs(self) -> Iterator[tuple[str, str]]:
        """Yield the table name and the path of each file that holds rows of an output."""
        for name, path in self.files.items():
            if name.startswith(OUTPUT):
                yield table_of(name), path


def table_of(name: str) -> str:
    """Return the table of an output's file, from its name in a segment."""
    return name.removeprefix(OUTPUT).partition("~")[0]


def own_table(metadata: pq.FileMetaData) -> str | None:
    """Return the name of the table in the metadata of an output's file; None if it has none, as in files of former formats."""
    name = (metadata.metadata or {}).get(TABLE.encode())
    return None if name is None else name.decode("utf-8", "replace")


def is_whole(segment: Segment, folder: Path) -> bool:
    """Return True; raise Damaged if a segment has lost a file whose rows would be missing without a word.

    A segment whose MANIFEST has changed has lost that.
    """
    for name in segment.missing:
        if name not in NOTICED:
            path = str(folder / segment.name / name)
            raise DamagedFile(changed(path) if Path(path).exists() else lost(path))
    return True


def is_first_part(path: str) -> bool:
    """Check if a file of an output holds the rows with the usual columns."""
    return "~" not in Path(path).name


def listed(folder: Path) -> list[Segment]:
    """Return all segments that are not ignored, in the order of their names. Raises Damaged if a damaged file may hide one.

    The Parquet files are verified when they are read, see `sierra.store.duckdb_file_io`.
    """
    found = marked(folder, names_in(folder))
    hidden = out_of_date(found)
    return sound([segment for segment in found if segment.name not in hidden], folder)


def marked(folder: Path, names: Iterable[str]) -> list[Segment]:
    """Return existing segments with these names, ignored or not. Raises Damaged if a damaged file may hide one."""
    found = list(_existing(folder, names))
    if not found and not folder.is_dir():
        raise DamagedFile(lost(str(folder)))
    verify(mark for segment in found for mark in segment.marks if not mark.endswith(f"/{OUTPUTS}"))
    return found


def sound(current: list[Segment], folder: Path) -> list[Segment]:
    """Return segments; those that have lost OUTPUTS are read without it."""
    if all(OUTPUTS not in segment.missing for segment in current) and are_sound(_lists(current)):
        return current
    return [segment if _names_its_tables(segment) else _renamed(segment, folder / segment.name) for segment in current]


def _lists(segments: Iterable[Segment]) -> list[str]:
    return [mark for segment in segments for mark in segment.marks if mark.endswith(f"/{OUTPUTS}")]


def _names_its_tables(segment: Segment) -> bool:
    return OUTPUTS not in segment.missing and are_sound(_lists([segment]))


def _renamed(segment: Segment, folder: Path) -> Segment:
    """Return a segment whose OUTPUTS is lost or has changed, with the tables that its sound files name in themselves.

    If one of them names none, OUTPUTS is missing.
    """
    paths = {path.name: str(path) for path in sorted(folder.iterdir()) if path.name.endswith(SUFFIX)}
    verify(path for name, path in paths.items() if name.startswith(OUTPUT))
    files = named_by_themselves(folder, paths)
    other = tuple(name for name in segment.missing if name != OUTPUTS)
    return replace(segment, files=files, renamed=True, missing=other if len(files) == len(paths) else (*other, OUTPUTS))


def named_by_themselves(folder: Path, files: Iterable[str]) -> dict[str, str]:
    """Return sound files of a segment without OUTPUTS by name, those of outputs by the tables that their own metadata names."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    paths = {file.removesuffix(SUFFIX): str(folder / file) for file in files if file.endswith(SUFFIX)}
    tables: dict[str, str] = {}
    for name, path in paths.items():
        if matched := NUMBERED.fullmatch(name):
            with contextlib.suppress(OSError, ValueError, pa.ArrowException):
                tables[matched[1]] = own_table(pq.read_metadata(path)) or ""
    return named(paths, tables)


def out_of_date(segments: Sequence[Segment], others: AbstractSet[str] = frozenset()) -> set[str]:
    """Return the names of ignored segments: replaced, or waiting for a segment that does not exist.

    `others`: the names of further existing segments, without REPLACES and AFTER.
    """
    names = {segment.name for segment in segments} | others
    waiting = {segment.name for segment in segments if segment.after is not None and segment.after not in names}
    replaced = {name for segment in segments if segment.name not in waiting for name in segment.replaces}
    return waiting | (replaced & names)


def on_disk(folder: Path) -> Iterator[Segment]:
    """Yield all existing segments, ignored or not, in the order of their names. Raises OSError for a lack of something.

    One whose folder cannot be read, such as a link to a folder that does not exist, has lost its MANIFEST.
    """
    return _existing(folder, names_in(folder))


def names_in(folder: Path) -> list[str]:
    """Return the sorted names of the entries that may be segments. Raises OSError for a lack of something."""
    path = str(folder)
    try:
        changed = folder.stat().st_mtime_ns
        if path not in _names or _names[path][0] != changed:
            names = sorted(entry.name for entry in os.scandir(folder) if _may_be_segment(entry))
            if time.time_ns() - changed <= SETTLED_NS:
                return names
            _names[path] = changed, names
    except OSError as error:
        if lacking(error) is not None:
            raise
        return []
    return list(_names[path][1])


def _existing(folder: Path, names: Iterable[str]) -> Iterator[Segment]:
    for name in names:
        path = f"{folder}/{name}"
        try:
            yield _segment(path, name)
        except OSError as error:
            if is_gone(path):  # another process removed it meanwhile
                continue
            if lacking(error) is not None:
                raise
            yield Segment(name.partition("-")[0], {}, name, missing=(MANIFEST,))


def _may_be_segment(entry: os.DirEntry[str]) -> bool:
    try:
        return NAME.fullmatch(entry.name) is not None or entry.is_dir()
    except OSError as error:
        if lacking(error) is not None:
            raise
        return False


def _segment(folder: str, name: str) -> Segment:
    """Return a segment as it is now. A command looks at all segments many times, and reads each folder once."""
    changed = os.stat(folder).st_mtime_ns  # noqa: PTH116 - for speed
    known = _known.get(folder)
    if known is not None and known[0] == changed:
        return known[1]
    segment = _read(folder, name)
    lasting = segment.after is None and not segment.replaces and not segment.missing
    if lasting and time.time_ns() - changed > SETTLED_NS:
        _known[folder] = changed, segment
    return segment


def _read(folder: str, name: str) -> Segment:
    with os.scandir(folder) as entries:
        paths = dict(sorted((entry.name, entry.path) for entry in entries))  # the first file of an output names its columns
    texts = {mark: _beginning(paths[mark]) for mark in MARKS if mark in paths}
    lines = {mark: _split(text) for mark, text in texts.items() if text is not None}
    for mark in texts.keys() - lines.keys():
        del paths[mark]
    files = {file.removesuffix(SUFFIX): path for file, path in paths.items() if file.endswith(SUFFIX)}
    replaces = frozenset(lines.get(REPLACES, ()))
    after = next(iter(lines[AFTER]), "") if AFTER in lines else None
    marks = tuple(paths[mark] for mark in (OUTPUTS, REPLACES, AFTER) if mark in paths)
    missing = _missing(paths, name, texts.get(MANIFEST))
    if OUTPUTS in paths:
        numbered = files
        files = named(numbered, _tables(lines[OUTPUTS]))
        missing += (OUTPUTS,) if len(files) < len(numbered) else ()
    return Segment(name.partition("-")[0], files, name, replaces, after, missing, marks)


def named(files: Mapping[str, str], tables: Mapping[str, str]) -> dict[str, str]:
    """Return files by name, those of outputs by the names of their tables, which `tables` has by number.

    Files of outputs whose table is unknown are left out.
    """
    paths = {}
    for name, path in files.items():
        if not name.startswith(OUTPUT):
            paths[name] = path
        elif (matched := NUMBERED.fullmatch(name)) and (table := tables.get(matched[1])):
            paths[f"{OUTPUT}{table}{matched[2]}"] = path
    return paths


def _tables(lines: Iterable[str]) -> dict[str, str]:
    """Return the names of tables by number from the lines of OUTPUTS; a line of another form has no effect."""
    found: dict[str, str] = {}
    for number, _, text in (line.partition(" ") for line in lines):
        with contextlib.suppress(ValueError, RecursionError):
            if isinstance(name := json.loads(text), str) and "~" not in name:
                found[number] = name
    return found


def _missing(paths: Mapping[str, str], segment: str, text: bytes | None) -> tuple[str, ...]:
    """Return the names in MANIFEST that are not among these paths; that of MANIFEST if this text is not the segment's."""
    if text is None or sha256(text)[:16] != segment.rpartition("-")[2]:
        return (MANIFEST,)
    names = (line.partition("  ")[2] for line in _split(text))
    return tuple(name for name in names if name not in paths)


def _beginning(path: str) -> bytes | None:
    """Return the content of a mark; None if it cannot be read, such as a link to a file that does not exist, or a pipe.

    Raises OSError for a lack of something, and if another process has removed the segment.
    """
    try:
        with open_regular(path) as file:
            return file.read(MARK_BYTES)
    except OSError as error:
        if lacking(error) is not None or is_gone(path.rpartition("/")[0]):
            raise
        return None


def _split(text: bytes) -> list[str]:
    return text.decode("utf-8", "replace").splitlines()


class Writer:
    """A segment that is being written in `folder`; `publish` adds it to the store."""

    def __init__(self, folder: Path, batch: str) -> None:
        self.folder = folder
        self.batch = batch[:12]
        self._tables: dict[str, int] = {}
        """The numbers of the tables of outputs, by name."""
        self.published: Path | None = None
        """The segment; None if there is none, or if the store had the same one already."""
        shutil.rmtree(folder, ignore_errors=True)
        with disk_errors(folder):
            folder.mkdir(parents=True)

    def path(self, name: str) -> Path:
        """Return the path for the Parquet file of this name, for callers that write it themselves.

        That of an output, `output.<table>` and perhaps `~2`, is called by the number of its table in this segment.
        """
        if name.startswith(OUTPUT):
            table, part, count = name.removeprefix(OUTPUT).partition("~")
            name = f"{OUTPUT}{self._tables.setdefault(table, len(self._tables) + 1)}{part}{count}"
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
        """Write OUTPUTS, REPLACES or AFTER."""
        with disk_errors(self.folder):
            (self.folder / name).write_text("".join(f"{line}\n" for line in lines), "utf-8")

    def _name_tables(self) -> None:
        """Write OUTPUTS, if there are files of outputs."""
        written = {matched[1] for file in self.folder.iterdir() if (matched := NUMBERED.fullmatch(file.stem))}
        tables = ((number, table) for table, number in self._tables.items() if str(number) in written)
        if lines := [f"{number} {json.dumps(table, ensure_ascii=False)}" for number, table in tables]:
            self.mark(OUTPUTS, lines)

    def seal(self) -> str:
        """Write OUTPUTS and MANIFEST, sync all files, and return the segment's future name.

        Nothing may be written afterwards.
        """
        with disk_errors(self.folder):
            self._name_tables()
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
            renew(StorePaths(segments.parent))
            try:
                self.folder.rename(target)
                self.published = target
            except OSError as error:
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                    raise
                shutil.rmtree(self.folder)
            sync(segments)
        return True


def renew(paths: StorePaths) -> None:
    """Replace the number of the former format, before the first segment of the present one is added. Raises OSError.

    The file stays the same, because readers hold a lock on it, and one byte changes: it is written or it is not.
    """
    with paths.format.open("rb") as file:
        if file.read(len(FORMER) + 1) != FORMER.encode():
            return
    offset = next(offset for offset, (new, old) in enumerate(zip(FORMAT, FORMER, strict=True)) if new != old)
    with paths.format.open("r+b", buffering=0) as file:
        os.pwrite(file.fileno(), FORMAT[offset].encode(), offset)
        os.fsync(file.fileno())


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
    """A context manager that turns errors of a full or read-only disk into Missing.

    The message names the file that may not be written, or else the folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError):
            raise Missing(f"cannot write to {self._unwritable(error)}: {error.strerror or error}") from error

    def _unwritable(self, error: OSError) -> Path:
        """Return the file that may not be written, as users know it; else the folder."""
        path = error.filename2 or error.filename
        if error.errno not in (errno.EACCES, errno.EPERM) or not isinstance(path, str | Path):
            return self._folder
        unfinished = re.fullmatch(rf"\.(.+){UNFINISHED_END}", Path(path).name)
        return Path(path).with_name(unfinished[1]) if unfinished else Path(path)
