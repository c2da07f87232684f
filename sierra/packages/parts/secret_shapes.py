"""Secrets in texts: tokens, private keys and passwords in addresses, found by the forms that their issuers document.

A form begins with a fixed text, so that a file without it costs one search. Words that look random are not reported: a check of
entropy finds hashes and ids everywhere. So a secret without a form of its own is found only by the name of its variable.

Forms: tokens of GitHub, GitLab, Hugging Face, npm, PyPI and Slack, and keys of AWS and Google, as their documentation on secret
scanning lists them; private keys in PEM (RFC 7468); user information in addresses (RFC 3986, 3.2.1).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from sierra.util.lazy_definitions import regex

TEXT = 8000
"""A content without NUL in this many bytes at its beginning is a text, as git decides it."""
LONGEST = 512
"""The number of bytes in which a form is recognized."""
NAMED = regex(r"(?:.*[_-])?(?:TOKEN|SECRET|PASSWORD|PASSWD|CREDENTIALS?|(?:API|ACCESS|SECRET|PRIVATE)[_-]?KEY)", re.IGNORECASE)
"""Names of variables whose values are secrets."""
PLACEHOLDER = regex(r"[$%{<*].*|x+|\.+", re.IGNORECASE | re.DOTALL)
"""Values that stand for a secret."""


class Shape(NamedTuple):
    """A kind of secret, the text that it begins with or contains, and its form."""

    kind: str
    literal: bytes
    form: re.Pattern[bytes]


SHAPES = (
    Shape("a private key", b"PRIVATE KEY-----", regex(rb"-----BEGIN (?:[A-Z]+ )*PRIVATE KEY-----\s+[A-Za-z0-9+/=:,\s-]{40}")),
    *(
        Shape("a token of GitHub", literal, regex(literal + rb"[A-Za-z0-9]{36,}\b"))
        for literal in (b"ghp_", b"gho_", b"ghu_", b"ghs_", b"ghr_")
    ),
    Shape("a token of GitHub", b"github_pat_", regex(rb"github_pat_\w{40,}")),
    Shape("a token of GitLab", b"glpat-", regex(rb"glpat-[\w-]{20,}")),
    Shape("a key of AWS", b"AKIA", regex(rb"\bAKIA(?![A-Z0-9]{9}EXAMPLE)[A-Z2-7]{16}\b")),
    Shape("a key of Google", b"AIza", regex(rb"\bAIza[\w-]{35}(?![\w-])")),
    Shape("a token of Slack", b"xox", regex(rb"\bxox[abeoprs]-\d[\w-]{20,}")),
    Shape("a token of Hugging Face", b"hf_", regex(rb"\bhf_[A-Za-z]{34}\b")),
    Shape("a token of npm", b"npm_", regex(rb"\bnpm_[A-Za-z0-9]{36}\b")),
    Shape("a token of PyPI", b"pypi-AgE", regex(rb"\bpypi-AgE[\w-]{50,}")),
    Shape(
        "a password in an address",
        b"://",
        regex(rb"\b[a-z][a-z0-9+.-]*://[^\s/:@\"'<>{}$]*:(?![$%{<*]|x+@|\.+@)[^\s/@\"'<>{}]+@[\w\[]", re.IGNORECASE),
    ),
    Shape("a token in an address", b"://", regex(rb"\bhttps?://(?=[^/@\s]*\d)[A-Za-z0-9_-]{20,}@[\w\[]", re.IGNORECASE)),
)


def kinds(blocks: Iterable[bytes]) -> set[str]:
    """Return the kinds of secrets in a text that is read in blocks; none if it is no text."""
    present: set[str] = set()
    before = None
    for block in blocks:
        if before is None and b"\0" in block[:TEXT]:
            return set()
        text = (before or b"")[-LONGEST:] + block
        present.update(shape.kind for shape in SHAPES if shape.literal in text and shape.form.search(text))
        before = text
    return present


def variables(table: object) -> Iterator[str]:
    """Yield the names in nested tables whose values are secrets because of their names."""
    for name, value in table.items() if isinstance(table, dict) else ():
        if isinstance(value, str) and value and NAMED.fullmatch(name) and not PLACEHOLDER.fullmatch(value):
            yield name
        elif isinstance(value, list):
            for item in value:
                yield from variables(item)
        else:
            yield from variables(value)
