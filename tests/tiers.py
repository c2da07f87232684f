"""Tiers of tests: `make test`, `make integration` and `make nightly`.

The folder of a test decides its tier. A mark on a test, a parameter or a file moves it to a later tier: `integration` if it
needs a cluster, containers or many processes, or more than about 0.7 seconds; `nightly` if it takes too long for each change.

Of a test with many cases, `make integration` runs the first, and `make nightly` the others: they take most of the time, and
rarely fail alone. The mark `each_case` keeps all of them in `make integration`, where they test different rules.

The tests of extensions are in their folders. A test for all formats or kinds together is where the others are, and marks the
cases of an extension with `of_extension`.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from sierra.config.extensions import is_there

INTEGRATION, NIGHTLY, EACH_CASE = "integration", "nightly", "each_case"
HERE = Path(__file__).parent


def add_marks(items: Iterable[pytest.Item]) -> None:
    """Mark each test with the tier of its folder, unless it has a mark of its own; and most of its cases for the night."""
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        folder = item.path.relative_to(HERE).parts[0] if item.path.is_relative_to(HERE) else ""
        if folder in (INTEGRATION, NIGHTLY) and not _has(item, NIGHTLY):
            item.add_marker(folder)
        if _has(item, INTEGRATION) and not _has(item, NIGHTLY) and not _has(item, EACH_CASE):
            cases.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for alike in cases.values():
        for item in alike[1:]:
            item.add_marker(NIGHTLY)


def needs_extension(name: str) -> pytest.MarkDecorator:
    """Return a mark that skips a test where an extension does not exist."""
    return pytest.mark.skipif(not is_there(name), reason=f"the extension {name!r} does not exist")


def of_extension(name: str, *values: Any) -> list[Any]:
    """Return values of a parameter, skipped where an extension does not exist; a tuple has those of several parameters."""
    return [_marked(value, needs_extension(name)) for value in values]


def _has(item: pytest.Item, name: str) -> bool:
    return any(item.iter_markers(name))


def at_night(values: Iterable[Any]) -> list[Any]:
    """Return these values of a parameter, sorted and marked for `make nightly`; a tuple has those of several parameters."""
    return [_marked(value, pytest.mark.nightly) for value in sorted(values)]


def _marked(value: Any, mark: pytest.MarkDecorator) -> Any:
    return pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=mark)
