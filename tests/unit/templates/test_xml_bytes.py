"""XML templates: the bytes around a value, for random documents that are written in all ways that XML has."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from typing import NamedTuple

import pytest
from hypothesis import assume
from hypothesis import strategies as st
from lxml import etree

from sierra.errors import TemplateError
from sierra.model import Add, Change, Remove, Rename, Set
from sierra.templates.same_number import same
from sierra.templates.xml import XmlTemplate
from tests.properties import given_in_tiers

ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1", "us-ascii", "windows-1252", "euc-jp"]
CHARACTERS = st.sampled_from("ab1 .<>&\"'\n\t\ré€𝄞]}-") | st.characters(
    codec="utf-8", exclude_categories=["Cc", "Cs"], exclude_characters="\ufffe\uffff{}"
)
VALUES = st.text(CHARACTERS, max_size=8).map(lambda text: text.replace("}", "")) | st.sampled_from(
    ["]]>", "", "0", "0.0", "&amp;"]
)


def written(character: str, draw: st.DrawFn, special: str) -> str:
    """Return one of the ways in which a character can be written."""
    named = {"<": "&lt;", ">": "&gt;", "&": "&amp;", '"': "&quot;", "'": "&apos;"}
    ways = [f"&#{ord(character)};", f"&#x{ord(character):x};"]
    ways += [named[character]] if character in named else []
    ways += [character] if character not in special else []
    return draw(st.sampled_from(ways[::-1]))


@st.composite
def attribute_values(draw: st.DrawFn, quote: str) -> str:
    return "".join(written(character, draw, f"<&{quote}") for character in draw(VALUES))


@st.composite
def texts(draw: st.DrawFn) -> str:
    pieces = []
    for value in draw(st.lists(VALUES, max_size=2)):
        if draw(st.booleans()) and "]]>" not in value:
            pieces.append(f"<![CDATA[{value}]]>")
        else:
            pieces.append("".join(written(character, draw, "<&>") for character in value))
    return "".join(pieces)


BLANKS = st.sampled_from([" ", "\n  ", "\t", "  ", "\r\n"])
PERHAPS = st.sampled_from(["", "", " ", "\n"])
OTHERS = st.sampled_from(["<!-- <c a='1'> & -->", "<?p <x> ?>", "\n", "\r\n  ", "<![CDATA[<a b='1'>]]>", ""])
NAMES = st.sampled_from(["a", "b", "p:c", "q:d", "Größe"])


@st.composite
def tags(draw: st.DrawFn) -> tuple[str, str]:
    """Draw the name and the attributes of an element."""
    pieces = []
    for name in draw(st.lists(st.sampled_from(["x", "y", "p:x", "q:y", "xml:lang"]), max_size=3, unique=True)):
        quote = draw(st.sampled_from("'\""))
        value = draw(attribute_values(quote))
        pieces.append(f"{draw(BLANKS)}{name}{draw(PERHAPS)}={draw(PERHAPS)}{quote}{value}{quote}")
    if draw(st.integers(0, 4)) == 0:
        pieces.append(f"{draw(BLANKS)}xmlns='urn:{draw(st.sampled_from('de'))}'")
    return draw(NAMES), "".join(pieces) + draw(PERHAPS)


@st.composite
def elements(draw: st.DrawFn, depth: int = 2) -> str:
    name, attributes = draw(tags())
    inner = [OTHERS, texts(), *([elements(depth - 1)] if depth else [])]
    content = "".join(draw(st.lists(st.one_of(inner), max_size=3)))
    if not content and draw(st.booleans()):
        return f"<{name}{attributes}/>"
    return f"<{name}{attributes}>{content}</{name}{draw(PERHAPS)}>"


class Document(NamedTuple):
    """A document in three pieces; the second is a value."""

    before: bytes
    value: bytes
    after: bytes
    path: str
    codec: str

    @property
    def all(self) -> bytes:
        return self.before + self.value + self.after


@st.composite
def documents(draw: st.DrawFn) -> Document:
    """Draw a document in some encoding, with a value in an attribute, in an element or behind one."""
    left, right = (draw(st.lists(st.one_of(elements(), OTHERS), max_size=2).map("".join)) for _ in range(2))
    quote = draw(st.sampled_from("'\""))
    name, attributes = draw(tags())
    kind = draw(st.sampled_from(["attribute", "text", "tail"]))
    if kind == "attribute":
        value, path = draw(attribute_values(quote)), "//*[local-name()='spot']/@v"
        around = f"<{name}><spot {attributes} v = {quote}", f"{quote}  w='1' />{draw(texts())}</{name}>"
    elif kind == "text":
        value, path = draw(texts()), "//*[local-name()='spot']"
        around = f"<spot{attributes}>", f"{draw(st.sampled_from(['<b/>', '<!-- c -->', '']))}</spot >"
    else:
        value, path = draw(texts()), "//*[@spot]/following-sibling::text()[1]"
        around = f"<{name}{attributes}><b spot=''></b>", f"</{name}>"
    encoding = draw(st.sampled_from(ENCODINGS))
    declared = encoding.replace("-sig", "")
    begin = (
        f"<?xml version='1.0'  encoding='{declared}'?>\n<!DOCTYPE w>\n<w xmlns:p = 'urn:p' xmlns:q=\"urn:q\">{left}{around[0]}"
    )
    codec = {"utf-16": "utf-16-le", "utf-8-sig": "utf-8"}.get(encoding, encoding)
    mark = {"utf-16": b"\xff\xfe", "utf-8-sig": b"\xef\xbb\xbf"}.get(encoding, b"")
    value = without_lacking(value, codec)
    assume(kind != "tail" or etree.fromstring(f"<_>{value}</_>".encode()).text)  # paths select no text that is empty
    before, after = (without_lacking(piece, codec) for piece in (begin, f"{around[1]}{right}</w>\n<!-- end -->"))
    return Document(mark + before.encode(codec), value.encode(codec), after.encode(codec), path, codec)


def without_lacking(text: str, codec: str) -> str:
    """Return a text without the characters that an encoding lacks."""
    return "".join(character for character in text if character.encode(codec, "ignore").decode(codec) == character)


def has_text_beside_elements(root: etree._Element, path: str) -> bool:
    """Return True if a path selects an element that has both child elements and a text that is not blank."""
    found = root.xpath(path, namespaces={"p": "urn:p", "q": "urn:q"})
    return any(node.xpath("*") and node.xpath("text()[normalize-space()]") for node in found if etree.iselement(node))


def tree(data: bytes) -> etree._Element:
    """Return what lxml reads, without texts that are empty, which the data model of XPath does not have."""
    root = etree.fromstring(data, etree.XMLParser(resolve_entities=False, no_network=True))
    for node in root.iter():
        node.tail = node.tail or None
        if isinstance(node.tag, str):
            node.text = node.text or None
    return root


def canonical(root: etree._Element, *, blanks: bool = True) -> bytes:
    return etree.tostring(root, method="c14n2", strip_text=not blanks)


@given_in_tiers(documents(), VALUES)
def test_a_set_value_is_read_back_and_all_other_bytes_stay(document: Document, value: str) -> None:
    template = XmlTemplate(document.all, "template")
    assert template.changed((), {}).render() == document.all
    change = Set(document.path, value, expect=1)
    if has_text_beside_elements(tree(document.all), document.path):
        with pytest.raises(TemplateError, match="has text beside child elements"):
            template.changed([change], {})
        return
    made = template.changed([change], {}).render()
    assert made.startswith(document.before)
    assert made.endswith(document.after)
    was = template.find(document.path)
    assert XmlTemplate(made, "made").find(document.path) in ([(value,)] if value else [("",), ()]) or (
        made == document.all and same(was[0], value)
    )
    assert template.changed((), {}).per_run([change])({}) == made
    assert template.changed((), {}).render() == document.all, "the template stays as it is"


CHANGES = st.builds(Set, st.sampled_from(["//@*[1]", "//*[2]", "//text()[1]", "//spot", "//p:c/@*", "//*/text()[2]"]), VALUES)
NEW = st.builds(
    Set, st.sampled_from(["//*[1]", "//spot | //b"]), VALUES, attribute=st.sampled_from(["z", "p:z", "xml:lang", "q:y"])
)
PIECES = st.sampled_from(
    ["<n/>", "<p:n q:z='&lt;1'>\n t<!-- c --></p:n>", "<n xmlns='urn:n' xmlns:p='urn:q' p:x='1'><p:m/></n>"]
)
STRUCTURAL: list[st.SearchStrategy[Change]] = [
    st.builds(Add, st.sampled_from(["//*[1]", "//spot", "/*"]), PIECES, at=st.sampled_from([None, 0])),
    st.builds(Remove, st.sampled_from(["//w/*[1]", "//@*[1]", "//comment()", "//b"])),
    st.builds(Rename, st.sampled_from(["//*[2]", "//spot", "//p:c"]), st.sampled_from(["r", "q:r", "p:r", "{urn:x}r"])),
]


def lxml_set(root: etree._Element, change: Set) -> None:
    """Set values as lxml does it by itself."""
    namespaces = {"p": "urn:p", "q": "urn:q"}
    every: list[tuple[etree._Element, str, str]] = []
    for node in root.xpath(change.path, namespaces=namespaces):
        if change.attribute is not None:
            prefix, _, local = change.attribute.rpartition(":")
            uri = {**namespaces, "xml": "http://www.w3.org/XML/1998/namespace"}.get(prefix)
            every.append((node, "attribute", f"{{{uri}}}{local}" if uri else local))
        elif not isinstance(node, str):
            every.append((node, "text", ""))
        elif node.is_attribute:
            every.append((node.getparent(), "attribute", node.attrname))
        else:
            every.append((node.getparent(), "tail" if node.is_tail else "text", ""))
    for node, kind, name in every:
        pieces = [(node, kind)] if kind == "attribute" else pieces_of_text(node, kind)
        was = node.get(name) if kind == "attribute" else "".join(getattr(*piece) or "" for piece in pieces)
        if was is not None and same(was, change.value):  # a number that is set to itself keeps its spelling
            continue
        if kind == "attribute":
            node.set(name, change.value)
            continue
        for piece in pieces:
            setattr(*piece, None)
        setattr(*pieces[0], change.value or None)


def pieces_of_text(node: etree._Element, kind: str) -> list[tuple[etree._Element, str]]:
    """Return the texts that only comments and processing instructions separate from a text."""
    if kind == "tail":
        parent, last = node.getparent(), [*node.itersiblings("*", preceding=True)]
        first = node if isinstance(node.tag, str) else last[0] if last else None
        begin = [(parent, "text")] if first is None else [(first, "tail")]
        after = parent if first is None else first.itersiblings()
    else:
        begin, after = [(node, "text")], node
    return begin + [(one, "tail") for one in itertools.takewhile(lambda one: not isinstance(one.tag, str), after)]


def without_comments(root: etree._Element) -> tuple[bytes, list[str]]:
    """Return a document without comments and processing instructions, and their texts."""
    taken = []
    for node in root.xpath("//comment() | //processing-instruction()"):
        taken.append(etree.tostring(node, encoding="unicode", with_tail=False))
        node.text = ""
    etree.strip_tags(root, etree.Comment, etree.ProcessingInstruction)
    return canonical(root), taken


@given_in_tiers(documents(), st.lists(CHANGES | NEW, max_size=4))
def test_set_values_give_the_document_that_lxml_alone_makes(document: Document, changes: list[Set]) -> None:
    template, root = XmlTemplate(document.all, "template"), tree(document.all)
    fitting = []
    for change in changes:
        found = root.xpath(change.path, namespaces={"p": "urn:p", "q": "urn:q"})
        if found and (change.attribute or not has_text_beside_elements(tree(document.all), change.path)):
            lxml_set(root, change)
            fitting.append(change)
    made = template.changed(fitting, {}).render()
    assert without_comments(tree(made)) == without_comments(root)
    assert made == by_one(template, fitting)


def by_one(template: XmlTemplate, changes: list[Change] | list[Set]) -> bytes:
    """Make changes in documents that follow each other."""
    document = template.changed((), {})
    for change in changes:
        document = document.changed([change], str)
    return document.render()


def fitting(template: XmlTemplate, changes: list[Change]) -> list[Change]:
    """Return the changes that select something after those before them."""
    found: list[Change] = []
    for change in changes:
        try:
            template.changed([*found, change], {})
        except TemplateError as error:
            refused = re.search("matches nothing|selects|Undefined namespace prefix|root element|beside", str(error))
            if not refused:
                raise
        else:
            found.append(change)
    return found


@given_in_tiers(documents(), st.lists(st.one_of(CHANGES, NEW, *STRUCTURAL), max_size=4))
def test_changes_together_give_the_bytes_of_changes_one_by_one(document: Document, changes: list[Change]) -> None:
    template = XmlTemplate(document.all, "template")
    made = fitting(template, changes)
    rendered = template.changed(made, {}).render()
    assert rendered == by_one(template, made)
    for number in range(len(made)):
        assert template.changed(made[:number], {}).per_run(made[number:])({}) == rendered
    assert XmlTemplate(rendered, "made").changed((), {}).render() == rendered


def remove(root: etree._Element) -> None:
    for node in root.xpath("//b"):
        before = node.getprevious()
        if node.tail and before is not None:
            before.tail = (before.tail or "") + node.tail
        elif node.tail:
            node.getparent().text = (node.getparent().text or "") + node.tail
        node.getparent().remove(node)


def rename(root: etree._Element) -> None:
    for node in root.xpath("//p:c", namespaces={"p": "urn:p"}):
        node.tag = "{urn:q}r"


def add(root: etree._Element) -> None:
    for node in [root, *root.xpath("//spot")]:
        etree.SubElement(node, "n").set("{urn:q}z", "1")


@given_in_tiers(documents())
@pytest.mark.parametrize(
    ("change", "theirs"),
    [
        (Remove("//b"), remove),
        (Rename("//p:c", "q:r"), rename),
        (Add("/w | //spot", "<n xmlns='' q:z='1'/>"), add),
    ],
)
def test_changes_of_structure_give_the_document_that_lxml_alone_makes(
    change: Change, theirs: Callable[[etree._Element], None], document: Document
) -> None:
    template, root = XmlTemplate(document.all, "template"), tree(document.all)
    if template.find(change.path) == ():
        return
    theirs(root)
    made = tree(template.changed([change], {}).render())
    assert canonical(made, blanks=False) == canonical(root, blanks=False)


@given_in_tiers(documents(), st.data())
def test_a_removed_element_leaves_all_bytes_that_are_not_beside_it(document: Document, data: st.DataObject) -> None:
    encoded = "<zz é='1'>&#65;<c/></zz>".replace("é", "e").encode(document.codec)
    with_more = document.before + document.value + document.after
    place = with_more.rindex("</w>".encode(document.codec))
    longer = with_more[:place] + encoded + with_more[place:]
    assert XmlTemplate(longer, "template").changed([Remove("//zz")], {}).render() == with_more
    renamed = XmlTemplate(longer, "template").changed([Rename("//zz", "yy")], {}).render()
    assert (
        renamed
        == with_more[:place] + encoded.replace(*(name.encode(document.codec) for name in ("zz", "yy"))) + with_more[place:]
    )
