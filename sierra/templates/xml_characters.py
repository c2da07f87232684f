"""Characters that XML 1.0 does not allow (production 2)."""

from __future__ import annotations

import re
from functools import cache


def illegal(text: str) -> str | None:
    """Return the first character of a text that XML does not allow; None if there is none."""
    found = None if _is_simple(text) else _illegal().search(text)
    return found[0] if found else None


def replaced(text: str) -> str:
    """Return a text in which U+FFFD replaces each character that XML does not allow."""
    return text if _is_simple(text) else _illegal().sub("\ufffd", text)


def _is_simple(text: str) -> bool:
    """Return True if all characters are allowed for sure; most texts are like this."""
    return text.isascii() and text.isprintable()


@cache
def _illegal() -> re.Pattern[str]:
    """Return the pattern. To compile it takes longer than to read a template."""
    return re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
