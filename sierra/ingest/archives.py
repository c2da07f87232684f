"""Files in archives, as `file = "out.tar.gz/results.csv"` declares them.

The files that belong to outputs are written into a temporary folder, under numbers instead of their names, and read there as
any other file. Nothing else of an archive is written anywhere.

An archive is read to its end, because a part of it may look whole. Names, members and contents of a zip are checked as those of
packages are (`sierra.worker.reproduce`), except that names need not suit all systems. An archive must end as its format says,
and nothing may follow. Lack of space, and errors of the disk, are never faults of a run: they raise Missing.
"""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import lzma
import shutil
import sys
import tarfile
import tempfile
import zipfile
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import BinaryIO, NamedTuple

from sierra.config.output_tables import Output
from sierra.containers.images import streams
from sierra.errors import Damaged, Missing
from sierra.ingest import robot_files
from sierra.ingest.base import LaterError, UnreadableError
from sierra.ingest.independent_row_count import described
from sierra.ingest.model import Written
from sierra.model import OutputFile, Result
from sierra.store.layout import RUN_OUTPUT
from sierra.store.segments import disk_errors
from sierra.util.lazy_definitions import regex
from sierra.util.scratch import scratch
from sierra.util.text import few
from sierra.worker import reproduce

WHAT = "the archive"
PIECE = 1 << 20
MEMORY = 256 << 20
"""The memory that xz may use; the strongest level needs 65 MiB."""
NAMED = 3
AT_A_TIME = 1 << 32
"""The largest number of bytes that are unpacked, of several executions, before their tables are read."""
FOLDER = "sierra-unpacked-"
END = b"PK\5\6"
END_SIZE = 22
"""The first bytes and the length of the record at the end of a zip, without the comment that follows it."""
OF_MACOS = regex(r"(^|/)(__MACOSX(/|$)|\._[^/]*$)")
"""The names that macOS gives to files with properties of other files."""
SUFFIX = regex(r"\.[A-Za-z0-9]{1,16}")
DAMAGES = (*reproduce.NOT_A_ZIP, tarfile.TarError, lzma.LZMAError, zlib.error, OSError)


class Member(NamedTuple):
    """A file in an archive."""

    name: str
    size: int
    content: Iterator[bytes]
    """Its bytes, to be read before the next member. Raises UnreadableError if it is damaged, or no regular file."""


class _File(io.FileIO):
    """An archive. Errors of the disk are Missing, so that no library takes them for damage."""

    def readinto(self, buffer: memoryview, /) -> int:  # type: ignore[override]  # it is always called with this type
        with _disk_read(self.name):
            return super().readinto(buffer) or 0

    def readall(self) -> bytes:
        with _disk_read(self.name):
            return super().readall() or b""


@contextlib.contextmanager
def _disk_read(path: object) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise Missing(f"cannot read {path}: {error.strerror or error}") from error


def open_archive(path: Path) -> BinaryIO:
    """Open an archive. Raises Missing, also later, if the disk cannot be read."""
    with _disk_read(path):
        return io.BufferedReader(_File(str(path)))


def members(file: BinaryIO, name: str, most: int) -> Iterator[Member]:
    """Yield all members of an archive except folders. Read them to the end: the archive is sound only then.

    `name` is its name, and `most` the largest number of bytes that it may expand to. Raises UnreadableError.
    """
    with _one_line():
        yield from _of_zip(file, most) if name.lower().endswith(".zip") else _of_tar(file, name, most)


def _of_zip(file: BinaryIO, most: int) -> Iterator[Member]:
    with zipfile.ZipFile(file) as opened:
        _check_end(file, len(opened.comment))
        infos = opened.infolist()
        files = {info.orig_filename.removeprefix("./"): info for info in infos if not info.is_dir()}
        _check_names([info.orig_filename for info in infos])
        reproduce.check_apart(opened)
        if min((info.header_offset for info in infos), default=opened.start_dir):
            raise UnreadableError(f"{WHAT} has data before its first member; is it two archives, one after the other?")
        if (size := sum(info.file_size for info in infos)) > most:
            raise UnreadableError(f"{WHAT} expands to {size:,} bytes, but there is space for {most:,}")
        for name, info in files.items():
            content = _zipped(opened, info)
            yield Member(name, info.file_size, content)
            with contextlib.suppress(reproduce.Stop):  # a link, encrypted, or of another method: only its reader minds
                reproduce.check_member(info)
                deque(content, 0)  # damage is UnreadableError


