"""A name is found in every kind of file, and the place of a hit leads to it."""

from __future__ import annotations

import base64
import bz2
import gzip
import io
import json
import lzma
import random
import re
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sierra.packages.anonymity import file_parts
from sierra.packages.anonymity.content_search import ContentSearch
from sierra.packages.anonymity.identifying_words import Word
from sierra.packages.anonymity.word_search import Search

TEXT = b"first line\nmade on secret-host\n" + bytes(range(32, 127)) * 20


def zipped(content: bytes, name: str = "log.txt") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return file.getvalue()


def tarred(content: bytes, owner: str = "") -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as archive:
        info = tarfile.TarInfo("log.txt.gz")
        info.size, info.uname = len(content), owner
        archive.addfile(info, io.BytesIO(content))
    return file.getvalue()


def parquet(table: pa.Table) -> bytes:
    file = io.BytesIO()
    pq.write_table(table, file, compression="zstd")
    return file.getvalue()


def arrow(table: pa.Table) -> bytes:
    file = io.BytesIO()
    with pa.ipc.new_file(file, table.schema, options=pa.ipc.IpcWriteOptions(compression="zstd")) as writer:
        writer.write_table(table)
    return file.getvalue()


def png(kind: bytes, *parts: bytes) -> bytes:
    chunks = ((b"IHDR", b"\0" * 13), (kind, b"".join(parts)))
    return b"\x89PNG\r\n\x1a\n" + b"".join(len(data).to_bytes(4, "big") + name + data + b"\0" * 4 for name, data in chunks)


def segment(marker: int, content: bytes) -> bytes:
    return b"\xff" + bytes([marker]) + (len(content) + 2).to_bytes(2, "big") + content


def jpeg(*segments: bytes, pixels: bytes = b"\x01\xff\0\x02") -> bytes:
    return b"\xff\xd8" + b"".join(segments) + segment(0xDA, b"\0" * 10) + pixels + b"\xff\xd9"


def exif(text: bytes) -> bytes:
    """Return Exif with one field, the artist."""
    field = struct.pack("<HHII", 0x13B, 2, len(text), 26) if len(text) > 4 else struct.pack("<HHI4s", 0x13B, 2, len(text), text)
    return b"II*\0" + struct.pack("<IH", 8, 1) + field + struct.pack("<I", 0) + text


def box(kind: bytes, *contents: bytes) -> bytes:
    content = b"".join(contents)
    return (len(content) + 8).to_bytes(4, "big") + kind + content


def video(*metadata: bytes, frames: bytes = b"\1\2\3", track: bytes = b"vide") -> bytes:
    handler = box(b"hdlr", b"\0" * 8, track, b"\0" * 12)
    described = box(b"moov", box(b"trak", box(b"mdia", handler)), box(b"udta", *metadata))
    return box(b"ftyp", b"isom\0\0\0\0") + box(b"mdat", frames) + described


def item(content: bytes) -> bytes:
    """Return metadata as of iTunes."""
    kind = box(b"hdlr", b"\0" * 8, b"mdir", b"\0" * 12)
    return box(b"meta", b"\0" * 4, kind, box(b"ilst", box(b"\xa9ART", box(b"data", b"\0\0\0\1\0\0\0\0", content))))


def pdf(dictionary: bytes, content: bytes) -> bytes:
    return b"%PDF-1.5\n7 0 obj\n<<" + dictionary + b">>\nstream\n" + content + b"\nendstream\nendobj\n"


def search(content: bytes, name: str = "secret-host") -> ContentSearch:
    found = ContentSearch(Search([Word(name, "host name")]))
    found.file(io.BytesIO(content), "x")
    return found


