"""Searching the content of files for words: also what is compressed, in archives, in Parquet, and in metadata of pictures.

The bytes of every file are searched as they are. Then, by its first bytes, a file is opened:

    zip, tar                   each member, and its name; also a zip at the end of a program
    gzip, bzip2, xz, zstd      the content
    Parquet, Arrow             texts and bytes of all columns, names of columns, metadata; objects of a store one by one
    PNG                        compressed texts
    PDF                        compressed streams, and strings as hexadecimal digits

A file that cannot be opened, or has a form that is known to hide text (HDF5, SquashFS, zlib), is reported as such.
"""

from __future__ import annotations

import bisect
import bz2
import contextlib
import gzip
import io
import itertools
import lzma
import re
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import IO, TYPE_CHECKING, cast

from sierra.packages.anonymity.identifying_words import Word
from sierra.packages.anonymity.word_search import Found, Search
from sierra.store.segments import own_table
from sierra.util.lazy_definitions import dataclass, regex

if TYPE_CHECKING:
    import pyarrow as pa

DEEPEST = 6
"""The largest depth of files in files."""
IN_MEMORY = 32 << 20
ROWS = 8192
BEGINNING = 512
"""The number of bytes that show the form of a file."""
HIDING = {
    b"\x89HDF\r\n\x1a\n": "HDF5 may have compressed text",
    b"hsqs": "a SquashFS is compressed",
    b"#!/usr/bin/env run-singularity": "the SquashFS in it is compressed",
    b"7z\xbc\xaf\x27\x1c": "7z cannot be opened",
    b"Rar!": "RAR cannot be opened",
    b"\x04\x22\x4d\x18": "LZ4 cannot be opened",
    b"\x1f\x9d": "a file of compress cannot be opened",
    b"MATLAB 5.0": "MATLAB's files may have compressed text",
    b"#ROSBAG": "a bag of ROS may have compressed text",
    **dict.fromkeys((b"x\x01", b"x\x9c", b"x\xda"), "a stream of zlib cannot be opened"),
    b"ORC": "ORC may have compressed text",
    b"Obj\x01": "Avro may have compressed text",
    b"\x89MCAP": "MCAP may have compressed text",
}
"""The first bytes of files that are not opened, and the reason why a text may be missed in them."""
UNREADABLE = (
    *(OSError, EOFError, ValueError, RuntimeError, NotImplementedError),
    *(zlib.error, lzma.LZMAError, zipfile.BadZipFile, tarfile.TarError),
)
PDF_STREAM = regex(rb"stream\r?\n(.*?)endstream", re.DOTALL)
PDF_HEX = regex(rb"<((?:[0-9A-Fa-f]{2}\s*){4,})>")
PROGRAMS = (b"#!", b"\x7fE", b"MZ")
"""The first bytes of programs, which may have a zip at their end."""
OBJECTS = ["sha256", "part", "size", "content"]


@dataclass(frozen=True, slots=True)
class Hit:
    """A word in a file."""

    place: str
    text: str
    word: Word

    def __str__(self) -> str:
        return f"{self.place}: {self.text!r} ({self.word.kind})"