def _check_end(file: BinaryIO, comment: int) -> None:
    """Raise UnreadableError unless a zip ends with its last record and a comment of this length."""
    file.seek(-END_SIZE - comment, io.SEEK_END)
    record = file.read(END_SIZE)
    if not record.startswith(END) or int.from_bytes(record[-2:], "little") != comment:
        raise UnreadableError(f"{WHAT} has data after its end, or its comment is cut short")


def _zipped(opened: zipfile.ZipFile, info: zipfile.ZipInfo) -> Iterator[bytes]:
    with _one_line():
        reproduce.check_member(info)
        yield from reproduce.member_blocks(opened, info)


def _of_tar(file: BinaryIO, name: str, most: int) -> Iterator[Member]:
    stream = streams.ForwardStream(_decompressed(file, name), most, WHAT)
    names: list[str] = []
    for member, tar in streams.members(stream, WHAT):
        names.append(member.name + "/" * member.isdir())
        if len(names) > reproduce.MOST:
            break
        if not member.isdir():
            yield Member(member.name.removeprefix("./"), member.size, _packed(tar, member))
    _check_names(names)
    if not stream.last:
        raise UnreadableError(f"{WHAT} is cut short: the mark of its end is missing")
    if any(piece.strip(b"\0") for piece in iter(lambda: stream.read(PIECE), b"")):
        raise UnreadableError(f"{WHAT} has data after its end; is it two archives, one after the other?")


def _packed(tar: tarfile.TarFile, member: tarfile.TarInfo) -> Iterator[bytes]:
    with _one_line():
        if not member.isreg() or member.issparse():
            raise UnreadableError(f"member {member.name!r} is a link, a device or a sparse file, and no plain file")
        yield from streams.content(tar, member, WHAT)


def _check_names(names: Sequence[str]) -> None:
    """Raise Stop for names that lead elsewhere or are not different; those of folders end with a slash, and may repeat."""
    relative = [name.removeprefix("./") for name in names if name not in (".", "./")]
    reproduce.check_names([name for name in relative if not name.endswith("/")], WHAT, portable=False)
    for folder in (name.rstrip("/") for name in relative if name.endswith("/")):
        if problem := reproduce.place_problem(folder):
            raise reproduce.damaged(f"{WHAT} has a folder {folder[:100]!r}, but {problem}")


@contextlib.contextmanager
def _one_line() -> Iterator[None]:
    """Raise UnreadableError for all that can be wrong with an archive."""
    try:
        yield
    except UnreadableError:
        raise
    except (reproduce.Stop, Damaged) as error:
        raise UnreadableError(" ".join(str(error).split())) from error
    except DAMAGES as error:
        raise UnreadableError(f"{WHAT} cannot be read: {' '.join(str(error).split()) or type(error).__name__}") from error


def _decompressed(file: BinaryIO, name: str) -> streams.Readable:
    ending = name.lower().rpartition(".")[2]
    if ending in ("gz", "tgz"):
        return gzip.GzipFile(fileobj=file)
    if ending == "bz2":
        return _Decompressed(file, bz2.BZ2Decompressor)
    if ending in ("xz", "txz"):
        return _Decompressed(file, lambda: lzma.LZMADecompressor(memlimit=MEMORY))
    if ending == "zst":
        import pyarrow as pa

        zstd: streams.Readable = pa.CompressedInputStream(pa.PythonFile(file, "r"), "zstd")
        return zstd
    return file


class _Decompressed:
    """The content of a file of bzip2 or xz. Unlike those of Python's modules, it accepts nothing else after the data."""

    def __init__(self, file: BinaryIO, new: Callable[[], bz2.BZ2Decompressor | lzma.LZMADecompressor]) -> None:
        self._file, self._new, self._unpacker, self._rest = file, new, new(), b""

    def read(self, size: int = -1, /) -> bytes:
        while True:
            if self._unpacker.eof:
                self._rest = self._unpacker.unused_data.lstrip(b"\0")
                while not self._rest:
                    if not (piece := self._file.read(PIECE)):
                        return b""
                    self._rest = piece.lstrip(b"\0")
                self._unpacker = self._new()
            piece = (self._rest or self._file.read(PIECE)) if self._unpacker.needs_input else b""
            if not piece and self._unpacker.needs_input:
                raise EOFError("the compressed data ends too early")
            self._rest = b""
            if data := self._unpacker.decompress(piece, size):
                return data


