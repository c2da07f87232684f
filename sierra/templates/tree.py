"""Templates that are trees of keys, lists and values: the part that all such formats share.

**Paths** are XPath 1.0 over a view of the data: keys are elements, the items of a list are elements `item`, and values are
texts. `/swarm/count` is the key `count` of the key `swarm`; `//robots/item[name='r1']/x` selects items by their content. A key
that is no name in XML is an element `key`: `/key[@name='my key/2']`.

**Bytes**: a format reports the place of each key and value. A change replaces the bytes of that place, and all others stay as
they are. The template is parsed once; each run only joins pieces. An added, removed or renamed part is read again, and the
result must be the old data with this change.

**Types** are kept: a number stays a number (a float stays a float: `1` becomes `1.0`), a boolean a boolean, and a text a text.
A value of another type is an error. A list, a table or `null` cannot be set.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from decimal import Decimal
from enum import StrEnum
from itertools import groupby
from typing import ClassVar, Protocol, TypeAlias

from lxml import etree

from sierra.config.plugin_registry import NoOptions
from sierra.config.project_file import Table
from sierra.errors import ConfigError, TemplateError
from sierra.model import Add, Change, Remove, Rename, Set, Value
from sierra.templates import xpath_time_limit
from sierra.templates.arithmetic import fill, names
from sierra.templates.base import Rendered
from sierra.templates.data_path import below_root
from sierra.templates.nearest_path import nearest
from sierra.templates.same_number import same
from sierra.util.hashing import sha256
from sierra.util.text import one_line

Element: TypeAlias = etree._Element
Span = tuple[int, int]
Address = tuple[int, ...]
"""The indices of the children that lead to a node."""
Plain = tuple[str, object]
"""Data without places, for comparisons: a kind, and a text, a tuple of items, or a mapping."""
DEPTH = 100
"""Maximum depth of a document."""
LONGEST = 400
"""Maximum number of characters of a number."""
NUMBER = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?")
"""A number as all formats write it."""
_NAME = re.compile("[A-Za-z_\xc0-\xd6\xd8-\xf6\xf8-\xff][A-Za-z_\xc0-\xd6\xd8-\xf6\xf8-\xff0-9.-]*")
"""A key that is a name in XPath; libxml2 has an old definition of letters outside of Latin-1."""
_ONE_NAME = re.compile(r"\{[A-Za-z_]\w*\}")
_ONE_EXPRESSION = re.compile(r"\{[^{}]*\}")
_ILLEGAL = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class Kind(StrEnum):
    """What a value is."""

    TEXT = "text"
    NUMBER = "number"
    BOOLEAN = "boolean"
    DATE = "date"
    UNTYPED = "value"
    NULL = "null"
    MAPPING = "mapping"
    LIST = "list"
    FIXED = "fixed"
    """A value that cannot be set; `Node.why` says why."""


@dataclass(slots=True, eq=False)
class Node:
    """One value of a document, with its place."""

    kind: Kind
    start: int
    end: int
    value: str = ""
    """The text of a value as it is read: without quotes and escapes."""
    key: str | None = None
    keys: list[Span] = field(default_factory=list)
    """The places of its key."""
    children: list[Node] = field(default_factory=list)
    entries: list[Span] = field(default_factory=list)
    """The places of its keys with their values: what is removed with it."""
    style: str = ""
    """How the format writes it, for example between which brackets; the format knows the meaning."""
    why: str = ""
    """Why it cannot be set; empty if it can."""

    def plain(self) -> Plain:
        """Return the data without places."""
        match self.kind:
            case Kind.MAPPING:
                return self.kind, {child.key: child.plain() for child in self.children}
            case Kind.LIST:
                return self.kind, tuple(self.plain_children())
            case Kind.NUMBER if NUMBER.fullmatch(self.value):
                return self.kind, (is_float(self.value), Decimal(self.value))
        return self.kind, self.value

    def plain_children(self) -> Iterator[Plain]:
        for child in self.children:
            yield child.plain()


class Unfit(Exception):
    """A change that a format cannot write; the message completes `PATH … in TEMPLATE`."""


class Notation(Protocol):
    """How a format reads and writes data. Places are indices in the text of the document."""

    name: str
    """The format's name in messages."""

    def scan(self, text: str, name: str) -> Node:
        """Return the document. Raises TemplateError, in one line with the place, if it is invalid or doubtful."""

    def text(self, node: Node, text: str) -> str:
        """Return a text as it is written in the place of a value. Raises Unfit."""

    def number(self, node: Node, text: str) -> str:
        """Return a number, which NUMBER matches, as it is written. Raises Unfit."""

    def key(self, node: Node, key: str) -> str:
        """Return a new key as it is written in the place of a node's key. Raises Unfit."""

    def added(self, text: str, node: Node, key: str | None, new: Node, at: int | None) -> str:
        """Return the document with a new value in a mapping or list, before the child `at`, or last. Raises Unfit."""

    def removed(self, text: str, parent: Node, node: Node) -> str:
        """Return the document without a node. Raises Unfit."""