class ContentSearch:
    """A search of files; `hits` and `unread` collect what is found, in the order of the search."""

    def __init__(self, search: Search, name_of: Callable[[str], str] = lambda digest: f"object {digest[:10]}") -> None:
        """`name_of` returns a text for an object of a store from its SHA-256."""
        self._search = search
        self._name_of = name_of
        self._known: set[bytes] = set()
        self.hits: list[Hit] = []
        self.unread: list[str] = []
        """One line for each file of which not all could be searched."""

    def name(self, name: str, place: str) -> None:
        """Search the name of a file."""
        self.hits += [Hit(f"name of {place}", one.text, one.word) for one in self._search.text(name)]

    def file(self, stream: IO[bytes], place: str, depth: int = 0) -> None:
        """Search a file from its beginning. The stream must be seekable."""
        beginning = stream.read(BEGINNING)
        stream.seek(0)
        raw = self._hits(place, self._search.stream(stream), by_line=b"\0" not in beginning)
        stream.seek(0)
        if depth > DEEPEST:
            self.unread.append(f"{place} is in too many other files")
        else:
            try:
                self._open(stream, beginning, place, depth)
            except UNREADABLE as error:
                self.unread.append(f"{place}: {_line(error)}")
        seen = {hit.word.text for hit in self.hits} if raw and beginning.startswith(b"PAR1") else set()
        self.hits += [hit for hit in raw if hit.word.text not in seen]  # bytes of tables say less than their values

    def known(self, digest: str) -> None:
        """Leave out objects of this SHA-256, because a file with this content is searched."""
        self._known.add(bytes.fromhex(digest))

    def _open(self, stream: IO[bytes], beginning: bytes, place: str, depth: int) -> None:
        for magic, reason in HIDING.items():
            if beginning.startswith(magic):
                self.unread.append(f"{place}: {reason}")
        if (opener := _decompressed(beginning)) is not None:
            with opener(stream) as content, _seekable(content) as file:
                self.file(file, f"{place} (decompressed)", depth + 1)
        elif beginning.startswith((b"PK\x03\x04", b"PK\x05\x06")) or (beginning[:2] in PROGRAMS and zipfile.is_zipfile(stream)):
            self._zip(stream, place, depth)
        elif beginning[8:12] == b"DUCK":
            self.unread.append(f"{place}: a database of DuckDB may have compressed text")
        elif beginning[257:262] == b"ustar":
            self._tar(stream, place, depth)
        elif beginning.startswith(b"PAR1"):
            self._parquet(stream, place, depth)
        elif beginning.startswith(b"ARROW1"):
            self._arrow(stream, place, depth)
        elif beginning.startswith(b"\x89PNG"):
            self._png(stream.read(), place)
        elif beginning.startswith(b"%PDF"):
            self._pdf(stream.read(), place)

    def _hits(self, place: str, found: Iterable[Found], *, by_line: bool) -> list[Hit]:
        """Return the first place of each word, with the number of the others."""
        first: dict[str, Found] = {}
        counts: dict[str, int] = {}
        for one in found:
            first.setdefault(one.word.text, one)
            counts[one.word.text] = counts.get(one.word.text, 0) + 1
        hits = []
        for text, one in first.items():
            where = f", line {one.line}" if by_line else f", byte {one.offset}"
            more = f" and {counts[text] - 1} more" if counts[text] > 1 else ""
            hits.append(Hit(f"{place}{where}{more}", one.text, one.word))
        return hits

    def _zip(self, stream: IO[bytes], place: str, depth: int) -> None:
        with zipfile.ZipFile(stream) as file:
            for info in file.infolist():
                inner = f"{place}/{info.filename}"
                self.name(info.filename, inner)
                with file.open(info) as member, _seekable(member) as content:
                    self.file(content, inner, depth + 1)

    def _tar(self, stream: IO[bytes], place: str, depth: int) -> None:
        with tarfile.open(fileobj=stream) as file:
            for info in file:
                member = file.extractfile(info) if info.isreg() else None
                if member is not None:
                    with _seekable(member) as content:
                        self.file(content, f"{place}/{info.name}", depth + 1)

    def _png(self, content: bytes, place: str) -> None:
        at = 8
        while at + 8 <= len(content):
            size, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
            if packed := _packed(kind, content[at + 8 : at + 8 + size]):
                self._bytes(zlib.decompress(packed), f"{place} ({kind.decode()})")
            at += 12 + size

    def _pdf(self, content: bytes, place: str) -> None:
        if b"/Encrypt" in content:
            self.unread.append(f"{place}: it is encrypted")
        streams = [content]
        for found in PDF_STREAM.finditer(content):
            with contextlib.suppress(zlib.error):
                streams.append(zlib.decompressobj().decompress(found[1]))
                self._bytes(streams[-1], f"{place} (compressed)")
        for one in streams:
            digits = b"\n".join(bytes.fromhex(found[1].decode()) for found in PDF_HEX.finditer(one))
            self._bytes(digits, f"{place} (hexadecimal)")

    def _bytes(self, content: bytes, place: str) -> None:
        self.hits += self._hits(place, self._search.stream(io.BytesIO(content)), by_line=False)

    # tables

    def _arrow(self, stream: IO[bytes], place: str, depth: int) -> None:
        import pyarrow as pa

        with pa.ipc.open_file(stream) as file:
            self._schema(file.schema, place)
            self._batches((file.get_batch(number) for number in range(file.num_record_batches)), place, depth)

    def _parquet(self, stream: IO[bytes], place: str, depth: int) -> None:
        import pyarrow.parquet as pq

        with pq.ParquetFile(stream) as file:
            if table := own_table(file.metadata):
                place = f"{place} (table {table})"
            self._schema(file.schema_arrow, place)
            groups = (file.iter_batches(ROWS, row_groups=[group]) for group in range(file.num_row_groups))
            search = self._objects if file.schema_arrow.names == OBJECTS else self._batches
            search(itertools.chain.from_iterable(groups), place, depth)

    def _schema(self, schema: pa.Schema, place: str) -> None:
        metadata = b"\n".join(itertools.chain.from_iterable((schema.metadata or {}).items()))
        self._bytes(metadata, f"{place} (metadata)")
        for name in schema.names:
            self.name(name, f"a column of {place}")

    def _batches(self, batches: Iterable[pa.RecordBatch], place: str, depth: int) -> None:
        first: dict[tuple[str, str], Hit] = {}
        row = 1
        for batch in batches:
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                where = f"{place}, column {name}, row"
                for at, value in enumerate(column.to_pylist() if _is_binary(column.type) else ()):
                    if value:
                        self.file(io.BytesIO(value), f"{where} {row + at}", depth + 1)
                for at, one in self._column(column):
                    first.setdefault((name, one.word.text), Hit(f"{where} {row + at}", one.text, one.word))
            row += batch.num_rows
        self.hits += first.values()

    def _column(self, column: pa.Array) -> Iterator[tuple[int, Found]]:
        """Yield the words in a column, each with the position of its row. Numbers and times have none."""
        import pyarrow as pa
        from pyarrow import types

        kind = column.type
        if types.is_string(kind) or types.is_large_string(kind):
            encoded = column.cast(pa.large_string()).dictionary_encode()
            for number, one in self._texts(encoded.dictionary.to_pylist()):
                yield encoded.indices.index(number).as_py(), one
        elif not (types.is_primitive(kind) or types.is_decimal(kind) or types.is_null(kind) or _is_binary(kind)):
            yield from self._texts([str(value) for value in column.to_pylist()])

    def _texts(self, texts: list[str]) -> Iterator[tuple[int, Found]]:
        """Yield the words in texts, each with the position of its text."""
        pieces = [text.encode("utf-8", "surrogatepass") for text in texts]
        begins = list(itertools.accumulate((len(piece) + 1 for piece in pieces), initial=0))
        for one in self._search.stream(io.BytesIO(b"\n".join(pieces))):
            yield bisect.bisect_right(begins, one.offset) - 1, one

    def _objects(self, batches: Iterable[pa.RecordBatch], place: str, depth: int) -> None:
        """Search the files in a file of objects, each only once."""
        rows = (row for batch in batches for row in zip(*(batch.column(name) for name in OBJECTS), strict=True))
        for digest, parts in itertools.groupby(rows, lambda row: row[0].as_py()):
            key = bytes.fromhex(digest)
            if key in self._known:
                continue
            self._known.add(key)
            with tempfile.SpooledTemporaryFile(IN_MEMORY) as content:
                for part in parts:
                    content.write(part[3].as_buffer())
                content.seek(0)
                self.file(content, f"{place} ({self._name_of(digest)})", depth + 1)


