"""XML templates: any document, changed by XPath 1.0, rendered with its original formatting.

**Paths** are XPath 1.0. Absolute paths begin at the document, relative paths at the root element. A change applies to all
matches. Every prefix that is declared anywhere in the document can be used (its first declaration applies). The first default
namespace has the prefix `_`, as in `//_:robot/@name`. Content before and after the root element cannot be selected.

**Kept byte for byte**: everything before and after the root element (byte order mark, XML declaration, doctype, comments,
final newline). Within it: comments, processing instructions, CDATA, white space between tags, order of attributes, and
prefixes. Also the encoding (missing characters are written as `&#8364;`), CRLF line ends if all lines have them, and a number
that is set to itself in another spelling (see `sierra.templates.same_number`).

**Not kept**, because the parser does not report it: quotes around attributes (always `"`), white space within tags (`<a />`
and `<a></a>` become `<a/>`), references to characters (`&#233;` becomes `é`, `&quot;` in a text becomes `"`), line ends if CR,
LF and CRLF are mixed, and CDATA that is set or stands beside a removed element. A doctype keeps the root's old name if the
root is renamed.

**Hostile input**: nothing is loaded (no DTD, no external entity, no network, no XInclude). A document that *declares* an entity
is refused, so there is nothing to expand. A reference that an external DTD would define stays unchanged. libxml2's own limits
(depth 256, 10 MB for one text) apply. A path whose evaluation would exceed a time limit is refused: see
`sierra.templates.xpath_time_limit`.
"""

from __future__ import annotations

import codecs
import copy
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal, TypeAlias, TypeGuard

from lxml import etree

from sierra.config.plugin_registry import NoOptions
from sierra.config.project_file import Table
from sierra.errors import ConfigError, TemplateError
from sierra.model import Add, Change, Remove, Rename, Set, Value
from sierra.templates import xpath_time_limit
from sierra.templates.arithmetic import fill, names
from sierra.templates.base import Rendered
from sierra.templates.nearest_path import nearest
from sierra.templates.same_number import same
from sierra.util.hashing import sha256
from sierra.util.text import one_line

Element: TypeAlias = etree._Element
Text: TypeAlias = etree._ElementUnicodeResult
"""A text or an attribute's value that a path selects; it knows its element."""
Node: TypeAlias = Element | Text
DEFAULT = "_"
"""The prefix that paths give to the document's default namespace."""

_XML = "http://www.w3.org/XML/1998/namespace"


class XmlTemplate:
    """The template format `xml`; see `sierra.templates.base.Template`."""

    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, data: bytes, name: str, options: Table | None = None) -> None:
        self.sha256 = sha256(data)
        tree = parse(data, name)
        self._document = XmlDocument(copy.deepcopy(tree.getroot()), _frame(data, tree.docinfo.encoding, name))

    def reread(self, rendered: Rendered, name: str) -> XmlTemplate:
        if not isinstance(rendered, bytes):
            raise TemplateError(f"{name}: an XML template must be one file, not {len(rendered)}")
        return XmlTemplate(rendered, name)

    def find(self, path: str) -> tuple[str, ...]:
        """Return the text of each match; for an element, the text before its first child."""
        return tuple(str(node) if _is_text(node) else str(node.text or "") for node in self._document.select(path))

    def attributes(self) -> tuple[tuple[str, str], ...]:
        return tuple(self._document.attributes())

    def changed(self, changes: Sequence[Change], values: Mapping[str, Value]) -> XmlDocument:
        return self._document.changed(changes, lambda text: fill(text, values))


