"""Bags of ROS 1, version 2.0: https://wiki.ros.org/Bags/Format/2.0

A file is a sequence of records: a header of fields, and data. Chunks hold connections and messages. After the chunks, the
index repeats the connections, and states the number of messages of each connection in each chunk. The recorder writes the index
last, so a bag that was cut off has none.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import BinaryIO

from sierra.extensions.ros.bags.containers import (
    CUT,
    LARGEST,
    NS,
    Bag,
    Channel,
    Message,
    Wanted,
    exactly,
    numbers,
    text,
    unpacked,
)
from sierra.ingest.base import UnreadableError

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
HEADERS = 1 << 20
"""The limit on the bytes of a record's header."""
Fields = Mapping[bytes, bytes]


class Ros1Bag(Bag):
    """A bag of ROS 1."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = file.seek(0, os.SEEK_END)
        file.seek(len(MAGIC))
        fields, length = self._next()
        if _op(fields) != HEADER:
            raise UnreadableError("has no header")
        if fields.get(b"encryptor"):
            raise UnreadableError("is encrypted")
        file.seek(length, os.SEEK_CUR)
        self._begin = file.tell()
        self._index = _number("<Q", fields, b"index_pos")
        self._connections = _number("<I", fields, b"conn_count")
        self._chunks = _number("<I", fields, b"chunk_count")

    def index(self) -> Mapping[Channel, int]:
        if not self._begin <= self._index <= self._size:
            raise UnreadableError(f"{CUT}: it has no index, so its recorder did not close it")
        self._file.seek(self._index)
        channels: dict[int, Channel] = {}
        counts: Counter[int] = Counter()
        chunks = 0
        while self._file.tell() < self._size:
            fields, length = self._next()
            data = exactly(self._file, length)
            if _op(fields) == CONNECTION:
                channels[_number("<I", fields, b"conn")] = _channel(fields, data)
            elif _op(fields) == CHUNK_INFO:
                chunks += 1
                for offset in range(0, 8 * _number("<I", fields, b"count"), 8):
                    connection, count = numbers("<II", data, offset)
                    counts[connection] += count
            else:
                raise UnreadableError("its index has other records")
        if (len(channels), chunks) != (self._connections, self._chunks) or not counts.keys() <= channels.keys():
            raise UnreadableError(f"{CUT} or damaged: its index is not complete")
        return {channel: counts[number] for number, channel in channels.items()}

    def scan(self, wanted: Wanted) -> Iterator[Message]:
        channels: dict[int, Channel] = {}
        self._file.seek(self._begin)
        end = self._index if self._begin <= self._index <= self._size else self._size
        while (offset := self._file.tell()) < end:
            fields, length = self._next()
            if _op(fields) == CHUNK:
                yield from self._chunk(fields, length, channels, wanted)
            elif _op(fields) == INDEX:
                if length > end - self._file.tell():
                    raise UnreadableError(CUT)
                self._file.seek(length, os.SEEK_CUR)
            elif _op(fields) in (CONNECTION, CHUNK_INFO) and end == self._size:
                return
            else:
                raise UnreadableError(f"has an unknown record at byte {offset}")

    def _chunk(self, fields: Fields, length: int, channels: dict[int, Channel], wanted: Wanted) -> Iterator[Message]:
        """Yield the messages in a chunk; those that are complete also if the chunk is not."""
        compression = text(fields.get(b"compression", b""))
        if length > LARGEST:
            raise UnreadableError(f"a chunk has {length} bytes; {LARGEST} is the maximum")
        content = self._file.read(length)
        cut = len(content) < length
        if not cut:
            content = unpacked(content, compression, _number("<I", fields, b"size"))
        elif compression != "none":
            raise UnreadableError(CUT)
        yield from _messages(content, channels, wanted)
        if cut:
            raise UnreadableError(CUT)

    def _next(self) -> tuple[Fields, int]:
        """Return the header of the next record, and the size of its data, which come next."""
        [length] = numbers("<I", exactly(self._file, 4))
        if length > HEADERS:
            raise UnreadableError(f"has a header of {length} bytes; {HEADERS} is the maximum")
        fields = _fields(exactly(self._file, length))
        [size] = numbers("<I", exactly(self._file, 4))
        return fields, size


def _messages(content: bytes, channels: dict[int, Channel], wanted: Wanted) -> Iterator[Message]:
    offset = 0
    while offset < len(content):
        [length] = numbers("<I", content, offset)
        fields = _fields(content[offset + 4 : offset + 4 + length])
        offset += 4 + length
        [size] = numbers("<I", content, offset)
        offset += 4 + size
        if offset > len(content):
            raise UnreadableError(CUT)
        data = content[offset - size : offset]
        number = _number("<I", fields, b"conn")
        if _op(fields) == CONNECTION:
            channels[number] = _channel(fields, data)
        elif _op(fields) == MESSAGE:
            if number not in channels:
                raise UnreadableError(f"has a message of connection {number}, which it does not describe")
            if wanted(channels[number]):
                seconds, nanoseconds = numbers("<II", fields.get(b"time", b""))
                yield channels[number], seconds * NS + nanoseconds, data
        else:
            raise UnreadableError("has an unknown record in a chunk")


def _channel(fields: Fields, data: bytes) -> Channel:
    described = _fields(data)
    return Channel(
        _number("<I", fields, b"conn"),
        text(fields.get(b"topic", b"")),
        text(described.get(b"type", b"")),
        text(described.get(b"message_definition", b"")),
        "msg",
        text(described.get(b"md5sum", b"")),
        ros1=True,
    )


def _fields(content: bytes) -> Fields:
    """Return the fields of a header."""
    fields, offset = {}, 0
    while offset < len(content):
        [size] = numbers("<I", content, offset)
        name, equals, value = content[offset + 4 : offset + 4 + size].partition(b"=")
        offset += 4 + size
        if not equals or offset > len(content):
            raise UnreadableError("has a damaged header")
        fields[name] = value
    return fields


def _op(fields: Fields) -> int:
    return _number("<B", fields, b"op")


def _number(layout: str, fields: Fields, name: bytes) -> int:
    if name not in fields:
        raise UnreadableError(f"has a header without {name.decode()!r}")
    [number] = numbers(layout, fields[name])
    return number
