"""The picture of the packages shows what the code imports, and no package stands below one that it imports."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import architecture

GRAPH = {
    "top": frozenset({"left", "right", "base"}),
    "left": frozenset({"base"}),
    "right": frozenset({"left"}),
    "base": frozenset[str](),
}


@pytest.mark.integration
def test_picture_of_the_packages_is_that_of_the_code() -> None:
    drawn = architecture.picture(architecture.imports(), architecture.floors())
    assert architecture.PICTURE.read_text("utf-8") == drawn, "make pictures draws it again"


def test_packages_stand_above_those_that_they_import() -> None:
    assert architecture.rows(GRAPH) == [["base"], ["left"], ["right"], ["top"]]


def test_packages_that_import_each_other_stand_in_one_row() -> None:
    assert architecture.rows(GRAPH | {"base": frozenset({"left"})}) == [["base", "left"], ["right"], ["top"]]


def test_imports_that_follow_from_others_have_no_arrow() -> None:
    assert architecture.arrows(GRAPH) == [("left", "base"), ("right", "left"), ("top", "right")]


def test_an_arrow_has_a_place_in_each_row_that_it_passes() -> None:
    graph = {
        "top": frozenset({"base", "middle"}),
        "middle": frozenset({"low"}),
        "low": frozenset[str](),
        "base": frozenset[str](),
    }
    assert architecture.routes(graph) == [("middle", "low"), ("top", "top base 1", "base"), ("top", "middle")]
    assert [place for row in architecture.ordered(graph) for place in row if " " in place] == ["top base 1"]


def test_all_kinds_of_imports_count(tmp_path: Path) -> None:
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("from sierra import alone\n", "utf-8")
    (package / "module.py").write_text("def call():\n    import sierra.other.deep as deep\n    return deep\n", "utf-8")
    (tmp_path / "alone.py").write_text("from sierra.package.module import call\nimport json\n", "utf-8")
    (tmp_path / "other.py").write_text("", "utf-8")
    expected = {"package": frozenset({"alone", "other"}), "alone": frozenset({"package"}), "other": frozenset[str]()}
    assert architecture.imports(tmp_path) == expected


def test_page_names_the_floors_of_the_contract() -> None:
    text = (architecture.ROOT / "docs" / "explanation" / "architecture.md").read_text("utf-8")
    rows = [
        line.split("|")[1:3] for line in text.splitlines() if line.startswith("| ") and line.split("|")[1].strip().isdigit()
    ]
    named = {name.strip(" `"): int(floor) for floor, names in rows for name in names.split(",")}
    assert named == architecture.floors()
