"""The texts in pictures and videos: PNG, JPEG, Exif, and the boxes of MP4 and QuickTime (ISO/IEC 14496-12).

Pixels, also those of videos, are compressed, and are not searched. Data count as pixels only if they are: those of a PNG must
unpack to their end, and those of a video belong to tracks that are all video or sound. In those of JPEG and of videos, which
nothing here can unpack, long readable texts are searched.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import IO

from sierra.packages.anonymity.file_parts import (
    LARGEST_TEXT,
    Allowance,
    Part,
    Unpacking,
    at,
    blocks,
    length,
    long_texts,
    readable,
    texts,
    whole,
)

LARGEST_JPEG = 64 << 20
NO_LENGTH = (0x01, *range(0xD0, 0xD9))
"""The markers of JPEG that are alone: TEM, RST0 to RST7, SOI."""
SOS, EOI, COMMENT, APP1 = 0xDA, 0xD9, 0xFE, 0xE1
EXIF = b"Exif\0\0"
TAGS = {
    **{0x10E: "ImageDescription", 0x10F: "Make", 0x110: "Model", 0x131: "Software", 0x13B: "Artist", 0x13C: "HostComputer"},
    **{0x8298: "Copyright", 0x9286: "UserComment", 0x9C9B: "XPTitle", 0x9C9C: "XPComment", 0x9C9D: "XPAuthor"},
    **{0xA430: "CameraOwnerName", 0xA420: "ImageUniqueID"},
}
"""Names of fields of Exif; others are shown by their numbers."""
FOLDERS = (0x8769, 0x8825, 0xA005)
"""The fields of Exif that lead to other folders."""
UTF_16 = range(0x9C9B, 0x9CA0)
MOST_FOLDERS = 64
BYTES, ASCII, UNDEFINED = 1, 2, 7
FIRST = frozenset((b"ftyp", b"moov", b"mdat", b"wide", b"pnot"))
"""The first boxes of videos."""
CONTAINERS = frozenset(b"moov trak mdia minf stbl udta meta ilst moof traf edts dinf".split())
METADATA = frozenset((b"udta", b"meta", b"ilst"))
"""Boxes in which all boxes have texts."""
WITH_TEXT = frozenset(b"free skip uuid hdlr name titl auth cprt".split())
WITHOUT_TEXT = frozenset((b"vide", b"soun", b"mdir", b"mdta", b"ID32", b"hint", b"alis", b"url "))
"""The kinds of tracks, and of metadata, whose data in `mdat` are no text."""
DEEPEST_BOX = 16
MOST_BOXES = 100_000


def png(stream: IO[bytes], allowance: Allowance) -> Iterator[Part]:
    """Yield the texts and pixels of a PNG."""
    end, begin, kind = length(stream), 8, b""
    pixels: list[list[tuple[int, int]]] = []
    while begin < end and kind != b"IEND":
        count, kind = struct.unpack(">I4s", at(stream, begin, 8))
        data = (begin + 8, begin + 8 + count)
        if data[1] + 4 > end:
            raise EOFError(f"its chunk {readable(kind)} is cut off")
        if kind == b"fcTL" or (kind in (b"IDAT", b"fdAT") and not pixels):
            pixels.append([])
        if kind in (b"IDAT", b"fdAT"):
            pixels[-1].append((data[0] + 4 * (kind == b"fdAT"), data[1]))
        elif kind in (b"tEXt", b"zTXt", b"iTXt", b"eXIf", b"iCCP"):
            yield from _png_text(kind, at(stream, data[0], count), data, allowance)
        begin = data[1] + 4
    for ranges in filter(None, pixels):
        picture = Unpacking(
            (block for low, high in ranges for block in blocks(stream, low, high)), zlib.decompressobj(), allowance
        )
        for _ in picture:
            pass
        if picture.used < sum(high - low for low, high in ranges):
            raise ValueError("it has more data than pixels")
        yield from (Part(low, high) for low, high in ranges)


def _png_text(kind: bytes, content: bytes, data: tuple[int, int], allowance: Allowance) -> Iterator[Part]:
    """Yield the keyword and the text of a chunk."""
    location = f"{kind.decode()} chunk"
    if kind == b"eXIf":
        yield from exif(content, data, location)
        return
    keyword, _, rest = content.partition(b"\0")
    location += f' "{readable(keyword)}"'
    if kind == b"iTXt":
        is_packed, (language, translated, text) = rest[:1] == b"\1", (rest[2:].split(b"\0", 2) + [b""] * 3)[:3]
        keyword = b"\n".join((keyword, language, translated))
    else:
        is_packed, text = kind != b"tEXt", rest[kind != b"tEXt" :]
    yield Part(*data, location, keyword, is_all=False)
    if is_packed:
        unpacking = Unpacking([text], zlib.decompressobj(), allowance)
        unpacked = b"".join(unpacking)
        yield Part(data[0], data[1] - len(text) + unpacking.used, location, unpacked)
    else:
        yield Part(*data, location, text)


def jpeg(stream: IO[bytes], allowance: Allowance) -> Iterator[Part]:
    """Yield the segments and the scans of a JPEG."""
    content = whole(stream, LARGEST_JPEG)
    begin = 2
    while begin + 4 <= len(content):
        if content[begin] != 0xFF:
            raise ValueError(f"it has no segment at byte {begin}")
        marker = content[begin + 1]
        if marker == EOI:
            return
        if marker == 0xFF or marker in NO_LENGTH:
            begin += 1 if marker == 0xFF else 2
            continue
        data = (begin + 4, begin + 2 + int.from_bytes(content[begin + 2 : begin + 4], "big"))
        if not data[0] <= data[1] <= len(content):
            raise EOFError("a segment is cut off")
        yield from _jpeg_segment(marker, content[data[0] : data[1]], data)
        begin = data[1]
        if marker == SOS:
            begin = _end_of_scan(content, begin)
            yield Part(data[1], begin, "pixels", long_texts([content[data[1] : begin]]))
    if content[-2:] != b"\xff\xd9":
        raise EOFError("it is cut off")


def _jpeg_segment(marker: int, content: bytes, data: tuple[int, int]) -> Iterator[Part]:
    if marker == COMMENT:
        yield Part(*data, "comment", content)
    elif marker == APP1 and content.startswith(EXIF):
        yield from exif(content[len(EXIF) :], data, "Exif")
    elif 0xE0 <= marker <= 0xEF:
        name = "XMP" if b"ns.adobe.com/x" in content[:40] else f"segment APP{marker - 0xE0}"
        yield Part(*data, name, content.replace(b"\0", b"\r") if name == "XMP" else content)


def _end_of_scan(content: bytes, begin: int) -> int:
    """Return the offset of the first marker after compressed pixels."""
    while (begin := content.find(b"\xff", begin)) != -1 and begin + 1 < len(content):
        if content[begin + 1] not in (0, 0xFF, *range(0xD0, 0xD8)):
            return begin
        begin += 1 if content[begin + 1] == 0xFF else 2
    raise EOFError("its pixels are cut off")


def exif(content: bytes, data: tuple[int, int], location: str) -> Iterator[Part]:
    """Yield the texts of Exif, which has the form of TIFF."""
    order = {b"II": "<", b"MM": ">"}.get(content[:2])
    offsets = list(struct.unpack(f"{order}I", content[4:8])) if order and len(content) >= 8 else []
    known: set[int] = set()
    while offsets and len(known) < MOST_FOLDERS:
        offset = offsets.pop()
        if offset in known or offset + 2 > len(content):
            continue
        known.add(offset)
        (count,) = struct.unpack(f"{order}H", content[offset : offset + 2])
        fields = content[offset + 2 : offset + 2 + 12 * count]
        for tag, kind, size, value in struct.iter_unpack(f"{order}HHI4s", fields[: len(fields) // 12 * 12]):
            (pointer,) = struct.unpack(f"{order}I", value)
            if tag in FOLDERS:
                offsets.append(pointer)
            elif kind in (BYTES, ASCII, UNDEFINED):
                text = value[:size] if size <= 4 else content[pointer : pointer + size]
                name = TAGS.get(tag, f"field 0x{tag:04X}")
                yield Part(*data, f"{location}, {name}", _exif_text(tag, text), is_all=False)
        following = content[offset + 2 + 12 * count : offset + 6 + 12 * count]
        offsets += struct.unpack(f"{order}I", following) if len(following) == 4 else ()


def _exif_text(tag: int, text: bytes) -> bytes:
    if tag in UTF_16:
        return text.decode("utf-16-le", "replace").encode()
    return text.strip(b"\0").replace(b"\0", b"\r")


def mp4(stream: IO[bytes], allowance: Allowance) -> Iterator[Part]:
    """Yield the texts in the boxes of a video, and its frames."""
    frames: list[tuple[int, int]] = []
    kinds: set[bytes] = set()
    names: set[bytes] = set()
    for number, (path, begin, end) in enumerate(_boxes(stream, 0, length(stream), ())):
        if number >= MOST_BOXES:
            raise ValueError(f"it has more than {MOST_BOXES:,} boxes")
        names.add(path[-1])
        if path == (b"mdat",):
            frames.append((begin, end))
            continue
        if path[-1] == b"hdlr":
            kinds.add(at(stream, begin, min(end - begin, 12))[8:12])
        if (path[-1] in WITH_TEXT or METADATA & set(path)) and end - begin <= LARGEST_TEXT:
            yield from _box_text(at(stream, begin, end - begin), path, begin, end)
    if frames and b"moov" not in names:
        raise ValueError("it describes no tracks")
    if kinds <= WITHOUT_TEXT:
        yield from (Part(*frame, "frames", long_texts(blocks(stream, *frame))) for frame in frames)


def _boxes(stream: IO[bytes], begin: int, end: int, above: tuple[bytes, ...]) -> Iterator[tuple[tuple[bytes, ...], int, int]]:
    """Yield the names of each box with those above it, and the range of its content. A container comes before its boxes."""
    while begin + 8 <= end:
        count, name = struct.unpack(">I4s", at(stream, begin, 8))
        low = begin + 8
        if count == 1:
            count, low = int.from_bytes(at(stream, low, 8), "big"), low + 8
        high = begin + count if count else end
        path = (*above, name)
        if not low <= high <= end:
            if name == b"\0\0\0\0" or METADATA & set(above):
                return  # the end of a list in QuickTime, or text of its own form; it is searched as bytes
            raise ValueError(f"its box {_named(path)} has a wrong size")
        is_metadata = b"ilst" in above
        if (name in CONTAINERS or is_metadata) and len(path) <= DEEPEST_BOX and high - low >= 8 and name != b"data":
            yield path, low, low
            yield from _boxes(stream, low + 4 * (name == b"meta" and at(stream, low + 4, 4) != b"hdlr"), high, path)
        else:
            yield path, low, high
        begin = high


def _box_text(content: bytes, path: tuple[bytes, ...], begin: int, end: int) -> Iterator[Part]:
    picture = content[8:]
    if path[-1] == b"data" and picture.startswith((b"\x89PNG", b"\xff\xd8\xff")):
        yield Part(begin, end, f"box {_named(path)}", picture, is_file=True)
    elif content:
        yield Part(begin, end, f"box {_named(path)}", texts(content), is_all=False)


def _named(path: tuple[bytes, ...]) -> str:
    return "/".join(map(readable, path))
