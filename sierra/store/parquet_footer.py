"""The number of rows that a Parquet file's footer states, read by this module alone.

Neither DuckDB, which writes the files, nor pyarrow, which takes long to load, takes part. A file ends with its description,
the length of that in four bytes, and `PAR1`. The description is the struct `FileMetaData` in Thrift's compact protocol: its
fields are the version (1), the schema (2), the number of rows (3), and others. Each field begins with a byte: the difference
to the number of the field before, and the type. Sources: github.com/apache/parquet-format (parquet.thrift) and
github.com/apache/thrift (doc/specs/thrift-compact-protocol.md).
"""

from __future__ import annotations

import os
from pathlib import Path

from sierra.errors import Damaged
from sierra.store.duckdb_messages import check_shortage

MAGIC = b"PAR1"
ROWS = 3
"""The number of the field with the number of rows."""
LARGEST = 256 << 20
"""The limit, in bytes, for a description."""
DEPTH = 32
"""The limit for structs and lists within each other."""
FIXED = {3: 1, 7: 8, 13: 16}
"""The sizes of the types byte, double and UUID."""


def rows_in(path: str | Path) -> int:
    """Return the number of rows that a Parquet file's footer states.

    Raises Damaged if the footer cannot be read, and Missing if memory, open files or the like are short.
    """
    try:
        return _Reader(_description(Path(path))).rows()
    except (OSError, ValueError, IndexError, MemoryError) as error:
        check_shortage(error)
        raise Damaged(f"{path}: cannot be read: {error}") from error


def _description(path: Path) -> bytes:
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 8))
        end = file.read(8)
        length = int.from_bytes(end[:4], "little")
        if end[4:] != MAGIC or not 0 < length <= min(LARGEST, size - 12):
            raise ValueError("it has no footer of Parquet")
        file.seek(size - 8 - length)
        return file.read(length)


class _Reader:
    """A reader of Thrift's compact protocol, which skips values."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._place = 0

    def rows(self) -> int:
        """Return the number of rows of a `FileMetaData`. Raises ValueError or IndexError if there is none."""
        field = 0
        while (head := self._byte()) & 15:
            field = field + (head >> 4) if head >> 4 else self._signed()
            if field == ROWS and head & 15 in (5, 6):
                return self._signed()
            self._skip(head & 15)
        raise ValueError("its footer does not state the number of rows")

    def _byte(self) -> int:
        self._place += 1
        return self._content[self._place - 1]

    def _number(self) -> int:
        """Return a number without a sign, in groups of seven bits."""
        number = shift = 0
        while shift < 70:
            byte = self._byte()
            number |= (byte & 127) << shift
            if byte < 128:
                return number
            shift += 7
        raise ValueError("its footer has an invalid number")

    def _signed(self) -> int:
        number = self._number()
        return (number >> 1) ^ -(number & 1)

    def _pass(self, size: int) -> None:
        """Skip so many bytes."""
        self._place += size
        if self._place > len(self._content):
            raise ValueError("its footer is cut off")

    def _skip(self, kind: int, depth: int = 0) -> None:
        if depth > DEPTH:
            raise ValueError("its footer is too deep")
        match kind:
            case 1 | 2:  # a truth value, which is in the type
                pass
            case 3 | 7 | 13:
                self._pass(FIXED[kind])
            case 4 | 5 | 6:
                self._number()
            case 8:
                self._pass(self._number())
            case 9 | 10:
                head = self._byte()
                for _ in range(head >> 4 if head >> 4 < 15 else self._number()):
                    self._skip_member(head & 15, depth)
            case 11:
                if pairs := self._number():
                    kinds = self._byte()
                    for _ in range(pairs):
                        self._skip_member(kinds >> 4, depth)
                        self._skip_member(kinds & 15, depth)
            case 12:
                while (head := self._byte()) & 15:
                    if not head >> 4:
                        self._number()
                    self._skip(head & 15, depth + 1)
            case _:
                raise ValueError("its footer has an unknown type")

    def _skip_member(self, kind: int, depth: int) -> None:
        """Skip a member of a list or map, in which a truth value is a byte."""
        if kind in (1, 2):
            self._byte()
        else:
            self._skip(kind, depth + 1)
