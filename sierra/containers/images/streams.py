"""Byte streams from outside that are read forwards once, and are counted, limited and hashed while they are read.

`tarfile` trusts the sizes in a header, and reads that many bytes into memory. A `ForwardStream` therefore limits the bytes of a
header, limits the total to the size that the image may have, and computes the digest of all bytes.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import subprocess
import tarfile
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import BinaryIO, Protocol, cast

from sierra.errors import Damaged

PIECE = 1 << 20
MAX_HEADER = 16 << 20
"""The greatest length in bytes of a header with the data that belongs to it."""
BLOCK = 512

UNREADABLE = (tarfile.TarError, ValueError, OverflowError, RecursionError)
"""The errors that `tarfile` raises for data that is not a tar."""


class Readable(Protocol):
    """A stream of bytes that is only read."""

    def read(self, size: int = -1, /) -> bytes: ...


class ForwardStream:
    """A stream that is read once from beginning to end, with only the methods that `tarfile` needs."""

    def __init__(self, stream: Readable, most: int, what: str) -> None:
        self._stream, self._most, self._what = stream, most, what
        self._place = 0
        self._hash = hashlib.sha256()
        self.header: int | None = None
        """The bytes of the current header that were read; None if no header is being read."""
        self.last = b""
        """The last data that was read, if it was one block of a tar; else empty."""

    def read(self, size: int = -1) -> bytes:
        whole = (self.header or 0) + size
        if size < 0 or whole > MAX_HEADER:
            raise Damaged(f"{self._what} has a header of {whole} bytes; at most {MAX_HEADER} are allowed")
        if self.header is not None:
            self.header = whole
        return self._read(size)

    def _read(self, size: int) -> bytes:
        parts, missing = [], size
        try:
            while missing and (part := self._stream.read(min(missing, PIECE))):
                parts.append(part)
                missing -= len(part)
        except (zlib.error, EOFError, gzip.BadGzipFile) as error:
            raise Damaged(f"{self._what} is truncated or damaged: {error}") from error
        data = b"".join(parts)
        self._place += len(data)
        if self._place > self._most:
            raise Damaged(f"{self._what} expands to more than {self._most} bytes, which is more than there may be")
        self._hash.update(data)
        self.last = data if size == BLOCK else b""
        return data

    def tell(self) -> int:
        return self._place

    def seek(self, place: int) -> int:
        if place < self._place:
            raise Damaged(f"{self._what} has a header that points back")
        while self._place < place and self._read(min(PIECE, place - self._place)):
            pass
        return self._place

    def digest(self) -> str:
        """Return the SHA-256 of the whole stream. Reads the rest first."""
        while self._read(PIECE):
            pass
        return self._hash.hexdigest()


def members(stream: ForwardStream, what: str) -> Iterator[tuple[tarfile.TarInfo, tarfile.TarFile]]:
    """Yield the members of a tar, in order. Raises Damaged for an invalid tar, also for errors that `tarfile` would ignore."""
    try:
        stream.header = 0
        with tarfile.TarFile(fileobj=stream, encoding="utf-8", errors="surrogateescape") as tar:  # type: ignore[arg-type]
            while (member := tar.next()) is not None:
                stream.header = None
                yield member, tar
                tar.members = []  # type: ignore[attr-defined]  # else it keeps all headers
                stream.header = 0
    except UNREADABLE as error:
        raise Damaged(f"{what} is not a valid tar archive: {error}") from error
    finally:
        stream.header = None
    if stream.last.strip(b"\0"):
        raise Damaged(f"{what} has a broken header near byte {stream.tell()}")


def content(tar: tarfile.TarFile, member: tarfile.TarInfo, what: str) -> Iterator[bytes]:
    """Yield the bytes of the last member that was read, in pieces. Holes of a sparse file are filled with zeros."""
    try:
        file = tar.extractfile(member)
        while file is not None and (piece := file.read(PIECE)):
            yield piece
    except UNREADABLE as error:
        raise Damaged(f"{what} is truncated or damaged at {member.name!r}: {error}") from error


def fed(command: Sequence[str], write: Callable[[BinaryIO], None], env: Mapping[str, str] | None = None) -> tuple[int, str]:
    """Run a program whose standard input `write` writes, and return its exit status and the beginning of what it prints."""
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT, env=env)
        try:
            with suppress(BrokenPipeError), cast("BinaryIO", process.stdin) as pipe:
                write(pipe)
            status = process.wait()
        finally:
            process.kill()
            process.wait()
        output.seek(0)
        return status, output.read(PIECE).decode("utf-8", "replace")


class Hashed(io.RawIOBase):
    """A stream that computes the digest of all its bytes."""

    def __init__(self, stream: Readable) -> None:
        self._stream = stream
        self._hash = hashlib.sha256()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]  # it is always called with this type
        data = self._stream.read(len(buffer))
        self._hash.update(data)
        buffer[: len(data)] = data
        return len(data)

    def digest(self) -> str:
        while self.read(PIECE):
            pass
        return self._hash.hexdigest()