class Unpacking:
    """A context manager for the files in archives that belong to outputs; they are there until its end."""

    def __init__(self, outputs: Mapping[str, Output]) -> None:
        self._outputs = outputs
        self._files: dict[tuple[str, str], dict[str, list[Written]]] = {}
        """The files by output, for each execution and archive."""
        self._names: dict[tuple[str, str], list[str]] = {}
        """The names of all members, for each execution and archive."""
        self._count = 0
        self._bytes = 0
        self._first = ""
        """The execution of the first archive; there is nothing to wait for before it is unpacked."""
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Unpacking:
        parent = Path(tempfile.gettempdir())
        with disk_errors(parent):
            self._folder = self._stack.enter_context(scratch(parent, FOLDER))
            self._most = min(AT_A_TIME, shutil.disk_usage(self._folder).free // 2)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def files(self, result: Result, archive: OutputFile, output: str) -> Sequence[Written]:
        """Return the files of an output in an archive that an execution has left.

        Raises UnreadableError, Missing, and LaterError.
        """
        key = result.execution, archive.path
        self._first = self._first or result.execution
        if key not in self._files:
            self._files[key] = {}
            folder = self._folder / str(len(self._files))
            with disk_errors(folder):
                folder.mkdir()
            try:
                with open_archive(Path(result.directory, RUN_OUTPUT, archive.path)) as file:
                    for member in members(file, archive.path, sys.maxsize):
                        self._add(result, archive.path, member, folder)
            except (UnreadableError, LaterError):
                self._files[key] = {}  # no other output gets a part of it
                shutil.rmtree(folder)
                raise
        return self._files[key].get(output, ())

    def _owners(self, archive: str, member: str) -> list[str]:
        """Return the outputs that a member belongs to: those that name it, or else those whose whole pattern fits."""
        name, hidden = f"{archive}/{member}", OF_MACOS.search(member)
        fitting = [
            key
            for key, output in self._outputs.items()
            if output.opens(archive) and output.names(name) and not (hidden and not OF_MACOS.search(output.file))
        ]
        return [key for key in fitting if self._outputs[key].base == name] or fitting

    def _add(self, result: Result, archive: str, member: Member, folder: Path) -> None:
        self._names.setdefault((result.execution, archive), []).append(member.name)
        name, owners = f"{archive}/{member.name}", self._owners(archive, member.name)
        if not owners:
            return
        if len(owners) > 1 and not all(self._outputs[owner].shares_file for owner in owners):
            raise UnreadableError(f"{member.name!r} belongs to the outputs {owners[0]!r} and {owners[1]!r}; change file in one")
        self._count += 1
        suffix = PurePosixPath(member.name).suffix
        path = folder / f"{self._count}{suffix if SUFFIX.fullmatch(suffix) else ''}"
        with disk_errors(folder), path.open("xb") as file:
            for piece in member.content:
                self._bytes += file.write(piece)
                if self._bytes > self._most and result.execution != self._first:
                    raise LaterError
        for owner in owners:
            ticks = self._outputs[owner].ticks_of(name) or ()
            empty = Written(str(path), result.run, result.execution, name, "", 0, True, 0, ticks=ticks, archive=archive)
            self._files[result.execution, archive].setdefault(owner, []).append(described(empty, path))

    def lacking(self, result: Result, written: Mapping[str, Sequence[str]]) -> str | None:
        """Return why an execution has failed of whose archives one lacks a required file; None if none does.

        `written` are the names of the files of each output.
        """
        for name, output in self._outputs.items():
            if not output.archive or not output.required:
                continue
            files = written.get(name, ())
            robot = robot_files.lacking(output, files, result.robots)
            if robot is not None or not files:
                whose = f" of {robot_files.named(robot, result.robots)}" if robot is not None else ""
                opened = [key for key in self._names if key[0] == result.execution and output.opens(key[1])]
                has = few([repr(known) for key in opened for known in self._names[key]], NAMED) or "no files"
                return f"{output.file!r} (output {name!r}) is not in the archive{whose}, which has {has}"
        return None
