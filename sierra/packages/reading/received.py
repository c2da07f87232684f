"""Opening a received package: its records can be read, and nothing of it is executed.

Only the store, the project's file and SQL statements are extracted, to a folder in the user's cache that the package's id
names. Each file is checked while it is extracted.
"""

from __future__ import annotations

from pathlib import Path

from sierra.config import project_file
from sierra.config.project_file import LoadedProject
from sierra.errors import Damaged
from sierra.packages import manifest
from sierra.packages.archive import Archive, Opened
from sierra.packages.layout import PACKAGE, PROGRAM, PROJECT, STORED
from sierra.packages.manifest import PackageManifest
from sierra.packages.parts import verifier
from sierra.packages.parts.stored import is_record
from sierra.store.layout import STORE, user_packages
from sierra.store.segments import disk_errors
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass
from sierra.util.scratch import scratch
from sierra.util.version import __version__

OTHER = (
    f"{PROGRAM} in the package is not that of SIERRA {__version__}: read it before you execute it, or use the one of a package "
    "that you wrote"
)
UNFINISHED = ".unfinished-"
"""The prefix of the names of folders that packages are extracted to."""
READ = (".toml", ".sql")
"""Endings of the project's files that commands read to show records."""


@dataclass(frozen=True, slots=True)
class Received:
    """A package that was opened."""

    path: Path
    id: str
    manifest: PackageManifest
    project: LoadedProject
    """Its project, in a folder without the source."""
    store: Store
    notes: tuple[str, ...] = ()
    """Warnings for the user of the package."""


def open_package(path: Path) -> Received:
    """Open a package to read its records.

    Raises Missing if it cannot be read, Damaged if it is no package or not a safe one.
    """
    with Archive(path) as archive:
        described = manifest.read(archive.read(PACKAGE))
        folder = user_packages() / archive.id
        if not folder.is_dir():
            _keep(archive, folder)
        identity = archive.id
        known = verifier.is_ours(archive.hashes.get(PROGRAM))
    project = project_file.load(folder)
    notes = (*(() if known else (OTHER,)), *project.notes)
    return Received(path, identity, described, project, Store(folder / STORE, project.rules).confined(), notes)


def batches(store: Store) -> list[str]:
    """Return the ids of the batches in a package's store, whatever its description says."""
    return store.values(str, "SELECT batch FROM batches ORDER BY batch")


def records(archive: Opened) -> list[str]:
    """Return the names of the files of a package's store. Raises Damaged if it has none, or has other files than records."""
    names = archive.names(STORED)
    if strange := [name for name in names if not is_record(name)]:
        raise Damaged(f"{archive.path}: the member {strange[0]!r} is no record, but it is in the store")
    if not names:
        raise Damaged(f"{archive.path} has no store")
    return names


def _keep(archive: Archive, folder: Path) -> None:
    """Extract the members of a package that are read; `folder` appears complete or not at all."""
    files = [name for name in archive.names(PROJECT) if not name.startswith(STORED) and name.endswith(READ)]
    wanted = [*records(archive), *files]
    with disk_errors(folder.parent):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with scratch(folder.parent, UNFINISHED) as unfinished:
            archive.extract(wanted, unfinished)
            _name(unfinished / PROJECT, folder)


def _name(extracted: Path, folder: Path) -> None:
    """Give the extracted files their name, unless another process has extracted the same package meanwhile."""
    try:
        extracted.rename(folder)
    except OSError:
        if not folder.is_dir():
            raise
