"""Fixtures for the tests with real simulators."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.extensions.simulators.changes import Edit
from tests.simulators import installed, made, started

__all__ = ["edit", "installed", "made", "started"]


@pytest.fixture
def edit() -> Iterator[Edit]:
    """Yield a function that writes another content into a file; the file is as before when the test ends."""
    before: dict[Path, bytes] = {}

    def edit(file: Path, content: bytes) -> None:
        assert content != before.setdefault(file, file.read_bytes())
        file.write_bytes(content)

    yield edit
    for file, content in before.items():
        file.write_bytes(content)
