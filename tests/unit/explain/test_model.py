"""Differences name what differs, also of values that look alike."""

from __future__ import annotations

import pytest

from sierra.explain.diff.model import Compared, changed

LONG = "/home/" + "a" * 110


@pytest.mark.parametrize(
    ("was", "now", "line"),
    [
        (f"{LONG} --speed 1", f"{LONG} --speed 2", f"x: …{'a' * 11} --speed 1' → …{'a' * 11} --speed 2'"),
        (f"{LONG}", f"{LONG}b", f"x: …{'a' * 20}' → …{'a' * 20}b'"),
        ("a  b", "a b", "x: 'a  b' → 'a b'"),
        (None, "", "x: nothing → ''"),
        ('{"a": 1, "b": ""}', '{"a": 2, "b": null}', "x: 2 differ: a 1 → 2, b '' → nothing"),
        (1, 2, "x: 1 → 2"),
    ],
)
def test_a_line_without_details_says_what_differs(was: Compared, now: Compared, line: str) -> None:
    [difference] = changed("variables", "x", was, now)
    assert difference.whole == line
