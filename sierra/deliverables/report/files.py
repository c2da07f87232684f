"""The file of a report: where it is written, and which files it replaces."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sierra.deliverables.record import marked_folder
from sierra.deliverables.report.page import GENERATOR
from sierra.errors import Missing, UsageError
from sierra.store.layout import REPORTS, ProjectPaths
from sierra.store.segments import disk_errors
from sierra.util.hashing import short
from sierra.util.lazy_definitions import dataclass
from sierra.util.scratch import scratch

OURS = f'<meta name="generator" content="{GENERATOR} '.encode()
BEGINNING = 8192
"""The number of bytes at the beginning of a file in which a report names its program."""
UNFINISHED = ".report-"
"""The beginning of the names of folders with unfinished reports."""
LONGEST = 5
"""The largest number of batches that the name of a file has."""


@dataclass(frozen=True, slots=True)
class Written:
    """A report that was written."""

    file: Path
    batches: Sequence[str]
    """The ids of the batches that it is about."""
    notes: Sequence[str]
    """The parts that it lacks, and the reason."""


def default(paths: ProjectPaths, batches: Sequence[str], *, every: bool) -> Path:
    """Return the file of a report of these batches in the project's folder for reports, which does not count as source."""
    named = "-".join(map(short, batches[:LONGEST])) + (f"-and-{len(batches) - LONGEST}-more" if len(batches) > LONGEST else "")
    name = "all" if every else named
    return marked_folder(paths.drawn(REPORTS), "Reports made by SIERRA.") / f"{name}.html"


def check(file: Path) -> None:
    """Raise UsageError if there is something at this path that is no report, Missing if its folder does not exist."""
    if not file.parent.is_dir():
        raise Missing(f"{file.parent}: no such folder")
    if not file.exists() and not file.is_symlink():
        return
    if not file.is_file():
        raise UsageError(f"{file} is no file; name a file for the report")
    with disk_errors(file), file.open("rb") as opened:
        if OURS not in opened.read(BEGINNING):
            raise UsageError(f"{file} exists and is no report of SIERRA; choose another name, or remove it")


def write(file: Path, data: bytes) -> Path:
    """Write a report completely or not at all. Raises the errors of `check`, Missing if it cannot be written.

    The next report in the same folder removes what killed processes left there.
    """
    check(file)
    with disk_errors(file), scratch(file.parent, UNFINISHED) as folder:
        unfinished = folder / file.name
        unfinished.write_bytes(data)
        return unfinished.replace(file)
