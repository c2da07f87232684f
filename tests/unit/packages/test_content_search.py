"""A name is found in every kind of file, and the place of a hit leads to it."""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import tarfile
import zipfile
import zlib

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sierra.packages.anonymity.content_search import ContentSearch
from sierra.packages.anonymity.identifying_words import Word
from sierra.packages.anonymity.word_search import Search

TEXT = b"first line\nmade on secret-host\n" + bytes(range(32, 127)) * 20


def zipped(content: bytes, name: str = "log.txt") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return file.getvalue()


def tarred(content: bytes) -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as archive:
        info = tarfile.TarInfo("log.txt.gz")
        info.size = len(content)
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


def search(content: bytes) -> ContentSearch:
    found = ContentSearch(Search([Word("secret-host", "host name")]))
    found.file(io.BytesIO(content), "x")
    return found


TABLE = pa.table({"n": [1, 2, 3], "host": ["a", "b", "on secret-host"], "tags": [["a"], ["b"], ["secret-host"]]})
FILES = {
    "text": (TEXT, "x, line 2"),
    "gzip": (gzip.compress(TEXT, mtime=0), "x (decompressed), line 2"),
    "bzip2": (bz2.compress(TEXT), "x (decompressed), line 2"),
    "xz": (lzma.compress(TEXT), "x (decompressed), line 2"),
    "zstd": (pa.compress(TEXT, "zstd", asbytes=True), None),
    "zip": (zipped(TEXT), "x/log.txt, line 2"),
    "program with a zip": (b"#!/usr/bin/env python3\n" + zipped(TEXT), "x/log.txt, line 2"),
    "name in a zip": (zipped(b"", "secret-host.log"), "name of x/secret-host.log"),
    "gzip in tar in zip": (zipped(tarred(gzip.compress(TEXT, mtime=0))), "x/log.txt/log.txt.gz (decompressed), line 2"),
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
    "PNG": (png(b"zTXt", b"Author\0\0", zlib.compress(b"secret-host")), "x (zTXt), byte 0"),
    "international PNG": (png(b"iTXt", b"Author\0\1\0en\0Autor\0", zlib.compress(b"secret-host")), "x (iTXt), byte 0"),
    "plain text in PNG": (png(b"iTXt", b"Author\0\0\0en\0Autor\0", b"secret-host"), None),
    "PDF": (
        b"%PDF-1.4\n1 0 obj\nstream\n" + zlib.compress(b"/Author (secret-host)") + b"\nendstream",
        "x (compressed), byte 9",
    ),
    "hexadecimal text in PDF": (b"%PDF-1.4\n/Title <" + "secret-host".encode("utf-16-be").hex().encode() + b">", None),
}


@pytest.mark.parametrize("form", FILES)
def test_a_name_is_found_in_each_kind_of_file(form: str) -> None:
    content, place = FILES[form]
    found = search(content)
    assert [hit for hit in found.hits if hit.word.text == "secret-host"]
    assert found.unread == ([] if form != "zstd" else found.unread)
    if place is not None:
        assert [hit for hit in found.hits if hit.place.startswith(place)], found.hits


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
    found.known("bb" * 32)
    found.file(io.BytesIO(parquet(table)), "objects")
    named = [str(hit) for hit in found.hits if "stdout" in hit.place]
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
    assert search(nested).unread == ["x/a/a/a/a/a/a/a is in too many other files"]
    assert search(bytes(range(256)) * 9).unread == []