class TreeTemplate:
    """A template of a format with a `Notation`; see `sierra.templates.base.Template`."""

    Options: ClassVar[type[Table]] = NoOptions
    notation: ClassVar[Notation]

    def __init__(self, data: bytes, name: str, options: Table | None = None) -> None:
        self.sha256 = sha256(data)
        self._options = options
        self._document = TreeDocument(Scan(data, name, self.notation), {})

    def reread(self, rendered: Rendered, name: str) -> TreeTemplate:
        if not isinstance(rendered, bytes):
            raise TemplateError(f"{name}: a {self.notation.name} template must be one file, not {len(rendered)}")
        return type(self)(rendered, name, self._options)

    def find(self, path: str) -> tuple[str, ...]:
        """Return the value of each match; for a mapping or a list, an empty text."""
        return self._document.find(path)

    def attributes(self) -> tuple[tuple[str, str], ...]:
        return tuple(self._document.scan.values())

    def changed(self, changes: Sequence[Change], values: Mapping[str, Value]) -> TreeDocument:
        return self._document.changed(changes, lambda text: fill(text, values))


class Scan:
    """A parsed document with its view. It is shared by all documents that differ from it in values only."""

    def __init__(self, data: bytes, name: str, notation: Notation) -> None:
        self.name = name
        self.notation = notation
        self.mark, self.text = decoded(data, name)
        self.root = notation.scan(self.text, name)
        self._nodes: dict[Element, Node] = {}
        self._elements: dict[Node, Element] = {}
        self.view = etree.Element("_")
        self._show(self.root, self.view)

    def select(self, path: str, who: str = "") -> list[str | Node]:
        """Return the nodes that a path selects, and as texts the names of keys. Raises TemplateError."""
        shown = one_line(path)
        rooted = below_root(path)
        if not xpath_time_limit.ends(rooted, {}, self.view):
            raise TemplateError(
                f"{who}{shown} takes more than {xpath_time_limit.LIMIT_S} s of computing time in {self.name}; "
                "use a path that visits the document less often, with fewer // and .. within [ ]"
            )
        try:
            found = etree.XPath(rooted, regexp=False)(self.view)
        except (etree.XPathError, ValueError) as error:
            raise TemplateError(f"{who}{shown} is not an XPath for {self.name}: {one_line(error)}") from error
        if not isinstance(found, list):
            kind = {bool: "a boolean", float: "a number"}.get(type(found), "a string")
            raise TemplateError(f"{who}{shown} returns {kind}, but must select keys or values in {self.name}")
        return list(dict.fromkeys(self._selected(one) for one in found))

    def _selected(self, found: object) -> str | Node:
        if isinstance(found, str):
            result: etree._ElementUnicodeResult = found
            return str(result) if result.is_attribute else self._nodes[result.getparent()]
        return self._nodes[found]

    def exists(self, path: str) -> list[str | Node]:
        """Return what a path selects, or nothing if it is invalid."""
        try:
            return self.select(path)
        except TemplateError:
            return []

    def steps(self, good: str, way: str, at: str) -> list[str]:
        """Return the different steps that lead from a path to keys and items; the names of keys have no attributes."""
        if at:
            return []
        nodes = self.exists(f"{good}{way}*")
        return list(dict.fromkeys(step(node) for node in nodes if isinstance(node, Node) and step(node)))

    def values(self) -> Iterator[tuple[str, str]]:
        """Yield paths that select one value each, with these values."""
        counted: dict[str, int] = {}
        for node in self._elements:
            counted[step(node)] = counted.get(step(node), 0) + 1
        yield from self._values(self.root, "", counted)

    def _values(self, node: Node, path: str, counted: Mapping[str, int]) -> Iterator[tuple[str, str]]:
        if not node.why and node.kind not in (Kind.MAPPING, Kind.LIST, Kind.NULL):
            alone = path and step(node) and counted[step(node)] == 1
            yield (f"//{step(node)}" if alone else path or "/"), node.value
        for number, child in enumerate(node.children, 1):
            called = f"item[{number}]" if child.key is None else step(child) or f"*[{number}]"
            yield from self._values(child, f"{path}/{called}", counted)

    @contextmanager
    def showing(self, edits: Mapping[Node, Edit]) -> Iterator[None]:
        """Let the view have other values for a while."""
        for node, edit in edits.items():
            self._elements[node].text = legal(edit.value)
        try:
            yield
        finally:
            for node in edits:
                self._elements[node].text = legal(node.value)

    def show(self, node: Node, value: str) -> None:
        self._elements[node].text = legal(value)

    def address(self, node: Node) -> Address:
        """Return the indices of the children that lead to a node."""
        element, found = self._elements[node], []
        while (parent := element.getparent()) is not None:
            found.append(parent.index(element))
            element = parent
        return tuple(reversed(found))

    def at(self, address: Address) -> Node:
        node = self.root
        for index in address:
            node = node.children[index]
        return node

    def _show(self, node: Node, element: Element) -> None:
        self._nodes[element] = node
        self._elements[node] = element
        element.text = legal(node.value) or None
        for child in node.children:
            self._show(child, _element(element, child.key))


