"""Figures as drawing commands of PGF, for LaTeX: text has the document's font.

The sizes of texts are those of the other formats, so that no TeX is needed to draw, and the file does not depend on one.
matplotlib's own way asks a TeX for each size.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, Literal

import matplotlib as mpl
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.backends.backend_pgf import RendererPgf
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties

from sierra.deliverables import paper_tables
from sierra.errors import UsageError

MOST = 4_000_000
"""The largest number of characters: TeX runs out of memory for a path of 5 million."""
HEADER = """\
% Include this figure with \\input{FILE}; the preamble needs \\usepackage{pgf}.
"""
BEGIN = """\
\\begingroup%
\\makeatletter%
\\begin{{pgfpicture}}%
\\pgfpathrectangle{{\\pgfpointorigin}}{{\\pgfqpoint{{{width:f}in}}{{{height:f}in}}}}%
\\pgfusepath{{use as bounding box, clip}}%
"""
END = """\
\\end{pgfpicture}%
\\makeatother%
\\endgroup%
"""


def picture(figure: Figure, comments: Sequence[str]) -> bytes:
    """Return a figure as PGF. Raises UsageError for a figure that is too large for TeX, or has pixels."""
    width, height = figure.get_size_inches()
    text = _Commands()
    text.write(HEADER)
    text.writelines(f"% {line}\n" for comment in comments for line in comment.splitlines())
    text.write(BEGIN.format(width=width, height=height))
    with mpl.rc_context({"pgf.rcfonts": False}):
        figure.draw(_Renderer(figure, text))
    text.write(END)
    return text.getvalue().encode()


class _Commands(io.StringIO):
    """Drawing commands, as many as TeX can hold."""

    def write(self, text: str, /) -> int:
        if self.tell() > MOST:
            raise UsageError(
                f"pgf: this figure needs more than {MOST / 1e6:g} MB of commands, too many for TeX; use pdf for it"
            )
        return super().write(text)


class _Renderer(RendererPgf):
    """A renderer that escapes texts for LaTeX, and takes their sizes from the fonts of the other formats."""

    def __init__(self, figure: Figure, file: io.StringIO) -> None:
        super().__init__(figure, file)  # type: ignore[no-untyped-call]
        renderer: Any = RendererAgg
        self._sizes = renderer(1, 1, figure.dpi)

    def draw_text(self, gc: Any, x: float, y: float, s: str, *rest: Any, **more: Any) -> None:
        super().draw_text(gc, x, y, paper_tables.escaped(s), *rest, **more)  # type: ignore[no-untyped-call]

    def get_text_width_height_descent(
        self, s: str, prop: FontProperties, ismath: bool | Literal["TeX"]
    ) -> tuple[float, float, float]:
        width, height, descent = self._sizes.get_text_width_height_descent(s, prop, ismath)
        return width, height, descent

    def draw_image(self, *_: Any, **__: Any) -> None:
        raise UsageError("this figure contains pixels, which a PGF file cannot hold; use pdf")
