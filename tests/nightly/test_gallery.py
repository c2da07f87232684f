"""Every kind of figure, with 1, 4, 12 and 40 categories, long and Chinese names, and grids of panels, is fit for print."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from matplotlib.font_manager import findSystemFonts

from sierra.config.plugin_registry import FIGURES
from tests import gallery
from tests.print_faults import faults

pytestmark = pytest.mark.nightly


@pytest.mark.parametrize("size", gallery.SIZES)
@pytest.mark.parametrize("kind", FIGURES.shipped)
def test_no_text_overlaps_leaves_the_figure_or_reads_like_another(kind: str, size: str, require: Callable[..., str]) -> None:
    require("fonts-wqy-microhei", there=any("wqy-microhei" in path for path in findSystemFonts()))
    found = {name: gallery.found(kind, axes, size, **keys) for name, kind, axes, keys in gallery.cases((kind,))}
    assert {name: lines for name, lines in found.items() if lines} == {}


@pytest.mark.parametrize("size", gallery.SIZES)
@pytest.mark.parametrize("letters", gallery.NAMES)
@pytest.mark.parametrize("count", [2, 4, 12])
def test_comparisons_are_fit_for_print(count: int, letters: str, size: str) -> None:
    for groups in (gallery.names(count, letters), gallery.names(2, letters)):
        with gallery.comparison(groups, size) as figure:
            # rows below different headings may read alike
            assert [line for line in faults(figure) if " texts read " not in line] == []
