"""Bags as containers of messages, in the three formats that ROS records.

A bag has *channels*, each with a topic, a type and its definition, and messages on them. `index` reads the list of channels and
the number of messages of each, as the file states it. `scan` reads the messages themselves, from the first to the last, without
the index. The two are independent, so their counts check each other. `scan` also works on a bag that was cut off.

Sizes in a file are not trusted: a record must be within its file, and a chunk must not be larger than `LARGEST`.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import BinaryIO, Literal

from sierra.ingest.base import UnreadableError
from sierra.util.lazy_definitions import dataclass

LARGEST = 1 << 28
"""The limit on the bytes of one message and of one chunk, decompressed."""
LONGEST = 200
"""The limit on the characters of another library's text in an error."""
CODECS = {"": None, "none": None, "bz2": "bz2", "lz4": "lz4", "zstd": "zstd"}
"""The compressions of chunks, by their names in bags, with Arrow's names."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""The first bytes of compressed messages; no message in CDR begins with them."""
CUT = "is truncated"
NS = 10**9


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic with the type of its messages. A bag may have several channels of a topic."""

    number: int
    topic: str
    type: str
    """The name of the type, as the bag has it; empty if the messages have another serialization than those of ROS."""
    definition: str | None
    """The definition of the type and of those that it needs; None if the bag does not have it."""
    language: Literal["msg", "idl"]
    """The language of the definition."""
    digest: str
    """The hash of the type: MD5 in ROS 1, RIHS01 in ROS 2; empty if the bag does not have it."""
    ros1: bool
    """True for the serialization of ROS 1, false for CDR."""


Message = tuple[Channel, int, bytes]
"""A message: its channel, the time when it was received in ns since 1970, and its bytes."""
Wanted = Callable[[Channel], bool]


class Bag(ABC):
    """An open bag."""

    @abstractmethod
    def index(self) -> Mapping[Channel, int]:
        """Return the channels with their numbers of messages, as the bag states them.

        Raises UnreadableError if the bag was cut off.
        """

    @abstractmethod
    def scan(self, wanted: Wanted) -> Iterator[Message]:
        """Yield the messages of the wanted channels in the order in which they were recorded.

        Raises UnreadableError at the first place that is damaged.
        """


@contextmanager
def damage(what: str) -> Iterator[None]:
    """Turn errors of code that trusts a bag into UnreadableError."""
    try:
        yield
    except UnreadableError:
        raise
    except (RecursionError, MemoryError) as error:
        raise UnreadableError(f"{what}: is damaged or too complex ({type(error).__name__})") from error
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        text = text if len(text) <= LONGEST else f"{text[:LONGEST]} …"
        raise UnreadableError(f"{what}: is damaged ({text})") from error


def exactly(file: BinaryIO, size: int) -> bytes:
    """Return the next bytes of a file. Raises UnreadableError if there are fewer."""
    content = file.read(size) if size <= LARGEST else b""
    if len(content) < size:
        raise UnreadableError(CUT if size <= LARGEST else f"a record has {size} bytes; {LARGEST} is the maximum")
    return content


def unpacked(content: bytes, compression: str, size: int | None = None) -> bytes:
    """Return the decompressed bytes. Raises UnreadableError if they are not `size` bytes, or too many."""
    import pyarrow as pa

    if compression not in CODECS:
        raise UnreadableError(f"the compression {compression!r} is unknown")
    if size is not None and size > LARGEST:
        raise UnreadableError(f"a chunk has {size} bytes; {LARGEST} is the maximum")
    most = LARGEST if size is None else size
    codec = CODECS[compression]
    if codec is not None:
        try:
            with pa.CompressedInputStream(pa.BufferReader(content), codec) as stream:
                content = stream.read(most + 1)
        except (pa.ArrowException, OSError) as error:
            raise UnreadableError(f"a chunk cannot be decompressed: {' '.join(str(error).split())}") from error
    if len(content) > most or (size is not None and len(content) != size):
        raise UnreadableError(f"a chunk has another size than the {most} bytes that are stated")
    return content


def numbers(layout: str, content: bytes, place: int = 0) -> tuple[int, ...]:
    """Return the numbers at a place. Raises UnreadableError if there are too few bytes."""
    try:
        return struct.unpack_from(layout, content, place)
    except struct.error as error:
        raise UnreadableError(CUT) from error


def text(content: bytes) -> str:
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise UnreadableError(f"has a name or definition that is not UTF-8: {content[:20]!r}") from error
