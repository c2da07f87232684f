"""Check the indexes of a store: each must have the rows of the segments that it names."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sierra.maintenance.check_files import Contents
from sierra.maintenance.findings import Finding, Kind
from sierra.store import index_check, index_files
from sierra.store.layout import StorePaths
from sierra.util.text import few

REMEDY = "sierra fsck --repair removes it, and SIERRA builds another one"


def check(paths: StorePaths, contents: Contents) -> Iterator[Finding]:
    """Yield a finding for each index that is damaged, or that nobody reads, and for what is no index."""
    sound = {segment.name: segment for segment in contents.sound if not contents.broken.get(segment.name)}
    for path in _entries(paths.index):
        name = f"{paths.index.name}/{path.name}"
        if index_files.UNFINISHED.fullmatch(path.name):
            yield Finding(Kind.LEFT, name, "an unfinished file")
        elif not index_files.NAME.fullmatch(path.name) or path.is_symlink() or not path.is_file():
            yield Finding(Kind.STRAY, name, "is not an index")
        elif not index_files.is_current(path):
            yield Finding(Kind.LEFT, name, "an index of another version of SIERRA")
        elif (index := index_files.verified(path, anew=True)) is None:
            yield Finding(Kind.DAMAGED, name, f"has other bytes than SIERRA wrote; {REMEDY}")
        elif tables := index_check.different(index, sound):
            yield Finding(Kind.DAMAGED, name, f"its rows of {few(tables, 3)} are not those of the segments; {REMEDY}")


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []
