"""Tests of the kept part of logs."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from sierra.util.kept_log import kept_of, shares


def test_a_long_log_keeps_its_beginning_and_its_end(tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(b"begin" + b"." * 1000 + b"end")
    kept, size = kept_of(str(tmp_path / "log"), 20)
    assert (kept, size) == (b"begin\n[... 988 bytes left out ...]\n............end", 1008)
    assert kept_of(str(tmp_path / "log"), 1008) == ((tmp_path / "log").read_bytes(), 1008)


def test_a_link_is_no_log(tmp_path: Path) -> None:
    (tmp_path / "log").symlink_to("/etc/passwd")
    assert kept_of(str(tmp_path / "log")) == (b"", 0)


@given(st.lists(st.integers(0, 1000), max_size=5), st.integers(0, 3000))
def test_no_log_takes_the_share_of_another(sizes: list[int], most: int) -> None:
    found = shares(sizes, most)
    assert sum(found) <= most
    fair = most // max(1, len(sizes))
    assert all(min(size, fair) <= share <= size for size, share in zip(sizes, found, strict=True))
