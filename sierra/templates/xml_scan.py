"""An XML document with the place of every value in its text, shared by all documents that differ from it in values only.

**No single witness**: lxml reads the document, and `xml_markup` finds the places in its text. All values at these places must
be those that lxml has read; otherwise the document is refused.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import zip_longest

from lxml import etree

from sierra.errors import TemplateError
from sierra.templates.xml_markup import Attribute, Mark, attributes, decoded, marks, name_in, read_source, unreadable
from sierra.templates.xml_view import XML, Element, Place, View, differ, parse, parser
from sierra.util.lazy_definitions import dataclass, regex

_PLAIN = regex(r"[A-Za-z0-9_.,;:/+ -]*")
"""A text that is written as it is."""


@dataclass(frozen=True, slots=True)
class Spot:
    """The span of text that a value replaces, and the texts that are written around the value."""

    start: int
    end: int
    before: str = ""
    after: str = ""
    quote: str = ""


@dataclass(frozen=True, slots=True)
class Edit:
    """The text in a spot, and the value that it is read as; None for an attribute that does not exist yet."""

    spot: Spot
    token: str
    value: str | None


Edits = Mapping[Place, Edit]


class Unspliced(Exception):
    """A value that cannot be written without changing other parts of the document."""


class Shown:
    """Values that a view has for a while."""

    def __init__(self) -> None:
        self._before: dict[Place, str | None] = {}

    def show(self, location: Place, value: str) -> None:
        self._before.setdefault(location, location.exact())
        location.write(value)

    def restore(self) -> None:
        for location, value in self._before.items():
            location.write(value)


class Scan:
    """A parsed document with its view and its marks.

    A document that was made from a checked one is not checked at all places again (`check=False`): each set of places that is
    used is verified later.
    """

    def __init__(self, data: bytes, name: str, *, check: bool = True) -> None:
        tree = parse(data, name)
        self.source = read_source(data, tree.docinfo.encoding, name)
        self.view = View(copy.deepcopy(tree.getroot()), self.source)  # a copy, so that paths select nothing around the root
        self.nodes = list(self.view.root.iter())
        if "<![CDATA[]]>" in self.source.text:
            self._drop_empty_texts()
        self.marks: dict[Element, Mark] = dict(self._paired(marks(self.source.text), check))
        self._spots: dict[Place, Spot] = {}
        self._verified: set[frozenset[Place]] = set()

    def _drop_empty_texts(self) -> None:
        """Let paths select no text that is empty; lxml reads empty CDATA as one."""
        for node in self.nodes:
            if isinstance(node.tag, str) and node.text == "":
                node.text = None
            if node.tail == "":
                node.tail = None

    @contextmanager
    def showing(self, edits: Edits) -> Iterator[Shown]:
        """Let the view have other values for a while."""
        shown = Shown()
        try:
            for location, edit in edits.items():
                shown.show(location, edit.value or "")
            yield shown
        finally:
            shown.restore()

    def verify(self, rendered: bytes, places: frozenset[Place], values: Iterable[tuple[Place, str]]) -> None:
        """Check once for each set of places that rendered bytes are read as this document with these values.

        Check it each time if the doctype declares the types of attributes, or if libraries may read the encoding differently.
        Raises TemplateError.
        """
        if places in self._verified and self.source.piecewise and not self.source.has_types:
            return
        name = self.source.name
        shown = Shown()
        try:
            for location, value in values:
                shown.show(location, value)
            if differ(self.view.root, parse(rendered, name).getroot()):
                raise TemplateError(f"{name}: cannot be changed: a new value would be read as another one")
        finally:
            shown.restore()
        self._verified.add(places)

    def original(self, location: Place) -> Edit:
        """Return what the text has in a place, which the view shows now. Raises Unspliced."""
        spot = self._spots.get(location) or self._spots.setdefault(location, self._spot(location))
        return Edit(spot, self.source.text[spot.start : spot.end], location.read())

    def raw(self, location: Place) -> str:
        """Return a text as it is written in the file, whatever the view shows now."""
        mark = self.marks[location.element]
        span = (mark.inner, mark.text_end) if location.kind == "text" else (mark.end, mark.tail_end)
        return self.source.text[span[0] : span[1]]

    def written(self, spot: Spot, value: str, *, section: bool = False) -> Edit:
        """Return a value as it is written in a spot, or in a CDATA section there. Raises ValueError."""
        if section:
            return Edit(spot, self.section(value), value)
        return Edit(spot, spot.before + self.token(value, spot.quote) + spot.after, value)

    def token(self, value: str, quote: str = "") -> str:
        """Return a value as it is written in a text or within quotes. Raises ValueError if lxml would read another value."""
        token = self.source.escaped(value, quote)
        if not _PLAIN.fullmatch(value) and self._read(token, quote) != value:
            raise ValueError(f"{value[:40]!r} would be read as another text; save the template as UTF-8")
        return token

    def section(self, value: str) -> str:
        """Return a text as a CDATA section, or as a usual text if the section would be read as another text."""
        section = f"<![CDATA[{self.source.with_line_ends(value)}]]>"
        fits = "]]>" not in value and not self.source.lacks(value) and self._read(section, "") == value
        return section if fits else self.token(value)

    def _read(self, token: str, quote: str) -> str | None:
        """Return the value that lxml reads where a token is written; None if it reads none."""
        xml = f"<_ a={quote}{token}{quote}/>" if quote else f"<_>{token}</_>"
        encoding = None if self.source.piecewise else self.source.codec
        try:
            root = etree.fromstring(self.source.encoded(xml) if encoding else xml, parser(encoding))
        except (etree.XMLSyntaxError, ValueError):
            return None
        found: str | None = root.get("a") if quote else root.text or ""
        return found

    def attributes(self, element: Element) -> Iterator[tuple[str, Attribute]]:
        """Yield the attributes that are written in a start tag, with their names as `{uri}name`."""
        yield from self._named(element, self.marks[element])

    def last(self, element: Element) -> int:
        """Return the place after the last attribute of an element, or after its name."""
        mark, text = self.marks[element], self.source.text
        last = mark.start + len(name_in(text, mark.start))
        for attribute in attributes(text, mark.start, mark.inner):
            last = attribute.end
        return last + 1

    def _spot(self, location: Place) -> Spot:
        mark, text = self.marks[location.element], self.source.text
        match location.kind:
            case "tail":
                return Spot(mark.end, mark.tail_end)
            case "text" if mark.empty:
                return Spot(self.last(location.element), mark.end, ">", f"</{name_in(text, mark.start)}>")
            case "text":
                return Spot(mark.inner, mark.text_end)
        for name, attribute in self.attributes(location.element):
            if name == location.name:
                return Spot(attribute.begin, attribute.end, quote=text[attribute.end])
        name = self.qualified(location)
        last = self.last(location.element)
        return Spot(last, last, f' {name}="', '"', '"')

    def qualified(self, location: Place) -> str:
        """Return the name of a new attribute as it is written. Raises Unspliced if its namespace has no prefix there."""
        name = etree.QName(location.name)
        if not name.namespace:
            return str(name.localname)
        prefix = prefix_of(name.namespace, {**location.element.nsmap, "xml": XML})
        if prefix is None:
            raise Unspliced
        return f"{prefix}:{name.localname}"

    def _paired(self, found: list[Mark], check: bool) -> Iterator[tuple[Element, Mark]]:
        """Yield the nodes with their marks. Raises TemplateError if the values in the text are not those that lxml has read."""
        for node, mark in zip_longest(self.nodes, found):
            if node is None or mark is None or (check and not self._reads(node, mark)):
                raise unreadable(self.source.name, self.source.codec)
            yield node, mark

    def _reads(self, node: Element, mark: Mark) -> bool:
        text = self.source.text
        if node is not self.view.root and decoded(text[mark.end : mark.tail_end], quoted=False) != (node.tail or ""):
            return False
        if not isinstance(node.tag, str):
            return mark.empty and text.startswith(_BEGINNINGS[node.tag], mark.start)
        tag = etree.QName(node).localname if node.tag[0] == "{" else node.tag
        name = f"{node.prefix}:{tag}" if node.prefix else tag
        if name_in(text, mark.start) != name or not (mark.empty or name_in(text, mark.close) == name):
            return False
        if not mark.empty and decoded(text[mark.inner : mark.text_end], quoted=False) != (node.text or ""):
            return False
        return (not mark.empty or not node.text) and self._reads_attributes(node, mark)

    def _reads_attributes(self, node: Element, mark: Mark) -> bool:
        text, count = self.source.text, 0
        for name, attribute in self._named(node, mark):
            value, read = decoded(text[attribute.begin : attribute.end], quoted=True), node.get(name)
            if read is None or (value is not None and value != read and not self._is_typed(value, read)):
                return False
            count += 1
        return count == len(node.attrib)

    def _named(self, element: Element, mark: Mark) -> Iterator[tuple[str, Attribute]]:
        for attribute in attributes(self.source.text, mark.start, mark.inner):
            prefix, _, local = attribute.name.rpartition(":")
            if prefix and not attribute.declares:
                yield f"{{{XML if prefix == 'xml' else element.nsmap.get(prefix)}}}{local}", attribute
            elif not attribute.declares:
                yield local, attribute

    def _is_typed(self, value: str, read: str) -> bool:
        """Return True if the doctype may say that white space in a value does not count."""
        return self.source.has_types and value.split(" ") != read.split(" ") and value.split() == read.split(" ")


_BEGINNINGS = {etree.Comment: "<!--", etree.ProcessingInstruction: "<?", etree.Entity: "&"}


def prefix_of(uri: str, prefixes: Mapping[str | None, str | None]) -> str | None:
    """Return the first prefix of a namespace, in the order of the alphabet."""
    return min((prefix for prefix, other in prefixes.items() if other == uri and prefix), default=None)