def _element(parent: Element, key: str | None) -> Element:
    if key is None:
        return etree.SubElement(parent, "item")
    if _NAME.fullmatch(key):
        return etree.SubElement(parent, key)
    return etree.SubElement(parent, "key", name=legal(key))


def step(node: Node) -> str:
    """Return the step of a path to a node; empty for a key that no path can contain."""
    if node.key is None:
        return "item"
    if _NAME.fullmatch(node.key):
        return "key[not(@name)]" if node.key == "key" else node.key
    quote = '"' if "'" in node.key else "'"
    return f"key[@name={quote}{node.key}{quote}]" if quote not in node.key and legal(node.key) == node.key else ""


def legal(text: str) -> str:
    """Return a text as the view shows it: characters that XML does not have are replaced."""
    return _ILLEGAL.sub("\ufffd", text)


@dataclass(frozen=True, slots=True)
class Edit:
    """A new value of a node: as it is written, and as it is read."""

    token: str
    value: str


class TreeDocument:
    """A document with other values in some places; see `sierra.templates.base.Document`."""

    def __init__(self, scan: Scan, edits: Mapping[Node, Edit]) -> None:
        self.scan = scan
        self._edits = edits

    def find(self, path: str) -> tuple[str, ...]:
        with self.scan.showing(self._edits):
            found = self.scan.select(path)
        return tuple(one if isinstance(one, str) else self._current(one, self._edits).value for one in found)

    def render(self) -> bytes:
        return self.scan.mark + "".join(self._pieces(self._edits)).encode()

    def per_run(self, changes: Sequence[Change]) -> Callable[[Mapping[str, Value]], bytes]:
        self.changed(changes, None)
        changes = tuple(changes)
        sets = [change for change in changes if isinstance(change, Set)]
        if len(sets) < len(changes):
            return lambda values: self.changed(changes, lambda text: fill(text, values)).render()
        return self._gapped(sets)

    def changed(self, changes: Sequence[Change], filled: Callable[[str], str] | None) -> TreeDocument:
        """Return a copy with the changes made. Without `filled`, values are not set: paths and expressions are checked."""
        document = self
        for are_sets, group in groupby(changes, lambda change: isinstance(change, Set)):
            if are_sets:
                document = document._set([change for change in group if isinstance(change, Set)], filled)
                continue
            for change in group:
                document = document._restructured(change, filled or _unfilled)
        return document

    def _gapped(self, sets: Sequence[Set]) -> Callable[[Mapping[str, Value]], bytes]:
        """Split the document at the values that differ between runs, so that each run only fills these gaps."""
        with self.scan.showing(self._edits):
            places = [(change, self._places(change)) for change in sets]
        gaps = sorted({node for _, nodes in places for node in nodes}, key=lambda node: node.start)
        begin = {node: self._current(node, self._edits) for node in gaps}
        ends = [0, *(node.end for node in gaps)]
        starts = [*(node.start for node in gaps), len(self.scan.text)]
        rest = {node: edit for node, edit in self._edits.items() if node not in begin}
        pieces = ["".join(self._pieces(rest, *span)).encode() for span in zip(ends, starts, strict=True)]
        pieces[0] = self.scan.mark + pieces[0]

        def render(values: Mapping[str, Value]) -> bytes:
            current = dict(begin)
            for change, nodes in places:
                text = _filled(change, lambda text: fill(text, values))
                for node in nodes:
                    current[node] = self._edit(change, node, current[node], text)
            made = [pieces[0]]
            for node, piece in zip(gaps, pieces[1:], strict=True):
                made += (current[node].token.encode(), piece)
            return b"".join(made)

        return render

    def _pieces(self, edits: Mapping[Node, Edit], start: int = 0, end: int | None = None) -> Iterator[str]:
        text = self.scan.text
        end = len(text) if end is None else end
        for node in sorted(edits, key=lambda node: node.start):
            if start <= node.start and node.end <= end:
                yield text[start : node.start]
                yield edits[node].token
                start = node.end
        yield text[start:end]

    def _current(self, node: Node, edits: Mapping[Node, Edit]) -> Edit:
        return edits.get(node) or Edit(self.scan.text[node.start : node.end], node.value)

    def _set(self, sets: Sequence[Set], filled: Callable[[str], str] | None) -> TreeDocument:
        edits = dict(self._edits)
        with self.scan.showing(self._edits):
            try:
                for change in sets:
                    nodes = self._places(change)
                    if filled is None:
                        _filled(change, _unfilled)
                        continue
                    text = _filled(change, filled)
                    for node in nodes:
                        edits[node] = self._edit(change, node, self._current(node, edits), text)
                        self.scan.show(node, edits[node].value)
            finally:
                for node in edits:
                    self.scan.show(node, node.value)
        return TreeDocument(self.scan, edits)

    def _edit(self, change: Set, node: Node, current: Edit, text: str) -> Edit:
        """Return a new value of a node, in its type. Raises TemplateError if the value does not fit."""
        if text == current.value:
            return current
        notation = self.scan.notation
        try:
            match node.kind:
                case Kind.NUMBER:
                    if same(current.value, text):
                        return current
                    token = notation.number(node, _number(node, text))
                    return Edit(token, token)
                case Kind.BOOLEAN:
                    if text not in ("true", "false"):
                        raise Unfit(f"is a boolean, which cannot become {text!r}; use true or false")
                    return current if current.value.lower() == text else Edit(text, text)
                case Kind.UNTYPED if same(current.value, text):
                    return current
            return Edit(notation.text(node, text), text)
        except Unfit as error:
            raise self._error(change, str(error)) from error

    def _matches(self, change: Change) -> list[Node]:
        """Return all matches of a change: at least one, and as many as the change expects."""
        scan = self.scan
        found = scan.select(change.path, _who(change))
        nodes = [node for node in found if isinstance(node, Node)]
        if len(nodes) < len(found):
            raise self._error(change, "selects names of keys; select the keys themselves")
        if not nodes:
            raise self._error(change, "matches nothing", one_line(nearest(change.path, scan.exists, scan.steps)))
        if change.expect is not None and len(nodes) != change.expect:
            raise self._error(change, f"matches {len(nodes)}", f", not {change.expect} as expected")
        return nodes

    def _places(self, change: Set) -> list[Node]:
        """Return the values that a `Set` writes."""
        if change.attribute is not None:
            raise self._error(
                change, f"has no attribute {change.attribute!r}", f"; {self._name} has keys: end the path with a key"
            )
        nodes = self._matches(change)
        for node in nodes:
            if node.kind in (Kind.MAPPING, Kind.LIST):
                raise self._error(change, f"is a {node.kind}; set works on single values")
            if node.kind is Kind.NULL:
                raise self._error(change, "is null, which has no type; write a value of the right type there")
            if node.why:
                raise self._error(change, node.why)
        return nodes

    def _restructured(self, change: Change, filled: Callable[[str], str]) -> TreeDocument:
        """Return the document after a change of its structure, read again after each match, the last match first."""
        with self.scan.showing(self._edits):
            nodes = self._matches(change)
        scan = Scan(self.render(), self.scan.name, self.scan.notation) if self._edits else self.scan
        for address in sorted((self.scan.address(node) for node in nodes), reverse=True):
            scan = self._restructure(scan, address, change, filled)
        return TreeDocument(scan, {})

    def _restructure(self, scan: Scan, address: Address, change: Change, filled: Callable[[str], str]) -> Scan:
        node = scan.at(address)
        try:
            if node.why:
                raise Unfit(node.why)
            match change:
                case Add():
                    return self._added(scan, address, change, filled)
                case Remove():
                    return self._removed(scan, address)
                case Rename():
                    return self._renamed(scan, address, filled(change.to) if _ONE_NAME.fullmatch(change.to) else change.to)
        except Unfit as error:
            raise self._error(change, str(error)) from error
        except ConfigError as error:
            raise ConfigError(f"{_who(change)}{error}") from error
        return scan

    def _added(self, scan: Scan, address: Address, change: Add, filled: Callable[[str], str]) -> Scan:
        node, new = scan.at(address), piece(change.xml, filled)
        if node.kind is Kind.LIST:
            if change.at is not None and change.at > len(node.children):
                raise Unfit(f"has {len(node.children)} items, so at={change.at} is too large")
            text = self.scan.notation.added(scan.text, node, None, new, change.at)
            items = list(node.plain_children())
            items.insert(len(items) if change.at is None else change.at, new.plain())
            return self._read(scan, text, address, lambda _: (Kind.LIST, tuple(items)))
        if node.kind is not Kind.MAPPING:
            raise Unfit(f"is a {node.kind}; add works on lists and mappings")
        if new.kind is not Kind.MAPPING or not new.children or change.at is not None:
            raise Unfit('is a mapping; add keys to it, as in json = \'{"key": 1}\', without "at"')
        for child in new.children:
            scan = self._added_key(scan, address, child)
        return scan

    def _added_key(self, scan: Scan, address: Address, new: Node) -> Scan:
        node, key = scan.at(address), new.key or ""
        if any(child.key == key for child in node.children):
            raise Unfit(f"already has the key {key!r}; set it")
        text = self.scan.notation.added(scan.text, node, key, new, None)
        return self._read(scan, text, address, lambda old: (Kind.MAPPING, {**_keys(old), key: new.plain()}))

    def _removed(self, scan: Scan, address: Address) -> Scan:
        if not address:
            raise Unfit("is the whole document, which cannot be removed")
        *above, index = address
        node, parent = scan.at(address), scan.at(tuple(above))
        text = self.scan.notation.removed(scan.text, parent, node)
        rest = [child for number, child in enumerate(parent.children) if number != index]
        left = Node(parent.kind, 0, 0, children=rest)
        return self._read(scan, text, tuple(above), lambda _: left.plain())

    def _renamed(self, scan: Scan, address: Address, to: str) -> Scan:
        node = scan.at(address)
        if node.key is None:
            raise Unfit("is an item of a list, which has no key" if address else "is the whole document, which has no key")
        parent = scan.at(address[:-1])
        if any(child.key == to for child in parent.children if child is not node):
            raise Unfit(f"cannot get the key {to!r}; there is another one")
        text, new = scan.text, self.scan.notation.key(node, to)
        for start, end in sorted(node.keys, reverse=True):
            text = text[:start] + new + text[end:]
        renamed = {to if child is node else child.key: child.plain() for child in parent.children}
        return self._read(scan, text, address[:-1], lambda _: (Kind.MAPPING, renamed))

    def _read(self, scan: Scan, text: str, address: Address, change: Callable[[Plain], Plain]) -> Scan:
        """Return a changed text, read again, after checking that it is the old data with this change."""
        try:
            new = Scan(scan.mark + text.encode(), scan.name, scan.notation)
        except TemplateError as error:
            raise Unfit("cannot be changed in its place; write it in the template in another style") from error
        if new.root.plain() != _rebuilt(scan.root, address, change):
            raise Unfit("cannot be changed in its place; write it in the template in another style")
        return new

    @property
    def _name(self) -> str:
        return self.scan.notation.name

    def _error(self, change: Change, what: str, more: str = "") -> TemplateError:
        """Return an error with a one-line message: the source of the change, its path, and what is wrong in this template."""
        return TemplateError(f"{_who(change)}{one_line(change.path)} in {self.scan.name} {what}{more}")


