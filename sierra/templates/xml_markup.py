"""The places of the markup of an XML document in its text, and how values are written and read there.

lxml does not report places. The expressions here find them in a document that lxml has read, and so is well-formed.
`sierra.templates.xml_scan` compares all that they find with what lxml has read.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from typing import NamedTuple

from sierra.errors import TemplateError
from sierra.util.lazy_definitions import dataclass, regex

_MARKS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))
_UNMARKED = ((b"<\0", "utf-16-le"), (b"\0<", "utf-16-be"))
_PIECEWISE = ("utf-8", "utf-16-le", "utf-16-be", "ascii", "iso8859-1", "iso8859-15", "cp1252")
"""Encodings that all libraries read alike, and in which the bytes of a text are the bytes of its pieces."""
_SKIPPED = r"<!--.*?-->|<\?.*?\?>"
_QUOTED = r""" "[^"]*+" | '[^']*+' """
_MARKUP = regex(
    rf"""{_SKIPPED} | (?P<cdata> <!\[CDATA\[.*?\]\]> )
    | (?P<doctype> <!DOCTYPE (?: [^\[\]<>"']++ | {_QUOTED} | \[ (?: {_SKIPPED} | {_QUOTED} | [^\]"'] )*+ \] )*+ > )
    | (?P<tag> <[^!?] (?: [^<>"']++ | {_QUOTED} )*+ > )
    | (?P<reference> &(?!(?:lt|gt|amp|quot|apos);|\#) [^;\s<&]++ ; )""",
    re.DOTALL | re.VERBOSE,
)
"""The markup of a document that is known to be well-formed; also references to entities that an external DTD may define."""
_ENTITY = regex(rf"{_SKIPPED} | {_QUOTED} | <!ENTITY\s+(?P<name>(?:%\s+)?[^\s]+)", re.DOTALL | re.VERBOSE)
_NAME = regex(r"[^ \t\r\n/>=]+")
_ATTRIBUTE = regex(r"""[ \t\r\n]+([^ \t\r\n=/>]+)[ \t\r\n]*=[ \t\r\n]*(?:"([^"]*)"|'([^']*)')""")
_CDATA = regex(r"<!\[CDATA\[(.*?)\]\]>", re.DOTALL)
_REFERENCE = regex(r"&(?:#x([0-9a-fA-F]+)|#([0-9]+)|([^;]+));")
_PREDEFINED = {"lt": "<", "gt": ">", "amp": "&", "quot": '"', "apos": "'"}
_IN_TEXT = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", "\r": "&#13;"})
_IN_ATTRIBUTE = _IN_TEXT | str.maketrans({"\n": "&#10;", "\t": "&#9;"})
_ESCAPES = {
    "": _IN_TEXT,
    '"': _IN_ATTRIBUTE | str.maketrans({'"': "&quot;"}),
    "'": _IN_ATTRIBUTE | str.maketrans({"'": "&apos;"}),
}
"""Escapes in a text, and within each kind of quotes."""


@dataclass(frozen=True, slots=True)
class EncodedText:
    """The text of a document, and how it is encoded."""

    name: str
    mark: bytes
    """The byte order mark, if any."""
    text: str
    codec: str
    piecewise: bool
    """True if pieces of the text can be encoded one by one, and are read as they were written."""
    crlf: bool
    """True if all lines end with CRLF."""
    has_types: bool
    """True if the doctype declares attributes: their types may change how values are read."""

    def encoded(self, text: str) -> bytes:
        """Return XML as bytes. Characters that the encoding lacks become references; names and comments must not have any."""
        return text.encode(self.codec, "xmlcharrefreplace")

    def lacks(self, text: str) -> bool:
        """Return True if the encoding lacks characters of a text, or changes them: EUC-JP writes a yen sign as a backslash."""
        try:
            return text.encode(self.codec).decode(self.codec) != text
        except UnicodeError:
            return True

    def escaped(self, text: str, quote: str = "") -> str:
        """Return a value as it is written in a text, or within quotes."""
        written = self.with_references(text.translate(_ESCAPES[quote]))
        return self.with_line_ends(written) if not quote else written

    def with_references(self, xml: str) -> str:
        """Return XML with references in place of characters that the encoding lacks or changes; names must not have any."""
        if xml.isascii() or not self.lacks(xml):
            return xml
        return "".join(f"&#{ord(character)};" if self.lacks(character) else character for character in xml)

    def with_line_ends(self, xml: str) -> str:
        """Return XML with the line ends of the document."""
        return xml.replace("\n", "\r\n") if self.crlf else xml


