"""The documentation shows a picture of each kind of figure, and its data are those that its lines give today."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.config.plugin_registry import FIGURES
from sierra.deliverables.record import ORIGIN
from tests import pictures

pytestmark = pytest.mark.integration

NO_FIGURES = ("architecture", "pipeline")
"""Pictures of SIERRA itself."""


@pytest.mark.nightly
def test_pictures_show_all_kinds_with_the_data_that_their_lines_give(tmp_path: Path) -> None:
    files = {path.stem: path.read_bytes() for path in pictures.FOLDER.iterdir() if path.stem not in NO_FIGURES}
    assert sorted(files) == sorted(FIGURES.shipped), "the page has one figure for each kind; make pictures draws them"
    assert sum(map(len, files.values())) < 800_000
    assert max(map(len, files.values())) < 40_000
    with pictures.drawings(tmp_path / "project") as found:
        assert {name: drawing.figure.kind for name, drawing in found.items()} == {name: name for name in files}
        new = {name: drawing.data for name, drawing in found.items()}
    shown = {name: origin[3].decode() for name, data in files.items() if (origin := ORIGIN.search(data))}
    assert shown == new, "make pictures draws them again"