def _is_binary(kind: pa.DataType) -> bool:
    from pyarrow import types

    return bool(types.is_binary(kind) or types.is_large_binary(kind) or types.is_fixed_size_binary(kind))


def _packed(kind: bytes, data: bytes) -> bytes:
    """Return the compressed text of a chunk of a PNG; nothing if it has none."""
    rest = data.partition(b"\0")[2]
    if kind == b"zTXt":
        return rest[1:]
    return rest[2:].split(b"\0", 2)[-1] if kind == b"iTXt" and rest[:1] == b"\1" else b""


def _decompressed(beginning: bytes) -> Callable[[IO[bytes]], IO[bytes]] | None:
    openers: Mapping[bytes, Callable[[IO[bytes]], IO[bytes]]] = {
        b"\x1f\x8b\x08": lambda stream: cast("IO[bytes]", gzip.GzipFile(fileobj=stream, mode="rb")),
        b"BZh": bz2.BZ2File,
        b"\xfd7zXZ\0": lzma.LZMAFile,
        b"\x28\xb5\x2f\xfd": _zstd,
    }
    return next((opener for magic, opener in openers.items() if beginning.startswith(magic)), None)


def _zstd(stream: IO[bytes]) -> IO[bytes]:
    import pyarrow as pa

    found: IO[bytes] = pa.CompressedInputStream(pa.PythonFile(stream, "r"), "zstd")
    return found


@contextlib.contextmanager
def _seekable(stream: IO[bytes]) -> Iterator[IO[bytes]]:
    """Copy a stream to a temporary file."""
    with tempfile.SpooledTemporaryFile(IN_MEMORY) as copy:
        while block := stream.read(1 << 20):
            copy.write(block)
        copy.seek(0)
        yield copy


def _line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:100]
