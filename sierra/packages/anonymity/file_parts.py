"""The parts of files that are read in a way of their own: texts, files in files, and compressed data.

A reader of a format yields the parts that it knows. Bytes that are in none of them are searched as they are. A reader raises
one of UNREADABLE where it cannot follow its format; the parts before stay. So a damaged or lying file loses no search: only
data that were unpacked to their end count as compressed. An Allowance limits what a file unpacks to.
"""

from __future__ import annotations

import lzma
import re
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from typing import IO, NamedTuple, Protocol

from sierra.util.lazy_definitions import regex
from sierra.util.text import size

UNREADABLE = (
    *(OSError, EOFError, ValueError, RuntimeError, LookupError, ArithmeticError, MemoryError, TypeError, AttributeError),
    *(struct.error, zlib.error, lzma.LZMAError, zipfile.BadZipFile, tarfile.TarError),
)
"""The errors of readers, and of libraries for files that are damaged on purpose."""
BLOCK = 1 << 20
LARGEST_TEXT = 16 << 20
"""The size of the largest text in a file that is read at once."""
SPARE = 256 << 20
RATIO = 200
"""A file may unpack to `SPARE` bytes and to `RATIO` times its own size."""
MOST_FILES = 100_000
"""The number of files that a file may have in it."""
TEXT_RUN = regex(rb"[\t\r\n\x20-\x7e\x80-\xff]{2,}")

PRINTABLE = bytes((*range(0x20, 0x7F), *b"\t\r\n"))
LONG_RUN = regex(rb"[\t\r\n\x20-\x7e]{24,}")


class Part(NamedTuple):
    """A part of a file."""

    begin: int
    end: int
    """The part has the bytes from `begin` to before `end`."""
    location: str = ""
    content: bytes | None = None
    """Its content, unpacked; None for compressed data, as of pictures, that hold no text."""
    is_file: bool = False
    """True if the content is a file, False if it is a text."""
    is_all: bool = True
    """False if its bytes may have more than the content, and are searched too."""


class Allowance:
    """The number of bytes and of files that a file may still unpack to."""

    def __init__(self, packed: int) -> None:
        """`packed`: the size of the file."""
        self._most = self._bytes = SPARE + RATIO * packed
        self._files = MOST_FILES

    def unpack(self, count: int) -> None:
        """Count unpacked bytes. Raises ValueError if there are too many."""
        self._bytes -= count
        if self._bytes < 0:
            raise ValueError(f"it unpacks to more than {size(self._most)}")

    def open(self) -> None:
        """Count a file. Raises ValueError if there are too many."""
        self._files -= 1
        self.unpack(0)
        if self._files < 0:
            raise ValueError(f"it has more than {MOST_FILES:,} files in it")


class Decompressor(Protocol):
    """An object of zlib, bz2 or lzma."""

    @property
    def eof(self) -> bool: ...
    @property
    def unused_data(self) -> bytes: ...
    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


class Unpacking:
    """Compressed data that are unpacked in small pieces; `used` is the number of their bytes that were needed."""

    def __init__(self, blocks: Iterable[bytes], decompressor: Decompressor, allowance: Allowance) -> None:
        self.used = 0
        self._blocks = blocks
        self._decompressor = decompressor
        self._allowance = allowance

    def __iter__(self) -> Iterator[bytes]:
        """Yield the content. Raises EOFError if the data end before it does."""
        for block in self._blocks:
            self.used += len(block)
            for piece in self._pieces(block):
                self._allowance.unpack(len(piece))
                yield piece
            if self._decompressor.eof:
                self.used -= len(self._decompressor.unused_data)
                return
        raise EOFError("its compressed data are cut off")

    def _pieces(self, block: bytes) -> Iterator[bytes]:
        tool, rest, is_more = self._decompressor, block, True
        while is_more and not tool.eof:
            piece = tool.decompress(rest, BLOCK)
            rest = getattr(tool, "unconsumed_tail", b"")
            is_more = bool(rest) or len(piece) == BLOCK or not getattr(tool, "needs_input", True)
            yield piece


def blocks(stream: IO[bytes], begin: int, end: int, most: int = BLOCK) -> Iterator[bytes]:
    """Yield the bytes of a range, at most so many at once."""
    while begin < end:
        stream.seek(begin)
        if not (block := stream.read(min(most, end - begin))):
            return
        begin += len(block)
        yield block


def at(stream: IO[bytes], begin: int, count: int) -> bytes:
    """Return bytes at an offset. Raises EOFError if there are fewer, ValueError for too many."""
    if count > LARGEST_TEXT:
        raise ValueError(f"a part is larger than {size(LARGEST_TEXT)}")
    stream.seek(begin)
    content = stream.read(count)
    if len(content) < count:
        raise EOFError("it is cut off")
    return content


def length(stream: IO[bytes]) -> int:
    """Return the size of a file; the position is then at its end."""
    stream.seek(0, 2)
    return stream.tell()


def whole(stream: IO[bytes], largest: int) -> bytes:
    """Return the content of a file. Raises ValueError if it is too large."""
    if (count := length(stream)) > largest:
        raise ValueError(f"it is larger than {size(largest)}")
    stream.seek(0)
    return stream.read(count)


def texts(content: bytes) -> bytes:
    """Return the readable texts in binary data, apart from each other."""
    return b"\r".join(TEXT_RUN.findall(content))


def long_texts(pieces: Iterable[bytes]) -> bytes:
    """Return the long readable texts in data that should be compressed, apart from each other. Noise has none.

    Raises ValueError if there are too many.
    """
    long_runs, rest, count = [], b"", 0
    for piece in pieces:
        content = rest + piece
        rest = content[len(content.rstrip(PRINTABLE)) :][-BLOCK:]
        for text in LONG_RUN.findall(content[: len(content) - len(rest)]):
            long_runs.append(text)
            count += len(text)
        if count > LARGEST_TEXT:
            raise ValueError("it has texts where pixels should be")
    return b"\r".join([*long_runs, *LONG_RUN.findall(rest)])


def readable(name: bytes) -> str:
    """Return a short name in a file for a message."""
    return re.sub(r"[^\x20-\x7e\xa1-\xff]", "?", name[:80].decode("latin-1"))


class Window:
    """A range of a file that is read from its beginning. The file stays open."""

    closed = False

    def __init__(self, stream: IO[bytes], begin: int, end: int) -> None:
        self._stream = stream
        self._at = begin
        self._end = end

    def read(self, count: int) -> bytes:
        """Return up to `count` bytes; none at the end of the range."""
        self._stream.seek(self._at)
        content = self._stream.read(max(0, min(count, self._end - self._at)))
        self._at += len(content)
        return content

    def close(self) -> None:
        """Do nothing."""


def gaps(ranges: Iterable[tuple[int, int]], end: int) -> Iterator[tuple[int, int]]:
    """Yield the ranges of a file that are in none of these; one range at least."""
    begin, is_first = 0, True
    for low, high in sorted((low, high) for low, high in ranges if low < high):
        if low > begin:
            yield begin, low
            is_first = False
        begin = max(begin, high)
    if begin < end or is_first:
        yield begin, end
