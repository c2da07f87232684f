"""Captions beside figures, to be pasted into a paper: `NAME.txt`, and `NAME.tex` for LaTeX.

A caption says what is shown, and then what the small print says: the center and its interval, n, what is left out, and the
figure's `footnote`. The text is that of the small print, so both always agree. In a paper, the claims that the figure shows
follow. The last line names the batch and the data.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sierra.deliverables.paper_tables import escaped
from sierra.stats.words import of_run

if TYPE_CHECKING:
    from sierra.deliverables.figures.drawing import Drawing


def text(drawing: Drawing, origin: str) -> bytes:
    """Return the caption as a file of text; the drawing has its complete small print."""
    return f"{caption(drawing)}\n\n{origin}\n".encode()


def latex(drawing: Drawing, origin: str) -> bytes:
    """Return the caption as a file of LaTeX, with a label."""
    return f"\\caption{{{escaped(caption(drawing))}}}\n\\label{{fig:{drawing.name}}}\n% {origin}\n".encode()


def caption(drawing: Drawing) -> str:
    """Return the caption in one line."""
    parts = (drawing.figure.title or _begun(shown(drawing)), _begun(drawing.note), drawing.figure.footnote, drawing.claims)
    return " ".join(ended(" ".join(part.split())) for part in parts if part.strip())


def shown(drawing: Drawing) -> str:
    """Return what a figure shows: its values over time, and the variables of its experiments."""
    from sierra.deliverables.figures import style

    figure, tables = drawing.figure, list(drawing.tables.values())
    timed = any("t" in table.column_names for table in tables)
    if len(tables) == 1:
        values = style.value_label(drawing)
    else:
        told = {name: of_run(figure.measure, name) if tables and not timed else name for name in figure.columns}
        names = (style.label(words, drawing.units.get(name, "")) for name, words in told.items())
        values = ", ".join(names)
    over = f" over {style.time_label(drawing)}" if timed else ""
    variables = ", ".join(map(style.axis_label, drawing.axes))
    return f"{values}{over}{f', by {variables}' if variables else ''}"


def _begun(text: str) -> str:
    """Return a text with a capital letter, unless it begins with a symbol such as x or mAh."""
    first, *_ = f"{text} ".replace(",", " ").split(" ")
    return text[0].upper() + text[1:] if len(first) > 1 and first.isalpha() and first.islower() else text


def ended(text: str) -> str:
    """Return a text as a sentence."""
    return text if text.endswith((".", "!", "?")) else f"{text}."
