"""Files whose content was checked. They can be opened as long as they are the same files, and nobody has written to them."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from io import BufferedReader
from pathlib import Path
from typing import NamedTuple

from sierra.util.lazy_definitions import dataclass


class Identity(NamedTuple):
    """The facts that change when another file is put in the place of one, or when a file is written."""

    device: int
    inode: int
    size: int
    mtime_ns: int

    @classmethod
    def of(cls, file: BufferedReader) -> Identity:
        found = os.fstat(file.fileno())
        return cls(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns)


@dataclass(frozen=True, slots=True)
class CheckedFile:
    """A file with the identity that it had while its content was checked."""

    path: Path
    identity: Identity

    def open(self) -> BufferedReader:
        """Return the open file. Raises FileNotFoundError if it is not there, is a link, or has changed."""
        try:
            file = _opened(self.path)
        except OSError as error:
            raise FileNotFoundError(self.path) from error
        if Identity.of(file) != self.identity:
            file.close()
            raise FileNotFoundError(self.path)
        return file


class Hashes:
    """The hashes of files, each of which is computed once for each identity."""

    def __init__(self) -> None:
        self._known: dict[Identity, str] = {}

    def checked(self, path: Path, sha256: str) -> CheckedFile | None:
        """Return a file if its content has this SHA-256; None if it has not, or is not a file."""
        with suppress(OSError), _opened(path) as file:
            identity = Identity.of(file)
            if identity not in self._known:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
                if Identity.of(file) != identity:
                    return None
                self._known[identity] = digest
            return CheckedFile(path, identity) if self._known[identity] == sha256 else None
        return None


def _opened(path: Path) -> BufferedReader:
    """Open a file, but not through a link in its last part; a pipe does not block."""
    return os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
