"""The texts in PDF files: strings of the document and of its pages, metadata, and compressed streams (ISO 32000-1, 7.3, 7.4).

Streams are taken in the order of the file, and not by its tables of references, which may be damaged. Pixels are not searched.
"""

from __future__ import annotations

import base64
import binascii
import itertools
import zlib
from collections.abc import Iterator
from typing import IO

from sierra.packages.anonymity.file_parts import UNREADABLE, Allowance, Part, Unpacking, whole
from sierra.util.lazy_definitions import dataclass, regex

LARGEST = 128 << 20
HEAD = 4096
"""The number of bytes before a stream that are searched for its dictionary."""
MOST_TOKENS = 2_000_000
STREAM = regex(rb"(?<!end)stream(?:\r?\n|\r)")
FILTER = regex(rb"/Filter\s*(\[[^\]]{0,300}\]|/\w+)")
LENGTH = regex(rb"/Length\s+(\d{1,10})(?!\s+\d+\s+R)")
NUMBER = regex(rb"(\d{1,10})\s+\d{1,5}\s+obj\b")
IMAGE = regex(rb"/Subtype\s*/Image\b")
OWN_CODES = regex(rb"/CIDToGIDMap\s*/Identity\b|/CIDFontType0\b")
"""Fonts whose characters are numbers of glyphs, so that no text can be seen."""
PICTURES = {b"DCTDecode", b"DCT", b"JPXDecode", b"CCITTFaxDecode", b"CCF", b"JBIG2Decode"}
TOKEN = regex(
    rb"\\(?:[0-7]{1,3}|\r\n|[\s\S])|(?P<open>\()|(?P<close>\))(?:\s{0,9}(?P<kern>-?[\d.]{1,12}))?"
    rb"|<(?P<hex>[0-9A-Fa-f\s]{4,65536})>(?:\s{0,9}(?P<hexkern>-?[\d.]{1,12}))?|(?P<list>[\[\]])|(?P<end>\bendobj|\bendstream|\bET\b)"
)
ESCAPE = regex(rb"\\([0-7]{1,3}|\r\n|[\s\S])")
ESCAPES = {b"n": b"\n", b"r": b"\r", b"t": b"\t", b"b": b"\b", b"f": b"\f", b"\n": b"", b"\r": b"", b"\r\n": b""}
SPACE = -150
"""Letters that are moved apart by more than this, in thousandths of their size, are two words."""


def pdf(stream: IO[bytes], allowance: Allowance) -> Iterator[Part | str]:
    """Yield the texts and compressed streams of a PDF, and a text for each thing that cannot be read."""
    content = whole(stream, LARGEST)
    if b"/Encrypt" in content:
        yield "it is encrypted"
    begin, is_coded = 0, OWN_CODES.search(content) is not None
    for word in STREAM.finditer(content):
        if word.start() < begin:
            continue  # within a stream
        yield from _objects(content, begin, word.start())
        encoded = _stream(content, word.start(), word.end())
        try:
            for part in _stream_parts(content, encoded, allowance):
                is_coded = is_coded or (isinstance(part, Part) and OWN_CODES.search(part.content or b"") is not None)
                yield part
        except UNREADABLE as error:
            yield f"{encoded.location}: {error}"
        begin = encoded.end
    yield from _objects(content, begin, len(content))
    if is_coded:
        yield "text in fonts with numbered glyphs cannot be read"


def _objects(content: bytes, begin: int, end: int) -> Iterator[Part]:
    """Yield the strings of the objects in a range."""
    heads = [(match.start(), match[1].decode()) for match in NUMBER.finditer(content, begin, end)]
    for (low, number), (high, _) in itertools.pairwise([(begin, ""), *heads, (end, "")]):
        if text := strings(content[low:high]):
            yield Part(low, high, f"object {number}" if number else f"strings after byte {low}", text, is_all=False)


@dataclass(frozen=True, slots=True)
class _Stream:
    """A stream of a PDF."""

    location: str
    begin: int
    end: int
    filters: tuple[bytes, ...]
    is_image: bool