def _rebuilt(node: Node, address: Address, change: Callable[[Plain], Plain]) -> Plain:
    """Return the data of a document with one part changed."""
    if not address:
        return change(node.plain())
    child = node.children[address[0]]
    inner = _rebuilt(child, address[1:], change)
    if node.kind is Kind.LIST:
        return node.kind, tuple(inner if other is child else other.plain() for other in node.children)
    return node.kind, {other.key: inner if other is child else other.plain() for other in node.children}


def _keys(plain: Plain) -> dict[object, object]:
    found = plain[1]
    return found if isinstance(found, dict) else {}


def piece(json: str, filled: Callable[[str], str]) -> Node:
    """Return a new part of a document from JSON. A text that is one `{expression}` with a number becomes a number."""
    from sierra.templates.json import JsonNotation

    try:
        new = JsonNotation().scan(json, "json")
    except TemplateError as error:
        raise Unfit(f"cannot contain {json!r}; {error}") from error
    _fill_all(new, filled)
    return new


def _fill_all(node: Node, filled: Callable[[str], str]) -> None:
    if node.kind is Kind.TEXT:
        whole = _ONE_EXPRESSION.fullmatch(node.value)
        node.value = filled(node.value)
        if whole and NUMBER.fullmatch(node.value):
            node.kind = Kind.NUMBER
    for child in node.children:
        _fill_all(child, filled)


