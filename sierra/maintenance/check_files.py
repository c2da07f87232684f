"""Check every byte of a store against its recorded hash, and every Parquet file against the table that it should hold.

A segment's name holds the hash of its MANIFEST, and MANIFEST holds the hash of each file. A file's content is read only if its
bytes have the right hash. Even then the file may be somebody else's, so memory use is bounded whatever the file contains.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import stat
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from sierra.errors import Missing
from sierra.execution import unrecorded
from sierra.maintenance.findings import Finding, Kind
from sierra.store import ownership_marks, session_log_file
from sierra.store.duckdb_messages import check_shortage, first_line
from sierra.store.layout import WORK, StorePaths
from sierra.store.objects import GROUP, ROWS
from sierra.store.schema import RECORDED, arrow_schema, is_table
from sierra.store.segments import (
    FORMAT,
    FORMER,
    MANIFEST,
    MARK_BYTES,
    NAME,
    OUTPUT,
    OUTPUTS,
    Segment,
    named_by_themselves,
    on_disk,
    out_of_date,
    own_table,
    table_of,
)
from sierra.store.store import CACHEDIR
from sierra.store.views import ONCE
from sierra.util.fs import UNFINISHED_END
from sierra.util.hashing import sha256, unsealed
from sierra.util.lazy_definitions import dataclass, field, regex, replace
from sierra.util.shortage import shortage
from sierra.worker import checkpoints

ASIDE = regex(rf"{NAME.pattern}(\.\d+)?")
"""The pattern of the name of a segment that a repair has put aside."""
LINE = regex(r"([0-9a-f]{64})  ([^/\0]+)")
UNFINISHED = regex(rf"\.(format|\.?gitignore|CACHEDIR\.TAG|MANIFEST|id){UNFINISHED_END}")
CHUNK = 1 << 20
THREADS = 4
EXPANDED = 256 << 20
"""The largest size in memory of a piece of an object file, in bytes."""
FIXED = {"format": FORMAT, ".gitignore": "*\n", "CACHEDIR.TAG": CACHEDIR}
"""Files that are the same in every store, but that `format` may have the number of the former format."""
DERIVED = frozenset(("files", "numbers"))
"""Files that are derived from others, and made again if they are missing."""
FOLDERS = frozenset(
    ("segments", "index", "work", "damaged", "kept", "images", "logs", "build", "try", "extracted", "checkpoints")
)


@dataclass(slots=True)
class Contents:
    """The result of reading a store: the sound parts of segments, and the problems of the others."""

    findings: list[Finding] = field(default_factory=list)
    sound: list[Segment] = field(default_factory=list)
    """Current segments, each with its sound Parquet files only."""
    broken: dict[str, set[str]] = field(default_factory=dict)
    """By segment: the names of its lost files."""
    left: list[str] = field(default_factory=list)
    """Segments that other segments replaced."""
    files: int = 0
    bytes: int = 0

    @property
    def unchecked(self) -> list[Finding]:
        """The findings about files that could not be read for lack of something."""
        return [finding for finding in self.findings if finding.kind is Kind.UNCHECKED]


def read(paths: StorePaths, tell: Callable[[int], None] = lambda done: None) -> Contents:
    """Read and hash all files of a store. `tell` receives the number of bytes that are done."""
    contents = Contents()
    contents.findings += _top(paths)
    present = {segment.name: segment for segment in on_disk(paths.segments)}
    contents.findings += _strays(paths, present)
    hidden = out_of_date(list(present.values()))
    suffixes: dict[str, str] = {}
    with ThreadPoolExecutor(THREADS) as pool:
        for name, segment in present.items():
            folder = paths.segments / name
            if folder.is_symlink() or not folder.is_dir() or not NAME.fullmatch(name):
                continue
            if name in hidden:
                contents.left.append(name)
            twin = suffixes.setdefault(name.partition("-")[2], name)
            if twin != name and not segment.files.keys() <= ONCE.keys():
                what = f"a copy of segment {twin} under another name"
                contents.findings.append(Finding(Kind.STRAY, _shown(paths, folder), what))
                continue
            _segment(paths, contents, segment, pool, counts=name not in hidden)
            tell(contents.bytes)
    return contents


def _shown(paths: StorePaths, path: Path) -> str:
    text = str(path.relative_to(paths.root))
    return text.encode("utf-8", "backslashreplace").decode()


# files outside segments


def _top(paths: StorePaths) -> Iterator[Finding]:
    former = {"format": FORMER.encode()}
    for name, content in FIXED.items():
        path = paths.root / name
        try:
            if not _is_plain(path):
                yield Finding(Kind.DAMAGED, name, "is not a regular file")
            elif _beginning(path, len(content.encode()) + 1) not in {content.encode(), former.get(name)}:
                yield Finding(Kind.DAMAGED, name, "has wrong content; sierra fsck --repair writes it again")
        except FileNotFoundError:
            yield Finding(Kind.ABSENT, name, "is missing; sierra fsck --repair writes it again")
        except OSError as error:
            yield _unread(name, error)
    for entry in _entries(paths.root):
        path = Path(entry.path)
        if entry.name not in FIXED and entry.is_file(follow_symlinks=False) and not os.access(path, os.R_OK):
            yield Finding(Kind.UNCHECKED, _shown(paths, path), f"may not be read: {os.strerror(errno.EACCES)}")
        elif entry.name in FOLDERS:
            if not entry.is_dir(follow_symlinks=entry.name == WORK):
                yield Finding(Kind.STRAY, _shown(paths, path), "is not a folder")
        elif UNFINISHED.fullmatch(entry.name):
            yield Finding(Kind.LEFT, _shown(paths, path), "an unfinished file")
        elif entry.name in DERIVED:
            if not _is_sealed(path):
                yield Finding(Kind.DAMAGED, entry.name, "has other content than SIERRA wrote; sierra fsck --repair removes it")
        elif entry.name == paths.identity.name:
            if ownership_marks.id_in(path) is None:
                yield Finding(
                    Kind.DAMAGED, entry.name, "contains no store id; move it and work away, and SIERRA creates both again"
                )
        elif entry.name not in FIXED:
            yield Finding(Kind.STRAY, _shown(paths, path), "does not belong to a store")
    if not paths.segments.is_dir():
        yield Finding(Kind.ABSENT, "segments", "is missing: all records are lost")
    segments, sessions = put_aside(paths), {session.folder: session for session in unrecorded.found(paths)}
    for entry in _entries(paths.damaged):
        path = Path(entry.path)
        if path in sessions:
            yield Finding(Kind.UNRECORDED, _shown(paths, path), str(sessions[path]))
        elif path in segments:
            yield Finding(Kind.LEFT, _shown(paths, path), "put aside by a repair; sierra gc --damaged removes it")
        else:
            yield Finding(
                Kind.FOREIGN, _shown(paths, path), "is not a segment, so SIERRA does not touch it; move it away if it is yours"
            )
    known = set(session_log_file.logs(paths))
    for entry in _entries(paths.logs):
        path = Path(entry.path)
        if path not in known:
            yield Finding(Kind.FOREIGN, _shown(paths, path), "is not a session's log; move it away if it is yours")
    for entry in _entries(paths.checkpoints):
        if not checkpoints.is_marked(entry.path):
            path = Path(entry.path)
            yield Finding(Kind.FOREIGN, _shown(paths, path), "is not a run's checkpoint; move it away if it is yours")


def has_segments(paths: StorePaths) -> bool:
    """Return whether anything is recorded, judging by names only."""
    return any(NAME.fullmatch(entry.name) for entry in _entries(paths.segments))


def put_aside(paths: StorePaths) -> list[Path]:
    """Return the segments in `damaged/`, where a repair put them. Nothing else in that folder is ever removed."""
    found = [Path(entry.path) for entry in _entries(paths.damaged) if entry.is_dir(follow_symlinks=False)]
    return [path for path in found if ASIDE.fullmatch(path.name)]


def _unread(name: str, error: OSError) -> Finding:
    """Return the finding about a file that cannot be read: damage, unless this user may not, or something is lacking."""
    if (lack := shortage(error)) is not None:
        return Finding(Kind.UNCHECKED, name, f"cannot be read: {lack}")
    return Finding(Kind.DAMAGED, name, f"cannot be read: {error.strerror}")


def _is_sealed(path: Path) -> bool:
    with contextlib.suppress(OSError):
        return _is_plain(path) and path.stat().st_size < EXPANDED and unsealed(path.read_bytes()) is not None
    return False


def _strays(paths: StorePaths, present: Mapping[str, Segment]) -> Iterator[Finding]:
    for entry in _entries(paths.segments):
        path = _shown(paths, Path(entry.path))
        if entry.is_symlink() or not entry.is_dir(follow_symlinks=False):
            yield Finding(Kind.STRAY, path, "is not a segment: it is not a folder")
        elif not NAME.fullmatch(entry.name):
            yield Finding(Kind.STRAY, path, "is not a segment: the names of segments consist of 12 and 16 hexadecimal digits")


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        return sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:
        return []


def _is_plain(path: Path) -> bool:
    return stat.S_ISREG(path.lstat().st_mode)


def _beginning(path: Path, count: int) -> bytes:
    with path.open("rb") as file:
        return file.read(count)


# segments


def _segment(paths: StorePaths, contents: Contents, segment: Segment, pool: ThreadPoolExecutor, *, counts: bool) -> None:
    """Check one segment, and add its sound part to `found.sound` if `counts`: if no other segment replaced it."""
    folder = paths.segments / segment.name
    try:
        listed, faults = _manifest(folder)
    except OSError as error:
        contents.findings.append(_unread(_shown(paths, folder / MANIFEST), error))
        return
    findings = [Finding(Kind.DAMAGED, _shown(paths, folder / MANIFEST), fault) for fault in faults]
    entries = {entry.name for entry in _entries(folder)} - {MANIFEST}
    findings += [
        Finding(Kind.LEFT, _shown(paths, folder / name), "an unfinished file")
        if UNFINISHED.fullmatch(name)
        else Finding(Kind.STRAY, _shown(paths, folder / name), "is not listed in the segment's MANIFEST")
        for name in sorted(entries - listed.keys())
        if not faults or UNFINISHED.fullmatch(name)
    ]
    hashed = dict(zip(sorted(entries), pool.map(lambda name: _hashed(folder / name), sorted(entries)), strict=True))
    lost: set[str] = set()
    for name, digest in listed.items():
        kind, fault = _differs(hashed.get(name), digest)
        if fault:
            lost.add(name)
            findings.append(Finding(kind, _shown(paths, folder / name), fault))
    files: Mapping[str, str] = segment.files
    if OUTPUTS in listed and (OUTPUTS in lost or OUTPUTS in segment.missing):
        files = {} if faults else named_by_themselves(folder, listed.keys() - lost)
        if OUTPUTS not in lost:
            lost.add(OUTPUTS)
            what = "does not name the table of each output"
            findings.append(Finding(Kind.INCONSISTENT, _shown(paths, folder / OUTPUTS), what))
    sound = {}
    for name, path in files.items():
        file = Path(path).name
        if file in listed and file not in lost and not faults:
            try:
                unlike = parquet_fault(Path(path), name)
            except Missing as error:
                findings.append(Finding(Kind.UNCHECKED, _shown(paths, Path(path)), str(error)))
                continue
            if unlike is not None:
                lost.add(file)
                findings.append(Finding(Kind.INCONSISTENT, _shown(paths, Path(path)), unlike))
            else:
                sound[name] = path
    contents.files += len(hashed) + 1
    contents.bytes += sum(size for _, size in hashed.values())
    contents.findings += findings
    if counts:
        if lost or faults:
            contents.broken[segment.name] = lost | ({MANIFEST} if faults else set())
        contents.sound.append(replace(segment, files=sound))


def _manifest(folder: Path) -> tuple[dict[str, str], list[str]]:
    """Return the entries of MANIFEST that can be read (SHA-256 by name), and its problems. Raises OSError for a lack."""
    path = folder / MANIFEST
    try:
        if not _is_plain(path):
            return {}, ["is not a regular file"]
        text = _beginning(path, MARK_BYTES)
    except FileNotFoundError:
        return {}, ["is missing"]
    except OSError as error:
        if shortage(error) is not None:
            raise
        return {}, [f"cannot be read: {error.strerror}"]
    listed = {}
    for line in text.decode("utf-8", "replace").splitlines():
        if matched := LINE.fullmatch(line):
            listed[matched[2]] = matched[1]
    faults = [] if sha256(text)[:16] == folder.name[-16:] else ["does not have the hash in the segment's name"]
    return listed, faults


class _Lack(str):
    """A lack that keeps a file from being read."""


def _hashed(path: Path) -> tuple[str, int]:
    """Return the SHA-256 and the size in bytes of a plain file; for any other or an unreadable file, the problem and 0."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        return ("is a symbolic link, not a file" if path.is_symlink() else _problem(error)), 0
    try:
        with os.fdopen(descriptor, "rb", buffering=0) as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                return "is not a regular file", 0
            digest, size = hashlib.sha256(), 0
            while piece := file.read(CHUNK):
                digest.update(piece)
                size += len(piece)
            return digest.hexdigest(), size
    except OSError as error:
        return _problem(error), 0


