"""The contract of formats for trees of keys, lists and values: nodes with their places, and how values are written."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from decimal import Decimal
from enum import StrEnum
from typing import Protocol

from sierra.errors import TemplateError
from sierra.model import INDEX, POSE, Repeat
from sierra.util.float_range import TOO_LARGE, out_of_range
from sierra.util.lazy_definitions import dataclass, field, regex
from sierra.util.random_poses import RandomPoses
from sierra.util.text import counted, one_line

Span = tuple[int, int]
Address = tuple[int, ...]
"""The indices of the children that lead to a node."""
Plain = tuple[str, object]
"""Data without places, for comparisons: a kind, and a text, a tuple of items, or a mapping."""
DEPTH = 100
"""Maximum depth of a document."""
LONGEST = 400
"""Maximum number of characters of a number."""
NUMBER = regex(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?")
"""A number as all formats write it."""

_POSE = regex(r"(?<![${])\{(?:x|y|yaw)\}(?!\})")
MOST_COPIES = 10_000


def copies(change: Repeat, texts: Iterable[str], filled: Callable[[str], str]) -> Iterator[Mapping[str, str]]:
    """Yield, for each copy, the values of `{index}`, `{x}`, `{y}` and `{yaw}` in the texts of its original. Raises Unfit."""
    count = filled(change.count)
    number = int(count) if re.fullmatch(r"[0-9]{1,9}", count) else -1
    if not 0 <= number <= MOST_COPIES:
        raise Unfit(f"cannot be repeated {count[:40]!r} times; use a whole number from 0 to {MOST_COPIES}")
    poses = change.poses
    if poses and not any(map(_POSE.search, texts)):
        raise Unfit(f"has poses, but no text in it contains {', '.join(POSE[:-1])} or {POSE[-1]}")
    if isinstance(poses, RandomPoses):
        try:
            poses = tuple(poses.drawn(filled(change.seed), number))
        except TemplateError as error:
            raise Unfit(f"cannot be repeated {number} times; {error}") from error
    if poses and len(poses) < number:
        raise Unfit(f"cannot be repeated {number} times with {counted(len(poses), 'pose')}; add poses, or use random_poses")
    for index in range(number):
        yield {INDEX: str(index), **(dict(zip(POSE, map(repr, poses[index]), strict=True)) if poses else {})}


def placed(text: str, values: Mapping[str, str]) -> str:
    """Return a text of a copy, with its number and its pose; `${x}` and `{{x}}` stay. Raises Unfit without poses."""

    def value(match: re.Match[str]) -> str:
        if match[0] not in values:
            raise Unfit(f"contains {match[0]}, but there are no poses; give the variable poses or random_poses")
        return values[match[0]]

    return _POSE.sub(value, text.replace(INDEX, values[INDEX]))


class Kind(StrEnum):
    """The type of a value."""

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
    """The notation, for example the kind of brackets; the format knows the meaning."""
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


@dataclass(frozen=True, slots=True)
class Edit:
    """A new value of a node: as it is written, and as it is read."""

    token: str
    value: str


class Unfit(Exception):
    """A change that a format cannot write; the message completes `PATH … in TEMPLATE`."""


class Notation(Protocol):
    """The reading and writing of data by a format. Places are indices in the text of the document."""

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


def is_float(text: str) -> bool:
    """Return True if a number is not written as a whole number."""
    return any(character in text for character in ".eE")


def too_large(number: str) -> bool:
    """Return True for a number that no program reads exactly or as a finite float."""
    return unfit_number(number) == TOO_LARGE


def unfit_number(number: str) -> str:
    """Return why programs would not read a new number as it is written; empty if they do."""
    return TOO_LARGE if len(number) > LONGEST else out_of_range(number) if is_float(number) else ""


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


def failure(name: str, text: str, position: int, what: str) -> TemplateError:
    """Return an error with the line and the column of a place."""
    line = text.count("\n", 0, position) + 1
    column = position - (text.rfind("\n", 0, position) + 1) + 1
    return TemplateError(f"{name}:{line}:{column}: {one_line(what)}")
