"""Unfinished files that killed processes left beside figures, tables, videos and reports.

Only folders with SIERRA's mark are looked at, and there only hidden names: files that were being written whole (see
`sierra.util.fs`), whose process is gone, and temporary folders (see `sierra.util.scratch`), whose lock nobody holds.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from sierra.store.layout import DRAWN, ProjectPaths
from sierra.util import scratch
from sierra.util.lazy_definitions import regex
from sierra.worker.processes import birth

WRITTEN = regex(r"\..+\.[0-9a-f]{8}\.(\d+)")
"""The names of files that are written whole: the process is their last part."""


def unfinished(root: Path) -> Iterator[Path]:
    """Yield the unfinished files and folders in all folders of deliverables in a project."""
    with contextlib.suppress(OSError):  # nothing was drawn, or the folder cannot be read
        for folder in sorted(ProjectPaths(root).figures.iterdir()):
            yield from unfinished_in(folder)


def unfinished_in(folder: Path) -> Iterator[Path]:
    """Yield the unfinished files and folders in one folder; none if it does not have SIERRA's mark."""
    if folder.is_symlink() or not (folder / DRAWN).is_file():
        return
    for path in sorted(folder.glob(".*")):
        if scratch.is_abandoned(path) or _is_left(path):
            yield path


def remove(path: Path) -> None:
    """Remove what `unfinished` yielded, if it is still there."""
    with contextlib.suppress(OSError):
        if path.is_dir():
            scratch.remove(path)
        else:
            path.unlink()


def _is_left(path: Path) -> bool:
    named = WRITTEN.fullmatch(path.name)
    return bool(named and path.is_file() and not path.is_symlink() and birth(int(named[1])) is None)
