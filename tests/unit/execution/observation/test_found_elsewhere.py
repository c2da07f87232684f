"""If `ldconfig` does not print the loader's cache, libraries count as changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.execution.observation import unchanged_files
from sierra.execution.observation.unchanged_files import LoaderCache

ENTRY = "printf '\\tlibx.so (libc6,x86-64) => /lib/libx.so\\n'\n"


@pytest.mark.parametrize(
    ("script", "known"),
    [
        (f"#!/bin/sh\n{ENTRY}", True),
        (f"#!/bin/sh\n{ENTRY}exit 1\n", False),
        ("#!/nowhere/sh\n", False),
        ("", False),
    ],
)
def test_a_cache_that_cannot_be_read_could_find_any_library_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, known: bool
) -> None:
    program, cache = tmp_path / "ldconfig", tmp_path / "ld.so.cache"
    program.write_text(script)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setattr(unchanged_files, "CACHE", str(cache))
    assert LoaderCache().found_elsewhere(["/usr/lib/liby.so"]) is None  # there is no cache
    cache.touch()
    assert LoaderCache().found_elsewhere(["/usr/lib/liby.so"]) == (None if known else str(cache))
