"""Data within HTML for scripts, so that no content can become an element or a script."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from sierra.util.text import STEERING

Data: TypeAlias = "str | int | float | bool | Sequence[Data] | Mapping[str, Data] | None"
ESCAPES = str.maketrans({"<": "\\u003c", ">": "\\u003e", "&": "\\u0026"})


def steering() -> str:
    """Return the characters that `sierra.util.html_elements.text` escapes, as a class of a script's regular expressions."""
    spans = (rf"\u{{{first:x}}}-\u{{{last:x}}}" for first, last in STEERING)
    return f"[{''.join(spans)}]"


def data(content: Data) -> str:
    """Return data as JSON for a `script` element. Raises ValueError for a number that is not finite."""
    return json.dumps(content, allow_nan=False, separators=(",", ":")).translate(ESCAPES)
