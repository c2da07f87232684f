"""Tests of the kept part of logs."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.util.kept_log import kept_of, last_lines, shares, with_cause
from tests.projects import make, quick


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


# The cause of a failure stays in what is shown of a log, although many lines follow it.

CAUSE = "[FATAL] Failed to load the controller: speed is not a number"
MORE = [f"  ... caused by exception {number}" for number in range(400)]


def test_the_first_fatal_line_stays() -> None:
    text = "\n".join(["begin", CAUSE, *MORE])
    kept = with_cause(text, 200)
    assert kept.splitlines()[:2] == [CAUSE, "[...]"]
    assert kept.endswith(text[-100:])
    assert last_lines(kept, 5) == [CAUSE, *MORE[-4:]]


def test_other_logs_are_cut_as_before() -> None:
    text = "\n".join(MORE)
    assert with_cause(text, 200) == text[-200:].strip()
    assert last_lines(text, 5) == MORE[-5:]
    assert last_lines("", 5) == []
    assert last_lines(f"a\n{CAUSE}\nb", 5) == ["a", CAUSE, "b"]


@pytest.mark.integration
def test_a_failed_run_says_its_cause(tmp_path: Path) -> None:
    said = "\\n".join([CAUSE, *MORE])
    folder = make(tmp_path / "project", simulator=f"import sys\nsys.exit('''{said}''')\n")
    failed = quick(folder, "run", "population_size=1", "--runs", "1")
    assert failed.returncode == 1
    assert f"    {CAUSE}\n    {MORE[-4]}\n" in failed.stdout
