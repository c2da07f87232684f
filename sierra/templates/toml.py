"""TOML templates (version 1.0), with the place of each key and value.

`tomllib` reads and validates the document. It does not report places, so a scanner finds them in the valid text. Both must
agree on the structure. A number in another notation (`0x10`, `1_000`) stays as it is until another number is set. A date can
become a date of the same kind. `inf` and `nan` cannot be set.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Iterator
from typing import ClassVar

from sierra.errors import TemplateError
from sierra.templates import brackets
from sierra.templates.notation import DEPTH, NUMBER, Kind, Node, Notation, Span, Unfit, failure, too_large
from sierra.templates.tree import TreeTemplate
from sierra.util.lazy_definitions import regex

Key = tuple[str, Span]
_FILLER = regex(r"(?:[ \t\r\n]|\#[^\n]*)*")
_BLANK = regex(r"[ \t]*")
_BARE = regex(r"[A-Za-z0-9_-]+")
_TEXTS = (
    ('"""', regex(r'"""(?:[^"\\]|\\.|"{1,2}(?!"))*"{3,5}', re.DOTALL)),
    ("'''", regex(r"'''(?:[^']|'{1,2}(?!'))*'{3,5}", re.DOTALL)),
    ('"', regex(r'"(?:[^"\\\n]|\\.)*"')),
    ("'", regex(r"'[^'\n]*'")),
)
_WORD = regex(r"[0-9]{4}-[0-9]{2}-[0-9]{2} [0-9:][^\s,\]}#]*|[^\s,\]}#]+")
_MOMENT = regex(r"[0-9:.TtZz+ -]+")
_PLACE = regex(r" \(at line ([0-9]+), column ([0-9]+)\)| \(at end of document\)")


class TomlNotation:
    """The notation of TOML; see `sierra.templates.notation.Notation`."""

    name = "TOML"

    def scan(self, text: str, name: str) -> Node:
        try:
            data = tomllib.loads(text)
            root = _Scanner(text).document()
        except RecursionError as error:
            raise failure(name, text, 0, f"not a TOML template: more than {DEPTH} levels of lists and tables") from error
        except ValueError as error:
            raise _invalid(name, text, error) from error
        _assign(root, data, text, name, 0)
        return root

    def text(self, node: Node, text: str) -> str:
        if node.kind is Kind.DATE:
            return _date(node, text)
        if node.style == "'" and text.isprintable() and "'" not in text:
            return f"'{text}'"
        return _quoted(text)

    def number(self, node: Node, text: str) -> str:
        return text

    def key(self, node: Node, key: str) -> str:
        return key if _BARE.fullmatch(key) else _quoted(key)

    def added(self, text: str, node: Node, key: str | None, new: Node, at: int | None) -> str:
        if node.style == "brackets":
            return brackets.insert(text, node, _member(key, new), at)
        line_end = "\r\n" if "\r\n" in text else "\n"
        if key is None:
            return _with_table(text, node, new, at, line_end)
        if not node.entries:
            raise Unfit("is a table without a header; write its header in the template")
        start, end = node.entries[0]
        last = text[text.rfind("\n", 0, max(end - 1, 0)) + 1 : end]
        indent = _BLANK.match(last)
        line = f"{indent[0] if indent and end > start else ''}{_member(key, new)}{line_end}"
        before = line_end if end and text[end - 1] != "\n" else ""
        return f"{text[:end]}{before}{line}{text[end:]}"

    def removed(self, text: str, parent: Node, node: Node) -> str:
        if parent.style == "brackets":
            return brackets.take(text, parent, node)
        end = len(text)
        for first, last in sorted(_regions(node), reverse=True):
            text = text[:first] + text[max(first, min(last, end)) :]
            end = first
        return text


class TomlTemplate(TreeTemplate):
    """The template format `toml`."""

    notation: ClassVar[Notation] = TomlNotation()


class _Scanner:
    """Finds the places of keys and values in a valid document."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._known: dict[tuple[Node, str], Node] = {}

    def document(self) -> Node:
        text = self._text
        root = table = Node(Kind.MAPPING, 0, len(text), style="table", entries=[(0, 0)])
        offset = self._fill(0)
        while offset < len(text):
            start = text.rfind("\n", 0, offset) + 1
            if text[offset] == "[":
                if table is root and root.entries == [(0, 0)]:
                    root.entries = [(start, start)]  # keys of the document would be written before the first header
                table, end = self._header(root, offset)
                table.entries = [(start, self._line_end(end))]
            else:
                node, end = self._pair(table, offset)
                end = self._line_end(end)
                node.entries = [(start, end)]
                table.entries = [(table.entries[0][0], end)]
            offset = self._fill(end)
        return root

    def _header(self, root: Node, position: int) -> tuple[Node, int]:
        """Return the table of a header, and the end of the header."""
        is_item = self._text.startswith("[[", position)
        keys, end = self._keys(self._blank(position + 1 + is_item))
        if not is_item:
            return self._table(root, keys), end + 1
        *above, (key, span) = keys
        tables = self._child(self._table(root, above), key, span, Kind.LIST)
        tables.children.append(Node(Kind.MAPPING, position, end + 2, style="table"))
        return tables.children[-1], end + 2

    def _pair(self, table: Node, position: int) -> tuple[Node, int]:
        """Return the node of a key with its value, in its table, and its end."""
        keys, end = self._keys(position)
        *above, (key, span) = keys
        node = self._value(self._blank(end + 1))
        node.key, node.keys, node.entries = key, [span], [(position, node.end)]
        parent = self._table(table, above)
        parent.children.append(node)
        self._known[parent, key] = node
        return node, node.end

    def _keys(self, offset: int) -> tuple[list[Key], int]:
        """Return the parts of a dotted key, and the place of the sign after it."""
        keys: list[Key] = []
        while True:
            bare = _BARE.match(self._text, offset)
            end = bare.end() if bare else self._quoted(offset)[1]
            written = self._text[offset:end]
            keys.append((written if bare else str(tomllib.loads(f"key = {written}")["key"]), (offset, end)))
            offset = self._blank(end)
            if self._text[offset : offset + 1] != ".":
                return keys, offset
            offset = self._blank(offset + 1)

    def _table(self, node: Node, keys: list[Key]) -> Node:
        """Return the table that keys lead to; it is made if it is new. Within a list of tables, it is the last."""
        for key, span in keys:
            node = self._child(node, key, span, Kind.MAPPING)
            node = node.children[-1] if node.kind is Kind.LIST else node
        return node

    def _child(self, node: Node, key: str, span: Span, kind: Kind) -> Node:
        found = self._known.get((node, key))
        if found is None:
            found = self._known[node, key] = Node(kind, span[0], span[1], key=key, style="table")
            node.children.append(found)
        found.keys.append(span)
        return found

    def _value(self, offset: int) -> Node:
        first = self._text[offset]
        if first == "[":
            return self._array(offset)
        if first == "{":
            return self._inline(offset)
        if first in "\"'":
            style, end = self._quoted(offset)
            return Node(Kind.TEXT, offset, end, style=style)
        word = _WORD.match(self._text, offset)
        return Node(Kind.FIXED, offset, word.end() if word else offset)

    def _array(self, position: int) -> Node:
        node = Node(Kind.LIST, position, position, style="brackets")
        position = self._fill(position + 1)
        while self._text[position] != "]":
            child = self._value(position)
            child.entries = [(child.start, child.end)]
            node.children.append(child)
            position = self._comma(child.end)
        node.end = position + 1
        return node

    def _inline(self, position: int) -> Node:
        node = Node(Kind.MAPPING, position, position, style="brackets")
        position = self._fill(position + 1)
        while self._text[position] != "}":
            _, end = self._pair(node, position)
            position = self._comma(end)
        node.end = position + 1
        return node

    def _comma(self, position: int) -> int:
        position = self._fill(position)
        return self._fill(position + 1) if self._text[position] == "," else position

    def _quoted(self, position: int) -> tuple[str, int]:
        """Return the quotes and the end of a text."""
        for style, pattern in _TEXTS:
            if self._text.startswith(style, position) and (match := pattern.match(self._text, position)):
                return style, match.end()
        return "", position

    def _fill(self, position: int) -> int:
        match = _FILLER.match(self._text, position)
        return match.end() if match else position

    def _blank(self, position: int) -> int:
        match = _BLANK.match(self._text, position)
        return match.end() if match else position

    def _line_end(self, position: int) -> int:
        end = self._text.find("\n", position)
        return len(self._text) if end < 0 else end + 1


