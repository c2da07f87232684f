"""Sessions that cannot be recorded: each is moved to `damaged/work-<session>/`, so that no other command fails for it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from sierra.errors import SierraError
from sierra.store import ownership_marks
from sierra.store.layout import SessionPaths, StorePaths
from sierra.store.segments import disk_errors
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import open_regular
from sierra.util.text import one_line

NAME = regex(r"work-([0-9a-f]{16})(\.\d+)?")
MOST = 1000
"""The largest number of characters of a reason."""


class Unrecorded(NamedTuple):
    """A session that was moved away."""

    session: str
    folder: Path
    reason: str
    elsewhere: Path | None = None
    """The folder where its runs were executed, if it is not in `folder`."""

    def __str__(self) -> str:
        where = f".sierra/{self.folder.parent.name}/{self.folder.name}{f' and {self.elsewhere}' if self.elsewhere else ''}"
        return (
            f"session {self.session} cannot be recorded ({self.reason}); its files are in {where}; sierra run executes "
            "its runs again, and sierra gc --damaged removes the files"
        )


def put_aside(store: StorePaths, paths: SessionPaths, error: Exception) -> Unrecorded:
    """Move the folder of a session that cannot be recorded, with the reason. Raises Missing."""
    reason = one_line(error if isinstance(error, SierraError) else f"{type(error).__name__}: {error}")
    reason = reason.partition(f"; move {paths.root} away")[0][:MOST]  # it is moved away now
    with disk_errors(store.damaged):
        paths.fault.write_text(reason, "utf-8", "backslashreplace")
        store.damaged.mkdir(exist_ok=True)
        name = f"{store.work.name}-{paths.root.name}"
        names = itertools.chain([name], (f"{name}.{number}" for number in itertools.count(1)))
        target = next(store.damaged / name for name in names if not (store.damaged / name).exists())
        paths.root.rename(target)
    return Unrecorded(paths.root.name, target, reason, paths.elsewhere)


def found(store: StorePaths) -> Iterator[Unrecorded]:
    """Yield the sessions that were moved away."""
    folders = sorted(store.damaged.iterdir()) if store.damaged.is_dir() else []
    for folder in folders:
        if (matched := NAME.fullmatch(folder.name)) and folder.is_dir() and not folder.is_symlink():
            yield Unrecorded(
                matched[1], folder, _reason(SessionPaths(folder)), ownership_marks.elsewhere(store, folder, matched[1])
            )


def _reason(paths: SessionPaths) -> str:
    try:
        with open_regular(paths.fault) as file:
            return one_line(file.read(MOST).decode("utf-8", "replace")) or "for an unknown reason"
    except OSError:
        return "for an unknown reason"