def _number(node: Node, text: str) -> str:
    """Return a number in the type of a node. Raises Unfit."""
    if not NUMBER.fullmatch(text):
        raise Unfit(f"is the number {node.value}, which cannot become {text!r}; use a number")
    if too_large(text):
        raise Unfit(f"cannot become {text[:40]}; it is too large")
    return f"{text}.0" if is_float(node.value) and not is_float(text) else text


def is_float(text: str) -> bool:
    """Return True if a number is not written as a whole number."""
    return any(character in text for character in ".eE")


def too_large(number: str) -> bool:
    """Return True for a number that no program reads exactly or as a finite float."""
    return len(number) > LONGEST or (is_float(number) and math.isinf(float(number)))


def _filled(change: Set, filled: Callable[[str], str]) -> str:
    try:
        return filled(change.value)
    except ConfigError as error:
        raise ConfigError(f"{_who(change)}{error}") from error


def _unfilled(text: str) -> str:
    """Return a text unchanged, after checking that it can be filled."""
    names(text)
    return text


def decoded(data: bytes, name: str) -> tuple[bytes, str]:
    """Return the byte order mark, if any, and the text of a file. Raises TemplateError if it is not UTF-8 text."""
    mark = b"\xef\xbb\xbf" if data.startswith(b"\xef\xbb\xbf") else b""
    try:
        text = data[len(mark) :].decode()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start + len(mark)) + 1
        raise TemplateError(f"{name}:{line}: not a text in UTF-8; save it as UTF-8") from error
    if "\0" in text:
        raise TemplateError(
            f"{name}:{text.count(chr(10), 0, text.index(chr(0))) + 1}: contains a NUL byte; it is a binary file"
        )
    return mark, text


def failure(name: str, text: str, place: int, what: str) -> TemplateError:
    """Return an error with the line and the column of a place."""
    line = text.count("\n", 0, place) + 1
    column = place - (text.rfind("\n", 0, place) + 1) + 1
    return TemplateError(f"{name}:{line}:{column}: {one_line(what)}")


def _who(change: Change) -> str:
    return f"{one_line(change.why)}: " if change.why else ""
