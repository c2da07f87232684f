"""Texts in base64 within other texts: as of pictures in reports and notebooks, of e-mail, and of tokens.

Every run of at least 16 letters of base64 is decoded, at each of the four offsets at which a text in it may begin. Few of these
runs are base64, and their bytes have short words by chance. So they are sorted: files, texts, and all others.
"""

from __future__ import annotations

import binascii
import re
from collections.abc import Iterator
from typing import NamedTuple

from sierra.util.lazy_definitions import regex

RUN = regex(rb"[A-Za-z0-9+/_-]{16,}(?:(?:\r?\n[ \t]*|\\r\\n|\\n)[A-Za-z0-9+/_-]+)*={0,2}")
"""Letters of base64, also on several lines, and with the line ends that JSON escapes."""
BREAK = regex(rb"\\r\\n|\\n|\s+")
DIGITS = regex(rb"[0-9a-f]*")
"""Hashes, which are long lists in packages: no text in base64 has these letters only."""
FILES = (
    *(
        b"\x89PNG\r\n",
        b"\xff\xd8\xff",
        b"%PDF-",
        b"PK\x03\x04",
        b"\x1f\x8b\x08",
        b"BZh91AY&SY",
        b"\xfd7zXZ\0",
        b"\x28\xb5\x2f\xfd",
    ),
    *(b"PAR1", b"ARROW1"),
)
"""The first bytes of files that are opened."""
STANDARD = bytes.maketrans(b"-_", b"+/")
OFFSETS = 4


class Decoded(NamedTuple):
    """The bytes that a run of base64 stands for."""

    begin: int
    """The offset of the run."""
    content: bytes
    is_file: bool
    is_text: bool


def decoded(content: bytes) -> Iterator[Decoded]:
    """Yield the contents of all runs of base64 in a text."""
    for run in RUN.finditer(content):
        letters = BREAK.sub(b"", run[0]).rstrip(b"=").translate(STANDARD)
        if DIGITS.fullmatch(letters):
            continue
        for offset in range(OFFSETS):
            raw = _bytes(letters[offset:])
            is_file = offset == 0 and (raw.startswith(FILES) or raw[4:8] == b"ftyp")
            yield Decoded(run.start(), raw, is_file, not is_file and _is_text(raw))
            if is_file:
                break


def _bytes(letters: bytes) -> bytes:
    letters = letters[: len(letters) - (len(letters) % 4 == 1)]
    return binascii.a2b_base64(letters + b"=" * (-len(letters) % 4))


def _is_text(raw: bytes) -> bool:
    try:
        text = raw.decode()
    except UnicodeDecodeError:
        return False
    return re.search(r"[^\s\x20-\x7e\xa0-\U0010ffff]", text) is None
