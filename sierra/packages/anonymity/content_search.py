"""Search the content of files for words, including compressed files, archives, tables, and metadata of pictures.

By its first bytes, a file is opened:

    zip, tar                   each member, and its name; also a zip at the end of a program
    gzip, bzip2, xz, zstd      the content
    Parquet, Arrow             texts and bytes of all columns, names of columns, metadata; objects of a store one by one
    PNG, JPEG, MP4, QuickTime  texts and metadata: `sierra.packages.anonymity.media_parts`
    PDF                        strings and compressed streams: `sierra.packages.anonymity.pdf_parts`

All other bytes are searched as they are: of other files, of files that are damaged, and between what was opened. Only data that
were unpacked to their end, and compressed pixels, are not: they have short words by chance. In texts, base64 is decoded.

A file that cannot be opened, or has a form that is known to hide text (HDF5, SquashFS, zlib), is reported as such.
"""

from __future__ import annotations

import bisect
import bz2
import io
import itertools
import lzma
import sys
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import IO, TYPE_CHECKING

from sierra.packages.anonymity import encoded_texts, media_parts, pdf_parts
from sierra.packages.anonymity.file_parts import (
    UNREADABLE,
    Allowance,
    Decompressor,
    Part,
    Unpacking,
    Window,
    at,
    blocks,
    gaps,
    length,
)
from sierra.packages.anonymity.identifying_words import Word
from sierra.packages.anonymity.word_search import Occurrence, Search
from sierra.store.segments import own_table
from sierra.util.lazy_definitions import dataclass, field
from sierra.util.text import one_line

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

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
PROGRAMS = (b"#!", b"\x7fE", b"MZ")
"""The first bytes of programs, which may have a zip at their end."""
MOST_MEMORY = 256 << 20
"""The memory that xz may use."""
COMPRESSED: Mapping[bytes, Callable[[], Decompressor]] = {
    b"\x1f\x8b\x08": lambda: zlib.decompressobj(31),
    b"BZh": bz2.BZ2Decompressor,
    b"\xfd7zXZ\0": lambda: lzma.LZMADecompressor(memlimit=MOST_MEMORY),
}
"""The first bytes of compressed files, and their decompressors."""
IN_ZIP: Mapping[int, Callable[[], Decompressor]] = {
    zipfile.ZIP_DEFLATED: lambda: zlib.decompressobj(-15),
    zipfile.ZIP_BZIP2: bz2.BZ2Decompressor,  # a small read of `zipfile` could unpack to gigabytes
}
GZIP = b"\x1f\x8b\x08"
ZSTD = b"\x28\xb5\x2f\xfd"
SMALL_BLOCK = 1 << 16
BESIDE = 256
"""The number of bytes beside a range that are looked at, because a word may be across its ends."""
MOST_TEXT = 16 << 20
"""The size of the text in which base64 is decoded at once."""
NEWLINE = b"\n"
BREAKS = (b" ", b",", b";", b'"', b"'", b"<", b">", b"(", b")", b":", b".")
Reader = Callable[[IO[bytes], Allowance], Iterator[Part | str]]
OBJECTS = ["sha256", "part", "size", "content"]


@dataclass(frozen=True, slots=True)
class Hit:
    """A word in a file."""

    location: str
    text: str
    word: Word

    def __str__(self) -> str:
        return f"{self.location}: {self.text!r} ({self.word.kind})"


@dataclass(slots=True)
class _Reading:
    """The ranges of one file that were read."""

    done: list[tuple[int, int]] = field(default_factory=list)
    """The ranges that need no other search."""
    shown: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    """The ranges in which a word was found, by word; their bytes are searched again."""

    def show(self, begin: int, end: int, hits: Iterable[Hit]) -> None:
        """Add the words that were found in a range."""
        for word in {hit.word.text for hit in hits}:
            bisect.insort(self.shown.setdefault(word, []), (begin, end))

    def is_shown(self, match: Occurrence) -> bool:
        """Return whether a word in the bytes is one that was found before."""
        ranges = self.shown.get(match.word.text, [])
        index = bisect.bisect_right(ranges, (match.offset, sys.maxsize)) - 1
        return index >= 0 and match.offset < ranges[index][1]


