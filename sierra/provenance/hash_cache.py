"""A cache of the SHA-256 of files, valid while a file's path, device, inode, size and both times are the same.

The kernel sets the time of change (ctime) whenever content or permissions change, and no program can set it. A file that was
changed within the last seconds is hashed again next time, because another change could fall into the same tick of the clock
(git calls such files racily clean).
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from sierra.errors import Missing
from sierra.store.layout import user_digests
from sierra.util.cache import Cache
from sierra.util.fs import RACY_NS, state
from sierra.util.hashing import sha256_file

VENV = "pyvenv.cfg"
"""File name that marks a folder as a virtual environment."""
SMALL = 1 << 16
"""Maximum size in bytes of files that are not cached, because hashing them is as fast as a look-up."""
MAX_ENTRIES = 4096


class HashCache:
    """A cache of the SHA-256 of files; `save` stores it for the next time."""

    def __init__(self) -> None:
        self._cache = Cache(user_digests(), MAX_ENTRIES)
        self._folders: dict[str, bool] = {}
        """Answers by folder: true if it is in a virtual environment of Python."""

    def of(self, path: str) -> str:
        """Return the SHA-256 of a file's content. Raises Missing if the file cannot be read."""
        return self._known_or(path, lambda there: sha256_file(Path(there)))

    def counted(self, path: str) -> str:
        """Return the SHA-256 of what counts of a file: in a virtual environment of Python, the environment's path does not.

        It is that of the content for all other files: see `sierra.worker.python_files.counted`. Raises Missing.
        """
        if not self._is_in_environment(os.path.dirname(path)):  # noqa: PTH120 - for speed
            return self.of(path)
        from sierra.worker import python_files

        hashed = functools.partial(python_files.sha256_of, environments=python_files.Environments())
        return _or_missing(path, hashed) if python_files.is_record(path) else self._known_or(path, hashed)

    def counted_before(self, path: str) -> str:
        """Return the SHA-256 that earlier versions of SIERRA recorded for a file of a virtual environment. Raises Missing."""
        if not self._is_in_environment(os.path.dirname(path)):  # noqa: PTH120 - for speed
            return self.of(path)
        from sierra.worker import python_files

        return _or_missing(path, lambda there: python_files.sha256_of(there, python_files.Environments(), former=True))

    def _is_in_environment(self, folder: str) -> bool:
        if folder not in self._folders:
            above = os.path.dirname(folder)  # noqa: PTH120 - for speed
            inside = os.path.isfile(folder + "/" + VENV) or (above != folder and self._is_in_environment(above))  # noqa: PTH113
            self._folders[folder] = inside
        return self._folders[folder]

    def learn(self, known: Mapping[str, list[int | str]]) -> None:
        """Add hashes that another program on this machine has computed in the same way: state and SHA-256, by path."""
        for path, fact in known.items():
            self._cache.put(path, fact)

    def save(self) -> None:
        self._cache.save()

    def _known_or(self, path: str, hashed: Callable[[str], str]) -> str:
        return _or_missing(path, lambda there: self._find(there, hashed))

    def _find(self, path: str, hashed: Callable[[str], str]) -> str:
        now = state(path)
        if now[2] <= SMALL:
            return hashed(path)
        known = self._cache.get(path)
        if isinstance(known, list) and known[:-1] == now and isinstance(known[-1], str):
            return known[-1]
        began = time.time_ns()
        digest = hashed(path)
        if state(path) == now and max(now[3:]) < began - RACY_NS:
            self._cache.put(path, [*now, digest])
        return digest


def cached_sha256(path: Path | str) -> str:
    """Return the SHA-256 of one file's content. Raises Missing if the file cannot be read."""
    cache = HashCache()
    found = cache.of(str(path))
    cache.save()
    return found


def _or_missing(path: str, hashed: Callable[[str], str]) -> str:
    try:
        return hashed(os.path.abspath(path))  # noqa: PTH100 - links stay
    except OSError as error:
        raise Missing(f"{path} cannot be read: {error.strerror}") from error
