"""The reader of Arrow files (IPC, also known as Feather) and Arrow streams.

The rows are counted a second time from the metadata of the record batches, by code that does not use an Arrow library.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import TYPE_CHECKING

from sierra.extensions.formats.columnar import Columnar
from sierra.ingest.base import UnreadableError
from sierra.ingest.rewriting import OriginalFile

if TYPE_CHECKING:
    import pyarrow as pa

MAGIC = b"ARROW1"
MARK = 0xFFFFFFFF
RECORD_BATCH = 3
END = b"\xff\xff\xff\xff\x00\x00\x00\x00"
"""The end of a stream, which is missing if the stream was cut short."""


class ArrowFiles(Columnar):
    """The reader of Arrow files and streams."""

    def table(self, source: OriginalFile) -> pa.Table:
        import pyarrow as pa

        content = source.content()
        try:
            if content.startswith(MAGIC):
                table = pa.ipc.open_file(pa.BufferReader(content)).read_all()
            else:
                if not content.endswith(END):
                    raise UnreadableError("is truncated, or neither an Arrow file nor an Arrow stream")
                table = pa.ipc.open_stream(pa.BufferReader(content)).read_all()
            table.validate(full=True)
        except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
            if isinstance(error, UnreadableError):
                raise
            raise UnreadableError(f"is truncated or damaged ({' '.join(str(error).split())})") from error
        if len(set(table.column_names)) < len(table.column_names):
            raise UnreadableError("has two columns of the same name")
        return table

    def count(self, source: OriginalFile, written: int) -> int:
        content = source.content()
        try:
            return sum(_lengths(content, 8 if content.startswith(MAGIC) else 0))
        except struct.error as error:
            raise UnreadableError("is truncated") from error


def _lengths(content: bytes, offset: int) -> Iterator[int]:
    """Yield the length that the metadata of each record batch state, read without an Arrow library.

    Each message is a mark, the size of its metadata, the metadata as a FlatBuffer, and its body. See
    https://arrow.apache.org/docs/format/Columnar.html#encapsulated-message-format.
    """
    while True:
        mark, size = struct.unpack_from("<Ii", content, offset)
        if mark != MARK:
            raise UnreadableError("was written by an Arrow before 0.15, whose format is not read")
        if size == 0:
            return
        start = offset + 8
        message = start + _number("<I", content, start)
        body = _field("<q", content, message, 3)
        if _field("<B", content, message, 1) == RECORD_BATCH:
            header = message + _offset(content, message, 2)
            yield _field("<q", content, header + _number("<I", content, header), 0)
        offset = start + size + body


def _field(kind: str, content: bytes, table: int, number: int) -> int:
    """Return a field of a FlatBuffer's table; 0, its default, if it is absent."""
    offset = _offset(content, table, number)
    return _number(kind, content, table + offset) if offset else 0


def _offset(content: bytes, table: int, number: int) -> int:
    """Return the place of a field from the beginning of its table; 0 if it is absent."""
    directory = table - _number("<i", content, table)
    return _number("<H", content, directory + 4 + 2 * number) if 4 + 2 * number < _number("<H", content, directory) else 0


def _number(kind: str, content: bytes, place: int) -> int:
    [number] = struct.unpack_from(kind, content, place)
    return int(number)