class XmlDocument:
    """A root element, and the frame around it; see `sierra.templates.base.Document`."""

    def __init__(self, root: Element, frame: _Frame, namespaces: dict[str, str] | None = None) -> None:
        self._root = root
        self._frame = frame
        self._namespaces = declarations(root) if namespaces is None else namespaces

    def render(self) -> bytes:
        return self._frame.complete(self._body())

    def per_run(self, changes: Sequence[Change]) -> Callable[[Mapping[str, Value]], bytes]:
        self.changed(changes, _unfilled)
        sets = [change for change in changes if isinstance(change, Set)]
        if len(sets) == len(changes):
            return self._gapped(sets)
        changes = tuple(changes)
        return lambda values: self.changed(changes, lambda text: fill(text, values)).render()

    def changed(self, changes: Iterable[Change], filled: Callable[[str], str]) -> XmlDocument:
        """Return a copy with the changes made; `filled` converts each of their texts."""
        document = XmlDocument(copy.deepcopy(self._root), self._frame, self._namespaces)
        for change in changes:
            try:
                document._make(change, filled)
            except ValueError as error:  # lxml's error about names
                raise self._frame.error(change, "cannot be changed", f": {one_line(error)}") from error
            except ConfigError as error:
                raise ConfigError(f"{_who(change)}{error}") from error
        return document

    def select(self, path: str, who: str = "") -> list[Node]:
        """Return the nodes that a path selects. Raises TemplateError if it is not a path to nodes."""
        shown = one_line(path)
        if not xpath_time_limit.ends(path, self._namespaces, self._root):
            raise TemplateError(
                f"{who}{shown} takes more than {xpath_time_limit.LIMIT_S} s of computing time in {self._frame.name}; "
                "use a path that visits the document less often, with fewer // and .. within [ ]"
            )
        try:
            found = etree.XPath(path, namespaces=self._namespaces, regexp=False)(self._root)
        except (etree.XPathError, ValueError) as error:
            known = f"; known prefixes are {', '.join(self._namespaces)}" if "prefix" in str(error) and self._namespaces else ""
            raise TemplateError(f"{who}{shown} is not an XPath for {self._frame.name}: {one_line(error)}{known}") from error
        if not isinstance(found, list):
            kind = {bool: "a boolean", float: "a number"}.get(type(found), "a string")
            raise TemplateError(f"{who}{shown} returns {kind}, but must select nodes in {self._frame.name}")
        if any(not _is_text(node) and not etree.iselement(node) for node in found):
            raise TemplateError(f"{who}{shown} selects namespaces in {self._frame.name}; select elements, attributes or texts")
        return found

    def attributes(self) -> Iterator[tuple[str, str]]:
        """Yield paths with the values that they select: attributes, and texts of elements that have no children.

        A path names an element by its tag, or by tag and name or id if several elements have the tag.
        """
        counted = Counter(call for element in self._root.iter(etree.Element) for call in self._calls(element))
        for element in self._root.iter(etree.Element):
            place = next((call for call in self._calls(element) if counted[call] == 1 and self._alone(call)), None)
            if place is None:
                continue
            for name, value in element.attrib.items():
                yield f"{place}/@{self._qualified(name)}", value
            if not len(element) and (element.text or "").strip():
                yield place, element.text

    def _calls(self, element: Element) -> list[str]:
        """Return the possible names of an element in paths: its tag, with its name, with its id."""
        tag = f"//{self._qualified(element.tag)}"
        return [tag, *(f"{tag}[@{key}='{element.get(key)}']" for key in ("name", "id") if "'" not in element.get(key, "'"))]

    def _alone(self, call: str) -> bool:
        """Return True if a name that occurs once selects one element; `local-name()` may match other namespaces too."""
        return "local-name()" not in call or len(self._found(call)) == 1

    def _body(self) -> str:
        return str(etree.tostring(self._root, encoding="unicode", with_tail=False))

    def _gapped(self, changes: Sequence[Set]) -> Callable[[Mapping[str, Value]], bytes]:
        """Split the document at the values that differ between runs, so that each run only fills these gaps."""
        mark = "gap"
        while mark in self._body():
            mark += "_"
        document = XmlDocument(copy.deepcopy(self._root), self._frame, self._namespaces)
        numbers: dict[_Gap, int] = {}
        for number, change in enumerate(changes):
            for place in document._places(change):
                was = place.read()
                before = re.fullmatch(f"{mark}:(\\d+):", was or "")
                gap = _Gap(number, place.kind == "attribute", int(before[1]) if before else was)
                place.write(f"{mark}:{numbers.setdefault(gap, len(numbers))}:")
        texts = re.split(f"{mark}:(\\d+):", document._body())
        frame, gaps = self._frame, tuple(numbers)
        pieces = [frame.encoded(text) for text in texts[::2]]
        following = list(zip(map(int, texts[1::2]), pieces[1:], strict=True))

        def render(values: Mapping[str, Value]) -> bytes:
            filled = [_filled(change, values, frame) for change in changes]
            becomes: list[str] = []
            for gap in gaps:
                was = becomes[gap.was] if isinstance(gap.was, int) else gap.was
                text = filled[gap.change]
                becomes.append(text if was is None or not same(was, text) else was)
            written = [frame.encoded(text.translate(_ESCAPES[gap.quoted])) for gap, text in zip(gaps, becomes, strict=True)]
            parts = [frame.before, pieces[0]]
            for number, piece in following:
                parts += (written[number], piece)
            return b"".join((*parts, frame.after))

        return render

    def _make(self, change: Change, filled: Callable[[str], str]) -> None:
        match change:
            case Set():
                text = _legal(filled(change.value), change, self._frame)
                for place in self._places(change):
                    place.update(text)
            case Add():
                for parent in self._elements(change):
                    _insert(parent, self._piece(change, parent, filled), self._index(change, parent))
            case Remove():
                for node in self._matches(change):
                    self._remove(node, change)
            case Rename():
                to = filled(change.to) if _ONE_NAME.fullmatch(change.to) else change.to
                for element in self._elements(change):
                    element.tag = self._clark(to, element, change, etree.QName(element).namespace)
        if isinstance(change, Add | Rename):
            self._namespaces = declarations(self._root)

    def _matches(self, change: Change) -> list[Node]:
        """Return all matches of a change: at least one, and as many as the change expects."""
        found = self.select(change.path, _who(change))
        if isinstance(change, Set) and not change.attribute:  # a text and adjacent CDATA are one place
            found = list({_place(node) or node: node for node in found}.values())
        if not found:
            raise self._frame.error(change, "matches nothing", one_line(self._nearest(change.path)))
        if change.expect is not None and len(found) != change.expect:
            raise self._frame.error(change, f"matches {len(found)}", f", not {change.expect} as expected")
        return found

    def _elements(self, change: Change) -> list[Element]:
        found = self._matches(change)
        for node in found:
            if _is_text(node) or not isinstance(node.tag, str):
                raise self._unfit(change, node, "elements")
        return found

    def _unfit(self, change: Change, node: Node, wanted: str) -> TemplateError:
        verb = {Set: "set", Add: "add", Remove: "remove", Rename: "rename"}[type(change)]
        return self._frame.error(change, f"selects {_kind(node)}", f"; {verb} works on {wanted}")

    def _places(self, change: Set) -> list[_Place]:
        """Return the places where a `Set` writes."""
        if change.attribute is not None:
            attribute = change.attribute
            return [_Place(e, "attribute", self._clark(attribute, e, change)) for e in self._elements(change)]
        places = []
        for node in self._matches(change):
            place = _place(node)
            if place is None:
                raise self._unfit(change, node, "elements, attributes and texts")
            places.append(place)
        return places

    def _remove(self, node: Node, change: Remove) -> None:
        if _is_text(node):
            if not node.is_attribute:
                raise self._unfit(change, node, "elements and attributes")
            del node.getparent().attrib[node.attrname]
        elif node is self._root:
            raise self._frame.error(change, "selects the root element", ", which cannot be removed")
        else:
            _take_out(node)

    def _clark(self, name: str, element: Element, change: Change, namespace: str | None = None) -> str:
        """Return `p:name` or `name` as `{uri}name`. Raises TemplateError for an unknown prefix."""
        if name.startswith("{"):
            return name
        error = partial(self._frame.error, change)
        prefix, colon, local = name.rpartition(":")
        known = {"xml": _XML, **self._namespaces, **element.nsmap}
        if "xmlns" in (prefix, local):
            raise error(f"cannot have the attribute {name!r}", "; it declares a namespace: write it in the template")
        if colon and prefix not in known:
            prefixes = ", ".join(other for other in known if other)
            raise error(f"cannot use the name {name!r}: its prefix is not declared", f"; known are {prefixes}")
        uri = known[prefix] if prefix else namespace
        if self._frame.lacks(local):
            raise error(f"cannot use the name {name!r}", f"; the encoding {self._frame.codec} lacks some of its characters")
        return f"{{{uri}}}{local}" if uri else local

    def _piece(self, change: Add, parent: Element, filled: Callable[[str], str]) -> Element:
        """Return the new child, parsed in the namespaces of `parent`."""
        error = partial(self._frame.error, change)
        declared = {**self._namespaces, **parent.nsmap}
        wrapper = etree.tostring(etree.Element("_", nsmap=declared), encoding="unicode").removesuffix("/>")
        xml = _legal(change.xml, change, self._frame)
        if self._frame.lacks(xml):
            raise error(f"cannot contain {xml!r}", f", whose encoding is {self._frame.codec}; write &#8364; for €")
        try:
            wrapped = etree.fromstring(f"{wrapper}>{xml}</_>".encode(), _parser())
        except etree.XMLSyntaxError as wrong:
            raise error(f"cannot contain {xml!r}", f": not XML: {_reason(wrong)}") from wrong
        content = [node for node in wrapped.xpath("node()") if not _is_text(node) or node.strip()]
        if len(content) != 1 or _is_text(content[0]) or not isinstance(content[0].tag, str):
            raise error(f"cannot contain {xml!r}", "; add exactly one element")
        piece = content[0]
        piece.tail = None
        _fill_all(piece, lambda text: _legal(filled(text), change, self._frame))
        return piece

    def _index(self, change: Add, parent: Element) -> int:
        """Return the index of the new child among all children, including comments; `at` counts elements only."""
        if change.at is None:
            return len(parent)
        indices = [index for index, child in enumerate(parent) if isinstance(child.tag, str)]
        if not 0 <= change.at <= len(indices):
            raise self._frame.error(change, f"has {len(indices)} child elements", f", so at={change.at} is too large")
        return indices[change.at] if change.at < len(indices) else len(parent)

    def _nearest(self, path: str) -> str:
        return nearest(path, self._found, self._names)

    def _found(self, path: str) -> list[Node]:
        try:
            return self.select(path)
        except TemplateError:
            return []

    def _names(self, good: str, way: str, at: str) -> list[str]:
        """Return the different names that are one step away from a path, in document order."""
        nodes = self._found(f"{good}{way}{at}*")
        return list(dict.fromkeys(self._qualified(node.attrname if at else node.tag) for node in nodes))

    def _qualified(self, clark: str) -> str:
        """Return a name as written in a path."""
        name = etree.QName(clark)
        if not name.namespace:
            return str(name.localname)
        known = [("xml", _XML), *self._namespaces.items()]
        prefix = next((prefix for prefix, uri in known if uri == name.namespace), None)
        return f"{prefix}:{name.localname}" if prefix else f"*[local-name()='{name.localname}']"