def _assign(node: Node, data: object, text: str, name: str, depth: int) -> None:
    """Write the kinds and values that `tomllib` has read into the nodes. Raises TemplateError."""
    if depth > DEPTH:
        raise failure(name, text, node.start, f"not a TOML template: more than {DEPTH} levels of lists and tables")
    if isinstance(data, dict):
        if node.kind is not Kind.MAPPING or {child.key for child in node.children} != set(data):
            raise failure(name, text, node.start, "this table cannot be read; write it in another way")
        for child in node.children:
            _assign(child, data[child.key], text, name, depth + 1)
    elif isinstance(data, list):
        if node.kind is not Kind.LIST or len(node.children) != len(data):
            raise failure(name, text, node.start, "this list cannot be read; write it in another way")
        for child, item in zip(node.children, data, strict=True):
            _assign(child, item, text, name, depth + 1)
    else:
        _assign_value(node, data, text, name)


def _assign_value(node: Node, data: object, text: str, name: str) -> None:
    written = text[node.start : node.end]
    if isinstance(data, str):
        node.value = data
    elif isinstance(data, bool):
        node.kind, node.value = Kind.BOOLEAN, written
    elif isinstance(data, int | float):
        plain = written.replace("_", "").removeprefix("+")
        node.kind, node.value = Kind.NUMBER, plain if NUMBER.fullmatch(plain) else str(data)
        if isinstance(data, float) and not math.isfinite(data):
            node.kind, node.why = Kind.FIXED, f"is {written}, which is not a finite number; write a number"
        if too_large(plain):
            raise failure(name, text, node.start, f"the number {plain[:20]}… is too large")
    else:
        node.kind, node.value = Kind.DATE, written


