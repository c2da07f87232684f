"""Short HTML for notebooks. All texts are escaped, because they may come from a stranger's record."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from sierra.util.text import DIGITS, digits_apart, short_number, visible

ROWS = 20
"""Maximum number of rows that are shown of a table."""
MAX_LENGTH = 120
"""Maximum number of characters of a value."""


def page(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], notes: Iterable[str] = (), *, total: int = 0
) -> str:
    """Return a title, a table of the first rows and notes. `total`: the number of rows that there are, if it is known."""
    shown = [tuple(row) for _, row in zip(range(ROWS), rows, strict=False)]
    more = (f"{total} rows, {len(shown)} of them shown",) if total > len(shown) else ()
    head = "".join(f"<th>{_text(column)}</th>" for column in columns)
    digits = [digits_apart(column) for column in zip(*shown, strict=True)]
    body = "".join(f"<tr>{''.join(f'<td>{_text(*one)}</td>' for one in zip(row, digits, strict=True))}</tr>" for row in shown)
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>" if columns else ""
    lines = "".join(f"<div>{_text(note)}</div>" for note in (*more, *notes))
    return f"<div><strong>{_text(title)}</strong>{table}{lines}</div>"


def _text(value: object, digits: int = DIGITS) -> str:
    match value:
        case None:
            return ""
        case float():
            text = short_number(value, digits)
        case _:
            text = str(value)
    return escape(visible(text if len(text) <= MAX_LENGTH else f"{text[:MAX_LENGTH]}…"))
