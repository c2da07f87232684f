"""The part `project/.sierra/` of a package: the records, as immutable segments, checked before they are packed."""

from __future__ import annotations

from collections.abc import Mapping

from sierra.packages.layout import STORED
from sierra.packages.subject import Member, PartResult, Subject

FILES = ("format", ".gitignore", "CACHEDIR.TAG")


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return the files of the subject's store."""
    root = subject.store.paths.root
    files = [root / name for name in FILES]
    for segment in sorted(subject.store.paths.segments.iterdir()):
        files += sorted(segment.iterdir())
    return PartResult(
        [Member(STORED + file.relative_to(root).as_posix(), file, "records of the packed batches") for file in files]
    )


def is_record(name: str) -> bool:
    """Return whether a member is a file that the store of a package may have: only records, and no work of sessions."""
    path = name.removeprefix(STORED)
    return path in FILES or (path.startswith("segments/") and path.count("/") == 2)
