"""An extracted package: a folder that is read without trust, with the checks of `sierra.packages.archive`.

Links are not followed. In the folder `reproduction`, an evaluator works: its files need not be listed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from sierra.errors import Damaged, Missing
from sierra.packages import members
from sierra.packages.archive import LARGEST_MANIFEST, Opened
from sierra.packages.members import MANIFEST
from sierra.util.hashing import CHUNK
from sierra.util.regular_files import open_regular, read_regular

CREATED = "reproduction/"
"""The folder for the results of an evaluator."""


class Extracted(Opened):
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
            self.hashes = members.read(read_regular(path / MANIFEST))
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

    def size(self, name: str) -> int:
        return (self.path / name).stat().st_size

    def _is_program(self, name: str) -> bool:
        return os.access(self.path / name, os.X_OK)

    def _blocks(self, name: str) -> Iterator[bytes]:
        try:
            with open_regular(self.path / name) as file:
                while block := file.read(CHUNK):
                    yield block
        except OSError as error:
            raise Missing(f"{self.path / name}: {error.strerror or error}") from error
