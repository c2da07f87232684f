"""Elements as lxml reads them: safe parsing, the paths that select them, and the places of their texts."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Literal, TypeAlias, TypeGuard

from lxml import etree

from sierra.errors import TemplateError
from sierra.model import Add, Change, Remove, Rename, Repeat, Set
from sierra.templates import xpath_time_limit
from sierra.templates.nearest_path import nearest
from sierra.templates.same_number import is_lost, same
from sierra.templates.xml_characters import illegal
from sierra.templates.xml_markup import EncodedText, decoded
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.text import one_line

Element: TypeAlias = etree._Element
Text: TypeAlias = etree._ElementUnicodeResult
"""A text or an attribute's value that a path selects; it knows its element."""
Node: TypeAlias = Element | Text
DEFAULT = "_"
"""The prefix that paths give to the document's default namespace."""
XML = "http://www.w3.org/XML/1998/namespace"
_BLANKS = " \t\r\n"
_SECTION = regex(r"\s*<!\[CDATA\[(?:(?!\]\]>).)*+\]\]>\s*", re.DOTALL)
"""A text that is one CDATA section."""


def parser(encoding: str | None = None) -> etree.XMLParser:
    return etree.XMLParser(
        encoding=encoding,
        resolve_entities=False,
        load_dtd=False,
        dtd_validation=False,
        attribute_defaults=False,
        no_network=True,
        huge_tree=False,
        strip_cdata=True,
        remove_blank_text=False,
    )


def parse(data: bytes, name: str) -> etree._ElementTree:
    """Return a parsed document; nothing but `data` is read. Raises TemplateError if it is not XML."""
    try:
        return etree.fromstring(data, parser()).getroottree()
    except etree.XMLSyntaxError as error:
        line, column = error.position
        raise TemplateError(f"{name}:{line}:{column}: not XML: {reason(error)}") from error


def reason(error: Exception) -> str:
    return re.sub(r", line \d+, column \d+.*$", "", one_line(getattr(error, "msg", None) or "the document is empty"))


def declarations(root: Element) -> dict[str, str]:
    """Return the namespaces of prefixes in paths: the first declaration of each prefix."""
    found: dict[str, str] = {}
    for _, (prefix, uri) in etree.iterwalk(root, events=("start-ns",)):
        if uri and prefix != "xml":
            found.setdefault(prefix or DEFAULT, uri)
    return found


def differ(element: Element, other: Element) -> bool:
    """Return True if two elements differ in their content: names, attributes, texts, comments and the rest in their order.

    Elements that lxml writes in the same way are the same. Others may differ in the writing only.
    """
    if etree.tostring(element, with_tail=False) == etree.tostring(other, with_tail=False):
        return False
    ours, theirs = list(element.iter()), list(other.iter())
    if len(ours) != len(theirs):
        return True
    for a, b in zip(ours, theirs, strict=True):
        if a.tag != b.tag or len(a) != len(b) or (a.text or "") != (b.text or ""):
            return True
        if a is not element and (a.tail or "") != (b.tail or ""):
            return True
        if isinstance(a.tag, str) and dict(a.attrib) != dict(b.attrib):
            return True
        if not isinstance(a.tag, str) and getattr(a, "target", None) != getattr(b, "target", None):
            return True
    return False


@dataclass(frozen=True, slots=True)
class Place:
    """The place of a text: an attribute, the beginning of an element, or the text after an element."""

    element: Element
    kind: Literal["attribute", "text", "tail"]
    name: str = ""
    """The name of an attribute, as `{uri}name`."""

    def read(self) -> str | None:
        """Return the text; None for an attribute that does not exist yet."""
        found: str | None = self.element.get(self.name) if self.kind == "attribute" else getattr(self.element, self.kind) or ""
        return found

    def exact(self) -> str | None:
        """Return what `write` restores; a text that is missing differs from an empty one."""
        found: str | None = self.element.get(self.name) if self.kind == "attribute" else getattr(self.element, self.kind)
        return found

    def write(self, text: str | None) -> None:
        """Write a text; paths select no text that is empty."""
        if self.kind != "attribute":
            setattr(self.element, self.kind, text or None)
        elif text is None:
            self.element.attrib.pop(self.name, None)
        else:
            self.element.set(self.name, text)


