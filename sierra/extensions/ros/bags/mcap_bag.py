"""Bags in MCAP, the default of ROS 2 since Iron: https://mcap.dev/spec

A file is a sequence of records: a byte for the kind, the size, and the content. Chunks hold further records. The summary at
the end has the channels and the number of messages of each. A file that was closed ends with the bytes that it begins with.
"""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, BinaryIO
from zlib import crc32

from sierra.extensions.ros.bags.containers import (
    CUT,
    LARGEST,
    Bag,
    Channel,
    Message,
    Wanted,
    damage,
    exactly,
    numbers,
    text,
    unpacked,
)
from sierra.ingest.base import UnreadableError

if TYPE_CHECKING:
    from mcap import records

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 3, 4, 5, 6, 15
LANGUAGES = {"ros2msg": "msg", "ros2idl": "idl"}


class McapBag(Bag):
    """A bag in MCAP."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = file.seek(0, os.SEEK_END)

    def index(self) -> Mapping[Channel, int]:
        from mcap.reader import SeekingReader

        self._file.seek(max(self._size - len(MAGIC), len(MAGIC)))
        if self._file.read() != MAGIC:
            raise UnreadableError(f"{CUT}: it does not end as an MCAP file, so its recorder did not close it")
        self._file.seek(0)
        with damage("its summary"):
            summary = SeekingReader(self._file, record_size_limit=LARGEST).get_summary()
        if summary is None or summary.statistics is None:
            return Counter(channel for channel, _, _ in self.scan(lambda _: True))
        counts = summary.statistics.channel_message_counts
        channels = {number: _channel(channel, summary.schemas) for number, channel in summary.channels.items()}
        if lacking := sorted(counts.keys() - channels.keys()):
            raise UnreadableError(f"its summary does not describe channel {lacking[0]}")
        return {channel: counts.get(number, 0) for number, channel in channels.items()}

    def scan(self, wanted: Wanted) -> Iterator[Message]:
        schemas: dict[int, records.Schema] = {}
        channels: dict[int, Channel] = {}
        self._file.seek(len(MAGIC))
        while True:
            kind, size = numbers("<BQ", exactly(self._file, 9))
            if kind == DATA_END:
                return
            if kind == CHUNK:
                yield from self._chunk(size, schemas, channels, wanted)
            elif kind in (SCHEMA, CHANNEL, MESSAGE):
                yield from _record(kind, exactly(self._file, size), schemas, channels, wanted)
            elif size > self._size - self._file.tell():
                raise UnreadableError(CUT)
            else:
                self._file.seek(size, os.SEEK_CUR)

    def _chunk(
        self, size: int, schemas: dict[int, records.Schema], channels: dict[int, Channel], wanted: Wanted
    ) -> Iterator[Message]:
        """Yield the messages in a chunk; those that are complete also if the chunk is not."""
        if size > LARGEST:
            raise UnreadableError(f"a chunk has {size} bytes; {LARGEST} is the maximum")
        content = self._file.read(size)
        *_, stated, crc, length = numbers("<QQQII", content)
        compression = text(content[32 : 32 + length])
        [packed] = numbers("<Q", content, 32 + length)
        inner = content[40 + length : 40 + length + packed]
        cut = len(content) < size
        if not cut:
            if len(inner) < packed:
                raise UnreadableError("a chunk states a larger size than it has")
            inner = unpacked(inner, compression, stated)
            if crc and crc32(inner) != crc:
                raise UnreadableError("a chunk is damaged: its checksum is another")
        elif compression:
            raise UnreadableError(CUT)
        offset = 0
        while offset < len(inner):
            kind, size = numbers("<BQ", inner, offset)
            offset += 9 + size
            if offset > len(inner):
                raise UnreadableError(CUT)
            yield from _record(kind, inner[offset - size : offset], schemas, channels, wanted)
        if cut:
            raise UnreadableError(CUT)


def _record(
    kind: int, content: bytes, schemas: dict[int, records.Schema], channels: dict[int, Channel], wanted: Wanted
) -> Iterator[Message]:
    if kind == MESSAGE:
        number, _, received, _ = numbers("<HIQQ", content)
        if number not in channels:
            raise UnreadableError(f"has a message of channel {number}, which it does not describe")
        if wanted(channels[number]):
            yield channels[number], received, content[22:]
    elif kind in (SCHEMA, CHANNEL):
        from mcap import records
        from mcap.data_stream import ReadDataStream

        stream = ReadDataStream(io.BytesIO(content))
        with damage("a description of a channel"):
            if kind == SCHEMA:
                schema = records.Schema.read(stream)
                schemas[schema.id] = schema
            else:
                channel = records.Channel.read(stream)
                channels[channel.id] = _channel(channel, schemas)


def _channel(channel: records.Channel, schemas: Mapping[int, records.Schema]) -> Channel:
    schema = schemas.get(channel.schema_id)
    if channel.message_encoding != "cdr" or schema is None:
        # such a channel is an error only if its topic is asked for: see `sierra.extensions.ros.bags.message_types`
        return Channel(channel.id, channel.topic, "", channel.message_encoding, "msg", "", ros1=False)
    language = LANGUAGES.get(schema.encoding)
    definition = text(schema.data) if language else None
    return Channel(channel.id, channel.topic, schema.name, definition, "idl" if language == "idl" else "msg", "", ros1=False)
