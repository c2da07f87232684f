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

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.errors import ConfigError, TemplateError
from sierra.model import Add, Change, Remove, Rename, Repeat, Set, Value
from sierra.templates.arithmetic import fill, names
from sierra.templates.base import Rendered
from sierra.templates.data_view import Scan
from sierra.templates.json_notation import JsonNotation
from sierra.templates.nearest_path import nearest
from sierra.templates.notation import (
    NUMBER,
    Address,
    Edit,
    Kind,
    Node,
    Notation,
    Plain,
    Unfit,
    copies,
    is_float,
    placed,
    unfit_number,
)
from sierra.templates.same_number import is_lost, same
from sierra.util.hashing import sha256
from sierra.util.lazy_definitions import regex
from sierra.util.text import one_line

_ONE_NAME = regex(r"\{[A-Za-z_]\w*\}")
_ONE_EXPRESSION = regex(r"\{[^{}]*\}")


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
            rendered = [pieces[0]]
            for node, piece in zip(gaps, pieces[1:], strict=True):
                rendered += (current[node].token.encode(), piece)
            return b"".join(rendered)

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
                case Kind.UNTYPED if why := is_lost(current.value, text):
                    raise Unfit(f"is the number {current.value}, which cannot become {text}; {why}")
            return Edit(notation.text(node, text), text)
        except Unfit as error:
            raise self._error(change, str(error)) from error

    def _matches(self, change: Change) -> list[Node]:
        """Return all matches of a change: at least one, and as many as the change expects."""
        scan = self.scan
        selected = scan.select(change.path, _who(change))
        nodes = [node for node in selected if isinstance(node, Node)]
        if len(nodes) < len(selected):
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
                case Repeat():
                    return self._repeated(scan, address, change, filled)
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

    def _repeated(self, scan: Scan, address: Address, change: Repeat, filled: Callable[[str], str]) -> Scan:
        """Put copies of an item into the place of all items of its list."""
        *above, index = address or (0,)
        parent = scan.at(tuple(above))
        if not address or parent.kind is not Kind.LIST:
            raise Unfit("is no item of a list; repeat works on these")
        if filled(change.count).startswith("{"):
            return scan
        item = scan.at(address)
        new_items = [_copy(item, values, scan.text) for values in copies(change, _texts(item), filled)]
        for other in reversed(range(len(parent.children))):
            scan = scan if other == index else self._removed(scan, (*above, other))
        text, parent = scan.text, scan.at(tuple(above))
        # Each is put after the item, at the same place of the text, which need not be read again for the next one.
        each = [self.scan.notation.added(text, parent, None, new, None) for new in new_items]
        common = min((_common(text, longer) for longer in each), default=0)
        pieces = (longer[common : common + len(longer) - len(text)] for longer in each)
        text = text[:common] + "".join(pieces) + text[common:]
        items = (item.plain(), *(new.plain() for new in new_items))
        scan = self._read(scan, text, tuple(above), lambda _: (Kind.LIST, items))
        return self._removed(scan, (*above, 0))

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
    try:
        new = JsonNotation().scan(json, "json")
    except TemplateError as error:
        raise Unfit(f"cannot contain {json!r}; {error}") from error
    _fill_all(new, filled)
    return new


def _common(text: str, longer: str) -> int:
    """Return the number of characters with which both texts begin."""
    return next((position for position, (a, b) in enumerate(zip(text, longer, strict=False)) if a != b), len(text))


def _texts(node: Node) -> Iterator[str]:
    """Yield all texts of a part of a document."""
    if node.kind is Kind.TEXT:
        yield node.value
    for child in node.children:
        yield from _texts(child)


def _copy(node: Node, values: Mapping[str, str], text: str) -> Node:
    """Return a copy of a part of a document, with its number for `{index}`, and its pose. Raises Unfit."""
    if node.why:
        raise Unfit(f"cannot be repeated: a part of it {node.why}")
    if node.kind is Kind.MAPPING and (raw := text[node.start : node.end]) in values:
        raise Unfit(f"cannot be repeated: {raw} without quotes is a mapping; write '{raw}'")
    children = [_copy(child, values, text) for child in node.children]
    new = Node(node.kind, 0, 0, node.value, node.key, children=children)
    if node.kind is Kind.TEXT:
        new.value = placed(node.value, values)
        new.kind = Kind.NUMBER if node.value in values else Kind.TEXT
    return new


def _fill_all(node: Node, filled: Callable[[str], str]) -> None:
    if node.kind is Kind.TEXT:
        whole = _ONE_EXPRESSION.fullmatch(node.value)
        node.value = filled(node.value)
        if whole and NUMBER.fullmatch(node.value):
            node.kind = Kind.NUMBER
    if node.kind is Kind.NUMBER and (why := unfit_number(node.value)):
        raise Unfit(f"cannot contain {node.value[:40]}; {why}")
    for child in node.children:
        _fill_all(child, filled)


def _number(node: Node, text: str) -> str:
    """Return a number in the type of a node. Raises Unfit."""
    if not NUMBER.fullmatch(text):
        raise Unfit(f"is the number {node.value}, which cannot become {text!r}; use a number")
    written = f"{text}.0" if is_float(node.value) and not is_float(text) else text
    if why := unfit_number(written):
        raise Unfit(f"cannot become {text[:40]}; {why}")
    return written


def _filled(change: Set, filled: Callable[[str], str]) -> str:
    try:
        return filled(change.value)
    except ConfigError as error:
        raise ConfigError(f"{_who(change)}{error}") from error


def _unfilled(text: str) -> str:
    """Return a text unchanged, after checking that it can be filled."""
    names(text)
    return text


def _who(change: Change) -> str:
    return f"{one_line(change.why)}: " if change.why else ""