def _problem(error: OSError) -> str:
    lack = shortage(error)
    return _Lack(f"cannot be read: {lack}") if lack is not None else f"cannot be read: {error.strerror}"


def _differs(hashed: tuple[str, int] | None, digest: str) -> tuple[Kind, str]:
    if hashed is None:
        return Kind.ABSENT, "is missing"
    if hashed[0] == digest:
        return Kind.DAMAGED, ""
    if isinstance(hashed[0], _Lack):
        return Kind.UNCHECKED, hashed[0]
    whole = re.fullmatch("[0-9a-f]{64}", hashed[0])
    return Kind.DAMAGED, "has other bytes than SIERRA wrote" if whole else hashed[0]


# content of Parquet files


def parquet_fault(path: Path, name: str) -> str | None:
    """Return why a file cannot be the one of that name; None if it can. Raises Missing for a lack of something."""
    try:
        with pq.ParquetFile(path) as file:
            schema, table = file.schema_arrow, own_table(file.metadata)
    except (OSError, ValueError, MemoryError, pa.ArrowException) as error:
        check_shortage(error)
        return f"is not a readable Parquet file: {first_line(error)}"
    if name.startswith(OUTPUT):
        if table not in (None, table_of(name)):
            return f"is of the table {table_of(name)!r}, but names itself {table!r}"
        missing = [column for column in ("run", "execution") if column not in schema.names]
        return f"has no column {missing[0]!r}" if missing else None
    if name not in RECORDED:
        return f"the store has no table {name!r}"
    if name == "experiments":
        schema = pa.schema(list(schema)[: len(arrow_schema(name))])
    if is_table(name, schema):
        return None
    return f"does not have the columns of {name}: {', '.join(map(str, schema.names))[:200]}"


