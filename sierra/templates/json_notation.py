"""JSON templates (RFC 8259): strict, with the place of each key and value.

Refused: comments, trailing commas, `NaN` and `Infinity`, keys that occur twice, numbers that are too large, text after the
document, and other encodings than UTF-8.
"""

from __future__ import annotations

import json
from json.decoder import scanstring  # type: ignore[attr-defined]

from sierra.templates import brackets
from sierra.templates.notation import DEPTH, NUMBER, Kind, Node, failure, too_large
from sierra.util.lazy_definitions import regex

_SPACE = regex(r"[ \t\n\r]*")
_WORD = regex(r"[A-Za-z_+-]?[\w.+-]*")
_WORDS = {"true": Kind.BOOLEAN, "false": Kind.BOOLEAN, "null": Kind.NULL}


class JsonNotation:
    """The notation of JSON; see `sierra.templates.notation.Notation`."""

    name = "JSON"

    def scan(self, text: str, name: str) -> Node:
        return _Scanner(text, name).document()

    def text(self, node: Node, text: str) -> str:
        return json.dumps(text, ensure_ascii=False)

    def number(self, node: Node, text: str) -> str:
        return text

    def key(self, node: Node, key: str) -> str:
        return json.dumps(key, ensure_ascii=False)

    def added(self, text: str, node: Node, key: str | None, new: Node, at: int | None) -> str:
        member = _written(new) if key is None else f"{_quoted(key)}: {_written(new)}"
        return brackets.insert(text, node, member, at)

    def removed(self, text: str, parent: Node, node: Node) -> str:
        return brackets.take(text, parent, node)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _written(node: Node) -> str:
    return brackets.written(node, _quoted, str)


class _Scanner:
    def __init__(self, text: str, name: str) -> None:
        self._text = text
        self._name = name

    def document(self) -> Node:
        node = self._value(self._skip(0), 0)
        end = self._skip(node.end)
        if end < len(self._text):
            raise self._wrong(end, "text after the end of the document")
        return node

    def _value(self, position: int, depth: int) -> Node:
        first = self._text[position : position + 1]
        if first in ("{", "["):
            if depth == DEPTH:
                raise self._wrong(position, f"more than {DEPTH} levels of lists and objects")
            return self._members(position, depth + 1)
        if first == '"':
            value, end = self._string(position)
            return Node(Kind.TEXT, position, end, value)
        return self._word(position)

    def _members(self, offset: int, depth: int) -> Node:
        is_object = self._text[offset] == "{"
        node = Node(Kind.MAPPING if is_object else Kind.LIST, offset, offset)
        keys: set[str] = set()
        close = "}" if is_object else "]"
        offset = self._skip(offset + 1)
        while self._text[offset : offset + 1] != close:
            if node.children:
                offset = self._skip(self._expect(offset, ","))
            child = self._member(offset, depth, keys) if is_object else self._item(offset, depth)
            node.children.append(child)
            offset = self._skip(child.end)
        node.end = offset + 1
        return node

    def _item(self, position: int, depth: int) -> Node:
        node = self._value(position, depth)
        node.entries = [(node.start, node.end)]
        return node

    def _member(self, position: int, depth: int, keys: set[str]) -> Node:
        if self._text[position : position + 1] != '"':
            raise self._wrong(position, "a key in double quotes is expected")
        key, end = self._string(position)
        if key in keys:
            raise self._wrong(position, f"the key {key!r} occurs twice")
        keys.add(key)
        node = self._value(self._skip(self._expect(self._skip(end), ":")), depth)
        node.key, node.keys, node.entries = key, [(position, end)], [(position, node.end)]
        return node

    def _word(self, position: int) -> Node:
        match = _WORD.match(self._text, position)
        word = match[0] if match else ""
        if word in _WORDS:
            return Node(_WORDS[word], position, position + len(word), word)
        if not NUMBER.fullmatch(word):
            raise self._wrong(position, f"{word[:40]!r} is not a value of JSON" if word else self._unexpected(position))
        if too_large(word):
            raise self._wrong(position, f"the number {word[:20]}… is too large")
        return Node(Kind.NUMBER, position, position + len(word), word)

    def _string(self, position: int) -> tuple[str, int]:
        try:
            value, end = scanstring(self._text, position + 1, True)
            return str(value), int(end)
        except json.JSONDecodeError as error:
            raise self._wrong(error.pos, f"{error.msg[0].lower()}{error.msg[1:].removesuffix(' at')} in a string") from error

    def _expect(self, position: int, sign: str) -> int:
        if self._text[position : position + 1] != sign:
            raise self._wrong(position, f"{sign!r} is expected; {self._unexpected(position)}")
        return position + 1

    def _unexpected(self, position: int) -> str:
        found = self._text[position : position + 2]
        if found in ("//", "/*") or found[:1] == "#":
            return "comments are not allowed in JSON"
        return f"{found[0]!r} is not allowed there" if found else "the document ends too early"

    def _skip(self, position: int) -> int:
        match = _SPACE.match(self._text, position)
        return match.end() if match else position

    def _wrong(self, position: int, what: str) -> Exception:
        return failure(self._name, self._text, position, f"not JSON: {what}")
