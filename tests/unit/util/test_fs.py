"""Names of files: the longest ones that file systems allow can be written, and long ones stay different when they are cut."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.util.fs import MOST_BYTES, fitting, write_once, write_whole


@pytest.mark.parametrize("name", ["a" * 255, "\U00010400" * 63 + "abc", "-" * 255, "x\n" * 127])
def test_files_with_the_longest_names_are_written_whole(tmp_path: Path, name: str) -> None:
    assert write_whole(tmp_path / name, b"1").read_bytes() == b"1"
    write_once(tmp_path / name, b"2")
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_long_names_are_cut_and_stay_different() -> None:
    names = [letter * 300 + end for letter in ("a", "é", "\U00010400") for end in ("", "x")]
    cut = [fitting(name) for name in names]
    assert len(set(cut)) == len(names)
    assert all(MOST_BYTES - 4 <= len(name.encode()) <= MOST_BYTES for name in cut)
    assert fitting("a" * MOST_BYTES) == "a" * MOST_BYTES