@dataclass(slots=True)
class Objects:
    """The objects of a store, hashed."""

    whole: set[str] = field(default_factory=set)
    """SHA-256 of the objects that are present and have the right content."""
    faults: list[tuple[str, str]] = field(default_factory=list)
    """Paths of files, each with a problem in it."""
    blobs: dict[str, str] = field(default_factory=dict)
    """Git's hash, by SHA-256, of the requested objects."""


def read_objects(segments: list[Segment], wanted: set[str], tell: Callable[[], None] = lambda: None) -> Objects:
    """Hash all objects over their parts; hash the objects in `wanted` as git blobs too."""
    objects = Objects()
    for segment in segments:
        path = segment.files.get("objects")
        if path is not None:
            try:
                _read_objects(path, objects, wanted)
            except (OSError, ValueError, MemoryError) as error:
                check_shortage(error)
                objects.faults.append((path, f"cannot be read: {first_line(error) if str(error) else 'out of memory'}"))
            tell()
    return objects


def _read_objects(path: str, objects: Objects, wanted: set[str]) -> None:
    current: _Object | None = None
    for digest, part, size, content in _parts(path):
        if current is None or current.digest != digest or part != current.parts:
            _finish(current, path, objects)
            current = _Object(digest, size, digest in wanted)
        if part != current.parts or size != current.size:
            objects.faults.append((path, f"the parts of object {digest[:16]} are not in order"))
        current.add(content)
    _finish(current, path, objects)


