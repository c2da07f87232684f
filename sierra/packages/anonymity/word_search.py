"""Search bytes for identifying words in any case and spelling.

A word is searched as UTF-8 and Latin-1, as UTF-16 and UTF-32 where a content has NUL bytes, composed and decomposed, without
accents and with `ue` for `ü`, as JSON, XML and addresses escape it, and with other separators: `Jane Doe` is also found as
`jane_doe`, `JaneDoe` and `Doe, Jane`.

Words of up to four characters, and those that are marked so, count only where no letters are beside them, and no digits beside
a digit: `jane` is not found in `janes`, and `n701` not in `n7012`. Words of up to three characters count only where neither
letters nor digits are beside them, and in binary data only within longer readable text.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator
from html import escape
from itertools import permutations, product
from typing import NamedTuple, Protocol
from urllib.parse import quote

from sierra.packages.anonymity.identifying_words import Word
from sierra.util.lazy_definitions import regex

SEPARATORS = ("", " ", "_", "-", ".", "+", "%20", ", ", "\\ ")
WHOLE = 4
"""Words up to this number of characters count only where no letters are beside them."""
TINY = 3
"""Words up to this number of characters count in binary data only within readable text."""
READABLE = regex(r"[\x20-\x7e\t\r\n]{8,}")
RUN = 8
"""The number of characters of the shortest readable text in binary data."""
MARKS = (b"\xff\xfe", b"\xfe\xff", b"\0\0\xfe\xff")
"""The first bytes of texts in UTF-16 and UTF-32."""
CHUNK = 8 << 20
WIDTHS = {"utf-8": 1, "latin-1": 1, "utf-16-le": 2, "utf-16-be": 2, "utf-32-le": 4, "utf-32-be": 4}
"""The encodings in which a word is searched, and the bytes of one character of Latin letters."""
LETTERS = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "AE", "Ö": "OE", "Ü": "UE", "ß": "ss", "æ": "ae", "Æ": "AE", "å": "aa", "Å": "AA"}
    | {"ø": "oe", "Ø": "OE", "œ": "oe", "Œ": "OE", "þ": "th", "Þ": "TH", "ð": "d", "Ð": "D", "đ": "d", "Đ": "D"}
    | {"ł": "l", "Ł": "L", "’": "'"}
)
"""Letters as names in user names and addresses spell them: `Müller` as `mueller`."""
PARTS = 3
"""The largest number of parts of a word whose order and separators may differ."""


class Readable(Protocol):
    """A stream of bytes."""

    def read(self, count: int, /) -> bytes: ...


class Occurrence(NamedTuple):
    """A word in a content."""

    word: Word
    text: str
    """As it is in the content."""
    offset: int
    """In bytes, from 0."""
    line: int
    """From 1."""
    size: int
    """The number of its bytes."""


class _Needle(NamedTuple):
    text: bytes
    """In lower case, as far as it is ASCII."""
    word: Word
    whole: bool
    encoding: str
    core: bytes
    """A part of the text that several needles share, so that most contents need to be searched only for a few cores."""


class Search:
    """Words to search for, and texts in which they are accepted."""

    def __init__(self, words: Iterable[Word], accepted: Iterable[str] = ()) -> None:
        """`accepted`: texts; a word that is part of one of them, where it stands, is not reported."""
        needles: dict[bytes, _Needle] = {}
        for word in words:
            for form in _forms(word.text):
                whole = word.whole or len(form) <= WHOLE
                for encoding in _encodings(form):
                    text, core = (_lower(spelling.encode(encoding, "replace")) for spelling in (form, _core(form)))
                    needles.setdefault(text, _Needle(text, word, whole, encoding, core))
        self._narrow = _by_core(needle for needle in needles.values() if WIDTHS[needle.encoding] == 1)
        self._all = _by_core(needles.values())
        texts = {_lower(form.encode(code)) for text in accepted for form in _cased(text) for code in _encodings(form)}
        self._accepted = sorted(filter(None, texts))
        self._margin = 2 * max(map(len, (*needles, *self._accepted, b"")), default=0) + 64

    def stream(self, stream: Readable) -> Iterator[Occurrence]:
        """Yield all words in a stream from its position, in their order."""
        content, begin, base, line = b"", 0, 0, 1
        is_marked = None
        while True:
            block = stream.read(CHUNK)
            content += block
            end = max(begin, len(content) - self._margin) if block else len(content)
            counted = begin
            is_marked = content.startswith(MARKS) if is_marked is None else is_marked
            for offset, stop, word in self._places(content, is_marked=is_marked):
                if begin <= offset < end:
                    line += content.count(b"\n", counted, offset)
                    counted = offset
                    text = content[offset:stop].replace(b"\0", b"").decode("utf-8", "replace")
                    yield Occurrence(word, text, base + offset, line, stop - offset)
            if not block:
                return
            line += content.count(b"\n", counted, end)
            cut = max(0, end - self._margin)
            content, base, begin = content[cut:], base + cut, end - cut

    def text(self, text: str) -> list[Occurrence]:
        """Return the words in a text."""
        content = text.encode("utf-8", "surrogatepass")
        return [
            Occurrence(word, content[offset:stop].decode("utf-8", "replace"), offset, 1, stop - offset)
            for offset, stop, word in self._places(content)
        ]

    def _places(self, content: bytes, *, is_marked: bool = False) -> Iterator[tuple[int, int, Word]]:
        """Yield begin, end and word of each occurrence, in order; of overlapping ones, only the longest of the first.

        `is_marked`: the content is text in UTF-16 or UTF-32, and has NUL bytes as such.
        """
        lower = _lower(content)
        binary = b"\0" in content
        occurrences = [
            (offset, -len(needle.text), needle.word)
            for core, needles in (self._all if binary else self._narrow).items()
            if core in lower
            for needle in needles
            for offset in _offsets(lower, needle.text)
            if _counts(lower, offset, needle, binary=binary and not is_marked)
        ]
        last = 0
        for offset, size, word in sorted(occurrences, key=lambda occurrence: occurrence[:2]):
            stop = offset - size
            if offset >= last and not self._is_accepted(lower, offset, stop):
                yield offset, stop, word
                last = stop

    def _is_accepted(self, content: bytes, begin: int, end: int) -> bool:
        for text in self._accepted:
            low = max(0, end - len(text))
            at = content.find(text, low, begin + len(text))
            if at != -1 and at <= begin:
                return True
        return False


def _encodings(form: str) -> Iterator[str]:
    """Yield the encodings in which a text is searched. Latin-1 is UTF-8 for ASCII, and lacks other letters."""
    for encoding in WIDTHS:
        if encoding != "latin-1" or (not form.isascii() and max(form) <= "\xff"):
            yield encoding


def _by_core(needles: Iterable[_Needle]) -> dict[bytes, list[_Needle]]:
    """Return needles by the shortest core that is in their own one."""
    listed = list(needles)
    cores = sorted({needle.core for needle in listed}, key=len)
    grouped: dict[bytes, list[_Needle]] = {}
    for needle in listed:
        grouped.setdefault(next(core for core in cores if core in needle.core), []).append(needle)
    return grouped


def _core(form: str) -> str:
    """Return the longest run of ASCII letters and digits, or the whole text if it has none."""
    return max(re.findall("[A-Za-z0-9]+", form), key=len, default=form)


def _lower(content: bytes) -> bytes:
    return content.lower()


def _offsets(content: bytes, needle: bytes) -> Iterator[int]:
    at = content.find(needle)
    while at != -1:
        yield at
        at = content.find(needle, at + 1)


def _counts(content: bytes, offset: int, needle: _Needle, *, binary: bool) -> bool:
    end = offset + len(needle.text)
    width, is_tiny = WIDTHS[needle.encoding], len(needle.word.text) <= TINY
    if needle.whole:
        before, after = _before(content, offset, needle, is_tiny=is_tiny), _after(content, end, needle, is_tiny=is_tiny)
        first, last = ("0", "0") if is_tiny else (needle.word.text[0], needle.word.text[-1])
        if _continues(before, first) or _continues(after, last):
            return False
    if not binary or not is_tiny:
        return True
    low = offset - min(RUN, offset // width) * width
    text = content[low : end + RUN * width].decode("latin-1" if width == 1 else needle.encoding, "replace")
    begin, stop = (offset - low) // width, (end - low) // width
    return any(run.start() <= begin and stop <= run.end() for run in READABLE.finditer(text))


def _before(content: bytes, offset: int, needle: _Needle, *, is_tiny: bool) -> str:
    """Return the character before an offset, in the encoding of a needle; "" at the beginning.

    In UTF-8, only short words look at letters that are not ASCII.
    """
    width = WIDTHS[needle.encoding]
    if width > 1:
        return content[max(0, offset - width) : offset].decode(needle.encoding, "replace")
    if not is_tiny:
        return content[max(0, offset - 1) : offset].decode("ascii", "replace")
    return content[max(0, offset - 4) : offset].decode("utf-8", "replace")[-1:]


def _after(content: bytes, end: int, needle: _Needle, *, is_tiny: bool) -> str:
    """Return the character at an offset, as `_before` does."""
    width = WIDTHS[needle.encoding]
    if width > 1:
        return content[end : end + width].decode(needle.encoding, "replace")
    if not is_tiny:
        return content[end : end + 1].decode("ascii", "replace")
    return content[end : end + 4].decode("utf-8", "replace")[:1]


def _continues(beside: str, edge: str) -> bool:
    """Return whether a character beside a word makes it part of a longer one: a letter, or a digit beside a digit."""
    return beside.isalpha() or (beside.isdigit() and edge.isdigit())


def _forms(text: str) -> set[str]:
    """Return the spellings of a word, in lower and upper case of letters that are not ASCII."""
    parts = re.split(r"[\s,._-]+", text.strip())
    spelled = {text}
    if len(parts) > 1 and " " in text.strip():
        spelled |= {separator.join(parts) for separator in SEPARATORS}
        if len(parts) <= PARTS:
            spelled |= {separator.join(order) for order, separator in product(permutations(parts), SEPARATORS)}
    forms: set[str] = set()
    for spelling in spelled:
        for cased in _cased(spelling):
            spelled_out = unicodedata.normalize("NFC", cased).translate(LETTERS)
            forms |= {cased, *map(_plain, (cased, spelled_out)), _escaped(cased), quote(cased, safe="/:@"), escape(cased)}
            forms.add(cased.encode("ascii", "xmlcharrefreplace").decode())
            forms.add(cased.replace("/", "\\/"))
    return {form for form in forms if form}


def _cased(text: str) -> set[str]:
    return {unicodedata.normalize(form, spelling) for form in ("NFC", "NFD") for spelling in (text, text.lower(), text.upper())}


def _plain(text: str) -> str:
    """Return a text without accents."""
    return "".join(character for character in unicodedata.normalize("NFD", text) if not unicodedata.combining(character))


def _escaped(text: str) -> str:
    """Return a text as JSON escapes it."""
    return text.encode("ascii", "backslashreplace").decode().replace("\\x", "\\u00")
