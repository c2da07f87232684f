"""Changes of lists and mappings that are written between brackets, as in JSON: `[1, 2]` and `{"a": 1}`.

A new member gets the white space of the member beside it. The first of a node's `entries` is its place as a member.
"""

from __future__ import annotations

from collections.abc import Callable

from sierra.templates.notation import Kind, Node
from sierra.util.lazy_definitions import regex

_BLANK = regex(r"\s*")


def insert(text: str, node: Node, member: str, at: int | None) -> str:
    """Return a document with a new member between the brackets of a node: before the member `at`, or last."""
    places = [child.entries[0] for child in node.children]
    if not places:
        return f"{text[: node.start + 1]}{member}{text[node.end - 1 :]}"
    index = len(places) if at is None else at
    if index < len(places):
        start = places[index][0]
        return f"{text[:start]}{member},{_before(text, node, index) or ' '}{text[start:]}"
    end = places[-1][1]
    return f"{text[:end]},{_before(text, node, len(places) - 1) or ' '}{member}{text[end:]}"


def take(text: str, parent: Node, node: Node) -> str:
    """Return a document without a member, and without the comma that belongs to it."""
    places = [child.entries[0] for child in parent.children]
    index = parent.children.index(node)
    if len(places) == 1:
        start, end = parent.start + 1, parent.end - 1
    elif index + 1 < len(places):
        start, end = places[index][0], places[index + 1][0]
    else:
        start, end = places[index - 1][1], places[index][1]
    return text[:start] + text[end:]


def _before(text: str, node: Node, index: int) -> str:
    """Return the white space before a member; a first member on the line of the bracket has none that others could use."""
    start = node.children[index].entries[0][0]
    begin = len(text[:start].rstrip())
    blank = text[begin:start]
    return blank if index or "\n" in blank else ""


def written(node: Node, quoted: Callable[[str], str], number: Callable[[str], str]) -> str:
    """Return a new node on one line: `quoted` writes texts and keys, `number` all other values."""
    match node.kind:
        case Kind.MAPPING:
            members = (f"{quoted(child.key or '')}: {written(child, quoted, number)}" for child in node.children)
            return f"{{{', '.join(members)}}}"
        case Kind.LIST:
            return f"[{', '.join(written(child, quoted, number) for child in node.children)}]"
        case Kind.TEXT:
            return quoted(node.value)
    return number(node.value)
