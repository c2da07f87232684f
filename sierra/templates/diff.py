"""How two input files differ, in the terms of who wrote them: `//swarm/@count: 4 → 8`.

XML is compared as elements, attributes and texts; the order of attributes, white space around texts, comments and processing
instructions make no difference. Children that have an `id` (or a `name`) of their own are the same wherever they stand; of
others, those that are alike to the last attribute are the same, and the rest in between are taken by their tags, in their
order. Where children that both have stand in another order, that is a difference too: simulators make things in the order
in which they read them.

A path selects one thing alone: in both files, where both have it. Paths of elements that are taken by their place are those
of the earlier file, but for what was added.

(xmldiff, which would be the library for this, needs seconds for 50 kB in which much has changed, and tells moves that
nobody made.)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from typing import Any, Literal

from lxml import etree

from sierra.errors import TemplateError
from sierra.templates.xml import DEFAULT, declarations, parse
from sierra.util.textdiff import patch

Element = Any
NAMES = ("id", "name")
"""Attributes that tell an element from its siblings."""
MATCHED = 4_000_000
"""Children of one element times children of the other, beyond which they are taken in their order."""


@dataclass(frozen=True, slots=True)
class Spot:
    """One place in which two input files differ."""

    path: str
    what: Literal["changed", "added", "removed", "order", "lines", "bytes", "writing"]
    """`order`: of the children that both have; `writing`: the same elements, attributes and texts in other bytes."""
    was: str | None = None
    """The value, or all of an element that was removed."""
    now: str | None = None
    lines: tuple[str, ...] = ()
    """A patch, where the files are no XML."""


def differing(name: str, before: bytes, after: bytes) -> tuple[Spot, ...]:
    """Where two files of one name differ; empty only if they are the same bytes."""
    if before == after:
        return ()
    try:
        trees = [parse(content, name).getroot() for content in (before, after)]
    except TemplateError:
        return (_no_xml(name, before, after),)
    return tuple(_Comparison(*trees).spots()) or (Spot(name, "writing"),)


def _no_xml(name: str, before: bytes, after: bytes) -> Spot:
    found = patch(before, after, name)
    if found.added is None:
        return Spot(name, "bytes", f"{len(before)} bytes", f"{len(after)} bytes")
    return Spot(name, "lines", f"{found.removed} lines", f"{found.added} lines", found.lines)


class _Comparison:
    """Two documents, and what is known of their elements."""

    def __init__(self, before: Element, after: Element) -> None:
        self._roots = (before, after)
        self._prefixes = {uri: prefix for root in (after, before) for prefix, uri in declarations(root).items()}
        self._shapes: dict[Any, int] = {}
        self._like: dict[Element, int] = {}
        self._steps: dict[Element, dict[Element, str]] = {}
        for root in self._roots:
            self._note(root)
        self._calls = [Counter(call for element in _all(root) for call in self._called(element)) for root in self._roots]

    def spots(self) -> Iterator[Spot]:
        before, after = self._roots
        if before.tag != after.tag:
            yield Spot("/*", "changed", self._name(before.tag), self._name(after.tag))
        else:
            yield from self._of(before, after)

    def _note(self, element: Element) -> int:
        """A number that only elements have which are alike in all that counts."""
        shape = (
            element.tag,
            frozenset(element.attrib.items()),
            _text(element),
            tuple(self._note(child) for child in _children(element)),
        )
        return self._like.setdefault(element, self._shapes.setdefault(shape, len(self._shapes)))

    def _of(self, before: Element, after: Element) -> Iterator[Spot]:
        if self._like[before] == self._like[after]:
            return
        path = self._path(before)
        for name in dict.fromkeys((*before.attrib, *after.attrib)):
            was, now = before.get(name), after.get(name)
            if was != now:
                what: Any = "added" if was is None else "removed" if now is None else "changed"
                yield Spot(f"{self._path(after) if was is None else path}/@{self._name(name)}", what, was, now)
        if _text(before) != _text(after):
            yield Spot(path, "changed", _text(before), _text(after))
        yield from self._children_of(path, before, after)

    def _children_of(self, path: str, before: Element, after: Element) -> Iterator[Spot]:
        old, new = list(_children(before)), list(_children(after))
        pairs = self._pairs(old, new)
        for place, child in enumerate(old):
            if place in pairs:
                yield from self._of(child, new[pairs[place]])
            else:
                yield Spot(self._path(child), "removed", was=_whole(child))
        for place in sorted(set(range(len(new))) - set(pairs.values())):
            yield Spot(self._path(new[place]), "added", now=_whole(new[place]))
        order = [pairs[place] for place in sorted(pairs)]
        if order != sorted(order):
            yield Spot(path, "order")

    def _pairs(self, old: Sequence[Element], new: Sequence[Element]) -> dict[int, int]:
        """Which children are the same, by their places."""
        ours, theirs = _named(old), _named(new)
        pairs = {place: theirs[name] for name, place in ours.items() if name in theirs}
        taken = set(pairs.values())
        left = [place for place in range(len(old)) if place not in pairs]
        right = [place for place in range(len(new)) if place not in taken]
        for begin, end, first, last, alike in self._blocks([old[p] for p in left], [new[p] for p in right]):
            if alike:
                pairs |= dict(zip(left[begin:end], right[first:last], strict=True))
            else:
                pairs |= _by_tag(old, new, left[begin:end], right[first:last])
        return pairs

    def _blocks(self, old: Sequence[Element], new: Sequence[Element]) -> Iterator[tuple[int, int, int, int, bool]]:
        """Stretches of children that are alike, and those in between."""
        if len(old) * len(new) > MATCHED:
            yield 0, len(old), 0, len(new), False
            return
        matcher = SequenceMatcher(None, [self._like[one] for one in old], [self._like[one] for one in new], autojunk=False)
        for what, *places in matcher.get_opcodes():
            begin, end, first, last = places
            yield begin, end, first, last, what == "equal"

    def _path(self, element: Element) -> str:
        """A path to this element alone, as short as that allows."""
        ways = [call for call in self._called(element) if self._is_alone(call)]
        if ways:
            return f"//{ways[0]}"
        parent = element.getparent()
        if parent is None:
            return f"/{self._name(element.tag)}"
        if parent not in self._steps:
            self._steps[parent] = dict(self._steps_to(list(_children(parent))))
        return f"{self._path(parent)}/{self._steps[parent][element]}"

    def _steps_to(self, siblings: Sequence[Element]) -> Iterator[tuple[Element, str]]:
        """What leads from an element to each of its children."""
        counted = Counter(call for child in siblings for call in self._called(child))
        place: Counter[str] = Counter()
        for child in siblings:
            place[child.tag] += 1
            alone = (call for call in self._called(child) if counted[call] == 1)
            yield child, next(alone, f"{self._name(child.tag)}[{place[child.tag]}]")

    def _is_alone(self, call: str) -> bool:
        return all(calls[call] <= 1 for calls in self._calls)

    def _called(self, element: Element) -> list[str]:
        """What a step of a path may call an element: its tag, with its id, with its name."""
        tag = self._name(element.tag)
        return [tag, *(f"{tag}[@{key}='{value}']" for key in NAMES if "'" not in (value := element.get(key, "'")))]

    def _name(self, clark: str) -> str:
        """A name as a path writes it: what stands in the default namespace has the prefix `_`."""
        name = etree.QName(clark)
        if not name.namespace:
            return str(name.localname)
        prefix = self._prefixes.get(name.namespace) or ("xml" if name.namespace.endswith("/XML/1998/namespace") else DEFAULT)
        return f"{prefix}:{name.localname}"


def _all(root: Element) -> Iterator[Element]:
    yield from root.iter(etree.Element)


def _children(element: Element) -> Iterator[Element]:
    yield from element.iterchildren(etree.Element)


def _text(element: Element) -> str:
    """The texts right in an element, without the white space around them."""
    texts = (element.text, *(child.tail for child in element))
    return " ".join(" ".join(text.split()) for text in texts if text and text.strip())


def _whole(element: Element) -> str:
    return " ".join(etree.tostring(element, encoding="unicode", with_tail=False).split())


def _named(children: Sequence[Element]) -> dict[tuple[str, str, str], int]:
    """Children with an id or a name that no other of their tag has here; and those that alone have their tag."""
    tags = Counter(child.tag for child in children)
    names = [_name_of(child, tags) for child in children]
    counted = Counter(names)
    return {name: place for place, name in enumerate(names) if name is not None and counted[name] == 1}


def _name_of(child: Element, tags: Counter[str]) -> tuple[str, str, str] | None:
    if tags[child.tag] == 1:
        return (child.tag, "", "")
    return next(((child.tag, key, value) for key in NAMES if (value := child.get(key)) is not None), None)


def _by_tag(old: Sequence[Element], new: Sequence[Element], left: Sequence[int], right: Sequence[int]) -> dict[int, int]:
    """Children of one tag (and name, where they have one), in their order."""
    waiting: dict[Any, list[int]] = {}
    for place in reversed(right):
        waiting.setdefault(_kind(new[place]), []).append(place)
    return {place: same.pop() for place in left if (same := waiting.get(_kind(old[place])))}


def _kind(child: Element) -> tuple[str | None, ...]:
    return (child.tag, *(child.get(key) for key in NAMES))