@dataclass(frozen=True, slots=True)
class _Frame:
    """The content around the root element, and the encoding of the document."""

    name: str
    before: bytes
    after: bytes
    codec: str
    crlf: bool

    def complete(self, body: str) -> bytes:
        return self.before + self.encoded(body) + self.after

    def encoded(self, body: str) -> bytes:
        """Return XML as bytes. Characters that the encoding lacks become references; names and comments must not have any."""
        return (body.replace("\n", "\r\n") if self.crlf else body).encode(self.codec, "xmlcharrefreplace")

    def error(self, change: Change, what: str, more: str) -> TemplateError:
        """Return an error with a one-line message: the source of the change, its path, and what is wrong in this template."""
        return TemplateError(f"{_who(change)}{one_line(change.path)} {what} in {self.name}{more}")

    def lacks(self, text: str) -> bool:
        try:
            text.encode(self.codec)
        except UnicodeEncodeError:
            return True
        return False


_MARKS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))
_UNMARKED = ((b"<\0", "utf-16-le"), (b"\0<", "utf-16-be"))
_SKIPPED = r"<!--.*?-->|<\?.*?\?>"
_QUOTED = r""" "[^"]*" | '[^']*' """
_MARKUP = re.compile(
    rf"""{_SKIPPED} | <!\[CDATA\[.*?\]\]>
    | (?P<doctype> <!DOCTYPE (?: [^\[\]<>"'] | {_QUOTED} | \[ (?: {_SKIPPED} | {_QUOTED} | [^\]"'] )*+ \] )*+ > )
    | (?P<tag> <[^!?] (?: [^<>"'] | {_QUOTED} )*+ > )""",
    re.DOTALL | re.VERBOSE,
)
"""The markup of a document that is known to be well-formed."""
_ENTITY = re.compile(rf"{_SKIPPED} | {_QUOTED} | <!ENTITY\s+(?P<name>(?:%\s+)?[^\s]+)", re.DOTALL | re.VERBOSE)


