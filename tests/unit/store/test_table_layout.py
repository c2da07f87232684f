"""The layout of a recorded table is read as it was written, and older layouts are read too."""

from __future__ import annotations

import json

from sierra.store.table_layout import TableLayout


def test_a_layout_is_read_as_it_was_written() -> None:
    for layout in (
        TableLayout("out.csv", {"tick": "number", "name": "text"}),
        TableLayout(None, {}, ended=False),
        TableLayout("out.csv", {"v": "text"}, hints={"v": "out.csv: line 3: text in the numeric column 'v': 'x'"}),
    ):
        assert TableLayout.load(layout.dump()) == layout


def test_hints_are_written_only_if_there_are_any() -> None:
    assert json.loads(TableLayout("out.csv", {"v": "number"}).dump()) == {
        "file": "out.csv",
        "columns": {"v": "number"},
        "ended": True,
    }


def test_a_table_without_a_layout_is_complete_and_one_file() -> None:
    assert TableLayout.load(None) == TableLayout("", {}, ended=True)