TABLE = pa.table({"n": [1, 2, 3], "host": ["a", "b", "on secret-host"], "tags": [["a"], ["b"], ["secret-host"]]})
FILES = {
    "text": (TEXT, "x, line 2"),
    "gzip": (gzip.compress(TEXT, mtime=0), "x (decompressed), line 2"),
    "bzip2": (bz2.compress(TEXT), "x (decompressed), line 2"),
    "xz": (lzma.compress(TEXT), "x (decompressed), line 2"),
    "zstd": (pa.compress(TEXT, "zstd", asbytes=True), None),
    "zip": (zipped(TEXT), "x: log.txt, line 2"),
    "program with a zip": (b"#!/usr/bin/env python3\n" + zipped(TEXT), "x: log.txt, line 2"),
    "name in a zip": (zipped(b"", "secret-host.log"), "name of x: secret-host.log"),
    "gzip in tar in zip": (zipped(tarred(gzip.compress(TEXT, mtime=0))), "x: log.txt: log.txt.gz (decompressed), line 2"),
    "Parquet": (parquet(TABLE), "x, column host, row 3"),
    "Arrow": (arrow(TABLE), "x, column host, row 3"),
    "bytes in Parquet": (parquet(pa.table({"raw": [b"", gzip.compress(TEXT)]})), "x, column raw, row 2 (decompressed), line 2"),
    "metadata of Parquet": (
        parquet(TABLE.select(["n"]).replace_schema_metadata({"by": "secret-host"})),
        "x (metadata), byte 3",
    ),
    "column of Parquet": (parquet(pa.table({"secret-host": [1]})), "name of a column of x"),
    "bytes in Parquet, late": (parquet(pa.table({"raw": [b""] * 9000 + [b"secret-host"]})), "x, column raw, row 9001, line 1"),
    "categories": (parquet(pa.table({"who": pa.array(["a", "secret-host"]).dictionary_encode()})), "x, column who, row 2"),
    "PNG": (png(b"zTXt", b"Author\0\0", zlib.compress(b"secret-host")), 'x: zTXt chunk "Author"'),
    "international PNG": (png(b"iTXt", b"Author\0\1\0en\0Autor\0", zlib.compress(b"secret-host")), 'x: iTXt chunk "Author"'),
    "plain text in PNG": (png(b"iTXt", b"Author\0\0\0en\0Autor\0", b"secret-host"), None),
    "PDF": (
        b"%PDF-1.4\n1 0 obj\nstream\n" + zlib.compress(b"/Author (secret-host)") + b"\nendstream",
        "x: object 1",
    ),
    "behind packed text in PNG": (png(b"zTXt", b"Title\0\0", zlib.compress(b"x"), b"secret-host"), "x, byte"),
    "behind coded data in PDF": (
        pdf(b"/Filter /ASCII85Decode", base64.a85encode(b"x") + b"~> secret-host"),
        "x, byte",
    ),
    "strings of a page": (
        pdf(b"/Filter /FlateDecode", zlib.compress(b"BT [(sec)12(ret\\055)-9(ho)<7374>]TJ ET")),
        "x: object 7",
    ),
    "two words of a page": (pdf(b"", b"[(from)-333(secret-host)-333(today)]TJ"), "x: object 7"),
    "text in a font of 16 bits": (pdf(b"", b"(" + "secret-host".encode("utf-16-be") + b") Tj"), "x: object 7"),
    "escapes in PDF": (b"%PDF-1.4\n4 0 obj\n<</Author (Mr \\(secret\\055host\\))>>\nendobj", "x: object 4"),
    "XMP in PDF": (pdf(b"/Type /Metadata", b"<x>secret-host</x>"), "x: object 7"),
    "picture in PDF": (
        pdf(
            b"/Subtype /Image /Filter [/ASCII85Decode /DCTDecode]",
            base64.a85encode(jpeg(segment(0xFE, b"secret-host"))) + b"~>",
        ),
        "x: object 7: comment",
    ),
    "comment in JPEG": (jpeg(segment(0xFE, b"by secret-host")), "x: comment"),
    "Exif in JPEG": (jpeg(segment(0xE1, b"Exif\0\0" + exif(b"secret-host"))), "x: Exif, Artist"),
    "XMP in JPEG": (jpeg(segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0<x>secret-host</x>")), "x: XMP"),
    "bytes after JPEG": (jpeg() + b"secret-host", "x, byte"),
    "Exif in PNG": (png(b"eXIf", exif(b"secret-host")), "x: eXIf chunk, Artist"),
    "keyword of PNG": (png(b"zTXt", b"secret-host\0\0", zlib.compress(b"x")), 'x: zTXt chunk "secret-host"'),
    "text in PNG": (png(b"tEXt", b"Author\0secret-host"), 'x: tEXt chunk "Author"'),
    "metadata of MP4": (video(item(b"secret-host")), "x: box moov/udta/meta/ilst/\xa9ART/data"),
    "cover of MP4": (
        video(item(png(b"tEXt", b"Author\0secret-host"))),
        'x: box moov/udta/meta/ilst/\xa9ART/data: tEXt chunk "Author"',
    ),
    "text of QuickTime": (video(box(b"\xa9cmt", b"\0\x0b\0\0secret-host")), "x: box moov/udta/\xa9cmt"),
    "free box of MP4": (video() + box(b"free", b"secret-host"), "x: box free"),
    "own box of MP4": (video() + box(b"uuid", b"0" * 16 + b"<x>secret-host</x>"), "x: box uuid"),
    "text in frames of MP4": (video(frames=b"\1\2" + b"x264, made on secret-host for all\0"), "x: frames"),
    "text in pixels of JPEG": (jpeg(pixels=b"\1\2" + b"x264, made on secret-host for all\0"), "x: pixels"),
    "subtitles of MP4": (video(frames=b"\0\x0bsecret-host", track=b"text"), "x, byte"),
    "base64 in a text": (b"\ntoken=" + base64.b64encode(b"secret-host for all") + b";", "x, line 2, base64"),
    "base64 within other letters": (b"xyz" + base64.b64encode(b"secret-host for all"), "x, line 1, base64"),
    "base64 of URLs": (base64.urlsafe_b64encode("ÿÿÿ? secret-host".encode()), "x, line 1, base64"),
    "base64 on lines": (b"a\n" + base64.encodebytes(TEXT), "x, line 2, base64"),
    "picture in HTML": (
        b"<p>\n<img src='data:image/png;base64," + base64.b64encode(png(b"tEXt", b"Author\0secret-host")) + b"'>",
        'x, line 2, base64: tEXt chunk "Author"',
    ),
    "picture in a notebook": (
        json.dumps({"image/png": base64.encodebytes(png(b"tEXt", b"Author\0secret-host" + b" " * 99)).decode()}).encode(),
        'x, line 1, base64: tEXt chunk "Author"',
    ),
    "base64 in Parquet": (
        parquet(pa.table({"raw": ["a", base64.b64encode(b"secret-host for all").decode()]})),
        "x, column raw, row 2",
    ),
    "file name in gzip": (b"\x1f\x8b\x08\x08\0\0\0\0\2\xffsecret-host\0" + gzip.compress(b"x", mtime=0)[10:], "x, byte 10"),
    "second part of gzip": (gzip.compress(b"x\n") + gzip.compress(b"secret-host"), "x (decompressed), line 2"),
    "after gzip": (gzip.compress(b"x") + b"secret-host", "x, byte"),
    "comment of a zip": (zipped(b"x")[:-2] + b"\x0b\0secret-host", "x, byte"),
    "owner in tar": (tarred(b"x", "secret-host"), "x, byte"),
    "text in UTF-16": ("\ufeffon secret-host".encode("utf-16-le"), "x, byte"),
    "hexadecimal text in PDF": (b"%PDF-1.4\n/Title <" + "secret-host".encode("utf-16-be").hex().encode() + b">", None),
}


@pytest.mark.parametrize("form", FILES)
def test_a_name_is_found_in_each_kind_of_file(form: str) -> None:
    content, place = FILES[form]
    found = search(content)
    assert [hit for hit in found.hits if hit.word.text == "secret-host"]
    assert found.unread == []
    if place is not None:
        assert [hit for hit in found.hits if hit.location.startswith(place)], found.hits


NOISE = random.Random(1).randbytes(300)
BESIDE = b" in a vm \n" + NOISE + b"a vm is here"
"""Bytes in which `vm` is a word between readable letters."""
WITHOUT = {
    "pixels of PNG": png(b"IDAT", zlib.compress(BESIDE, 0)),
    "pixels of JPEG": jpeg(pixels=b" in a vm \n" + b"\1" * 30),
    "frames of MP4": video(frames=BESIDE),
    "picture in PDF": pdf(b"/Subtype /Image /Filter /FlateDecode", zlib.compress(BESIDE, 0)),
    "JPEG 2000 in PDF": pdf(b"/Subtype /Image /Filter /JPXDecode", BESIDE),
}
"""Files in which a short word is there by chance."""


@pytest.mark.parametrize("form", WITHOUT)
def test_a_word_in_compressed_pixels_is_not_found(form: str) -> None:
    assert b"vm" in WITHOUT[form]
    found = search(WITHOUT[form], "vm")
    assert (found.hits, found.unread) == ([], [])


@pytest.mark.parametrize(
    "pack", [gzip.compress, bz2.compress, lzma.compress, zipped, lambda content: pa.compress(content, "zstd", asbytes=True)]
)
def test_a_word_in_compressed_bytes_is_not_found(pack: Callable[[bytes], bytes]) -> None:
    content = random.Random(1).randbytes(300_000).hex().encode()
    packed = pack(content)
    by_chance = re.search(rb"(?<![A-Za-z])[g-z]{4}(?![A-Za-z])", packed[100:-100])
    assert by_chance is not None
    found = search(packed, by_chance[0].decode())
    assert (found.hits, found.unread) == ([], [])


def test_a_name_with_an_accent_is_found_in_pictures() -> None:
    found = ContentSearch(Search([Word("Jürgen Müller", "author")]))
    found.file(io.BytesIO(png(b"tEXt", b"Author\0", "Jürgen Müller".encode("latin-1"))), "x")
    assert len(found.hits) == 1


def test_objects_of_a_store_are_searched_one_by_one_and_each_once() -> None:
    rows = [("aa" * 32, 0, 30, b"x" * 20 + b"secr"), ("aa" * 32, 1, 30, b"et-host\n"), ("bb" * 32, 0, 11, b"secret-host")]
    rows += rows[:2]
    table = pa.table(
        [pa.array(column) for column in zip(*rows, strict=True)],
        pa.schema([("sha256", pa.string()), ("part", pa.int64()), ("size", pa.int64()), ("content", pa.large_binary())]),
    )
    found = ContentSearch(Search([Word("secret-host", "host name")]), {"aa" * 32: "stdout of run 1"}.__getitem__)
    found.skip_object("bb" * 32)
    found.file(io.BytesIO(parquet(table)), "objects")
    named = [str(hit) for hit in found.hits if "stdout" in hit.location]
    assert named == ["objects (stdout of run 1), line 1: 'secret-host' (host name)"]


def test_files_that_cannot_be_searched_are_named() -> None:
    broken = zipped(TEXT)[:-30]
    assert search(broken).unread == ["x: File is not a zip file"]
    assert search(b"\x89HDF\r\n\x1a\n rest").unread == ["x: HDF5 may have compressed text"]
    assert search(zlib.compress(TEXT)).unread == ["x: a stream of zlib cannot be opened"]
    assert search(b"\1" * 8 + b"DUCK").unread == ["x: a database of DuckDB may have compressed text"]
    nested = json.dumps({}).encode()
    for _ in range(9):
        nested = zipped(nested, "a")
    assert search(nested).unread == ["x: a: a: a: a: a: a: a is in too many other files"]
    assert search(bytes(range(256)) * 9).unread == []
    assert search(b"The wide arena of all moovies, ftyp").unread == []


DAMAGED = {
    "PNG without pixels": png(b"IDAT", b"secret-host"),
    "PNG": png(b"tEXt", b"Author\0secret-host") + b"\xff\xff\xff\xffIDAT",
    "JPEG": jpeg(segment(0xFE, b"secret-host"))[:-2],
    "MP4": video(item(b"secret-host")) + b"\xff\xff\xff\xfffree",
    "PDF": pdf(b"/Filter /FlateDecode", zlib.compress(b"secret-host, and more text")[:-6]) + b"secret-host",
    "zip": zipped(TEXT)[:-30] + b"secret-host",
    "unknown filter of PDF": pdf(b"/Filter 9 0 R /Author (secret-host)", b"\1\2\3"),
    "checksum of zip": zipped(TEXT).replace(zlib.crc32(TEXT).to_bytes(4, "little"), b"\1\2\3\4"),
    "gzip": gzip.compress(TEXT * 9)[:-9],
    "encoded gzip": base64.b64encode(gzip.compress(TEXT * 9)[:-9]),
}


@pytest.mark.parametrize("form", DAMAGED)
def test_damaged_files_are_searched_as_bytes_and_named(form: str) -> None:
    found = search(DAMAGED[form])
    assert [line for line in found.unread if line.startswith("x")]
    assert found.hits


@pytest.mark.parametrize(
    "bomb",
    [
        gzip.compress(bytes(1 << 20)),
        bz2.compress(bytes(1 << 20)),
        zipped(bytes(1 << 20)),
        zipped(zipped(bytes(1 << 20))),
        png(b"zTXt", b"Title\0\0", zlib.compress(bytes(1 << 20))),
        png(b"IDAT", zlib.compress(bytes(1 << 20))),
        pdf(b"/Filter /FlateDecode", zlib.compress(bytes(1 << 20))),
    ],
)
def test_bombs_are_refused_and_named(bomb: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_parts, "SPARE", 1000)
    monkeypatch.setattr(file_parts, "RATIO", 2)
    found = search(bomb)
    assert found.hits == []
    assert "unpacks to more than" in found.unread[0]


def test_a_zip_of_too_many_files_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_parts, "MOST_FILES", 1)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a", "secret-host")
        archive.writestr("b", "secret-host")
    found = search(file.getvalue())
    assert found.unread == ["x: it has more than 1 files in it"]
    assert [hit.location for hit in found.hits] == ["x: a, line 1", "x, byte 73"]