def _frame(data: bytes, encoding: str | None, name: str) -> _Frame:
    """Return the frame of a document. Raises TemplateError for declared entities, or if text and bytes do not convert."""
    mark, codec = next(((m, c) for m, c in _MARKS if data.startswith(m)), (b"", ""))
    codec = codec or next((c for start, c in _UNMARKED if data.startswith(start)), encoding or "utf-8")
    try:
        text = data.removeprefix(mark).decode(codec)
        same = mark + text.encode(codec) == data and "\0" not in text  # NUL characters appear when UTF-32 is read as UTF-16
    except (LookupError, UnicodeError):
        same = False
    if not same:
        raise TemplateError(f"{name}: cannot be written in its encoding {codec}; save it as UTF-8")
    markup = list(_MARKUP.finditer(text))
    for doctype in markup:
        _refuse_entities(doctype["doctype"] or "", name)
    tags = [match.span() for match in markup if match["tag"]]
    before, after = text[: tags[0][0]], text[tags[-1][1] :]
    crlf = "\r\n" in text and not re.search(r"\r(?!\n)|(?<!\r)\n", text)
    return _Frame(name, mark + before.encode(codec), after.encode(codec), codec, crlf)


def _refuse_entities(doctype: str, name: str) -> None:
    for match in _ENTITY.finditer(doctype):
        if match["name"]:
            raise TemplateError(
                f"{name}: declares the entity {match['name']!r}; write its text instead: SIERRA does not expand entities"
            )


