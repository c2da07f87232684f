"""Quotes around values of queries are found, removed and written again."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.util.quoted_values import pieces, quoted, split_off, unquoted, words

TEXT = st.text('"\\ ,a(龍')


@given(st.text())
def test_a_quoted_value_is_read_as_it_was(value: str) -> None:
    assert unquoted(quoted(value)) == value
    assert pieces(quoted(value), ", :") == [quoted(value)]


@given(TEXT)
def test_pieces_are_the_whole_text(text: str) -> None:
    assert ",".join(pieces(text, ",")) == text


@given(TEXT)
def test_parts_in_quotes_are_the_rest_of_a_text(text: str) -> None:
    outside, parts = split_off(text)
    for number, part in enumerate(parts):
        outside = outside.replace(f'"{number}"', part, 1)
    assert outside == text


@given(st.text().filter(lambda text: '"' not in text))
def test_without_quotes_a_text_is_split_as_ever(text: str) -> None:
    assert words(text) == tuple(text.split())


def test_blanks_in_quotes_belong_to_a_word() -> None:
    assert words('  law="a b",c  n=1\n x="\\" " ') == ('law="a b",c', "n=1", 'x="\\" "')


@pytest.mark.parametrize("word", ["", '"', "a", '"a', 'a"', '"a"b', '"a""b"', r'"\n"', '"\\"', '"a\\"'])
def test_other_words_are_not_in_quotes(word: str) -> None:
    assert unquoted(word) is None
