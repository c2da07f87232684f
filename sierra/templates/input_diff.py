"""The differences between two input files, as paths and values: `//swarm/@count: 4 → 8`.

XML is compared as elements, attributes and texts. The order of attributes, white space around texts, comments and processing
instructions are ignored. Children that have an `id` (or a `name`) of their own are matched in any place. Of the others,
children with equal content are matched first. The rest between them are matched by tag, in their order. If matched children
have another order, that is a difference too, because simulators create things in the order in which they read them.

A path selects exactly one thing: in both files, if both have it. Paths of elements that are matched by place refer to the
earlier file, except for added elements.

(The library xmldiff would fit, but it needs seconds for 50 kB with many changes, and reports moves that did not happen.)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from difflib import SequenceMatcher
from itertools import chain
from typing import Literal, TypeAlias

from lxml import etree

from sierra.errors import TemplateError
from sierra.templates.xml_view import DEFAULT, Element, declarations, parse
from sierra.util.lazy_definitions import dataclass
from sierra.util.textdiff import patch

Shape: TypeAlias = tuple[str, frozenset[tuple[str, str]], str, tuple[int, ...]]
"""The content of an element: tag, attributes, text, and the numbers of the shapes of its children."""
NAMES = ("id", "name")
"""Attributes that distinguish an element from its siblings."""
MATCHED = 4_000_000
"""Limit for the product of the numbers of children of two elements; above it, children are matched in their order."""
What: TypeAlias = Literal["changed", "added", "removed", "order", "lines", "bytes", "writing"]


@dataclass(frozen=True, slots=True)
class Spot:
    """One place where two input files differ."""

    path: str
    what: What
    """`order`: another order of the children that both have; `writing`: the same content in other bytes."""
    was: str | None = None
    """The value, or the whole element if it was removed."""
    now: str | None = None
    lines: tuple[str, ...] = ()
    """A patch, if the files are not XML."""


def differing(name: str, before: bytes, after: bytes) -> tuple[Spot, ...]:
    """Return the places where two versions of a file differ; empty only if the bytes are equal."""
    if before == after:
        return ()
    try:
        trees = [parse(content, name).getroot() for content in (before, after)]
    except TemplateError:
        changed = patch(before, after, name)
        if changed.added is None:
            return (Spot(name, "bytes", f"{len(before)} bytes", f"{len(after)} bytes"),)
        return (Spot(name, "lines", f"{changed.removed} lines", f"{changed.added} lines", changed.lines),)
    return tuple(_Comparison(*trees).spots()) or (Spot(name, "writing"),)


class _Comparison:
    """Two documents, with indexes of their elements."""

    def __init__(self, before: Element, after: Element) -> None:
        self._roots = (before, after)
        self._prefixes = {uri: prefix for root in (after, before) for prefix, uri in declarations(root).items()}
        self._shapes: dict[Shape, int] = {}
        self._like: dict[Element, int] = {}
        self._steps: dict[Element, dict[Element, str]] = {}
        for root in self._roots:
            self._note(root)
        every = ((self._called(element) for element in root.iter(etree.Element)) for root in self._roots)
        self._calls = [Counter(chain.from_iterable(called)) for called in every]

    def spots(self) -> Iterator[Spot]:
        before, after = self._roots
        if before.tag != after.tag:
            yield Spot("/*", "changed", self._name(before.tag), self._name(after.tag))
        else:
            yield from self._of(before, after)

    def _note(self, element: Element) -> int:
        """Return a number that is equal for elements with equal content."""
        children = tuple(self._note(child) for child in _children(element))
        shape = (element.tag, frozenset(element.attrib.items()), _text(element), children)
        return self._like.setdefault(element, self._shapes.setdefault(shape, len(self._shapes)))

    def _of(self, before: Element, after: Element) -> Iterator[Spot]:
        if self._like[before] == self._like[after]:
            return
        path = self._path(before)
        for name in dict.fromkeys((*before.attrib, *after.attrib)):
            was, now = before.get(name), after.get(name)
            if was != now:
                what: What = "added" if was is None else "removed" if now is None else "changed"
                yield Spot(f"{self._path(after) if was is None else path}/@{self._name(name)}", what, was, now)
        if _text(before) != _text(after):
            yield Spot(path, "changed", _text(before), _text(after))
        yield from self._children_of(path, before, after)

    def _children_of(self, path: str, before: Element, after: Element) -> Iterator[Spot]:
        old, new = _children(before), _children(after)
        pairs = self._pairs(old, new)
        for index, child in enumerate(old):
            if index in pairs:
                yield from self._of(child, new[pairs[index]])
            else:
                yield Spot(self._path(child), "removed", was=_whole(child))
        for index in sorted(set(range(len(new))) - set(pairs.values())):
            yield Spot(self._path(new[index]), "added", now=_whole(new[index]))
        order = [pairs[index] for index in sorted(pairs)]
        if order != sorted(order):
            yield Spot(path, "order")

    def _pairs(self, old: Sequence[Element], new: Sequence[Element]) -> dict[int, int]:
        """Return the matching children as pairs of indices."""
        ours, theirs = _named(old), _named(new)
        pairs = {index: theirs[name] for name, index in ours.items() if name in theirs}
        taken = set(pairs.values())
        left = [index for index in range(len(old)) if index not in pairs]
        right = [index for index in range(len(new)) if index not in taken]
        for begin, end, first, last, alike in self._blocks([old[p] for p in left], [new[p] for p in right]):
            if alike:
                pairs |= dict(zip(left[begin:end], right[first:last], strict=True))
            else:
                pairs |= _by_tag(old, new, left[begin:end], right[first:last])
        return pairs

    def _blocks(self, old: Sequence[Element], new: Sequence[Element]) -> Iterator[tuple[int, int, int, int, bool]]:
        """Yield blocks of equal children, and the blocks between them."""
        if len(old) * len(new) > MATCHED:
            yield 0, len(old), 0, len(new), False
            return
        matcher = SequenceMatcher(None, [self._like[one] for one in old], [self._like[one] for one in new], autojunk=False)
        for what, begin, end, first, last in matcher.get_opcodes():
            yield begin, end, first, last, what == "equal"

    def _path(self, element: Element) -> str:
        """Return a short path that selects only this element."""
        for call in self._called(element):
            if all(calls[call] <= 1 for calls in self._calls):
                return f"//{call}"
        parent = element.getparent()
        if parent is None:
            return f"/{self._name(element.tag)}"
        if parent not in self._steps:
            self._steps[parent] = dict(self._steps_to(_children(parent)))
        return f"{self._path(parent)}/{self._steps[parent][element]}"

    def _steps_to(self, siblings: Sequence[Element]) -> Iterator[tuple[Element, str]]:
        """Yield each child with the step of a path that leads to it."""
        counted = Counter(call for child in siblings for call in self._called(child))
        position: Counter[str] = Counter()
        for child in siblings:
            position[child.tag] += 1
            alone = (call for call in self._called(child) if counted[call] == 1)
            yield child, next(alone, f"{self._name(child.tag)}[{position[child.tag]}]")

    def _called(self, element: Element) -> list[str]:
        """Return the possible steps of a path to an element: its tag, with its id, with its name."""
        tag = self._name(element.tag)
        return [tag, *(f"{tag}[@{key}='{value}']" for key in NAMES if "'" not in (value := element.get(key, "'")))]

    def _name(self, clark: str) -> str:
        """Return a name as written in a path; names in the default namespace have the prefix `_`."""
        name = etree.QName(clark)
        if not name.namespace:
            return str(name.localname)
        prefix = self._prefixes.get(name.namespace) or ("xml" if name.namespace.endswith("/XML/1998/namespace") else DEFAULT)
        return f"{prefix}:{name.localname}"


def _children(element: Element) -> list[Element]:
    return list(element.iterchildren(etree.Element))


def _text(element: Element) -> str:
    """Return the texts directly inside an element, without the surrounding white space."""
    texts = (element.text, *(child.tail for child in element))
    return " ".join(" ".join(text.split()) for text in texts if text and text.strip())


def _whole(element: Element) -> str:
    return " ".join(etree.tostring(element, encoding="unicode", with_tail=False).split())


def _named(children: Sequence[Element]) -> dict[tuple[str, str, str], int]:
    """Return the children that have a unique id or name among those of their tag, or a unique tag, with their indices."""
    tags = Counter(child.tag for child in children)
    names = [_name_of(child, tags) for child in children]
    counted = Counter(names)
    return {name: position for position, name in enumerate(names) if name is not None and counted[name] == 1}


def _name_of(child: Element, tags: Counter[str]) -> tuple[str, str, str] | None:
    if tags[child.tag] == 1:
        return (child.tag, "", "")
    return next(((child.tag, key, value) for key in NAMES if (value := child.get(key)) is not None), None)


def _by_tag(old: Sequence[Element], new: Sequence[Element], left: Sequence[int], right: Sequence[int]) -> dict[int, int]:
    """Return pairs of children with the same tag (and name, if they have one), in their order."""
    waiting: dict[tuple[str | None, ...], list[int]] = {}
    for position in reversed(right):
        waiting.setdefault(_kind(new[position]), []).append(position)
    return {position: same.pop() for position in left if (same := waiting.get(_kind(old[position])))}


def _kind(child: Element) -> tuple[str | None, ...]:
    return (child.tag, *(child.get(key) for key in NAMES))
