"""Differences of two input files are reported by XPaths, each of which selects exactly one node."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from sierra.templates.input_diff import Spot, differing
from tests.effort import is_cheap


def told(before: str, after: str) -> list[tuple[str, str, str | None, str | None]]:
    spots = differing("in.xml", before.encode(), after.encode())
    return [(spot.path, spot.what, spot.was, spot.now) for spot in spots]


@pytest.mark.parametrize(
    ("before", "after", "path", "what", "was", "now"),
    [
        ('<a><swarm count="4"/></a>', '<a><swarm count="8"/></a>', "//swarm/@count", "changed", "4", "8"),
        ("<a><noise>0.1</noise></a>", "<a><noise> 0.2\n</noise></a>", "//noise", "changed", "0.1", "0.2"),
        ('<a><b x="1"/></a>', '<a><b x="1" y="2"/></a>', "//b/@y", "added", None, "2"),
        ('<a><b x="1"/></a>', "<a><b/></a>", "//b/@x", "removed", "1", None),
        ("<a/>", '<a><b  x="1"/></a>', "//b", "added", None, '<b x="1"/>'),
        ("<a><b/><b/></a>", "<a><b/></a>", "//a/b[2]", "removed", "<b/>", None),
        ('<a><b id="x" v="1"/><b id="y"/></a>', '<a><b id="x" v="2"/><b id="y"/></a>', "//b[@id='x']/@v", "changed", "1", "2"),
        ('<a><b v="1"/><b v="2"/></a>', '<a><b v="1"/><b v="3"/></a>', "//a/b[2]/@v", "changed", "2", "3"),
        ('<a><b id="x"/><c/></a>', '<a><c/><b id="x"/></a>', "//a", "order", None, None),
        ("<a/>", "<b/>", "/*", "changed", "a", "b"),
        ('<a xmlns="u:x"><b v="1"/></a>', '<a xmlns="u:x"><b v="2"/></a>', "//_:b/@v", "changed", "1", "2"),
        ('<a><b v="1" w="2"/></a>', '<a>\n <!-- c --><b w="2" v="1"></b></a>', "in.xml", "writing", None, None),
    ],
)
def test_one_difference_is_reported_with_its_path_and_values(
    before: str, after: str, path: str, what: str, was: str | None, now: str | None
) -> None:
    assert told(before, after) == [(path, what, was, now)]


def test_removed_first_elements_are_not_reported_as_changes_of_the_others() -> None:
    boxes = [f'<box at="{n}"><body/></box>' for n in range(20)]
    found = told(f"<a>{''.join(boxes)}</a>", f"<a>{''.join(boxes[2:])}</a>")
    assert [spot[:2] for spot in found] == [("//a/box[1]", "removed"), ("//a/box[2]", "removed")]


def test_other_texts_are_compared_by_lines_and_binary_files_by_size() -> None:
    [lines] = differing("in.txt", b"a\nb\n", b"a\nc\n")
    assert (lines.what, lines.lines[-3:]) == ("lines", ("-b", "+c", " "))
    assert differing("in.bin", b"\0a", b"\0bc") == (Spot("in.bin", "bytes", "2 bytes", "3 bytes"),)


def test_external_files_are_not_loaded_and_entities_not_expanded() -> None:
    hostile = '<!DOCTYPE a SYSTEM "file:///etc/passwd"><a>&x;</a>'
    assert told("<a/>", hostile) in ([("//a", "changed", "", "&x;")], [("in.xml", "writing", None, None)])


@pytest.mark.nightly
def test_comparing_large_files_that_differ_everywhere_is_fast() -> None:
    boxes = [[f'<box><body position="{n * k}"/></box>' for n in range(1, 3000)] for k in (1, 2)]
    texts = [f"<a>{''.join(each)}</a>" for each in boxes]
    assert len(told(*texts)) > 1000
    assert is_cheap(lambda: told(*texts), 40)


ELEMENTS = st.recursive(
    st.builds(lambda tag, value: f'<{tag} v="{value}"/>', st.sampled_from("abc"), st.integers(0, 2)),
    lambda inner: st.builds(
        lambda tag, key, children: f'<{tag} id="{key}">{"".join(children)}</{tag}>',
        st.sampled_from("abc"),
        st.integers(0, 3),
        st.lists(inner, max_size=4),
    ),
    max_leaves=12,
)


@pytest.mark.integration
@given(ELEMENTS, ELEMENTS)
def test_each_reported_path_selects_exactly_its_node(one: str, other: str) -> None:
    before, after = f"<root>{one}</root>", f"<root>{other}</root>"
    trees = [etree.fromstring(text) for text in (before, after)]
    for spot in differing("in.xml", before.encode(), after.encode()):
        if spot.what in ("changed", "removed"):
            [found] = trees[0].xpath(spot.path)
            if "@" in spot.path.rpartition("/")[2] and "[" not in spot.path.rpartition("/")[2]:
                assert found == spot.was
        elif spot.what == "added":
            assert len(trees[1].xpath(spot.path)) == 1


@pytest.mark.integration
@given(ELEMENTS, ELEMENTS)
def test_differences_are_reported_only_if_the_documents_differ(one: str, other: str) -> None:
    found = told(one, other)
    assert bool(found) == (one != other)
    if one != other and all(what == "writing" for _, what, _, _ in found):
        assert etree.canonicalize(one) == etree.canonicalize(other)
