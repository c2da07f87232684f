r"""Double quotes around values of queries: `interval="exponential(0.2s)"`.

Within quotes, blanks, commas, colons, brackets and letters of all scripts belong to the value. `\"` is a quote and `\\` is a
backslash; there are no other escapes. A quote that is not closed reaches to the end of the text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import groupby

from sierra.util.lazy_definitions import regex

QUOTE, ESCAPE = '"', "\\"
_QUOTED = regex(r'"((?:[^"\\]|\\["\\])*)"')


def _characters(text: str) -> Iterator[tuple[str, bool]]:
    """Yield the characters of a text; each with True if it is in quotes, or one of them."""
    quoted = escaped = False
    for character in text:
        is_quote = character == QUOTE and not escaped
        yield character, quoted or is_quote
        quoted ^= is_quote
        escaped = quoted and not escaped and character == ESCAPE


def pieces(text: str, separators: str) -> list[str]:
    """Return the parts of a text between any of these characters, with their quotes. Separators in quotes do not count."""
    if QUOTE not in text and len(separators) == 1:
        return text.split(separators)
    parts = [""]
    for is_separator, group in groupby(_characters(text), lambda pair: not pair[1] and pair[0] in separators):
        written = "".join(character for character, _ in group)
        if is_separator:
            parts += [""] * len(written)
        else:
            parts[-1] += written
    return parts


def words(text: str) -> tuple[str, ...]:
    """Return the words of a text, as `str.split` does it; blanks in quotes belong to a word."""
    return tuple(filter(None, pieces(text, " \t\r\n\v\f"))) if QUOTE in text else tuple(text.split())


def split_off(text: str) -> tuple[str, list[str]]:
    """Return a text with `"0"`, `"1"`, … in place of the parts in quotes, and these parts."""
    if QUOTE not in text:
        return text, []
    outside = ""
    parts: list[str] = []
    for is_quoted, group in groupby(_characters(text), lambda pair: pair[1]):
        written = "".join(character for character, _ in group)
        outside += f"{QUOTE}{len(parts)}{QUOTE}" if is_quoted else written
        parts += [written] if is_quoted else []
    return outside, parts


def unquoted(word: str) -> str | None:
    """Return the value of a word in quotes; None if the word is not in quotes as a whole, or has an unknown escape."""
    found = _QUOTED.fullmatch(word)
    return None if found is None else re.sub(r"\\(.)", r"\1", found[1])


def quoted(value: str) -> str:
    """Return a value in quotes."""
    for character in (ESCAPE, QUOTE):
        value = value.replace(character, ESCAPE + character)
    return f"{QUOTE}{value}{QUOTE}"
