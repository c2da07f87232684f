"""The view of a document of keys, lists and values, in which XPath selects: keys and items as elements, values as texts.

A document of XML has one root element, but a mapping has many keys. Therefore the view of a mapping has a root element without
a name of its own, and absolute paths begin below it: `/swarm/count` becomes `/*/swarm/count`, `//count` becomes `/*//count`.
A lone `/` selects the root. Relative paths begin at the root already.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TypeAlias

from lxml import etree

from sierra.errors import TemplateError
from sierra.templates import xpath_time_limit
from sierra.templates.notation import Address, Edit, Kind, Node, Notation, decoded
from sierra.templates.xml_characters import replaced
from sierra.util.lazy_definitions import regex
from sierra.util.text import one_line

Element: TypeAlias = etree._Element
_NAME = regex("[A-Za-z_\xc0-\xd6\xd8-\xf6\xf8-\xff][A-Za-z_\xc0-\xd6\xd8-\xf6\xf8-\xff0-9.-]*")
"""A key that is a name in XPath; libxml2 has an old definition of letters outside of Latin-1."""
_TOKEN = regex(
    r"""\s*(?: (?P<literal> '[^']*' | "[^"]*") | (?P<number> \d+(?:\.\d*)? | \.\d+) | (?P<name> [^\W\d][\w.-]*)
    | (?P<sign> // | :: | \.\. | != | <= | >= | [^\s]) )""",
    re.VERBOSE,
)
_STEP = regex(r"\s*[\w*@.]")
_OPERATORS = frozenset({"and", "or", "div", "mod"})
_ENDS = frozenset({")", "]", ".", ".."})
"""Signs that end an operand; the others are operators, or expect one more step."""


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
            selected = etree.XPath(rooted, regexp=False)(self.view)
        except (etree.XPathError, ValueError) as error:
            raise TemplateError(f"{who}{shown} is not an XPath for {self.name}: {one_line(error)}") from error
        if not isinstance(selected, list):
            kind = {bool: "a boolean", float: "a number"}.get(type(selected), "a string")
            raise TemplateError(f"{who}{shown} returns {kind}, but must select keys or values in {self.name}")
        return list(dict.fromkeys(self._selected(node) for node in selected))

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
    return replaced(text)


def below_root(path: str) -> str:
    """Return a path in which every absolute path begins below the root element."""
    pieces: list[str] = []
    operand = slash = False  # after an operand; after a sign that a step must follow
    end = 0
    for token in _TOKEN.finditer(path):
        pieces.append(path[end : token.start()])
        end, sign, text = token.end(), token["sign"], token.group()
        if sign in ("/", "//") and not operand:
            text = text.replace(sign, _rooted(path, end, sign))
            operand, slash = text.endswith("*"), True
        elif sign == "*" or token["name"]:
            is_operator = operand and not slash and (sign == "*" or token["name"] in _OPERATORS)
            operand, slash = not is_operator, False
        elif sign in ("/", "//", "@", "::"):
            operand, slash = sign in ("/", "//"), True
        else:
            operand, slash = sign is None or sign in _ENDS, False
        pieces.append(text)
    return "".join([*pieces, path[end:]])


def _rooted(path: str, end: int, sign: str) -> str:
    return f"/*{sign}" if sign == "//" or _STEP.match(path, end) else "/*"