@dataclass(frozen=True, slots=True)
class Slot:
    """The places of one value: an attribute, or the texts that only comments and processing instructions separate."""

    places: tuple[Place, ...]
    main: int = 0
    """The index of the place where a value is written. The other texts become empty, because readers join all of them."""
    sections: frozenset[Place] = frozenset()
    """The places that keep their CDATA marks."""

    def keeps(self, was: Sequence[str | None], now: str) -> bool:
        """Return True if a new value spells the number of its places. Raises ValueError if programs would not read a number."""
        if None in was:
            return False
        value = "".join(text or "" for text in was)
        if why := is_lost(value, now):
            raise ValueError(f"the number {one_line(value)} cannot become {one_line(now)}; {why}")
        return same(value, now)

    def parts(self, value: str) -> Iterator[tuple[Place, str]]:
        """Yield what each place holds when a value is set."""
        for index, location in enumerate(self.places):
            yield location, value if index == self.main else ""


def place_of(node: Node) -> Place | None:
    """Return the place of a selected node's value; None for comments and processing instructions.

    Texts that only comments and processing instructions separate have one place: that of the first one.
    """
    if not is_text(node):
        return Place(node, "text") if isinstance(node.tag, str) else None
    if node.is_attribute:
        return Place(node.getparent(), "attribute", node.attrname)
    if not node.is_tail:
        return Place(node.getparent(), "text")
    before = node.getparent()
    while before.tag in _BETWEEN:
        if before.getprevious() is None:
            return Place(before.getparent(), "text")
        before = before.getprevious()
    return Place(before, "tail")


_BETWEEN = (etree.Comment, etree.ProcessingInstruction)


def texts_from(location: Place) -> Iterator[Place]:
    """Yield a place and the places of the texts that only comments and processing instructions separate from it."""
    yield location
    if location.kind == "attribute":
        return
    node = next(iter(location.element), None) if location.kind == "text" else location.element.getnext()
    while node is not None and node.tag in _BETWEEN:
        yield Place(node, "tail")
        node = node.getnext()


def _slot(places: tuple[Place, ...], written: Sequence[str]) -> Slot:
    """Return the texts of one value, as they are written in the file; the main one is the first that is not blank."""
    main = next((index for index, text in enumerate(written) if not _is_blank(text)), 0)
    sections = (location for location, text in zip(places, written, strict=True) if _SECTION.fullmatch(text))
    return Slot(places, main, frozenset(sections))


def _is_blank(written: str) -> bool:
    return not (decoded(written, quoted=False) or "").strip(_BLANKS)


def value_of(node: Node) -> str:
    """Return the text of a selected node; for an element, the text before its first child element, without comments."""
    if is_text(node):
        return str(node)
    if not isinstance(node.tag, str):
        return str(node.text or "")
    return "".join(location.read() or "" for location in texts_from(Place(node, "text")))


def is_text(node: Node) -> TypeGuard[Text]:
    return isinstance(node, str)


def _kind(node: Node) -> str:
    if is_text(node):
        return "attributes" if node.is_attribute else "texts"
    return "elements" if isinstance(node.tag, str) else "comments or processing instructions"


def who(change: Change) -> str:
    return f"{one_line(change.why)}: " if change.why else ""


