"""The formats of figures: a function for each that returns the content of a file.

A file has the name of its format as its ending. No file holds a date. Each holds the SQL that computed its numbers, and
`sierra VERSION batch ID data HASH` (see `sierra.deliverables.record`):

    PNG     text chunks `sierra`, `sierra:sql`
    PDF     Keywords, Subject (the SQL)
    SVG     dc:identifier, dc:source (the SQL)
    HTML    meta elements `sierra`, `sierra:sql`; also as text
    PGF     comments at the beginning
    TXT     the caption, without the SQL (see `sierra.deliverables.figures.captions`)
    TEX     the caption for LaTeX, without the SQL

To add a format, write its function, and add its name to `sierra.config.deliverable_tables.Format`.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from sierra.config.deliverable_tables import Format
from sierra.deliverables.matplotlib_import import variables
from sierra.errors import UsageError
from sierra.util.text import like, visible

if TYPE_CHECKING:
    import matplotlib.figure

    from sierra.deliverables.figures.drawing import Drawing

Writer: TypeAlias = "Callable[[matplotlib.figure.Figure, Drawing, str], bytes]"
"""A function of the figure, the drawing, and the line of `sierra.deliverables.record.origin_of`."""


PNG_LEVEL = 3
"""The level of compression: level 6 takes twice the time, and files are 8 % smaller."""


def png(figure: matplotlib.figure.Figure, drawing: Drawing, origin: str) -> bytes:
    texts = {"Title": drawing.title, "Description": visible(drawing.note)}
    texts |= {"sierra": origin, "sierra:sql": visible(drawing.sql)}
    return _saved(figure, "png", texts, pil_kwargs={"compress_level": PNG_LEVEL})


def pdf(figure: matplotlib.figure.Figure, drawing: Drawing, origin: str) -> bytes:
    texts = {"Title": drawing.title, "Subject": visible(drawing.sql), "Keywords": origin}
    return _saved(figure, "pdf", texts | {"CreationDate": None})


def svg(figure: matplotlib.figure.Figure, drawing: Drawing, origin: str) -> bytes:
    texts = {"Title": drawing.title, "Description": visible(drawing.note)}
    return _saved(figure, "svg", texts | {"Identifier": origin, "Source": visible(drawing.sql), "Date": None})


def html(figure: matplotlib.figure.Figure, drawing: Drawing, origin: str) -> bytes:
    from sierra.deliverables.figures import interactive

    return interactive.page(drawing, b"" if drawing.charts else svg(figure, drawing, origin), origin)


def pgf(figure: matplotlib.figure.Figure, drawing: Drawing, origin: str) -> bytes:
    from sierra.deliverables.figures.tex import picture

    return picture(figure, [drawing.title, origin, *visible(drawing.sql).splitlines()])


def txt(figure: matplotlib.figure.Figure, drawing: Drawing, origin: str) -> bytes:
    from sierra.deliverables.figures import captions

    del figure
    return captions.text(drawing, origin)


def tex(figure: matplotlib.figure.Figure, drawing: Drawing, origin: str) -> bytes:
    from sierra.deliverables.figures import captions

    del figure
    return captions.latex(drawing, origin)


FORMATS: Mapping[Format, Writer] = {"png": png, "pdf": pdf, "svg": svg, "html": html, "pgf": pgf, "txt": txt, "tex": tex}


def named(names: Iterable[str]) -> tuple[Format, ...]:
    """Return the formats of these names. Raises UsageError for an unknown name, or for one that is there twice."""
    known: dict[str, Format] = {name: name for name in FORMATS}
    formats: list[Format] = []
    for name in names:
        if name not in known:
            raise UsageError(f"unknown format of figures {name!r}; {like(name, list(known), 'known are')}")
        if name in formats:
            raise UsageError(f"format {name!r} is named twice; name each format once")
        formats.append(known[name])
    return tuple(formats)


def _saved(figure: matplotlib.figure.Figure, ending: str, metadata: Mapping[str, str | None], **more: Any) -> bytes:
    buffer = io.BytesIO()
    with variables({"SOURCE_DATE_EPOCH": None}):  # no file has a date, but matplotlib reads this one
        figure.savefig(buffer, format=ending, metadata=dict(metadata), **more)
    return buffer.getvalue()
