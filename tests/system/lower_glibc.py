"""Make programs for a newer C library run with version 2.36, if they differ only in two names.

    lower_glibc.py FILE...

Since glibc 2.38, C23's strtol and strtoul are named __isoc23_strtol and __isoc23_strtoul, and differ only in reading binary
literals. In each file (ELF, 64 bits, little-endian) a needed symbol of such a name becomes the one without the prefix, of
the oldest version of the library, and the record of the newer version repeats that of 2.34. Files are changed in place; if a
file needs anything else of a newer library, no file is written. Format: the System V ABI, and the Linux Standard
Base on symbol versions (https://refspecs.linuxfoundation.org).
"""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import NamedTuple

FITS, OLDEST, REPEATED = (2, 36), "GLIBC_2.2.5", "GLIBC_2.34"
PREFIX, ALIASED = b"__isoc23_", (b"strtol", b"strtoul", b"strtoll", b"strtoull")
DYNSYM, VERNEED, VERSYM = 11, 0x6FFFFFFE, 0x6FFFFFFF


class Section(NamedTuple):
    kind: int
    offset: int
    size: int
    link: int
    count: int


class Version(NamedTuple):
    name: str
    record: int
    """The offset in the file."""
    hash: int
    text: int


def lowered(data: bytearray) -> bool:
    """Change a file's bytes; return whether they changed. Raise ValueError if the file can't be changed."""
    if data[:6] != b"\x7fELF\x02\x01":
        raise ValueError("not a 64-bit little-endian ELF file")
    sections = _sections(data)
    found = {section.kind: section for section in sections}
    if VERNEED not in found:
        return False
    symbols, names = found[DYNSYM], sections[found[DYNSYM].link]
    versions = _versions(data, found[VERNEED], names)
    newer = {index for index, version in versions.items() if _number(version.name) > FITS}
    if not newer:
        return False
    oldest = next(index for index, version in versions.items() if version.name == OLDEST)
    repeated = next(version for version in versions.values() if version.name == REPEATED)
    for place in range(symbols.size // 24):
        at, symbol = found[VERSYM].offset + 2 * place, symbols.offset + 24 * place
        (index,) = struct.unpack_from("<H", data, at)
        if index & 0x7FFF in newer:
            (text,) = struct.unpack_from("<I", data, symbol)
            name = _text(data, names, text)
            if not name.startswith(PREFIX) or name.removeprefix(PREFIX) not in ALIASED:
                raise ValueError(f"needs {name.decode()} of {versions[index & 0x7FFF].name}")
            struct.pack_into("<I", data, symbol, text + len(PREFIX))
            struct.pack_into("<H", data, at, oldest)
    for index in newer:
        struct.pack_into("<I", data, versions[index].record, repeated.hash)
        struct.pack_into("<I", data, versions[index].record + 8, repeated.text)
    return True


def _sections(data: bytearray) -> list[Section]:
    (table,) = struct.unpack_from("<Q", data, 0x28)
    size, count = struct.unpack_from("<HH", data, 0x3A)
    read = (struct.unpack_from("<IIQQQQII", data, table + size * number) for number in range(count))
    return [Section(kind, offset, length, link, info) for _, kind, _, _, offset, length, link, info in read]


def _versions(data: bytearray, needed: Section, names: Section) -> dict[int, Version]:
    """Return the versions that a file needs, by the index that its symbols use."""
    found, at = {}, needed.offset
    for _ in range(needed.count):
        _, count, _, first, following = struct.unpack_from("<HHIII", data, at)
        record = at + first
        for _ in range(count):
            value, _, index, text, beyond = struct.unpack_from("<IHHII", data, record)
            found[index & 0x7FFF] = Version(_text(data, names, text).decode(), record, value, text)
            record += beyond
        at += following
    return found


def _text(data: bytearray, names: Section, place: int) -> bytes:
    begin = names.offset + place
    return bytes(data[begin : data.index(0, begin)])


def _number(name: str) -> tuple[int, ...]:
    library, _, number = name.partition("_")
    return tuple(int(part) for part in number.split(".")) if library == "GLIBC" and number[:1].isdigit() else (0,)


def main(paths: list[str]) -> int:
    changed = {}
    for path in paths:
        data = bytearray(Path(path).read_bytes())
        try:
            if lowered(data):
                changed[path] = data
        except (ValueError, struct.error, StopIteration, KeyError) as error:
            print(f"lower_glibc.py: {path}: {error}", file=sys.stderr)
            return 1
    for path, data in changed.items():
        Path(path).write_bytes(data)
        print(f"{path}: lowered")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
