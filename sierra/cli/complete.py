"""Shell completion of batches' ids, names of variables and queries, and tables.

It must answer within the time of a key press, so it looks only at file names and never queries the store. On any error it
prints nothing, because its output would appear in the line that the user types.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sierra.config.project_file import LoadedProject

IGNORED = (Exception, SystemExit)
"""Errors that are ignored: nothing is completed then."""


def ids(incomplete: str) -> list[str]:
    """Return prefixes of batches' ids."""
    found: set[str] = set()
    with contextlib.suppress(*IGNORED):
        found = {segment.partition("-")[0][:10] for segment in _segments()}
    return _beginning(found, incomplete.lower())


def criteria(incomplete: str) -> list[str]:
    """Return the names of queries, and those of variables with a dot at the end."""
    found: list[str] = []
    with contextlib.suppress(*IGNORED):
        config = _project().config
        found = [*config.queries, *(f"{name}." for name in config.variables), "montecarlo.C"]
    return _beginning(found, incomplete)


def tables(incomplete: str) -> list[str]:
    """Return the names of tables that runs have written."""
    from sierra.store.segments import OUTPUT, SUFFIX

    found: set[str] = set()
    with contextlib.suppress(*IGNORED):
        names = (path.name for segment in _segments() for path in (_folder() / segment).iterdir())
        files = (name.removesuffix(SUFFIX) for name in names if name.startswith(OUTPUT) and name.endswith(SUFFIX))
        found = {name.removeprefix(OUTPUT).partition("~")[0] for name in files}
    return _beginning(found, incomplete)


def _project() -> LoadedProject:
    from sierra.config import project_file

    return project_file.load(Path())


def _folder() -> Path:
    from sierra.store.layout import ProjectPaths, StorePaths

    return StorePaths(ProjectPaths(_project().root).store).segments


def _segments() -> Iterator[str]:
    """Yield the names of segments, including replaced ones."""
    yield from (path.name for path in _folder().iterdir() if path.is_dir())


def _beginning(names: Iterable[str], incomplete: str) -> list[str]:
    return sorted(name for name in names if name.startswith(incomplete))


__all__ = ["criteria", "ids", "tables"]
