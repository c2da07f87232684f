"""Bytes that come from outside, read forwards once: counted, bounded, and hashed on the way.

`tarfile` trusts what a header says of sizes, and reads so much at once. So it gets a `ForwardStream`, which gives no more at a
time than a header may need, goes on to no byte beyond what the image may come to, and knows in the end the digest of all of it.
"""

from __future__ import annotations

import hashlib
import tarfile
from collections.abc import Iterator
from typing import BinaryIO

from sierra.errors import Damaged

PIECE = 1 << 20
AT_ONCE = 16 << 20
"""The longest that a header and what belongs to it may be."""
BLOCK = 512

UNREADABLE = (tarfile.TarError, ValueError, OverflowError, RecursionError)
"""What `tarfile` raises for what is no tar."""


class ForwardStream:
    """A stream that is read once, from its beginning to its end: what `tarfile` needs of a file, and no more."""

    def __init__(self, stream: BinaryIO, most: int, what: str) -> None:
        self._stream, self._most, self._what = stream, most, what
        self._place = 0
        self._hash = hashlib.sha256()
        self.last = b""
        """What was read last, where it was a block of a tar."""

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= AT_ONCE:
            raise Damaged(f"{self._what} has a header of {size} bytes; at most {AT_ONCE} are read")
        parts, missing = [], size
        while missing and (part := self._stream.read(min(missing, PIECE))):
            parts.append(part)
            missing -= len(part)
        data = b"".join(parts)
        self._place += len(data)
        if self._place > self._most:
            raise Damaged(f"{self._what} expands to more than {self._most} bytes, far more than an image's files would")
        self._hash.update(data)
        self.last = data if size == BLOCK else b""
        return data

    def tell(self) -> int:
        return self._place

    def seek(self, place: int) -> int:
        if place < self._place:
            raise Damaged(f"{self._what} has a header that points back")
        while self._place < place and self.read(min(PIECE, place - self._place)):
            pass
        return self._place

    def digest(self) -> str:
        """The SHA-256 of all of it, of which the rest is read now."""
        while self.read(PIECE):
            pass
        return self._hash.hexdigest()


def members(stream: ForwardStream, what: str) -> Iterator[tuple[tarfile.TarInfo, tarfile.TarFile]]:
    """The members of a tar, in order. Raises Damaged for what is none, all of it that `tarfile` would pass over included."""
    try:
        with tarfile.TarFile(fileobj=stream, encoding="utf-8", errors="surrogateescape") as tar:  # type: ignore[arg-type]
            while (member := tar.next()) is not None:
                yield member, tar
                tar.members = []  # type: ignore[attr-defined]  # else it remembers all headers
    except UNREADABLE as error:
        raise Damaged(f"{what} is no sound tar archive: {error}") from error
    if stream.last.strip(b"\0"):
        raise Damaged(f"{what} has a broken header in it, near byte {stream.tell()}")


def content(tar: tarfile.TarFile, member: tarfile.TarInfo, what: str) -> Iterator[bytes]:
    """The bytes of the member that was read last, in pieces; the holes of a sparse one are filled."""
    try:
        file = tar.extractfile(member)
        while file is not None and (piece := file.read(PIECE)):
            yield piece
    except UNREADABLE as error:
        raise Damaged(f"{what} is cut short, or damaged, at {member.name!r}: {error}") from error


class Hashed:
    """A stream whose digest is known once it is at its end."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._hash = hashlib.sha256()
        self.size = 0

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(size)
        self._hash.update(data)
        self.size += len(data)
        return data

    def digest(self) -> str:
        while self.read(PIECE):
            pass
        return self._hash.hexdigest()
