"""Tiers of tests: `make test`, `make integration` and `make nightly`.

The folder of a test decides its tier. A mark on a test, a parameter or a file moves it to a later tier: `integration` if it
needs a cluster, containers or many processes, or more than about 0.7 seconds; `nightly` if it takes too long for each change.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

INTEGRATION, NIGHTLY = "integration", "nightly"
HERE = Path(__file__).parent


def add_marks(items: Iterable[pytest.Item]) -> None:
    """Mark each test with the tier of its folder, unless it has a mark of its own."""
    for item in items:
        folder = item.path.relative_to(HERE).parts[0] if item.path.is_relative_to(HERE) else ""
        if folder in (INTEGRATION, NIGHTLY) and not any(item.iter_markers(NIGHTLY)):
            item.add_marker(folder)


def at_night(values: Iterable[Any]) -> list[Any]:
    """Return these values of a parameter, sorted and marked for `make nightly`; a tuple has those of several parameters."""
    night = pytest.mark.nightly
    return [pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=night) for value in sorted(values)]