class ContentSearch:
    """A search of files; `hits` and `unread` collect what is found, in the order of the search."""

    def __init__(self, search: Search, name_of: Callable[[str], str] = lambda digest: f"object {digest[:10]}") -> None:
        """`name_of` returns a text for an object of a store from its SHA-256."""
        self._search = search
        self._name_of = name_of
        self._searched: set[bytes] = set()
        self._allowance = Allowance(0)
        self.hits: list[Hit] = []
        self.unread: list[str] = []
        """One line for each file of which not all could be searched."""

    def name(self, name: str, location: str) -> None:
        """Search the name of a file."""
        self.hits += [Hit(f"name of {location}", match.text, match.word) for match in self._search.text(name)]

    def file(self, stream: IO[bytes], location: str, depth: int = 0) -> None:
        """Search a file from its beginning. The stream must be seekable."""
        outer, self._allowance = self._allowance, Allowance(length(stream))
        self._file(stream, location, depth)
        self._allowance = outer

    def skip_object(self, digest: str) -> None:
        """Leave out objects of this SHA-256, because a file with this content is searched."""
        self._searched.add(bytes.fromhex(digest))

    def _file(self, stream: IO[bytes], location: str, depth: int) -> None:
        """Search a file that may be in another one: first what can be opened, then all bytes that were not."""
        size, reading = length(stream), _Reading()
        stream.seek(0)
        beginning = stream.read(BEGINNING)
        if depth > DEEPEST:
            self.unread.append(f"{location} is in too many other files")
        else:
            try:
                self._open(stream, beginning, location, depth, reading)
            except UNREADABLE as error:
                self.unread.append(f"{location}: {_line(error)}")
        is_text = not (reading.done or reading.shown) and b"\0" not in beginning
        self.hits += self._hits(location, self._raw(stream, reading, size), by_line=is_text)
        if is_text and depth <= DEEPEST:
            try:
                self._base64(Window(stream, 0, size), location, depth)
            except UNREADABLE as error:
                self.unread.append(f"{location}: {_line(error)}")

    def _raw(self, stream: IO[bytes], reading: _Reading, size: int) -> Iterator[Occurrence]:
        """Yield the words in the bytes of a file that were not read in another way, or of which a part was not."""
        for begin, end in gaps(reading.done, size):
            low = max(0, begin - BESIDE)
            for match in self._search.stream(Window(stream, low, min(size, end + BESIDE))):
                here = match._replace(offset=low + match.offset)
                if begin < here.offset + here.size and here.offset < end and not reading.is_shown(here):
                    yield here

    def _named(self, name: str, location: str, reading: _Reading) -> None:
        """Search the name of a file in an archive."""
        before = len(self.hits)
        self.name(name, location)
        reading.show(0, sys.maxsize, self.hits[before:])

    def _open(self, stream: IO[bytes], beginning: bytes, location: str, depth: int, reading: _Reading) -> None:
        """Search what is in a file; add the ranges that were read to `reading`."""
        for magic, reason in HIDING.items():
            if beginning.startswith(magic):
                self.unread.append(f"{location}: {reason}")
        if magics := [magic for magic in COMPRESSED if beginning.startswith(magic)]:
            self._compressed(stream, magics[0], location, depth, reading)
        elif beginning.startswith(ZSTD):
            self._zstd(stream, location, depth, reading)
        elif beginning.startswith((b"PK\x03\x04", b"PK\x05\x06")) or (beginning[:2] in PROGRAMS and zipfile.is_zipfile(stream)):
            self._zip(stream, location, depth, reading)
        elif beginning[8:12] == b"DUCK":
            self.unread.append(f"{location}: a database of DuckDB may have compressed text")
        elif beginning[257:262] == b"ustar":
            self._tar(stream, location, depth, reading)
        else:
            self._open_single(stream, beginning, location, depth, reading)

    def _open_single(self, stream: IO[bytes], beginning: bytes, location: str, depth: int, reading: _Reading) -> None:
        """Search a file of a form that is not an archive."""
        if beginning.startswith(b"PAR1"):
            self._parquet(stream, location, depth, reading)
        elif beginning.startswith(b"ARROW1"):
            self._arrow(stream, location, depth)
        elif (reader := _reader(beginning)) is not None:
            stream.seek(0)
            known: dict[str, set[str]] = {}
            for part in reader(stream, self._allowance):
                self._part(part, location, depth, reading, known)

    def _part(self, part: Part | str, location: str, depth: int, reading: _Reading, known: dict[str, set[str]]) -> None:
        """Search a part of a file. `known`: the words of hits by location, of which none and no part is shown again."""
        if isinstance(part, str):
            self.unread.append(f"{location}: {part}")
            return
        before = len(self.hits)
        if part.content is not None and part.is_file:
            self._allowance.open()
            self._file(io.BytesIO(part.content), f"{location}: {part.location}", depth + 1)
        elif part.content is not None:
            self._text(part.content, f"{location}: {part.location}", depth)
        if part.is_all:
            reading.done.append((part.begin, part.end))
        else:
            reading.show(part.begin, part.end, self.hits[before:])
        seen = known.setdefault(part.location, set())
        new = [hit for hit in self.hits[before:] if not any(hit.word.text.casefold() in word for word in seen)]
        self.hits[before:] = new
        seen |= {hit.word.text.casefold() for hit in new}

    def _hits(self, location: str, matches: Iterable[Occurrence], *, by_line: bool | None, after: str = "") -> list[Hit]:
        """Return the first location of each word, with the number of the others. `by_line`: None if the location is enough."""
        first: dict[str, Occurrence] = {}
        counts: dict[str, int] = {}
        for match in matches:
            first.setdefault(match.word.text, match)
            counts[match.word.text] = counts.get(match.word.text, 0) + 1
        hits = []
        for text, match in first.items():
            where = "" if by_line is None else f", line {match.line}" if by_line else f", byte {match.offset}"
            more = f" and {counts[text] - 1} more" if counts[text] > 1 else ""
            hits.append(Hit(f"{location}{where}{after}{more}", match.text, match.word))
        return hits

    def _compressed(self, stream: IO[bytes], magic: bytes, location: str, depth: int, reading: _Reading) -> None:
        """Search the content of a file of one or more compressed streams."""
        begin, size = 0, length(stream)
        with tempfile.SpooledTemporaryFile(IN_MEMORY) as content:
            try:
                while begin < size and _starts(stream, begin, magic):
                    self._allowance.open()
                    header = _gzip_header(stream, begin) if magic == GZIP else 0
                    unpacking = Unpacking(blocks(stream, begin, size, SMALL_BLOCK), COMPRESSED[magic](), self._allowance)
                    content.writelines(unpacking)
                    reading.done.append((begin + header, begin + unpacking.used))
                    begin += unpacking.used
            finally:
                self._file(content, f"{location} (decompressed)", depth + 1)

    def _zstd(self, stream: IO[bytes], location: str, depth: int, reading: _Reading) -> None:
        import pyarrow as pa

        with tempfile.SpooledTemporaryFile(IN_MEMORY) as content:
            try:
                packed = Window(stream, 0, length(stream))
                self._copy(pa.CompressedInputStream(pa.PythonFile(packed, "r"), "zstd"), content)
                reading.done.append((0, _end_of_zstd(stream)))
            finally:
                self._file(content, f"{location} (decompressed)", depth + 1)

    def _copy(self, source: IO[bytes], target: IO[bytes]) -> None:
        while block := source.read(1 << 20):
            self._allowance.unpack(len(block))
            target.write(block)

    def _zip(self, stream: IO[bytes], location: str, depth: int, reading: _Reading) -> None:
        with zipfile.ZipFile(stream) as file:
            for info in file.infolist():
                self._allowance.open()
                inner = f"{location}: {one_line(info.filename)}"
                self._named(info.filename, inner, reading)
                try:
                    reading.done.append(self._zip_member(file, stream, info, inner, depth))
                except UNREADABLE as error:
                    self.unread.append(f"{inner}: {_line(error)}")

    def _zip_member(
        self, file: zipfile.ZipFile, stream: IO[bytes], info: zipfile.ZipInfo, location: str, depth: int
    ) -> tuple[int, int]:
        """Search a member, and return the range of its data. Raises one of UNREADABLE if it is damaged, after the search."""
        header = at(stream, info.header_offset, 30)
        begin = info.header_offset + 30 + int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little")
        end = begin + info.compress_size
        if header[:4] != b"PK\x03\x04" or info.flag_bits & 1:
            raise ValueError("it is encrypted" if info.flag_bits & 1 else "it is damaged")
        with tempfile.SpooledTemporaryFile(IN_MEMORY) as content:
            try:
                if (decompressor := IN_ZIP.get(info.compress_type)) is not None:
                    unpacking, crc = Unpacking(blocks(stream, begin, end), decompressor(), self._allowance), 0
                    for piece in unpacking:
                        content.write(piece)
                        crc = zlib.crc32(piece, crc)
                    if crc != info.CRC:
                        raise ValueError("its content is not that of its checksum")
                    end = begin + unpacking.used
                else:
                    with file.open(info) as member:
                        self._copy(member, content)
            finally:
                self._file(content, location, depth + 1)
        return begin, end

    def _tar(self, stream: IO[bytes], location: str, depth: int, reading: _Reading) -> None:
        stream.seek(0)
        with tarfile.open(fileobj=stream, mode="r:") as file:
            for info in file:
                self._allowance.open()
                inner = f"{location}: {one_line(info.name)}"
                self._named(info.name, inner, reading)
                if info.isreg() and (member := file.extractfile(info)) is not None:
                    with tempfile.SpooledTemporaryFile(IN_MEMORY) as content:
                        self._copy(member, content)
                        self._file(content, inner, depth + 1)
                    if not info.issparse():
                        reading.done.append((info.offset_data, info.offset_data + info.size))

    def _text(self, content: bytes, location: str, depth: int, *, by_line: bool | None = None) -> None:
        """Search a text in a file; without `by_line`, the line is shown if it has several."""
        if by_line is None:
            by_line = True if b"\n" in content.strip() else None
        self.hits += self._hits(location, self._search.stream(io.BytesIO(content)), by_line=by_line)
        self._base64(Window(io.BytesIO(content), 0, len(content)), location, depth)

    # base64

    def _base64(self, text: Window, location: str, depth: int) -> None:
        """Search the base64 data in a text, which ends at the first NUL."""
        rest, line, is_whole = b"", 1, True
        while block := text.read(MOST_TEXT):
            content, is_last = rest + block, len(block) < MOST_TEXT
            cut = len(content) if is_last else max(map(content.rfind, BREAKS)) + 1
            if b"\0" in content:
                return
            is_whole, cut = is_whole and cut > 0, cut or len(content)
            rest, content = content[cut:], content[:cut]
            self.hits += self._hits(location, self._encoded(content, line, location, depth), by_line=True, after=", base64")
            line += content.count(b"\n")
        if not is_whole:
            self.unread.append(f"{location}: a text in base64 is too long, and is searched in pieces")

    def _encoded(self, content: bytes, line: int, location: str, depth: int) -> Iterator[Occurrence]:
        """Yield the words that are encoded in a text, with the location of the code; search encoded files."""
        pieces: dict[bool, list[encoded_texts.Decoded]] = {True: [], False: []}
        for piece in encoded_texts.decoded(content):
            if piece.is_file:
                self._allowance.open()
                where = f"{location}, line {line + content.count(NEWLINE, 0, piece.begin)}, base64"
                self._file(io.BytesIO(piece.content), where, depth + 1)
            else:
                pieces[piece.is_text].append(piece)
        for is_text, some in pieces.items():
            between = b"\n\n" if is_text else b"\0" * 8
            ends = list(itertools.accumulate(len(piece.content) + len(between) for piece in some))
            for match in self._search.stream(io.BytesIO(between.join(piece.content for piece in some))):
                begin = some[bisect.bisect_right(ends, match.offset)].begin
                yield match._replace(offset=begin, line=line + content.count(NEWLINE, 0, begin))

    # tables

    def _arrow(self, stream: IO[bytes], location: str, depth: int) -> None:
        import pyarrow as pa

        with pa.ipc.open_file(stream) as file:
            self._schema(file.schema, location)
            self._batches((file.get_batch(number) for number in range(file.num_record_batches)), location, depth)

    def _parquet(self, stream: IO[bytes], location: str, depth: int, reading: _Reading) -> None:
        import pyarrow.parquet as pq

        before = len(self.hits)
        with pq.ParquetFile(stream) as file:
            if table := own_table(file.metadata):
                location = f"{location} (table {table})"
            self._schema(file.schema_arrow, location)
            described = {**(file.metadata.metadata or {}), b"created by": (file.metadata.created_by or "").encode()}
            self._text(
                b"\n".join(itertools.chain.from_iterable(described.items())), f"{location} (footer)", DEEPEST, by_line=False
            )
            groups = (file.iter_batches(ROWS, row_groups=[group]) for group in range(file.num_row_groups))
            search = self._objects if file.schema_arrow.names == OBJECTS else self._batches
            search(itertools.chain.from_iterable(groups), location, depth)
            reading.done += _searched_pages(file.metadata)
            footer = length(stream) - 8 - int.from_bytes(at(stream, length(stream) - 8, 4), "little")
            reading.done.append((footer, length(stream)))  # its statistics repeat values, as the first bytes of pictures
            reading.show(0, sys.maxsize, self.hits[before:])

    def _schema(self, schema: pa.Schema, location: str) -> None:
        metadata = b"\n".join(itertools.chain.from_iterable((schema.metadata or {}).items()))
        self._text(metadata, f"{location} (metadata)", DEEPEST, by_line=False)
        for name in schema.names:
            self.name(name, f"a column of {location}")

    def _batches(self, batches: Iterable[pa.RecordBatch], location: str, depth: int) -> None:
        first: dict[tuple[str, str], Hit] = {}
        row = 1
        for batch in batches:
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                where = f"{location}, column {name}, row"
                for number, value in enumerate(column.to_pylist() if _is_binary(column.type) else ()):
                    if value:
                        self._file(io.BytesIO(value), f"{where} {row + number}", depth + 1)
                for number, match in self._column(column, f"{location}, column {name}", depth):
                    first.setdefault((name, match.word.text), Hit(f"{where} {row + number}", match.text, match.word))
            row += batch.num_rows
        self.hits += first.values()

    def _column(self, column: pa.Array, location: str, depth: int) -> Iterator[tuple[int, Occurrence]]:
        """Yield the words in a column, each with the position of its row. Numbers and times have none."""
        import pyarrow as pa
        from pyarrow import types

        kind = column.type
        if types.is_string(kind) or types.is_large_string(kind):
            encoded = column.cast(pa.large_string()).dictionary_encode()
            for number, match in self._texts(encoded.dictionary.to_pylist(), location, depth):
                yield encoded.indices.index(number).as_py(), match
        elif not (types.is_primitive(kind) or types.is_decimal(kind) or types.is_null(kind) or _is_binary(kind)):
            yield from self._texts([str(value) for value in column.to_pylist()], location, depth)

    def _texts(self, texts: list[str], location: str, depth: int) -> Iterator[tuple[int, Occurrence]]:
        """Yield the words in texts, each with the position of its text."""
        pieces = [text.encode("utf-8", "surrogatepass") for text in texts]
        begins = list(itertools.accumulate((len(piece) + 1 for piece in pieces), initial=0))
        content = b"\n".join(pieces)
        for match in itertools.chain(self._search.stream(io.BytesIO(content)), self._encoded(content, 1, location, depth)):
            yield bisect.bisect_right(begins, match.offset) - 1, match

    def _objects(self, batches: Iterable[pa.RecordBatch], location: str, depth: int) -> None:
        """Search the files in a file of objects, each only once."""
        rows = (row for batch in batches for row in zip(*(batch.column(name) for name in OBJECTS), strict=True))
        for digest, parts in itertools.groupby(rows, lambda row: row[0].as_py()):
            key = bytes.fromhex(digest)
            if key in self._searched:
                continue
            self._searched.add(key)
            with tempfile.SpooledTemporaryFile(IN_MEMORY) as content:
                for part in parts:
                    content.write(part[3].as_buffer())
                content.seek(0)
                self.file(content, f"{location} ({self._name_of(digest)})", depth + 1)


