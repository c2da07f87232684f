"""The videos of a batch that are recorded and still there, for the page to play."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path, PurePosixPath

from sierra.deliverables.report import moving_pictures
from sierra.deliverables.report.make import ReportSource
from sierra.errors import SierraError
from sierra.extensions.explorer.checked_files import Hashes
from sierra.extensions.explorer.tickets import ServedContent, ServedFile, Tickets
from sierra.store import deliverable_records
from sierra.store.row_types import DeliverableRow
from sierra.store.store import Store
from sierra.util.hashing import sha256
from sierra.util.json_types import JsonView

AT_MOST = 100
"""The largest number of videos of a batch that the page shows."""
LARGEST = 64 << 20
"""The largest size in bytes of a video of a package, which is read as a whole."""
CHANGED = "the file is not there, or is not the recorded one"
TOO_LARGE = f"the file is too large to be played from a package (more than {LARGEST >> 20} MiB); extract the package"
Find = Callable[[str, str], ServedContent | None]
"""A function that returns the content of a file by its name and its SHA-256 in records, if it is that file.

Raises TooLarge for a file that cannot be played because of its size.
"""


def videos(source: ReportSource, store: Store, batch: str, tickets: Tickets, hashes: Hashes) -> list[JsonView]:
    """Return the recorded videos of a batch: of each, the address of the first file that is as it was recorded, or why not."""
    find = _in_project(source.project.root, hashes) if source.read is None else _in_package(source.read)
    rows = [row for row in deliverable_records.latest(store, batch) if moving_pictures.by_name(row.files)]
    every = [(row, name, files) for row in rows for name, files in moving_pictures.by_name(row.files).items()]
    shown: list[JsonView] = [_video(row, name, files, find, tickets) for row, name, files in every[:AT_MOST]]
    more = len(every) - len(shown)
    return [*shown, *([{"name": f"and {more:,} more", "problem": f"only the first {AT_MOST} are shown"}] if more else [])]


def _video(row: DeliverableRow, name: str, files: Sequence[str], find: Find, tickets: Tickets) -> dict[str, JsonView]:
    hashes = dict(zip(row.files, row.sha256s, strict=True))
    problem = CHANGED
    for file in files:
        try:
            content = find(file, hashes[file])
        except moving_pictures.TooLarge:
            content, problem = None, TOO_LARGE
        if content:
            kind = moving_pictures.FORMATS[PurePosixPath(file).suffix]
            address = tickets.issue(ServedFile(kind, content))
            return {
                "name": moving_pictures.captions(row)(name),
                "file": file,
                "address": address,
                "picture": kind == "image/gif",
            }
    return {"name": name, "file": ", ".join(files or row.files), "problem": problem}


def _in_project(root: Path, hashes: Hashes) -> Find:
    """Return a function that finds files within a project's folder."""

    def find(name: str, recorded_sha256: str) -> ServedContent | None:
        path = (root / name).resolve()
        is_there = path.is_relative_to(root.resolve()) and path.is_file()
        return hashes.checked(path, recorded_sha256) if is_there else None

    return find


def _in_package(read: moving_pictures.Read) -> Find:
    """Return a function that finds files of a package, which are read again each time that a browser asks for a part."""

    def find(name: str, recorded_sha256: str) -> ServedContent | None:
        again = partial(_checked, read, name, recorded_sha256)
        with suppress(SierraError, FileNotFoundError):
            again()
            return again
        return None

    return find


def _checked(read: moving_pictures.Read, name: str, recorded_sha256: str) -> bytes:
    """Return the content of a file in a package. Raises FileNotFoundError if it is not there or not the recorded one."""
    data = read(name, LARGEST)
    if data is None or sha256(data) != recorded_sha256:
        raise FileNotFoundError(name)
    return data
