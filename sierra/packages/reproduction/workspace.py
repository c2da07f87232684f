"""The folder in which a package is reproduced: the verified copy of the package, and the report.

    FOLDER/package/             verified copy of the package; replays are recorded in its store
    FOLDER/reproduction.md      report
    FOLDER/reproduction.json    report for programs
    FOLDER/index.html           figures, tables, comparisons and numbers from the reproduced runs, beside those of the package
    FOLDER/.sierra-reproduction mark, and lock of the process that works here

The copy appears complete or not at all. If an earlier process was killed or interrupted, the next one with the same package
verifies the copy again and continues there: only the store may have got more files. Runs that were executed there count.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from sierra.errors import Damaged, Missing, UsageError
from sierra.execution import recover
from sierra.execution.observer import Observer
from sierra.packages.archive import CREATED, Archive, Extracted, Opened
from sierra.packages.layout import PACKAGE, PROJECT, STORED
from sierra.packages.members import MANIFEST, written
from sierra.packages.reading.received import records
from sierra.store.layout import CONFIG, PYPROJECT
from sierra.store.segments import FORMAT, FORMER, disk_errors
from sierra.store.store import Snapshot, Store
from sierra.util.hashing import sha256

COPY = "package"
SEGMENTS = f"{STORED}segments/"
FORMAT_FILE = f"{STORED}format"
REPORT = "reproduction"
PAGE = "index.html"
"""The stem of the names of the reports."""
MARK = ".sierra-reproduction"
UNFINISHED = ".sierra-unfinished"


def default(package: Path) -> Path:
    """Return the folder for a package if none is given: beside an archive, or inside an extracted package."""
    return package / CREATED if package.is_dir() else Path(f"{package.stem}-{REPORT}")


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Create a folder for a reproduction, or take an existing one, and keep other processes out until the end.

    Raises UsageError if it has other files under the names of this module, or if another process works there; Missing if the
    folder cannot be written.
    """
    taken = [name for name in (COPY, UNFINISHED, f"{REPORT}.md", f"{REPORT}.json", PAGE) if os.path.lexists(folder / name)]
    if taken and not (folder / MARK).is_file():
        raise UsageError(f"{folder / taken[0]} exists already; choose another folder with --into")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / MARK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    except OSError as error:
        raise Missing(f"cannot write to {folder}: {error.strerror}; choose another folder with --into") from error
    try:
        _lock(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UsageError(f"another sierra process works in {folder}; choose another folder with --into") from error


@contextlib.contextmanager
def opened(package: Path) -> Iterator[Opened]:
    """Open a package. Its list of files is checked, and not yet their contents.

    Raises Missing if it cannot be read, Damaged if it is not a safe package with a project.
    """
    with Extracted(package) if package.is_dir() else Archive(package) as archive:
        _check(archive)
        yield archive


def replays_here(package: Opened, store: Store, observer: Observer) -> frozenset[str]:
    """Return the sessions of the replays that earlier calls made in this folder: those of records that are not in the package.

    Finished runs of killed processes are recorded first; `observer` receives a notice if they cannot be.
    """
    recover.finish_dead(store, observer)
    packed = {name.removeprefix(SEGMENTS).split("/")[0] for name in package.names(SEGMENTS)}
    own = [segment for segment in store.segments() if segment.name not in packed]
    with Snapshot(store.paths.root, own) as snapshot:
        return frozenset(snapshot.values(str, "SELECT DISTINCT session FROM executions WHERE purpose = 'replay'"))


def copy_verified(package: Opened, folder: Path) -> None:
    """Verify a package, and copy it to the folder unless the same package is there already.

    Raises Damaged for a changed file, UsageError if the folder has another package.
    """
    if (folder / COPY).exists():
        _verify_again(package, folder / COPY)
    else:
        _copy(package, folder)


def _check(found: Opened) -> None:
    file = any(PROJECT + name in found.hashes for name in (CONFIG, PYPROJECT))
    if not file or PACKAGE not in found.hashes or not found.names(STORED):
        wanted = f"{PACKAGE}, {PROJECT}{CONFIG} (or {PYPROJECT}) and {STORED}"
        raise Damaged(f"{found.path} has no project with a store: {wanted} are required")
    records(found)


def _verify_again(package: Opened, copy: Path) -> None:
    """Verify a package, and a copy that an earlier process made. Raises UsageError if they differ."""
    again = f"{copy.parent} is of another package; choose another folder with --into"
    if not (copy / MANIFEST).is_file():
        raise UsageError(again)
    with _Used(copy, grows=STORED) as known:
        if known.id != package.id:
            raise UsageError(again)
        package.verify()
        known.verify()


class _Used(Extracted):
    """A copy whose store may have got the number of the present format, when a replay was recorded."""

    def _blocks(self, name: str) -> Iterator[bytes]:
        for block in super()._blocks(name):
            renewed = name == FORMAT_FILE and block == FORMAT.encode() and self.hashes[name] == sha256(FORMER.encode())
            yield FORMER.encode() if renewed else block


def _copy(package: Opened, folder: Path) -> None:
    unfinished = folder / UNFINISHED
    if unfinished.is_symlink():
        raise UsageError(f"{unfinished} is a link; remove it")
    shutil.rmtree(unfinished, ignore_errors=True)  # of a process that was killed: `alone` keeps others out
    package.extract(package.names(), unfinished)
    with disk_errors(folder):
        (unfinished / MANIFEST).write_bytes(written(package.hashes))
        unfinished.rename(folder / COPY)
