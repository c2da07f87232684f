"""XML templates: any document, changed by XPath 1.0; bytes that no change concerns stay as they are.

**Paths** are XPath 1.0. Absolute paths begin at the document, relative paths at the root element. A change applies to all
matches. Every prefix that is declared anywhere in the document can be used (its first declaration applies). The first default
namespace has the prefix `_`, as in `//_:robot/@name`. Content before and after the root element cannot be selected. A text and
the CDATA sections beside it are one text.

**Texts**: programs read all text of an element, also around comments and processing instructions. A set value takes the place
of the first of these texts that is not blank, and the others become empty. An element with text beside child elements cannot be
set, because programs read such a text in different ways; a path may select one of its texts.

**Bytes**: the template is parsed once, with the place of each value. A set value replaces the bytes of its place, and all
others stay as they are: also quotes, white space within tags, references such as `&#233;`, comments, CDATA and line ends. A
number that is set to itself in another spelling stays too (see `sierra.templates.same_number`). A new value is written within
the quotes of its place, with CRLF if all lines end so. It has the document's encoding; a character that this encoding lacks, or
reads back as another one, is written as a reference, for example `&#8364;`. CDATA that is set becomes a usual text, but stays
CDATA beside comments. A doctype keeps the root's old name if the root is renamed.

An added, removed or renamed part is written into a copy of the document, which is read again (`xml_copy`).

**Checks**: what is rendered is read again by lxml, once for each set of places that change; it must be the document with these
values. A value with special characters is also read again by itself, each time. In encodings that libraries read differently
(`xml_markup` has the others), the whole document is read again each time.

**Hostile input**: nothing is loaded (no DTD, no external entity, no network, no XInclude). A document that *declares* an entity
is refused, so there is nothing to expand. A reference that an external DTD would define stays unchanged. libxml2's own limits
(depth 256, 10 MB for one text) apply. A path whose evaluation would exceed a time limit is refused: see
`sierra.templates.xpath_time_limit`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain, groupby
from typing import AnyStr, ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions
from sierra.errors import ConfigError, TemplateError
from sierra.model import Change, Set, Value
from sierra.templates.arithmetic import fill, names
from sierra.templates.base import Rendered
from sierra.templates.xml_copy import XmlCopy
from sierra.templates.xml_scan import Edit, Edits, Scan, Unspliced
from sierra.templates.xml_view import Place, Slot, View, differ, value_of, who
from sierra.util.hashing import sha256
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import one_line


class XmlTemplate:
    """The template format `xml`; see `sierra.templates.base.Template`."""

    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, data: bytes, name: str, options: Table | None = None) -> None:
        self.sha256 = sha256(data)
        self._document = XmlDocument(Scan(data, name), {})

    def reread(self, rendered: Rendered, name: str) -> XmlTemplate:
        if not isinstance(rendered, bytes):
            raise TemplateError(f"{name}: an XML template must be one file, not {len(rendered)}")
        return XmlTemplate(rendered, name)

    def find(self, path: str) -> tuple[str, ...]:
        """Return the text of each match; for an element, the text before its first child element, without comments."""
        return tuple(map(value_of, self._document.view.select(path)))

    def attributes(self) -> tuple[tuple[str, str], ...]:
        return tuple(self._document.view.attributes())

    def changed(self, changes: Sequence[Change], values: Mapping[str, Value]) -> XmlDocument:
        return self._document.changed(changes, lambda text: fill(text, values))


class XmlDocument:
    """A scanned document with other values in some places; see `sierra.templates.base.Document`."""

    def __init__(self, scan: Scan, edits: Edits) -> None:
        self._scan = scan
        self._edits = edits
        self._last: _Made | None = None

    @property
    def view(self) -> View:
        """Return the view of the document without its edits."""
        return self._scan.view

    def render(self) -> bytes:
        return self._gapped(())({})

    def per_run(self, changes: Sequence[Change]) -> Callable[[Mapping[str, Value]], bytes]:
        changes = tuple(changes)
        sets = [change for change in changes if isinstance(change, Set)]
        if len(sets) == len(changes):
            try:
                return self._gapped(sets)
            except Unspliced:
                pass
        self.changed(changes, _unfilled)
        return lambda values: self.changed(changes, lambda text: fill(text, values)).render()

    def changed(self, changes: Sequence[Change], filled: Callable[[str], str]) -> XmlDocument:
        """Return a copy with the changes made; `filled` converts each of their texts."""
        structural = [number for number, change in enumerate(changes) if not isinstance(change, Set)]
        first = structural[-1] + 1 if structural else 0
        document = self._structured(changes[:first], filled) if first else self
        return document._one_by_one(changes[first:], filled)

    def _structured(self, changes: Sequence[Change], filled: Callable[[str], str]) -> XmlDocument:
        """Return a copy with the changes made; experiments whose changes become the same share it."""
        if self._last and self._last.holds(changes, filled):
            return self._last.document
        texts: dict[str, str] = {}

        def recorded(text: str) -> str:
            texts[text] = filled(text)
            return texts[text]

        document = self._one_by_one(changes, recorded)
        self._last = _Made(tuple(changes), texts, document)
        return document

    def _one_by_one(self, changes: Sequence[Change], filled: Callable[[str], str]) -> XmlDocument:
        document = self
        for are_sets, group in groupby(changes, lambda change: isinstance(change, Set)):
            together = list(group)
            try:
                if not are_sets:
                    raise Unspliced
                document = document._set([change for change in together if isinstance(change, Set)], filled)
            except Unspliced:
                document = document._restructured(together, filled)
        return document

    def _set(self, sets: Sequence[Set], filled: Callable[[str], str]) -> XmlDocument:
        scan, edits = self._scan, dict(self._edits)
        with scan.showing(self._edits) as shown:
            for change in sets:
                with self._told(change):
                    text = scan.view.legal(filled(change.value), change)
                    for slot in scan.view.slots(change, scan.raw):
                        was = {location: edits.get(location) or scan.original(location) for location in slot.places}
                        for location, edit in _written(scan, slot, was, text):
                            edits[location] = edit
                            shown.show(location, edit.value or "")
        return XmlDocument(scan, edits)

    def _restructured(self, changes: Sequence[Change], filled: Callable[[str], str]) -> XmlDocument:
        """Return the document after changes of its structure, read again after them and before changes of added parts."""
        made = XmlCopy(self._scan, self._edits)
        for number, change in enumerate(changes):
            try:
                with self._told(change):
                    made.make(change, filled)
            except Unspliced:
                return self._reread(made, changes[number - 1])._restructured(changes[number:], filled)
        return self._reread(made, changes[-1])

    def _reread(self, made: XmlCopy, last: Change) -> XmlDocument:
        scan = Scan(made.render(), self._scan.source.name, check=False)
        if differ(scan.view.root, made.view.root):
            raise scan.view.error(last, "cannot be changed in its place", "; write it in the template in another style")
        return XmlDocument(scan, {})

    def _gapped(self, sets: Sequence[Set]) -> Callable[[Mapping[str, Value]], bytes]:
        """Split the document at the values that differ between runs, so that each run only fills these gaps."""
        scan, begin = self._scan, dict[Place, Edit]()
        wanted: list[tuple[Set, list[Slot]]] = []
        with scan.showing(self._edits) as shown:
            for change in sets:
                with self._told(change):
                    text = scan.view.legal(_unfilled(change.value), change)
                    slots = scan.view.slots(change, scan.raw)
                    wanted.append((change, slots))
                    for location, part in chain.from_iterable(slot.parts(text) for slot in slots):
                        begin.setdefault(location, self._edits.get(location) or scan.original(location))
                        shown.show(location, part)  # so that later paths find what it adds
        every = {**self._edits, **begin}
        gaps, pieces = self._split(every, begin)
        places_changed, source = frozenset(every), scan.source
        encoded = [source.encoded(piece) for piece in pieces] if source.piecewise else []

        def render(values: Mapping[str, Value]) -> bytes:
            current = dict(begin)
            for change, slots in wanted:
                with self._told(change):
                    text = scan.view.legal(fill(change.value, values), change)
                    for slot in slots:
                        current.update(_written(scan, slot, current, text))
            tokens = [current[gap].token for gap in gaps]
            if source.piecewise:
                rendered = source.mark + _joined(encoded, [source.encoded(token) for token in tokens], b"")
            else:
                rendered = source.mark + source.encoded(_joined(pieces, tokens, ""))
            after = {**self._edits, **current}
            scan.verify(rendered, places_changed, ((location, edit.value or "") for location, edit in after.items()))
            return rendered

        return render

    def _split(self, edits: Edits, gaps: Edits) -> tuple[list[Place], list[str]]:
        """Return the gaps in the order of the document, and the text around them with all other edits made."""
        text, order = self._scan.source.text, list[Place]()
        pieces, piece, done = list[str](), list[str](), 0
        for location, edit in sorted(edits.items(), key=lambda item: (item[1].spot.start, item[1].spot.end)):
            piece.append(text[done : edit.spot.start])
            done = edit.spot.end
            if location in gaps:
                order.append(location)
                pieces.append("".join(piece))
                piece = []
            else:
                piece.append(edit.token)
        return order, [*pieces, "".join((*piece, text[done:]))]

    @contextmanager
    def _told(self, change: Change) -> Iterator[None]:
        """Let errors name the change."""
        try:
            yield
        except ValueError as error:  # names that lxml refuses, values that cannot be written
            raise self.view.error(change, "cannot be changed", f": {one_line(error)}") from error
        except ConfigError as error:
            raise ConfigError(f"{who(change)}{error}") from error


@dataclass(frozen=True, slots=True)
class _Made:
    """A document that changes made, with their texts and what these became."""

    changes: tuple[Change, ...]
    texts: Mapping[str, str]
    document: XmlDocument

    def holds(self, changes: Sequence[Change], filled: Callable[[str], str]) -> bool:
        """Return True if changes would make the same document."""
        try:
            return self.changes == tuple(changes) and all(filled(text) == made for text, made in self.texts.items())
        except ConfigError:  # it is reported with its change when the changes are made
            return False


def _written(scan: Scan, slot: Slot, edits: Edits, text: str) -> Iterator[tuple[Place, Edit]]:
    """Yield the places where a new value changes edits; none if the value before spells the same number."""
    values = [edits[location].value for location in slot.places]
    if slot.keeps(values, text):
        return
    for location, part in slot.parts(text):
        if edits[location].value != part:
            yield location, scan.written(edits[location].spot, part, section=location in slot.sections)


def _joined(pieces: Sequence[AnyStr], tokens: Sequence[AnyStr], nothing: AnyStr) -> AnyStr:
    made = [pieces[0]]
    for token, piece in zip(tokens, pieces[1:], strict=True):
        made += (token, piece)
    return nothing.join(made)


def _unfilled(text: str) -> str:
    """Return a text unchanged, after checking that it can be filled."""
    names(text)
    return text
