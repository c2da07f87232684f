"""An extracted package: a folder that is read without trust, with the checks of `sierra.packages.archive`.

Links are not followed. In the folder `reproduction`, an evaluator works: its files need not be listed.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from sierra.errors import Damaged, Missing
from sierra.packages import members
from sierra.packages.archive import LARGEST_MANIFEST
from sierra.packages.members import MANIFEST
from sierra.store.segments import disk_errors
from sierra.util.fs import inside
from sierra.util.hashing import CHUNK

CREATED = "reproduction/"
"""The folder for the results of an evaluator."""


class Extracted:
    """A context manager for an extracted package. Nothing of it is executed, and nothing is written in it."""

    def __init__(self, path: Path, grows: str = CREATED) -> None:
        """List the files. `grows` is a folder whose files need not be listed.

        Raises Missing if a file cannot be read, Damaged unless the files are regular and those of the manifest.
        """
        self.path = path
        self._grows = grows
        try:
            files = set(self._files())
            if MANIFEST not in files:
                raise Damaged(f"{path} is no extracted package: it has no {MANIFEST}")
            if (path / MANIFEST).stat().st_size > LARGEST_MANIFEST:
                raise Damaged(f"{path / MANIFEST} is too large")
            self.hashes = members.read((path / MANIFEST).read_bytes())
        except OSError as error:
            raise Missing(f"{error.filename or path}: {error.strerror or error}") from error
        if lost := sorted(self.hashes.keys() - files):
            raise Damaged(f"{path}: {lost[0]!r} of {MANIFEST} is missing")
        extra = sorted(name for name in files - self.hashes.keys() - {MANIFEST} if not name.startswith(grows))
        if extra:
            raise Damaged(f"{path}: {MANIFEST} does not list {extra[0][:200]!r}")

    def __enter__(self) -> Extracted:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    @property
    def id(self) -> str:
        """The identity of the package."""
        return members.package_id(self.hashes)

    def _files(self) -> Iterator[str]:
        """Yield the names of all files. Raises Damaged for links and devices."""
        folders = [""]
        while folders:
            before = folders.pop()
            with os.scandir(self.path / before) as entries:
                for entry in entries:
                    name = before + entry.name
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(name + "/")
                    elif entry.is_file(follow_symlinks=False):
                        yield name
                    elif not name.startswith(self._grows):
                        raise Damaged(f"{self.path}: {name[:200]!r} is a link or a device: only files and folders are accepted")

    def names(self, folder: str = "") -> list[str]:
        """Return the names of all listed files in a folder, in order."""
        return [name for name in sorted(self.hashes) if name.startswith(folder)]

    def blocks(self, name: str) -> Iterator[bytes]:
        """Yield the content of a file. Raises Damaged at the end if it is not that of the manifest."""
        digest = hashlib.sha256()
        try:
            with (self.path / name).open("rb") as file:
                while block := file.read(CHUNK):
                    digest.update(block)
                    yield block
        except OSError as error:
            raise Missing(f"{self.path / name}: {error.strerror or error}") from error
        if digest.hexdigest() != self.hashes[name]:
            raise Damaged(f"{self.path}: {name!r} is not what {MANIFEST} says (SHA-256 {digest.hexdigest()[:10]})")

    def verify(self) -> None:
        """Read all listed files. Raises Damaged for the first one that is not what the manifest says."""
        for name in self.names():
            for _ in self.blocks(name):
                pass

    def extract(self, names: Iterable[str], folder: Path) -> None:
        """Copy files below `folder`, which must be a new folder of the caller's, and check their contents.

        Raises Damaged, and Missing if there is too little space.
        """
        wanted = list(names)
        needed = sum((self.path / name).stat().st_size for name in wanted)
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(folder).free
        if needed > free:
            raise Missing(f"{folder} has {free:,} bytes of free space, but {needed:,} are needed")
        for name in wanted:
            self._extract(name, folder)

    def _extract(self, name: str, folder: Path) -> None:
        path = inside(folder, name)
        with disk_errors(folder):
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("xb") as file:
                file.writelines(self.blocks(name))
            if os.access(self.path / name, os.X_OK):
                path.chmod(0o755)