def _invalid(name: str, text: str, error: ValueError) -> TemplateError:
    said = str(error)
    position = _PLACE.search(said)
    line, column = (int(position[1]), int(position[2])) if position and position[1] else (text.count("\n") + 1, 1)
    return TemplateError(f"{name}:{line}:{column}: not TOML: {_PLACE.sub('', said)}")


def _date(node: Node, text: str) -> str:
    """Return a date or time, if it is of the same kind as that of a node."""
    try:
        old, new = (tomllib.loads(f"x = {written}")["x"] for written in (node.value, text))
    except (ValueError, RecursionError) as error:
        raise Unfit(f"is {node.value}, which cannot become {text!r}; use a date or time of the same kind") from error
    local = getattr(old, "tzinfo", None) is not None and getattr(new, "tzinfo", None) is None
    if type(old) is not type(new) or local or not _MOMENT.fullmatch(text):
        raise Unfit(f"is {node.value}, which cannot become {text!r}; use a date or time of the same kind")
    return text


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _member(key: str | None, new: Node) -> str:
    if key is None:
        return _written(new)
    return f"{key if _BARE.fullmatch(key) else _quoted(key)} = {_written(new)}"


def _written(node: Node) -> str:
    """Return a new node in brackets, on one line."""
    match node.kind:
        case Kind.MAPPING:
            return f"{{{', '.join(_member(child.key, child) for child in node.children)}}}"
        case Kind.LIST:
            return f"[{', '.join(map(_written, node.children))}]"
        case Kind.TEXT:
            return _quoted(node.value)
        case Kind.NULL:
            raise Unfit("cannot contain null; TOML has none")
    return node.value


def _with_table(text: str, node: Node, new: Node, at: int | None, line_end: str) -> str:
    """Return the document with a new item `[[…]]` after the last one of a list of tables."""
    if new.kind is not Kind.MAPPING or (at is not None and at < len(node.children)):
        raise Unfit("is a list of tables; add a table to its end")
    last = node.children[-1]
    end = max(end for _, end in _regions(last))
    lines = [text[last.start : last.end], *(_member(child.key, child) for child in new.children)]
    before = line_end if text[end - 1 : end] != "\n" else ""
    return f"{text[:end]}{before}{line_end}{line_end.join(lines)}{line_end}{text[end:]}"


def _regions(node: Node) -> Iterator[Span]:
    """Yield the places of a node's lines, also of its tables elsewhere."""
    yield from node.entries
    if node.style == "table":
        for child in node.children:
            yield from _regions(child)
