"""Text and data within HTML, so that no content can become an element, an attribute or a script."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from typing import TypeAlias

Data: TypeAlias = "str | int | float | bool | Sequence[Data] | Mapping[str, Data] | None"
ESCAPES = str.maketrans({"<": "\\u003c", ">": "\\u003e", "&": "\\u0026"})


def text(content: str) -> str:
    """Return a text for an element or a quoted attribute.

    Characters that are not printable become blanks: a NUL, or one that reverses the direction of the text after it.
    """
    return html.escape("".join(c if c.isprintable() or c == "\n" else " " for c in content))


def data(content: Data) -> str:
    """Return data as JSON for a `script` element. Raises ValueError for a number that is not finite."""
    return json.dumps(content, allow_nan=False, separators=(",", ":")).translate(ESCAPES)
