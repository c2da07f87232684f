"""XML documents, and what ElementTree, minidom and SAX read from them."""

from __future__ import annotations

import xml.dom.minidom
import xml.sax
import xml.sax.handler
from collections.abc import Hashable
from xml.etree import ElementTree

from hypothesis import strategies as st

from tests.written_values.claim import Document, Reader, Values, check

REFUSED = (
    "would be read as another one|has text beside child elements|has the reference|declares the entity"
    "|save (it|the template) as UTF-8|too large|too close to 0"
)
ENCODINGS = {
    "utf-8": b"",
    "utf-8-sig": b"\xef\xbb\xbf",
    "utf-16": b"\xff\xfe",
    "iso-8859-1": b"",
    "us-ascii": b"",
    "cp1252": b"",
}
NAMES = st.sampled_from(["a", "b", "p:c", "q:d", "Größe"])
CHARACTERS = st.sampled_from("ab15 .<>&\"'\n\t\ré€𝄞]}-") | st.characters(
    codec="utf-8", exclude_categories=["Cc", "Cs"], exclude_characters="\ufffe\uffff"
)
TEXTS = st.text(CHARACTERS, max_size=6) | st.sampled_from(["5", "0.5", "]]>", "&amp;", " ", "\r\n", ""])
BLANKS = st.sampled_from(["", " ", "\n  ", "\t", "\r\n"])


@st.composite
def escaped(draw: st.DrawFn, special: str) -> str:
    """Draw a text in which each character is written in one of the ways that XML has."""
    pieces = []
    for character in draw(TEXTS):
        ways = [character] if character not in special else []
        pieces.append(draw(st.sampled_from([*ways, f"&#{ord(character)};", f"&#x{ord(character):x};"])))
    return "".join(pieces)


BETWEEN = st.sampled_from(["<!-- 5 <a b='1'> & -->", "<?p <x> 5?>", "<!---->", "<?p?>"])
CDATA = TEXTS.filter(lambda text: "]]>" not in text).map(lambda text: f"<![CDATA[{text}]]>")


@st.composite
def elements(draw: st.DrawFn, depth: int) -> str:
    name, attributes = draw(NAMES), []
    for attribute in draw(st.lists(st.sampled_from(["x", "y", "p:x", "q:y", "xml:space", "xmlns"]), max_size=2, unique=True)):
        quote = draw(st.sampled_from("'\""))
        fixed = {"xml:space": "preserve", "xmlns": "urn:d"}.get(attribute)
        value = fixed or draw(escaped(f"<&\r\n\t{quote}"))
        attributes.append(f"{draw(BLANKS) or ' '}{attribute}{draw(BLANKS)}={draw(BLANKS)}{quote}{value}{quote}")
    tag = name + "".join(attributes) + draw(BLANKS)
    text = st.one_of(BETWEEN, CDATA, escaped("<&>\r"), BLANKS)
    content = draw(
        st.lists(text if draw(st.booleans()) or not depth else st.one_of(elements(depth - 1), BLANKS, BETWEEN), max_size=4)
    )
    return f"<{tag}>{''.join(content)}</{name}{draw(BLANKS)}>" if content or draw(st.booleans()) else f"<{tag}/>"


BEGINNINGS = st.sampled_from(
    [
        "",
        "<!DOCTYPE w>",
        "<!-- <w>5</w> -->\n<?p 5?>",
        '<!DOCTYPE w [<!ATTLIST a x NMTOKENS #IMPLIED y CDATA "5">]>',
        '<!DOCTYPE w SYSTEM "none.dtd" [<!ELEMENT w ANY>]>',
        '<!DOCTYPE w [<!ENTITY five "5">]>',
    ]
)


@st.composite
def documents(draw: st.DrawFn) -> Document:
    encoding = draw(st.sampled_from(list(ENCODINGS)))
    codec = {"utf-16": "utf-16-le", "utf-8-sig": "utf-8"}.get(encoding, encoding)
    declared = {"cp1252": "windows-1252"}.get(encoding, encoding.removesuffix("-sig"))
    content = "".join(draw(st.lists(elements(2) | BETWEEN, max_size=3)))
    begin = f"<?xml version='1.0' encoding='{declared}'?>{draw(BLANKS)}{draw(BEGINNINGS)}"
    text = f"{begin}<w xmlns:p='urn:p' xmlns:q=\"urn:q\">{content}<a x='5'>5</a></w>{draw(BLANKS)}<!-- end -->"
    text = "".join(one for one in text if one.encode(codec, "ignore").decode(codec) == one)
    return Document("xml", ENCODINGS[encoding] + text.encode(codec), tuple(f"(//*)[{n}]" for n in (2, 3, 4)))


def by_elementtree(data: bytes) -> Values:
    found: dict[Hashable, object] = {}
    for number, element in enumerate(ElementTree.fromstring(data).iter()):  # noqa: S314
        found[number, "tag"] = element.tag
        found.update({(number, name): value for name, value in element.attrib.items()})
        for place, text in enumerate([element.text, *(child.tail for child in element)]):
            found[number, place] = text or ""
    return found


def by_minidom(data: bytes) -> Values:
    found: dict[Hashable, object] = {}
    for number, element in enumerate(xml.dom.minidom.parseString(data).getElementsByTagName("*")):  # noqa: S318
        found[number, "tag"] = element.tagName
        for name, value in element.attributes.items():
            found[number, name] = value
        place = 0
        found[number, place] = ""
        for child in element.childNodes:
            if child.nodeType in (child.TEXT_NODE, child.CDATA_SECTION_NODE):
                found[number, place] = f"{found[number, place]}{child.data}"
            elif child.nodeType == child.ELEMENT_NODE:
                place += 1
                found[number, place] = ""
            else:
                found[number, place, "other", len(found)] = child.toxml()
    return found


class _Handler(xml.sax.handler.ContentHandler):
    def __init__(self) -> None:
        self.found: dict[Hashable, object] = {}
        self.open: list[list[int]] = []
        self.count = 0

    def startElement(self, name: str, attrs: xml.sax.xmlreader.AttributesImpl) -> None:
        if self.open:
            self.open[-1][1] += 1
            self.found[tuple(self.open[-1])] = ""
        self.open.append([self.count, 0])
        self.found[self.count, "tag"] = name
        self.found.update({(self.count, key): value for key, value in attrs.items()})
        self.found[self.count, 0] = ""
        self.count += 1

    def characters(self, content: str) -> None:
        self.found[tuple(self.open[-1])] = f"{self.found[tuple(self.open[-1])]}{content}"

    def endElement(self, name: str) -> None:
        self.open.pop()


def by_sax(data: bytes) -> Values:
    handler = _Handler()
    xml.sax.parseString(data, handler)  # noqa: S317
    return handler.found


READERS: dict[str, Reader] = {"ElementTree": by_elementtree, "minidom": by_minidom, "SAX": by_sax}
STRATEGIES = (documents(), st.integers(0, 1000), TEXTS)


def claim(document: Document, choice: int, value: str) -> None:
    """Check that all readers of XML read a value that was set."""
    check(document, choice, value, READERS, REFUSED)
