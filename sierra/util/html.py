"""Short HTML for notebooks. All texts are escaped, because they may come from a stranger's record."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from sierra.util.html_elements import Markup, element
from sierra.util.text import DIGITS, digits_apart, short_number

ROWS = 20
"""Maximum number of rows that are shown of a table."""
MAX_LENGTH = 120
"""Maximum number of characters of a value."""


def page(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], notes: Iterable[str] = (), *, total: int = 0
) -> Markup:
    """Return a title, a table of the first rows and notes. `total`: the number of rows that there are, if it is known."""
    shown = [tuple(row) for _, row in zip(range(ROWS), rows, strict=False)]
    more = (f"{total} rows, {len(shown)} of them shown",) if total > len(shown) else ()
    head = element("tr", *(element("th", _text(column)) for column in columns))
    digits = [digits_apart(column) for column in zip(*shown, strict=True)]
    body = (element("tr", *(element("td", _text(*cell)) for cell in zip(row, digits, strict=True))) for row in shown)
    table = element("table", element("thead", head), element("tbody", *body)) if columns else None
    lines = (element("div", _text(note)) for note in (*more, *notes))
    return element("div", element("strong", _text(title)), table, *lines)


def _text(value: object, digits: int = DIGITS) -> str:
    match value:
        case None:
            return ""
        case float():
            text = short_number(value, digits)
        case _:
            text = str(value)
    return text if len(text) <= MAX_LENGTH else f"{text[:MAX_LENGTH]}…"
