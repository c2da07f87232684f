"""Paths with names from a record never leave the folder of their purpose."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.errors import Damaged
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.util.fs import inside


@pytest.mark.parametrize("name", ["", ".", "/etc/passwd", "..", "../x", "a/../../x", "a/..", "x\0y", "//x"])
def test_a_name_that_leads_outside_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(Damaged) as raised:
        inside(tmp_path, name)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["x", "a/b", "a b'c\nd", "...", "a..b/..c", "~", "-rf"])
def test_a_name_that_stays_inside_is_a_path_in_the_folder(tmp_path: Path, name: str) -> None:
    assert inside(tmp_path, name) == tmp_path / name


def test_a_link_in_a_path_is_refused_only_if_it_leads_outside(tmp_path: Path) -> None:
    root = tmp_path / "root"
    (root / "folder").mkdir(parents=True)
    (root / "out").symlink_to(tmp_path)
    (root / "in").symlink_to("folder")
    (root / "loop").symlink_to("loop")
    assert inside(root, "in/x") == root / "in/x"
    for name in ("out/x", "out", "loop/x", "loop"):
        with pytest.raises(Damaged):
            inside(root, name)


def test_a_link_that_is_not_followed_may_lead_anywhere(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (root / "out").symlink_to(tmp_path)
    assert inside(root, "out", link=True) == root / "out"
    with pytest.raises(Damaged):
        inside(root, "out/x", link=True)


def test_a_root_that_is_a_link_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "root").symlink_to("real")
    assert inside(tmp_path / "root", "x") == tmp_path / "root" / "x"


@given(st.text(alphabet="ab./\0~\\ ", max_size=12))
def test_no_name_leads_outside(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    root = tmp_path_factory.getbasetemp()
    try:
        found = inside(root, name)
    except Damaged:
        return
    assert found.resolve().is_relative_to(root.resolve())
    assert found.resolve() != root.resolve()


@pytest.mark.parametrize("name", ["..", "../../../x", "/etc", ""])
def test_folders_of_a_store_that_are_named_by_ids_stay_in_it(tmp_path: Path, name: str) -> None:
    store = StorePaths(tmp_path)
    for named in (store.image, store.kept, ProjectPaths(tmp_path).drawn):
        with pytest.raises(Damaged):
            named(name)
