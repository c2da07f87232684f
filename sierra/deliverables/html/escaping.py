"""Text and data within HTML, so that no content can become an element, an attribute or a script."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from sierra.util.text import STEERING, visible

Data: TypeAlias = "str | int | float | bool | Sequence[Data] | Mapping[str, Data] | None"
ESCAPES = str.maketrans({"<": "\\u003c", ">": "\\u003e", "&": "\\u0026"})


def text(content: str) -> str:
    """Return a text for an element or a quoted attribute.

    Characters that control are shown as escapes: see `sierra.util.text.visible`. All others stay as they are, so that names in
    any script, and SQL, can be copied.
    """
    return html.escape(visible(content)).replace("\r", "&#13;")


def steering() -> str:
    """Return the characters that `text` escapes, as a class of a script's regular expressions."""
    spans = (rf"\u{{{first:x}}}-\u{{{last:x}}}" for first, last in STEERING)
    return f"[{''.join(spans)}]"


def data(content: Data) -> str:
    """Return data as JSON for a `script` element. Raises ValueError for a number that is not finite."""
    return json.dumps(content, allow_nan=False, separators=(",", ":")).translate(ESCAPES)