class View:
    """A root element in which paths select nodes; messages name its source."""

    def __init__(self, root: Element, source: EncodedText) -> None:
        self.root = root
        self.source = source
        self.namespaces = declarations(root)

    def error(self, change: Change, what: str, more: str) -> TemplateError:
        """Return an error with a one-line message: the source of the change, its path, and what is wrong in this template."""
        return TemplateError(f"{who(change)}{one_line(change.path)} {what} in {self.source.name}{more}")

    def legal(self, text: str, change: Change) -> str:
        """Return a text. Raises TemplateError for characters that XML does not allow."""
        if wrong := illegal(text):
            raise self.error(change, f"cannot contain the character U+{ord(wrong):04X}", ": XML does not allow it")
        return text

    def select(self, path: str, who: str = "") -> list[Node]:
        """Return the nodes that a path selects. Raises TemplateError if it is not a path to nodes."""
        shown, name = one_line(path), self.source.name
        if not xpath_time_limit.ends(path, self.namespaces, self.root):
            raise TemplateError(
                f"{who}{shown} takes more than {xpath_time_limit.LIMIT_S} s of computing time in {name}; "
                "use a path that visits the document less often, with fewer // and .. within [ ]"
            )
        try:
            selected = etree.XPath(path, namespaces=self.namespaces, regexp=False)(self.root)
        except (etree.XPathError, ValueError) as error:
            known = f"; known prefixes are {', '.join(self.namespaces)}" if "prefix" in str(error) and self.namespaces else ""
            raise TemplateError(f"{who}{shown} is not an XPath for {name}: {one_line(error)}{known}") from error
        if not isinstance(selected, list):
            kind = {bool: "a boolean", float: "a number"}.get(type(selected), "a string")
            raise TemplateError(f"{who}{shown} returns {kind}, but must select nodes in {name}")
        if any(not is_text(node) and not etree.iselement(node) for node in selected):
            raise TemplateError(f"{who}{shown} selects namespaces in {name}; select elements, attributes or texts")
        return selected

    def matches(self, change: Change) -> list[Node]:
        """Return all matches of a change: at least one, and as many as the change expects."""
        found = self.select(change.path, who(change))
        if isinstance(change, Set) and not change.attribute:  # an element and its text are one place
            found = list({place_of(node) or node: node for node in found}.values())
        if not found:
            raise self.error(change, "matches nothing", one_line(nearest(change.path, self._selected, self._names)))
        if change.expect is not None and len(found) != change.expect:
            raise self.error(change, f"matches {len(found)}", f", not {change.expect} as expected")
        return found

    def elements(self, change: Change) -> list[Element]:
        found = []
        for node in self.matches(change):
            if is_text(node) or not isinstance(node.tag, str):
                raise self.unfit(change, node, "elements")
            found.append(node)
        return found

    def unfit(self, change: Change, node: Node, wanted: str) -> TemplateError:
        verb = {Set: "set", Add: "add", Remove: "remove", Rename: "rename", Repeat: "repeat"}[type(change)]
        return self.error(change, f"selects {_kind(node)}", f"; {verb} works on {wanted}")

    def slots(self, change: Set, raw: Callable[[Place], str]) -> list[Slot]:
        """Return the places where a `Set` writes. `raw` returns the text of a place as it is written in the file.

        A value takes the place of the first text that is not blank in the file, so that it does not depend on earlier changes.
        """
        if change.attribute is not None:
            attribute = change.attribute
            return [Slot((Place(e, "attribute", self.clark(attribute, e, change)),)) for e in self.elements(change)]
        slots = []
        for node in self.matches(change):
            location = place_of(node)
            if location is None:
                raise self.unfit(change, node, "elements, attributes and texts")
            places = tuple(texts_from(location))
            if location.kind != "attribute":
                self._check_alone(change, node, places, raw)
            slots.append(_slot(places, [raw(selected) for selected in places]) if len(places) > 1 else Slot(places))
        return slots

    def _check_alone(self, change: Set, node: Node, places: Sequence[Place], raw: Callable[[Place], str]) -> None:
        """Check that no other text or reference belongs to the value of a node."""
        first, last = places[0].element, places[-1]
        after = next(iter(first), None) if last == Place(first, "text") else last.element.getnext()
        if references := [near for near in (first, after) if near is not None and near.tag is etree.Entity]:
            raise self.error(
                change, f"has the reference {references[0].text} beside its text", "; write its text there instead"
            )
        if not is_text(node) and any(isinstance(child.tag, str) for child in node):
            texts = (Place(node, "text"), *(Place(child, "tail") for child in node))
            if not all(_is_blank(raw(location)) for location in texts):
                more = "; set an element without child elements, or select one of its texts, as in text()[1]"
                raise self.error(change, "has text beside child elements", more)

    def clark(self, name: str, element: Element, change: Change, namespace: str | None = None) -> str:
        """Return `p:name` or `name` as `{uri}name`. Raises TemplateError for an unknown prefix."""
        if name.startswith("{"):
            return name
        error = partial(self.error, change)
        prefix, colon, local = name.rpartition(":")
        known = {"xml": XML, **self.namespaces, **element.nsmap}
        if "xmlns" in (prefix, local):
            raise error(f"cannot have the attribute {name!r}", "; it declares a namespace: write it in the template")
        if colon and prefix not in known:
            prefixes = ", ".join(other for other in known if other)
            raise error(f"cannot use the name {name!r}: its prefix is not declared", f"; known are {prefixes}")
        uri = known[prefix] if prefix else namespace
        if self.source.lacks(local):
            raise error(f"cannot use the name {name!r}", f"; the encoding {self.source.codec} lacks some of its characters")
        return f"{{{uri}}}{local}" if uri else local

    def attributes(self) -> Iterator[tuple[str, str]]:
        """Yield paths with the values that they select: attributes, and texts of elements that have no children.

        A path names an element by its tag, or by tag and name or id if several elements have the tag, or else by the path of
        the element around it.
        """
        counted = Counter(call for element in self.root.iter(etree.Element) for call in self._calls(element))
        named: dict[Element, str] = {}
        beside = Counter((element.getparent(), element.tag) for element in self.root.iter(etree.Element))
        for element in self.root.iter(etree.Element):
            slot = next((call for call in self._calls(element) if counted[call] == 1 and self._alone(call)), None)
            if slot is None and (around := named.get(element.getparent())) is not None:
                is_only = beside[element.getparent(), element.tag] == 1 and "local-name()" not in self._qualified(element.tag)
                slot = f"{around}/{self._qualified(element.tag)}" if is_only else None
            if slot is None:
                continue
            named[element] = slot
            for name, value in element.attrib.items():
                yield f"{slot}/@{self._qualified(name)}", value
            if all(child.tag in _BETWEEN for child in element) and (value := value_of(element)).strip():
                yield slot, value

    def _calls(self, element: Element) -> Sequence[str]:
        """Return the possible names of an element in paths: its tag, with its name, with its id."""
        tag = f"//{self._qualified(element.tag)}"
        return [
            tag,
            *(f"{tag}[@{key}='{element.get(key)}']" for key in ("name", "id", "variable") if "'" not in element.get(key, "'")),
        ]

    def _alone(self, call: str) -> bool:
        """Return True if a name that occurs once selects one element; `local-name()` may match other namespaces too."""
        return "local-name()" not in call or len(self._selected(call)) == 1

    def _selected(self, path: str) -> list[Node]:
        try:
            return self.select(path)
        except TemplateError:
            return []

    def _names(self, good: str, way: str, at: str) -> list[str]:
        """Return the different names that are one step away from a path, in document order."""
        nodes = self._selected(f"{good}{way}{at}*")
        return list(dict.fromkeys(self._qualified(node.attrname if at else node.tag) for node in nodes))

    def _qualified(self, clark: str) -> str:
        """Return a name as written in a path."""
        name = etree.QName(clark)
        if not name.namespace:
            return str(name.localname)
        known = [("xml", XML), *self.namespaces.items()]
        prefix = next((prefix for prefix, uri in known if uri == name.namespace), None)
        return f"{prefix}:{name.localname}" if prefix else f"*[local-name()='{name.localname}']"
