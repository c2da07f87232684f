"""A figure has the same bytes whether the layouts of its texts are remembered or computed each time."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
from matplotlib.text import Text

from sierra.config.deliverable_tables import DEFAULT_FORMATS
from sierra.deliverables.figures import style, text_layouts
from sierra.deliverables.figures.drawing import Drawing, rendered
from tests.unit.deliverables.test_figures import NAMES, SIZES, drawing


def computed(drawing: Drawing, monkeypatch: pytest.MonkeyPatch) -> tuple[int, dict[str, bytes]]:
    """Return how many layouts matplotlib computes, and the files."""
    count, compute = [0], vars(Text)[text_layouts.METHOD]

    def counting(*arguments: object) -> object:
        count[0] += 1
        return compute(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Text, text_layouts.METHOD, counting)
        files = dict(rendered(drawing))
    return count[0], files


@pytest.mark.parametrize("kind", ["timeseries", "summary"])
def test_remembered_layouts_are_those_that_matplotlib_computes(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = drawing(kind, (SIZES, NAMES), title="A rotated label, a title, two\nlines", footnote="and small print")
    few, files = computed(shown, monkeypatch)
    monkeypatch.setattr(style.text_layouts, "remembered", nullcontext)
    many, others = computed(shown, monkeypatch)
    assert files.keys() == set(DEFAULT_FORMATS)
    assert files == others
    assert 0 < few < many / 2
