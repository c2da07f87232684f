"""Regular expressions that are compiled late behave as compiled ones."""

from __future__ import annotations

import re

import pytest

from sierra.util.lazy_patterns import regex


def test_all_methods_are_those_of_a_compiled_pattern() -> None:
    late, early = regex(r"(?P<name>[a-z]+)=(\d+)", re.IGNORECASE), re.compile(r"(?P<name>[a-z]+)=(\d+)", re.IGNORECASE)
    text = "A=1, b=22"
    assert late.findall(text) == early.findall(text)
    assert late.sub(r"\2", text) == "1, 22"
    assert [match["name"] for match in late.finditer(text)] == ["A", "b"]
    found = late.fullmatch("x=5")
    assert found is not None
    assert found[2] == "5"
    assert (late.pattern, late.flags, late.groups, dict(late.groupindex)) == (
        *(early.pattern, early.flags, early.groups),
        dict(early.groupindex),
    )


def test_patterns_of_bytes_match_bytes() -> None:
    assert regex(rb"\d").search(b"a1") is not None
    with pytest.raises(TypeError):
        regex(r"\d").search(b"a1")  # type: ignore[arg-type]


def test_a_wrong_pattern_is_an_error_when_it_is_used() -> None:
    with pytest.raises(re.error):
        regex("(").match("")
    with pytest.raises(AttributeError):
        regex("a").no_such_method  # type: ignore[attr-defined]  # noqa: B018