def _stream(content: bytes, word: int, begin: int) -> _Stream:
    """Return the stream that begins there, after the word `stream` at an offset."""
    head = content[max(0, word - HEAD) : word]
    head = head[head.rfind(b"endobj") + 6 if b"endobj" in head else 0 :]
    numbers = NUMBER.findall(head)
    dictionary = head[head.rfind(b" obj") :] if numbers else head
    count = LENGTH.search(dictionary)
    end = begin + int(count[1]) if count else -1
    if end < 0 or not content[end : end + 20].lstrip().startswith(b"endstream"):
        end = content.find(b"endstream", begin)
    if end == -1:
        end = len(content)
    match = FILTER.search(dictionary)
    filters = tuple(match[1].strip(b"[]").replace(b"/", b" ").split()) if match else ()
    if match is None and b"/Filter" in dictionary and content[begin : begin + 1] != b"x":
        filters = (b"an indirect filter",)
    location = f"object {numbers[-1].decode()}" if numbers else f"stream at byte {begin}"
    return _Stream(location, begin, end, filters, IMAGE.search(dictionary) is not None)


def _stream_parts(content: bytes, stream: _Stream, allowance: Allowance) -> Iterator[Part | str]:
    data, end = content[stream.begin : stream.end], stream.end
    for position, name in enumerate(stream.filters or (b"",)):
        match name:
            case b"FlateDecode" | b"Fl" | b"":
                if not name and data[:1] != b"x":
                    break
                unpacking = Unpacking([data], zlib.decompressobj(), allowance)
                data = b"".join(unpacking)
                end = stream.begin + unpacking.used if position == 0 else end
            case b"ASCII85Decode" | b"A85":
                coded, mark, _ = data.partition(b"~>")
                end = stream.begin + len(coded + mark) if position == 0 else end
                data = base64.a85decode(coded.strip().removeprefix(b"<~"))
            case b"ASCIIHexDecode" | b"AHx":
                coded, mark, _ = data.partition(b">")
                end = stream.begin + len(coded + mark) if position == 0 else end
                data = binascii.unhexlify(b"".join(coded.split()))
            case _ if name in PICTURES:
                is_jpeg = name in (b"DCTDecode", b"DCT")
                yield Part(stream.begin, end, stream.location, data if is_jpeg else None, is_file=is_jpeg)
                return
            case _:
                yield f"{stream.location}: data of {name.decode('latin-1')[:40]} cannot be read"
                return
    if stream.is_image:
        yield Part(stream.begin, end)
    else:
        yield Part(stream.begin, stream.end, stream.location, strings(data), is_all=False)
        yield Part(stream.begin, end, stream.location, data)


def strings(content: bytes) -> bytes:
    """Return the texts of all strings, with `\\r` between them. Letters of a list that a page shows are one text."""
    lines: list[bytes] = []
    joined: list[bytes] | None = None
    depth = begin = 0
    for number, token in enumerate(TOKEN.finditer(content)):
        if number >= MOST_TOKENS:
            raise ValueError("it has too many strings")
        text = None
        if token["open"]:
            begin = token.end() if depth == 0 else begin
            depth += 1
        elif token["close"] and depth:
            depth -= 1
            text = _literal(content[begin : token.start("close")]) if depth == 0 else None
        elif token["end"]:
            depth, joined = 0, None
        elif depth == 0 and token["hex"]:
            digits = b"".join(token["hex"].split())
            text = decoded(binascii.unhexlify(digits + b"0" * (len(digits) % 2)))
        elif depth == 0 and token["list"]:
            lines += [b"".join(joined)] if joined else []
            joined = [] if token["list"] == b"[" else None
        if text is not None and joined is None:
            lines.append(text)
        elif text is not None and joined is not None:
            joined += [text, b" "] if _number(token["kern"] or token["hexkern"]) < SPACE else [text]
    return b"\r".join([*lines, b"".join(joined or [])])


def _number(text: bytes | None) -> float:
    try:
        return float(text or 0)
    except ValueError:
        return 0


def _literal(content: bytes) -> bytes:
    def escaped(match: object) -> bytes:
        text: bytes = match[1]  # type: ignore[index]
        return bytes([int(text, 8) & 255]) if text[:1].isdigit() and text < b"8" else ESCAPES.get(text, text)

    return decoded(ESCAPE.sub(escaped, content) if b"\\" in content else content)


def decoded(text: bytes) -> bytes:
    """Return a string of a PDF as UTF-8 if it is UTF-16, with or without a mark, and as it is otherwise."""
    if text[:2] in (b"\xfe\xff", b"\xff\xfe"):
        return text.decode("utf-16", "replace").encode("utf-8", "replace")
    if text and len(text) % 2 == 0 and text[::2].count(0) * 4 >= len(text):
        return text.decode("utf-16-be", "replace").encode("utf-8", "replace")
    return text
