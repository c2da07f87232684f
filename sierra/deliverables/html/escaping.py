"""Text and data within HTML, so that no content can become an element, an attribute or a script."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping, Sequence
from typing import TypeAlias

Data: TypeAlias = "str | int | float | bool | Sequence[Data] | Mapping[str, Data] | None"
ESCAPES = str.maketrans({"<": "\\u003c", ">": "\\u003e", "&": "\\u0026"})
STEERING = re.compile("[\0-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters except tab and the ends of lines, those that reverse the text after them, and bytes that are not UTF-8."""


def text(content: str) -> str:
    """Return a text for an element or a quoted attribute.

    Characters that control are shown as escapes: a NUL, or one that reverses the direction of the text after it. All others
    stay as they are, so that names in any script, and SQL, can be copied.
    """
    shown = STEERING.sub(lambda found: found[0].encode("unicode_escape").decode(), content)
    return html.escape(shown).replace("\r", "&#13;")


def data(content: Data) -> str:
    """Return data as JSON for a `script` element. Raises ValueError for a number that is not finite."""
    return json.dumps(content, allow_nan=False, separators=(",", ":")).translate(ESCAPES)
