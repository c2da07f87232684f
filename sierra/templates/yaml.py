"""YAML templates: one document, with the place of each key and value.

Programs read YAML by version 1.1 or 1.2, which differ. SIERRA interprets nothing that it does not change. It sets a value only
if both versions read the old value in the same way, and writes values that both read in the same way. A text that is not quoted
stays so if it is a plain word; otherwise it gets double quotes.

Refused: several documents, keys that occur twice (also as `1` and `0x1`), keys that are not single values, a document that its
aliases expand to more than MOST nodes, and an alias within its own anchor. A value cannot be set if an alias repeats it
elsewhere, if `<<` merges it, or if it has a tag.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import ClassVar

import yaml

from sierra.templates import brackets
from sierra.templates.notation import DEPTH, NUMBER, Kind, Node, Notation, Unfit, failure, is_float, too_large
from sierra.templates.tree import TreeTemplate
from sierra.util.lazy_definitions import regex

MOST = 1_000_000
"""Maximum number of nodes of a document after its aliases are expanded."""
_BOTH = regex(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+(?:[eE][+-][0-9]+)?)?")
"""A number in YAML 1.1 and 1.2."""
_NULLS = frozenset({"", "~", "null", "Null", "NULL"})
_BOOLEANS = frozenset({"true", "True", "TRUE", "false", "False", "FALSE"})
_DOUBTFUL = regex(
    r"""[yYnN] | yes | Yes | YES | no | No | NO | on | On | ON | off | Off | OFF | = | <<
    | [-+]?[0-9][0-9_,]*(?:\.[0-9_]*)?(?:[eE][-+]?[0-9]+)? | [-+]?\.[0-9_]+(?:[eE][-+]?[0-9]+)? | [-+]?0[xob][0-9a-fA-F_]+
    | [-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+(?:\.[0-9_]*)? | [-+]?\.(?:inf|Inf|INF) | \.(?:nan|NaN|NAN)
    | [0-9]{4}-[0-9]{1,2}-[0-9]{1,2}.*""",
    re.VERBOSE | re.DOTALL,
)
"""Texts that some programs read as a boolean, a number or a date, and others as something else."""
_PLAIN = regex(r"[A-Za-z_][A-Za-z0-9_./-]*(?: [A-Za-z0-9_./-]+)*")
_UNPRINTABLE = regex("[^\x20-\x7e\xa0-\u2027\u202a-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]")
_PROPERTIES = regex(r"(?:[&!]\S*\s+)*")


class YamlNotation:
    """The notation of YAML; see `sierra.templates.notation.Notation`."""

    name = "YAML"

    def scan(self, text: str, name: str) -> Node:
        return _Reader(text, name).document()

    def text(self, node: Node, text: str) -> str:
        if node.style == "'" and not _UNPRINTABLE.search(text):
            return "'" + text.replace("'", "''") + "'"
        plain = node.style == "" and _PLAIN.fullmatch(text) and _kind(text) is Kind.TEXT
        return text if plain else _quoted(text)

    def number(self, node: Node, text: str) -> str:
        return _number(text)

    def key(self, node: Node, key: str) -> str:
        return key if _PLAIN.fullmatch(key) and _kind(key) is Kind.TEXT else _quoted(key)

    def added(self, text: str, node: Node, key: str | None, new: Node, at: int | None) -> str:
        member = _written(new) if key is None else f"{self.key(node, key)}: {_written(new)}"
        if node.style == "flow":
            return brackets.insert(text, node, member, at)
        line_end = "\r\n" if "\r\n" in text else "\n"
        indent = " " * _column(text, _begin(text, node.children[0]))
        line = f"{indent}{'- ' if key is None else ''}{member}"
        if at is not None and at < len(node.children):
            start = _line(text, _begin(text, node.children[at]))
            return f"{text[:start]}{line}{line_end}{text[start:]}"
        end = _line_end(text, node.children[-1].end)
        return f"{text[:end]}{line_end}{line}{text[end:]}"

    def removed(self, text: str, parent: Node, node: Node) -> str:
        if parent.style == "flow":
            return brackets.take(text, parent, node)
        index = parent.children.index(node)
        begin = _begin(text, node)
        if len(parent.children) == 1:
            return f"{text[:begin]}{'[]' if parent.kind is Kind.LIST else '{}'}{text[node.end :]}"
        if not text[_line(text, begin) : begin].strip():
            end = _line_end(text, node.end)
            return text[: _line(text, begin)] + text[end:].removeprefix("\r").removeprefix("\n")
        if index + 1 == len(parent.children):
            raise Unfit("cannot be removed in its place; write it in the template in another style")
        return text[:begin] + text[_begin(text, parent.children[index + 1]) :]


class YamlTemplate(TreeTemplate):
    """The template format `yaml`."""

    notation: ClassVar[Notation] = YamlNotation()


class _Reader:
    """Makes nodes from the events of libyaml; nothing is constructed, and aliases are not expanded."""

    def __init__(self, text: str, name: str) -> None:
        self._text = text
        self._name = name
        self._sizes: dict[str, int | None] = {}
        """The sizes of anchored nodes with aliases expanded; None within the node itself."""
        self._used: set[str] = set()
        self._anchors: dict[Node, str] = {}

    def document(self) -> Node:
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        events: Iterator[yaml.Event] = yaml.parse(self._text, Loader=loader)
        try:
            root = self._root(events)
        except yaml.YAMLError as error:
            raise self._invalid(error) from error
        self._mark(root, "")
        return root

    def _root(self, events: Iterator[yaml.Event]) -> Node:
        root: Node | None = None
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                if root is not None:
                    raise self._wrong(event, "a second document begins there; a template must have one")
            elif isinstance(event, yaml.NodeEvent):
                root, _ = self._node(event, events, 0)
        if root is None:
            raise failure(self._name, self._text, 0, "not YAML: the document is empty")
        return root

    def _node(self, event: yaml.NodeEvent, events: Iterator[yaml.Event], depth: int) -> tuple[Node, int]:
        """Return a node, and its size with aliases expanded."""
        if depth > DEPTH:
            raise self._wrong(event, f"more than {DEPTH} levels of lists and mappings")
        if isinstance(event, yaml.AliasEvent):
            return self._alias(event)
        if event.anchor:
            self._sizes[event.anchor] = None
        if isinstance(event, yaml.ScalarEvent):
            node, size = self._scalar(event), 1
        else:
            node, size = self._collection(event, events, depth)
        if event.tag and not node.why:
            node.why = f"has the tag {event.tag}; SIERRA does not know how programs read it"
        if event.anchor:
            self._sizes[event.anchor] = size
            self._anchors[node] = event.anchor
        if size > MOST:
            raise self._wrong(event, f"aliases expand the document to more than {MOST} nodes")
        return node, size

    def _alias(self, event: yaml.AliasEvent) -> tuple[Node, int]:
        if event.anchor not in self._sizes:
            raise self._wrong(event, f"the alias *{event.anchor} has no anchor before it")
        size = self._sizes[event.anchor]
        if size is None:
            raise self._wrong(event, f"the alias *{event.anchor} is part of its own anchor")
        self._used.add(event.anchor)
        why = f"is the alias *{event.anchor}; write its content there to change it"
        return Node(Kind.FIXED, event.start_mark.index, event.end_mark.index, f"*{event.anchor}", why=why), size

    def _collection(self, event: yaml.NodeEvent, events: Iterator[yaml.Event], depth: int) -> tuple[Node, int]:
        kind = Kind.MAPPING if isinstance(event, yaml.MappingStartEvent) else Kind.LIST
        flow = bool(event.flow_style)
        node = Node(kind, event.end_mark.index - 1 if flow else event.start_mark.index, 0, style="flow" if flow else "block")
        size, keys = 1, set[object]()
        for inner in events:
            if isinstance(inner, yaml.MappingEndEvent | yaml.SequenceEndEvent):
                node.end = inner.end_mark.index if flow else node.children[-1].end
                break
            key = self._key(inner, keys) if kind is Kind.MAPPING else None
            child, its_size = self._node(next(events) if key else inner, events, depth + 1)
            child.key = key.value if key else None
            child.keys = [(key.start, key.end)] if key else []
            child.entries = [(key.start if key else child.start, child.end)]
            if key and key.value == "<<" and not key.style:
                _forbid(child, "is merged by <<, where programs may ignore it; write it beside the key <<")
            node.children.append(child)
            size += its_size
        return node, size

    def _key(self, event: yaml.Event, keys: set[object]) -> Node:
        if not isinstance(event, yaml.ScalarEvent):
            raise self._wrong(event, "a key must be a single value")
        node = self._scalar(event)
        names = {node.value, ("read as", node.value if node.style else _read_as(node.value))}
        if not keys.isdisjoint(names):
            raise self._wrong(event, f"the key {node.value!r} occurs twice")
        keys |= names
        return node

    def _scalar(self, event: yaml.ScalarEvent) -> Node:
        start, end = event.start_mark.index, event.end_mark.index
        written = self._text[start:end]
        if event.anchor or event.tag:
            properties = _PROPERTIES.match(written + " ")
            start += min(properties.end(), len(written)) if properties else 0
        style = (event.style or "").strip()
        if style in ("|", ">"):
            end = start + len(self._text[start:end].rstrip())
        kind = Kind.TEXT if style else _kind(event.value)
        node = Node(kind, start, end, event.value, style=style)
        if kind is Kind.NUMBER and too_large(event.value):
            raise self._wrong(event, f"the number {event.value[:20]}… is too large")
        if kind is Kind.FIXED:
            right = "write a plain number, true, false or quotes"
            node.why = f"is {event.value[:40]}, which YAML 1.1 and 1.2 read in different ways; {right}"
        return node

    def _mark(self, node: Node, anchor: str) -> None:
        """Forbid changes of everything that an alias repeats elsewhere."""
        own = self._anchors.get(node, "")
        anchor = own if own in self._used else anchor
        if anchor:
            node.why = (
                f"is part of the anchor &{anchor}, which an alias repeats elsewhere; write its content there to change it"
            )
        for child in node.children:
            self._mark(child, anchor)

    def _wrong(self, event: yaml.Event, what: str) -> Exception:
        return failure(self._name, self._text, event.start_mark.index, f"not a YAML template: {what}")

    def _invalid(self, error: yaml.YAMLError) -> Exception:
        mark = getattr(error, "problem_mark", None)
        position = mark.index if mark is not None else getattr(error, "position", 0)
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or error
        return failure(self._name, self._text, position, f"not YAML: {problem}")


def _read_as(plain: str) -> object:
    """Return a key without quotes as programs of YAML 1.1 read it: `0x1` is 1, and `yes` is true."""
    if _kind(plain) is Kind.TEXT:
        return plain
    try:
        return yaml.safe_load(plain)
    except (yaml.YAMLError, ValueError):
        return plain


def _forbid(node: Node, why: str) -> None:
    """Forbid changes of a node and all that is in it."""
    node.why = node.why or why
    for child in node.children:
        _forbid(child, why)


def _kind(plain: str) -> Kind:
    """Return what a value without quotes is for all programs; FIXED if they differ."""
    if plain in _NULLS:
        return Kind.NULL
    if plain in _BOOLEANS:
        return Kind.BOOLEAN
    if _BOTH.fullmatch(plain):
        return Kind.NUMBER
    return Kind.FIXED if _DOUBTFUL.fullmatch(plain) else Kind.TEXT


def _number(text: str) -> str:
    """Return a number in a notation that YAML 1.1 and 1.2 share: `1.0e-05`."""
    if not NUMBER.fullmatch(text) or not is_float(text):
        return text
    digits, _, exponent = text.lower().partition("e")
    digits = digits if "." in digits else f"{digits}.0"
    return f"{digits}e{exponent if exponent[0] in '+-' else f'+{exponent}'}" if exponent else digits


def _quoted(text: str) -> str:
    """Return a text in double quotes."""
    escaped = json.dumps(text, ensure_ascii=False)
    return _UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", escaped)


def _written(node: Node) -> str:
    """Return a new node in brackets, on one line."""
    return brackets.written(node, _quoted, _number)


def _begin(text: str, node: Node) -> int:
    """Return the place of a node's key, or of the dash before it."""
    return node.keys[0][0] if node.keys else text.rfind("-", 0, node.start)


def _line(text: str, position: int) -> int:
    return text.rfind("\n", 0, position) + 1


def _column(text: str, position: int) -> int:
    return position - _line(text, position)


def _line_end(text: str, position: int) -> int:
    """Return the place of the line break after a place."""
    end = text.find("\n", position)
    end = len(text) if end < 0 else end
    return end - 1 if text[end - 1 : end] == "\r" else end
