"""Files stored under the hash of their content, many in one Parquet file, large ones in parts.

A file of any size is written with bounded memory: rows of at most 8 MiB, collected into row groups of at most
32 MiB and 8192 rows. A segment stores equal files once.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.store.parquet_writer import write
from sierra.store.schema import arrow_schema, sql_types
from sierra.store.segments import disk_errors
from sierra.util.hashing import sha256
from sierra.util.regular_files import open_regular

if TYPE_CHECKING:
    import pyarrow.parquet as pq

PART = 8 << 20
GROUP = 32 << 20
ROWS = 8192
PAGE = 8
"""The smallest number of rows in a page, which a reader has in memory as a whole. By default, a page may be a row group."""


class Objects:
    """A writer of one `objects.parquet`; `close` finishes it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: set[bytes] = set()
        self._rows: list[tuple[str, int, int, bytes]] = []
        self._held = 0
        self._writer: pq.ParquetWriter | None = None

    def add(self, content: bytes) -> str:
        """Add `content` and return its SHA-256."""
        digest = sha256(content)
        self._add(digest, len(content), (content[at : at + PART] for at in range(0, max(len(content), 1), PART)))
        return digest

    def add_file(self, path: Path, digest: str, size: int) -> None:
        """Add a file whose SHA-256 is already known."""
        with open_regular(path) as file:
            self._add(digest, size, iter(lambda: file.read(PART), b"") if size else (b"",))

    def _add(self, digest: str, size: int, parts: Iterable[bytes]) -> None:
        key = bytes.fromhex(digest[:32])  # half of the digest saves memory: there may be 100,000
        if key in self._known:
            return
        self._known.add(key)
        for number, part in enumerate(parts):
            self._rows.append((digest, number, size, part))
            self._held += len(part)
            if self._held >= GROUP or len(self._rows) >= ROWS:
                self._flush()

    def _flush(self) -> None:
        """Write a row group. DuckDB would need all of them at once."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        schema = arrow_schema("objects")
        columns = zip(zip(*self._rows, strict=True), schema, strict=True)
        table = pa.table([pa.array(column, field.type) for column, field in columns], schema)
        with disk_errors(self._path.parent):
            if self._writer is None:
                self._writer = pq.ParquetWriter(self._path, schema, compression="zstd", write_batch_size=PAGE)
            self._writer.write_table(table)
        self._rows, self._held = [], 0

    def close(self) -> None:
        self._known.clear()
        if self._writer is None:
            write(self._path, sql_types("objects"), self._rows)
            return
        if self._rows:
            self._flush()
        with disk_errors(self._path.parent):
            self._writer.close()
