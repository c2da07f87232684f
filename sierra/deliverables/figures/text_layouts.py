"""Layouts of texts, computed once while a figure is drawn: otherwise it takes a tenth of the time of all formats.

matplotlib computes the layout of each text whenever it asks for the text's size: in each pass of the figure's layout, and for
each format. The layout depends on the text, its font and alignment, on the resolution, and on the renderer, and not on the
text's place. matplotlib's own method, which is replaced for that time, computes it; a version without it is only slower.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from typing import Any

from matplotlib.font_manager import FontProperties
from matplotlib.text import Text

METHOD = "_get_layout"
NO_LAYOUT = ("_x", "_y", "stale", "_stale")
"""Attributes of a text that have no effect on its layout, and change all the time."""
PLAIN = (str, int, float, bool, tuple, type(None), FontProperties)
"""The types of the attributes that a layout depends on. Others are objects such as the axes and the clipping path."""


@contextmanager
def remembered() -> Iterator[None]:
    """Compute the layout of each text once until the end of the context."""
    compute = vars(Text).get(METHOD)
    if compute is None:
        yield
        return
    known: dict[Hashable, Any] = {}

    def layout(text: Text, renderer: Any) -> Any:
        if text.get_wrap() or text.get_transform_rotates_text():
            return compute(text, renderer)  # these depend on the place
        key = _key(text, renderer)
        if key not in known:
            known[key] = compute(text, renderer)
        return known[key]

    setattr(Text, METHOD, layout)
    try:
        yield
    finally:
        setattr(Text, METHOD, compute)


def _key(text: Text, renderer: Any) -> Hashable:
    """Return everything that the layout of a text depends on."""
    attributes = ((name, value) for name, value in vars(text).items() if name not in NO_LAYOUT and isinstance(value, PLAIN))
    figure = text.get_figure(root=True)
    # PDF and SVG have the same renderer, which has one of their own inside
    return type(getattr(renderer, "_renderer", renderer)), getattr(figure, "dpi", None), tuple(attributes)