def _parser() -> etree.XMLParser:
    return etree.XMLParser(
        resolve_entities=False,
        load_dtd=False,
        dtd_validation=False,
        attribute_defaults=False,
        no_network=True,
        huge_tree=False,
        strip_cdata=False,
        remove_blank_text=False,
    )


def parse(data: bytes, name: str) -> etree._ElementTree:
    """Return a parsed document; nothing but `data` is read. Raises TemplateError if it is not XML."""
    try:
        return etree.fromstring(data, _parser()).getroottree()
    except etree.XMLSyntaxError as error:
        line, column = error.position
        raise TemplateError(f"{name}:{line}:{column}: not XML: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return re.sub(r", line \d+, column \d+.*$", "", one_line(getattr(error, "msg", None) or "the document is empty"))


def declarations(root: Element) -> dict[str, str]:
    """Return the namespaces of prefixes in paths: the first declaration of each prefix."""
    found: dict[str, str] = {}
    for _, (prefix, uri) in etree.iterwalk(root, events=("start-ns",)):
        if uri and prefix != "xml":
            found.setdefault(prefix or DEFAULT, uri)
    return found


@dataclass(frozen=True, slots=True)
class _Place:
    """The place of a text: an attribute, the beginning of an element, or the text after an element."""

    element: Element
    kind: Literal["attribute", "text", "tail"]
    name: str = ""

    def read(self) -> str | None:
        """Return the text; None for an attribute that does not exist yet."""
        if self.kind == "attribute":
            attribute: str | None = self.element.get(self.name)
            return attribute
        return getattr(self.element, self.kind) or ""

    def update(self, text: str) -> None:
        """Write a text, unless the current text spells the same number."""
        was = self.read()
        if was is None or not same(was, text):
            self.write(text)

    def write(self, text: str) -> None:
        if self.kind == "attribute":
            self.element.set(self.name, text)
        else:
            setattr(self.element, self.kind, text)


@dataclass(frozen=True, slots=True)
class _Gap:
    """A value that differs between runs: the index of its change, if it is within quotes, and the previous text."""

    change: int
    quoted: bool
    was: str | int | None
    """The previous text, the number of an earlier gap, or None."""


def _place(node: Node) -> _Place | None:
    """Return the place of a selected node's text; None for comments and processing instructions."""
    if not _is_text(node):
        return _Place(node, "text") if isinstance(node.tag, str) else None
    if node.is_attribute:
        return _Place(node.getparent(), "attribute", node.attrname)
    return _Place(node.getparent(), "tail" if node.is_tail else "text")


def _is_text(node: Node) -> TypeGuard[Text]:
    return isinstance(node, str)


def _kind(node: Node) -> str:
    if _is_text(node):
        return "attributes" if node.is_attribute else "texts"
    return "elements" if isinstance(node.tag, str) else "comments or processing instructions"


def _take_out(element: Element) -> None:
    """Remove an element and its line; the text after it stays."""
    parent, previous, after = element.getparent(), element.getprevious(), element.tail or ""
    before = (parent.text if previous is None else previous.tail) or ""
    kept = before + after
    if not kept.strip() and "\n" in kept:
        kept = after if "\n" in after else before
    parent.remove(element)
    if kept == before:
        return
    if previous is None:
        parent.text = kept
    else:
        previous.tail = kept


def _insert(parent: Element, new: Element, index: int) -> None:
    """Insert a new child, with the indentation of its siblings."""
    inner = parent.text or ""
    if len(parent) and _indents(inner):
        last = parent[-1]
        if index < len(parent):
            new.tail = inner
        elif _indents(last.tail or ""):
            new.tail, last.tail = last.tail, inner
    elif not len(parent) and not inner.strip() and _indents(outer := _before(parent)):
        outer = "\n" + outer.rpartition("\n")[2]
        unit = outer.removeprefix("\n" + _before(parent.getparent()).rpartition("\n")[2]) or "  "
        parent.text, new.tail = outer + unit, outer
    parent.insert(index, new)


def _indents(text: str) -> bool:
    return "\n" in text and not text.strip()


def _before(element: Element) -> str:
    """Return the text before an element."""
    if element.getparent() is None:
        return ""
    previous = element.getprevious()
    return (element.getparent().text if previous is None else previous.tail) or ""


def _fill_all(piece: Element, filled: Callable[[str], str]) -> None:
    """Fill all attributes and texts of an element after parsing, so that a value cannot become markup."""
    for node in piece.iter():
        if isinstance(node.tag, str):
            for name, value in node.attrib.items():
                node.set(name, filled(value))
            if node.text and (text := filled(node.text)) != node.text:
                node.text = text
        if node.tail and (text := filled(node.tail)) != node.tail:
            node.tail = text


_IN_TEXT = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", "\r": "&#13;"})
_IN_ATTRIBUTE = _IN_TEXT | str.maketrans({'"': "&quot;", "\n": "&#10;", "\t": "&#9;"})
_ESCAPES = (_IN_TEXT, _IN_ATTRIBUTE)
"""Escapes like those of libxml2: in a text (index False), and in an attribute (index True)."""
_ILLEGAL = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 does not allow (production 2)."""


def _legal(text: str, change: Change, frame: _Frame) -> str:
    if wrong := _ILLEGAL.search(text):
        raise frame.error(change, f"cannot contain the character U+{ord(wrong[0]):04X}", ": XML does not allow it")
    return text


def _filled(change: Set, values: Mapping[str, Value], frame: _Frame) -> str:
    try:
        return _legal(fill(change.value, values), change, frame)
    except ConfigError as error:
        raise ConfigError(f"{_who(change)}{error}") from error


def _unfilled(text: str) -> str:
    """Return a text unchanged, after checking that it can be filled."""
    names(text)
    return text


_ONE_NAME = re.compile(r"\{[A-Za-z_]\w*\}")
"""A tag such as `{controller}`; any other `{…}` in a tag is a namespace."""


def _who(change: Change) -> str:
    return f"{one_line(change.why)}: " if change.why else ""