class _Object:
    def __init__(self, digest: str, size: int, as_blob: bool) -> None:
        self.digest, self.size = digest, size
        self.parts = self.bytes = 0
        self.sha256 = hashlib.sha256()
        self.sha1 = hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False) if as_blob else None

    def add(self, content: memoryview) -> None:
        self.parts += 1
        self.bytes += len(content)
        self.sha256.update(content)
        if self.sha1 is not None:
            self.sha1.update(content)


def _finish(current: _Object | None, path: str, objects: Objects) -> None:
    if current is None:
        return
    if current.bytes == current.size and current.sha256.hexdigest() == current.digest:
        objects.whole.add(current.digest)
        if current.sha1 is not None:
            objects.blobs[current.digest] = current.sha1.hexdigest()
    else:
        objects.faults.append((path, f"object {current.digest[:16]} does not have the content of its SHA-256"))


def _parts(path: str) -> Iterator[tuple[str, int, int, memoryview]]:
    """Yield the rows of an object file, reading a bounded number of bytes at a time.

    Raises ValueError for a file that SIERRA cannot have written.
    """
    with pq.ParquetFile(path, pre_buffer=False) as file:
        for group in range(file.num_row_groups):
            described = file.metadata.row_group(group)
            held = sum(described.column(index).total_uncompressed_size for index in range(described.num_columns))
            if described.num_rows > ROWS or held > 2 * GROUP:
                raise ValueError("its row groups are larger than any that SIERRA writes")
            rows = max(1, min(ROWS, EXPANDED // max(held, 1)))
            for batch in file.iter_batches(rows, row_groups=[group]):
                digests, parts, sizes, contents = (batch.column(name) for name in ("sha256", "part", "size", "content"))
                for row in range(batch.num_rows):
                    content = contents[row].as_buffer()
                    if content is None or None in (fixed := (digests[row].as_py(), parts[row].as_py(), sizes[row].as_py())):
                        raise ValueError("it has rows without a value")
                    yield *fixed, memoryview(content)
