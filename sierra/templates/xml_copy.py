"""A copy of an XML document that changes of its structure are made in, and that is written with the bytes of the original.

What no change touches is copied from the original's text: whole elements, or the parts of a start tag, texts and end tags.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator
from functools import partial

from lxml import etree

from sierra.model import Add, Change, Remove, Rename, Repeat, Set
from sierra.templates.xml_markup import attributes, decoded, name_in, tag_end
from sierra.templates.xml_scan import Edits, Scan, Unspliced, prefix_of
from sierra.templates.xml_view import XML, Element, Place, View, declarations, is_text, parser, reason
from sierra.util.lazy_definitions import regex

_ONE_NAME = regex(r"\{[A-Za-z_]\w*\}")
"""A tag such as `{controller}`; any other `{…}` in a tag is a namespace."""
_SECTION = "<![CDATA["
Prefixes = dict[str | None, str | None]


class XmlCopy:
    """A copy of a scanned document with its edits."""

    def __init__(self, scan: Scan, edits: Edits) -> None:
        self.view = View(copy.deepcopy(scan.view.root), scan.source)
        self._scan = scan
        self._nodes = list(self.view.root.iter())
        self._originals = dict(zip(self._nodes, scan.nodes, strict=True))
        self._touched: set[Element] = set()
        self._renamed: set[Element] = set()
        self._raws: dict[Place, str] = {}
        """Texts and values of attributes that are not those of the original, as they are written."""
        self._declares = False
        """True if a change has added or removed declarations of namespaces, whose prefixes are known when they are written."""
        copies = dict(zip(scan.nodes, self._nodes, strict=True)) if edits else {}
        for location, edit in edits.items():
            copied = Place(copies[location.element], location.kind, location.name)
            if edit.token.startswith(_SECTION):
                self._put(copied, edit.value or "", edit.token)
            else:
                self._write(copied, edit.value or "")

    def make(self, change: Change, filled: Callable[[str], str]) -> None:
        """Make a change. Raises TemplateError, ConfigError, and ValueError for an invalid name.

        Raises Unspliced, and changes nothing, if the document must be read again before: if the change concerns an added
        element, or names in an element that was changed, or if the change before declared namespaces.
        """
        view = self.view
        if self._declares:
            raise Unspliced
        match change:
            case Set():
                self._set(change, filled)
            case Add():
                parents = view.elements(change)
                self._check_read(parents)
                for parent in parents:
                    self._insert(parent, self._piece(change, parent, filled), self._index(change, parent))
            case Remove():
                nodes = view.matches(change)
                self._check_read(node.getparent() if is_text(node) else node for node in nodes)
                if any(is_text(node) and node.getparent() in self._touched for node in nodes):
                    raise Unspliced
                for node in nodes:
                    self._remove(node, change)
            case Rename():
                self._rename(change, filled)
            case Repeat():
                elements = view.elements(change)
                self._check_read(other for element in elements for other in (element, *element.itersiblings(element.tag)))
                for element in elements:
                    self._repeat(element, change, filled)
        if not isinstance(change, Set) or change.attribute:
            self._declares = declarations(view.root) != view.namespaces

    def _raw_in_file(self, location: Place) -> str:
        """Return a text as it is written in the file."""
        self._check_read([location.element])
        return self._scan.raw(Place(self._originals[location.element], location.kind))

    def _check_read(self, elements: Iterable[Element]) -> None:
        if any(element not in self._originals for element in elements):
            raise Unspliced

    def _write(self, location: Place, text: str) -> None:
        self._touched.add(location.element)
        location.write(text)
        self._raws[location] = self._scan.token(text, '"' if location.kind == "attribute" else "")

    def _put(self, location: Place, text: str, raw: str) -> None:
        """Write a text that is known as it is written."""
        self._write(location, text)
        self._raws[location] = raw

    def _set(self, change: Set, filled: Callable[[str], str]) -> None:
        text = self.view.legal(filled(change.value), change)
        slots = self.view.slots(change, self._raw_in_file)
        self._check_read(slot.places[0].element for slot in slots)
        for slot in slots:
            if slot.keeps([location.read() for location in slot.places], text):
                continue
            for location, part in slot.parts(text):
                if location.read() != part and location in slot.sections:
                    self._put(location, part, self._scan.section(part))
                elif location.read() != part:
                    self._write(location, part)

    # Changes of the structure

    def _rename(self, change: Rename, filled: Callable[[str], str]) -> None:
        name = filled(change.to) if _ONE_NAME.fullmatch(change.to) else change.to
        elements = self.view.elements(change)
        self._check_read(elements)
        if not self._touched.isdisjoint(elements):
            raise Unspliced
        for element in elements:
            element.tag = self.view.clark(name, element, change, etree.QName(element).namespace)
            self._touched.add(element)
            self._renamed.add(element)

    def _remove(self, node: Element | etree._ElementUnicodeResult, change: Remove) -> None:
        if is_text(node):
            if not node.is_attribute:
                raise self.view.unfit(change, node, "elements and attributes")
            parent = node.getparent()
            self._touched.add(parent)
            del parent.attrib[node.attrname]
        elif node is self.view.root:
            raise self.view.error(change, "selects the root element", ", which cannot be removed")
        else:
            self._take_out(node)

    def _take_out(self, element: Element) -> None:
        """Remove an element and its line; the text after it stays."""
        parent, previous = element.getparent(), element.getprevious()
        ahead, behind = Place(parent, "text") if previous is None else Place(previous, "tail"), Place(element, "tail")
        before, after = ahead.read() or "", behind.read() or ""
        raw, raw_after = self._raw(ahead), self._raw(behind)
        kept, raw_kept = before + after, raw + raw_after
        if not kept.strip() and "\n" in kept:
            kept, raw_kept = (after, raw_after) if "\n" in after else (before, raw)
        parent.remove(element)
        self._touched.add(parent)
        if raw_kept != raw:
            self._put(ahead, kept, raw_kept)

    def _repeat(self, element: Element, change: Repeat, filled: Callable[[str], str]) -> None:
        """Put copies of an element into its place, and remove the following ones of its name."""
        from sierra.templates.notation import Unfit, copies, placed

        parent = element.getparent()
        if parent is None:
            raise self.view.error(change, "selects the root element", ", of which there is one")
        if filled(change.count).startswith("{"):
            return
        new_elements = []
        try:
            for values in copies(change, element.xpath(".//text() | descendant-or-self::*/@*"), filled):
                new = copy.deepcopy(element)
                new.tail = None
                _fill_all(new, partial(placed, values=values))
                new_elements.append(new)
        except Unfit as error:
            fault, semicolon, advice = str(error).partition(";")
            raise self.view.error(change, fault, semicolon + advice) from error
        for other in list(element.itersiblings(element.tag)):
            self._take_out(other)
        for new in new_elements:
            self._insert(parent, new, parent.index(element))
        self._take_out(element)

    def _insert(self, parent: Element, new: Element, index: int) -> None:
        """Insert a new child, with the indentation of its siblings."""
        self._touched.add(parent)
        first = Place(parent, "text")
        inner = first.read() or ""
        if len(parent) and _indents(inner):
            last, raw_inner = Place(parent[-1], "tail"), self._raw(first)
            if index < len(parent):
                self._put(Place(new, "tail"), inner, raw_inner)
            elif _indents(last.read() or ""):
                self._put(Place(new, "tail"), last.read() or "", self._raw(last))
                self._put(last, inner, raw_inner)
        elif not len(parent) and not inner.strip() and _indents(outer := _before(parent)):
            outer = "\n" + outer.rpartition("\n")[2]
            unit = outer.removeprefix("\n" + _before(parent.getparent()).rpartition("\n")[2]) or "  "
            self._write(first, outer + unit)
            self._write(Place(new, "tail"), outer)
        parent.insert(index, new)

    def _piece(self, change: Add, parent: Element, filled: Callable[[str], str]) -> Element:
        """Return the new child, parsed in the namespaces of `parent`."""
        source = self.view.source
        declared = {**self.view.namespaces, **parent.nsmap}
        wrapper = etree.tostring(etree.Element("_", nsmap=declared), encoding="unicode").removesuffix("/>")
        xml = self.view.legal(change.xml, change)
        shown = f"cannot contain {xml!r}"
        if source.lacks(xml):
            raise self.view.error(change, shown, f", whose encoding is {source.codec}; write &#8364; for €")
        try:
            wrapped = etree.fromstring(f"{wrapper}>{xml}</_>".encode(), parser())
        except etree.XMLSyntaxError as wrong:
            raise self.view.error(change, shown, f": not XML: {reason(wrong)}") from wrong
        content = [node for node in wrapped.xpath("node()") if not is_text(node) or node.strip()]
        if len(content) != 1 or is_text(content[0]) or not isinstance(content[0].tag, str):
            raise self.view.error(change, shown, "; add exactly one element")
        piece: Element = content[0]
        piece.tail = None
        _fill_all(piece, lambda text: self.view.legal(filled(text), change))
        return piece

    def _index(self, change: Add, parent: Element) -> int:
        """Return the index of the new child among all children, including comments; `at` counts elements only."""
        if change.at is None:
            return len(parent)
        indices = [index for index, child in enumerate(parent) if isinstance(child.tag, str)]
        if not 0 <= change.at <= len(indices):
            raise self.view.error(change, f"has {len(indices)} child elements", f", so at={change.at} is too large")
        return indices[change.at] if change.at < len(indices) else len(parent)

    # Writing

    def render(self) -> bytes:
        """Return the document with the bytes of the original where nothing was changed."""
        source = self.view.source
        mark = self._scan.marks[self._originals[self.view.root]]
        changed = self._touched.union(*(element.iterancestors() for element in self._touched))
        body = "".join(self._whole(self.view.root, changed, {}))
        return source.mark + source.encoded(source.text[: mark.start] + body + source.text[mark.end :])

    def _whole(self, element: Element, changed: set[Element], outer: Prefixes) -> Iterator[str]:
        original = self._originals.get(element)
        if original is None:
            yield self._new(element, outer)
            return
        mark, text = self._scan.marks[original], self.view.source.text
        if element not in changed or not isinstance(element.tag, str):
            yield text[mark.start : mark.end]
            return
        prefixes: Prefixes = {**outer, "xml": XML, **original.nsmap}
        old, name, tag = self._start(element, original, prefixes)
        yield tag
        content = [self._raw(Place(element, "text"))]
        for child in element:
            content += self._whole(child, changed, prefixes)
            content.append(self._raw(Place(child, "tail")))
        if not mark.empty:
            yield from (*content, f"</{name}{text[mark.close + 2 + len(old) : mark.end]}")
        elif any(content) or Place(element, "text") in self._raws:
            yield from (">", *content, f"</{name}>")
        else:
            yield text[self._scan.last(original) : mark.end]

    def _start(self, element: Element, original: Element, prefixes: Prefixes) -> tuple[str, str, str]:
        """Return the old name, the new name and the start tag of an element; `prefixes` gets what the tag declares anew."""
        text, mark = self.view.source.text, self._scan.marks[original]
        old, more = name_in(text, mark.start), Prefixes()
        name = self._name(element, original, prefixes, more) if element in self._renamed else old
        declared = (attribute for attribute in attributes(text, mark.start, mark.inner) if attribute.declares)
        kept = {attribute.start: text[attribute.start : attribute.end + 1] for attribute in declared}
        known = dict(self._scan.attributes(original))
        for clark, attribute in known.items():
            if (value := element.get(clark)) is None:
                continue
            token = text[attribute.begin : attribute.end]
            if Place(element, "attribute", clark) in self._raws:
                token = self.view.source.escaped(value, text[attribute.end])
            kept[attribute.start] = text[attribute.start : attribute.begin] + token + text[attribute.end]
        pieces = [kept[start] for start in sorted(kept)]
        for clark, value in element.attrib.items():
            if clark not in known:
                called = self._called(clark, prefixes, more)
                pieces.append(f' {called}="{self.view.source.escaped(value, chr(34))}"')
        pieces += [f' xmlns{":" if p else ""}{p or ""}="{self.view.source.escaped(u or "", chr(34))}"' for p, u in more.items()]
        end = "" if mark.empty else text[self._scan.last(original) : mark.inner]
        return old, name, f"<{name}{''.join(pieces)}{end}"

    def _name(self, element: Element, original: Element, prefixes: Prefixes, more: Prefixes) -> str:
        """Return the name of a renamed element as it is written: with its old prefix, without one, or with another."""
        name = etree.QName(element)
        uri, local = name.namespace, str(name.localname)
        for prefix in (original.prefix, None):
            if (prefixes.get(prefix) or None) == uri:
                return f"{prefix}:{local}" if prefix else local
        if uri is None:
            more[None] = prefixes[None] = ""
            return local
        return f"{self._prefix(uri, prefixes, more)}:{local}"

    def _called(self, clark: str, prefixes: Prefixes, more: Prefixes) -> str:
        """Return the name of a new attribute as it is written."""
        name = etree.QName(clark)
        if not name.namespace:
            return str(name.localname)
        return f"{self._prefix(name.namespace, prefixes, more)}:{name.localname}"

    def _prefix(self, uri: str, prefixes: Prefixes, more: Prefixes) -> str:
        """Return a prefix of a namespace; declare one if there is none."""
        found = prefix_of(uri, prefixes)
        if found is None:
            found = next(f"ns{n}" for n in range(len(prefixes) + 1) if f"ns{n}" not in prefixes)
            more[found] = prefixes[found] = uri
        return found

    def _raw(self, location: Place) -> str:
        """Return a text as it is written."""
        raw = self._raws.get(location)
        original = self._originals.get(location.element)
        if raw is not None or original is None:
            return raw or ""
        return self._scan.raw(Place(original, location.kind))

    def _new(self, element: Element, outer: Prefixes) -> str:
        """Return an added element, without declarations of namespaces that its place has."""
        text = str(etree.tostring(element, encoding="unicode", with_tail=False))
        for attribute in reversed(list(attributes(text, 0, tag_end(text)))):
            prefix = attribute.name.partition(":")[2] or None
            uri = decoded(text[attribute.begin : attribute.end], quoted=True)
            if attribute.declares and (outer.get(prefix) or "") == uri:
                text = text[: attribute.start] + text[attribute.end + 1 :]
        return self.view.source.with_line_ends(self.view.source.with_references(text))


def _indents(text: str) -> bool:
    return "\n" in text and not text.strip()


def _before(element: Element) -> str:
    """Return the text before an element."""
    if element.getparent() is None:
        return ""
    previous = element.getprevious()
    return (element.getparent().text if previous is None else previous.tail) or ""


def _fill_all(piece: Element, filled: Callable[[str], str]) -> None:
    """Fill all attributes and texts of an element after parsing, so that a value cannot become markup."""
    for node in piece.iter():
        if isinstance(node.tag, str):
            for name, value in node.attrib.items():
                node.set(name, filled(value))
            if node.text and (text := filled(node.text)) != node.text:
                node.text = text
        if node.tail and (text := filled(node.tail)) != node.tail:
            node.tail = text