def read_source(data: bytes, encoding: str | None, name: str) -> EncodedText:
    """Return the text of a document. Raises TemplateError for declared entities, or if text and bytes do not convert."""
    mark, codec = next(((m, c) for m, c in _MARKS if data.startswith(m)), (b"", ""))
    codec = codec or next((c for start, c in _UNMARKED if data.startswith(start)), encoding or "utf-8")
    try:
        text = data.removeprefix(mark).decode(codec)
        same = mark + text.encode(codec) == data and "\0" not in text  # NUL characters appear when UTF-32 is read as UTF-16
    except (LookupError, UnicodeError):
        same = False
    if not same:
        raise unreadable(name, codec)
    doctype = next((match["doctype"] for match in _MARKUP.finditer(text) if match["doctype"] or match["tag"]), None) or ""
    _refuse_entities(doctype, name)
    crlf = "\r\n" in text and not re.search(r"\r(?!\n)|(?<!\r)\n", text)
    return EncodedText(name, mark, text, codec, codecs.lookup(codec).name in _PIECEWISE, crlf, "<!ATTLIST" in doctype)


def unreadable(name: str, codec: str) -> TemplateError:
    return TemplateError(f"{name}: cannot be written in its encoding {codec}; save it as UTF-8")


def _refuse_entities(doctype: str, name: str) -> None:
    for match in _ENTITY.finditer(doctype):
        if match["name"]:
            raise TemplateError(
                f"{name}: declares the entity {match['name']!r}; write its text instead: SIERRA does not expand entities"
            )


@dataclass(slots=True, eq=False)
class Mark:
    """The places of one node of a document: an element, a comment, a processing instruction or a reference."""

    start: int
    inner: int
    """The end of the start tag."""
    text_end: int
    """The end of the text before the first child."""
    close: int
    """The start of the end tag."""
    end: int
    tail_end: int
    """The end of the text after the node."""

    @property
    def empty(self) -> bool:
        """Return True for an element without an end tag, and for a node that is no element."""
        return self.inner == self.end


def marks(text: str) -> list[Mark]:
    """Return the marks of the root element and all that is in it, in the order of the document."""
    in_order: list[Mark] = []
    around: list[Mark] = []
    in_text = False
    last: Mark | None = None
    for match in _MARKUP.finditer(text):
        kind = match.lastgroup
        if kind in ("cdata", "doctype") or (not around and (in_order or kind != "tag")):
            continue
        start, end = match.span()
        if last and in_text:
            last.text_end = start
        elif last:
            last.tail_end = start
        if kind == "tag" and text[start + 1] == "/":
            if not around:
                return []
            last, in_text = around.pop(), False
            last.close, last.end, last.tail_end = start, end, end
            continue
        last = Mark(start, end, end, end, end, end)
        in_order.append(last)
        in_text = kind == "tag" and text[end - 2] != "/"
        if in_text:
            around.append(last)
    return in_order


class Attribute(NamedTuple):
    """An attribute in a start tag; there may be very many."""

    start: int
    """The start of the white space before the name."""
    name: str
    begin: int
    """The start of the value, within the quotes."""
    end: int
    """The end of the value."""

    @property
    def declares(self) -> bool:
        """Return True if it declares a namespace."""
        return self.name == "xmlns" or self.name.startswith("xmlns:")


def attributes(text: str, start: int, end: int) -> Iterator[Attribute]:
    """Yield the attributes of the start tag in a span."""
    for match in _ATTRIBUTE.finditer(text, start + 1, end):
        yield Attribute(match.start(), match[1], match.end() - 1 - len(match[2] or match[3] or ""), match.end() - 1)


def name_in(text: str, tag: int) -> str:
    """Return the name in a start or end tag."""
    match = _NAME.match(text, tag + (2 if text[tag + 1] == "/" else 1))
    return match[0] if match else ""


def tag_end(text: str) -> int:
    """Return the end of the first tag of a text that begins with it."""
    match = _MARKUP.match(text)
    return match.end() if match else len(text)


def decoded(raw: str, *, quoted: bool) -> str | None:
    """Return the value of a written text or attribute; None if it has references that only an external DTD may define."""
    if "\r" in raw:
        raw = raw.replace("\r\n", "\n").replace("\r", "\n")
    if quoted:
        return _resolved(raw.replace("\n", " ").replace("\t", " "))
    if "<" not in raw:
        return _resolved(raw)
    pieces = [piece if number % 2 else _resolved(piece) for number, piece in enumerate(_CDATA.split(raw))]
    return None if None in pieces else "".join(piece or "" for piece in pieces)


def _resolved(raw: str) -> str | None:
    if "&" not in raw:
        return raw
    known = all(match[3] in _PREDEFINED for match in _REFERENCE.finditer(raw) if match[3])
    return _REFERENCE.sub(_character, raw) if known else None


def _character(reference: re.Match[str]) -> str:
    if reference[3]:
        return _PREDEFINED[reference[3]]
    return chr(int(reference[1], 16) if reference[1] else int(reference[2]))