def _is_binary(kind: pa.DataType) -> bool:
    from pyarrow import types

    return bool(types.is_binary(kind) or types.is_large_binary(kind) or types.is_fixed_size_binary(kind))


def _reader(beginning: bytes) -> Reader | None:
    """Return the reader of a file's parts, from its first bytes."""
    readers: Mapping[bytes, Reader] = {
        b"\x89PNG\r\n": media_parts.png,
        b"\xff\xd8\xff": media_parts.jpeg,
        b"%PDF": pdf_parts.pdf,
    }
    of_magic = next((reader for magic, reader in readers.items() if beginning.startswith(magic)), None)
    return of_magic or (media_parts.mp4 if beginning[:1] == b"\0" and beginning[4:8] in media_parts.FIRST else None)


def _searched_pages(metadata: pq.FileMetaData) -> Iterator[tuple[int, int]]:
    """Yield the ranges of a Parquet file that are compressed, or that hold texts and bytes, which were all searched."""
    for group in range(metadata.num_row_groups):
        for number in range(metadata.num_columns):
            column = metadata.row_group(group).column(number)
            if column.compression != "UNCOMPRESSED" or column.physical_type == "BYTE_ARRAY":
                begin = min(column.dictionary_page_offset or column.data_page_offset, column.data_page_offset)
                yield begin, begin + column.total_compressed_size


def _starts(stream: IO[bytes], begin: int, magic: bytes) -> bool:
    stream.seek(begin)
    return stream.read(len(magic)) == magic


def _gzip_header(stream: IO[bytes], begin: int) -> int:
    """Return the size of a gzip header, which may have a file name and a comment (RFC 1952)."""
    stream.seek(begin)
    head = stream.read(SMALL_BLOCK)
    flags, end = head[3], 10
    if flags & 4:
        end += 2 + int.from_bytes(head[end : end + 2], "little")
    for flag in (8, 16):
        end = head.index(0, end) + 1 if flags & flag else end
    return end


def _end_of_zstd(stream: IO[bytes]) -> int:
    """Return the end of the first frame of a zstd file, by its blocks (RFC 8878, 3.1.1)."""
    flags = at(stream, 4, 1)[0]
    is_single = flags >> 5 & 1
    end = 5 + (1 - is_single) + (0, 1, 2, 4)[flags & 3] + (is_single, 2, 4, 8)[flags >> 6]
    is_last = False
    while not is_last:
        block = int.from_bytes(at(stream, end, 3), "little")
        is_last, end = bool(block & 1), end + 3 + (1 if block >> 1 & 3 == 1 else block >> 3)
    return end


def _line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:100]
