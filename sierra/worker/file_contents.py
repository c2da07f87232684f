"""Contents of the files that a run has used, as they are after it; those that have changed meanwhile are unusable."""

from __future__ import annotations

import functools
import hashlib
import os
import stat
import time
from typing import Callable, Mapping, NamedTuple, Sequence

from sierra.worker.file_trace import Trace, nothing
from sierra.worker.python_files import PYTHON_CACHE, Environments, sha256_of

LATER = "its times are in the future, so that a clock is or was wrong"
LATER_NS = 24 * 3600 * 10**9
CHANGED = "it was changed after the run had opened it"


class File(NamedTuple):
    """The content of a file after the run, and values that differ if it is changed (inode, size, times in ns)."""

    sha256: str
    size: int
    state: tuple[int, ...]


class Contents(NamedTuple):
    """The contents that a run has read, by paths; and the paths with unknown contents, with the reason."""

    files: Mapping[str, File]
    folders: Mapping[str, str]
    """For each listed folder the SHA-256 of its names: sorted, each before a NUL, without `__pycache__` and the run's own, and
    without those that `is_listed` leaves out."""
    unusable: Mapping[str, str]
    listings: Mapping[str, Sequence[str]] = {}
    """The names behind each of these SHA-256."""
    kinds: Mapping[str, str] = {}
    """For each found path the SHA-256 of what `sha256_of_kind` returns."""


Hashed = Callable[[], str]
Cache = Callable[[str, os.stat_result, Hashed], str]
"""Returns the SHA-256 of a file with this path and status: one that it knows, or what the function returns that it is given."""


def contents(
    trace: Trace,
    began: int,
    cache: Cache = lambda path, status, hashed: hashed(),
    check_stop: Callable[[], None] = nothing,
    is_listed: Callable[[str], bool] = lambda path: True,
) -> Contents:
    """Return the content of all that a run executed, read or listed: of a trace that `Names.inputs` has returned.

    `is_listed` tells which paths count in a listed folder: `Names.is_listed`.

    `began` is `Observation.began`. A file is unusable if it was changed since then, or while it is hashed, because the run may
    have read something else; and so is a link or a folder. A time in the future counts as changed if it is the ctime, which
    programs cannot set. If it is more than a day in the future, a clock is wrong: the file is unusable, but has its content.
    Also unusable: a path that is missing now or exists now, unlike in the run. Devices have no content.
    """
    reader = Reader(began, cache, check_stop)
    for path in sorted({*trace.executed, *trace.read}):
        reader.try_to(reader.read, path)
    own = set(trace.written)
    for path in trace.listed:
        reader.try_to(functools.partial(reader.list, own, is_listed), path)
    for path, real in trace.links.items():
        reader.try_to(functools.partial(reader.follow, real), path)
    for path in trace.found:
        if not os.path.lexists(path) and path not in trace.removed:
            reader.unusable[path] = "it was removed after the run had found it"
    for path in trace.missed:
        if os.path.exists(path) and path not in own:
            reader.unusable[path] = "it was made after the run had looked for it"
    kinds = {path: sha256_of_kind(path) for path in (*trace.found, *trace.refused)}
    return Contents(reader.files, reader.folders, reader.unusable, reader.listings, kinds)


def sha256_of_kind(path: str) -> str:
    """Return the SHA-256 of what a program sees of a path without opening it: a folder, or a file with its size and rights.

    Times are not among it, because they differ between machines.
    """
    try:
        status = os.stat(path)
    except OSError as error:
        kind = "error %s" % error.errno
    else:
        is_file = stat.S_ISREG(status.st_mode)
        kind = "file %d %d" % (status.st_size, bool(status.st_mode & 0o111)) if is_file else "%o" % stat.S_IFMT(status.st_mode)
        kind += "" if os.access(path, os.R_OK) else " unreadable"
    return hashlib.sha256(kind.encode()).hexdigest()


class Reader:
    """Reads files, folders and links after a run."""

    def __init__(self, began: int, cache: Cache, check_stop: Callable[[], None]) -> None:
        self._began = began
        self._cache, self._check_stop = cache, check_stop
        self._environments = Environments()
        self.files: dict[str, File] = {}
        self.folders: dict[str, str] = {}
        self.unusable: dict[str, str] = {}
        self.listings: dict[str, list[str]] = {}

    def try_to(self, read: Callable[[str], None], path: str) -> None:
        self._check_stop()
        try:
            read(path)
        except FileNotFoundError:
            self.unusable[path] = "it was removed after the run had read it"
        except (OSError, ValueError) as error:
            self.unusable[path] = "it cannot be read: %s" % (getattr(error, "strerror", None) or error)

    def read(self, path: str) -> None:
        status = os.stat(path)
        kind = stat.S_IFMT(status.st_mode)
        if kind in (stat.S_IFCHR, stat.S_IFBLK):
            return
        if kind != stat.S_IFREG:
            self.unusable[path] = "it is no regular file"
            return
        if self._changed(status):
            self.unusable[path] = CHANGED
            return
        if self._is_later(status):
            self.unusable[path] = LATER  # and yet its content is recorded, for what depends on the bytes alone
        sha256 = self._cache(path, status, lambda: sha256_of(path, self._environments, self._check_stop))
        if key_of(os.stat(path)) != key_of(status):
            self.unusable[path] = CHANGED
            return
        self.files[path] = File(sha256, status.st_size, key_of(status))

    def list(self, own: set[str], is_listed: Callable[[str], bool], path: str) -> None:
        before = os.stat(path)
        if self._changed(before):
            self.unusable[path] = "it was changed after the run had listed it"
            return
        if self._is_later(before):
            self.unusable[path] = LATER
        paths = ((name, os.path.join(path, name)) for name in os.listdir(path) if name != PYTHON_CACHE)
        kept = [name for name, entry in paths if entry not in own and is_listed(entry)]
        kept.sort(key=os.fsencode)
        if key_of(os.stat(path)) != key_of(before):
            self.unusable[path] = "it was changed after the run had listed it"
            return
        digest = hashlib.sha256(b"".join(os.fsencode(name) + b"\0" for name in kept)).hexdigest()
        self.folders[path] = digest
        self.listings[digest] = kept

    def follow(self, real: str, path: str) -> None:
        status = os.lstat(path)
        if os.path.realpath(path) != real or (stat.S_ISLNK(status.st_mode) and self._changed(status)):
            self.unusable[path] = "its link was changed after the run had followed it"
        elif self._is_later(status):
            self.unusable[path] = LATER

    def _changed(self, status: os.stat_result) -> bool:
        """Return whether a file may have been changed in the run, by its times."""
        if self._is_later(status):
            return False
        return status.st_ctime_ns >= self._began or self._began <= status.st_mtime_ns <= time.time_ns()

    def _is_later(self, status: os.stat_result) -> bool:
        """Return whether a file was changed by another clock: so long after now that no change in the run can be meant."""
        return status.st_ctime_ns > time.time_ns() + LATER_NS


def key_of(status: os.stat_result) -> tuple[int, ...]:
    """Return values of a file that differ after it was changed."""
    return (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
