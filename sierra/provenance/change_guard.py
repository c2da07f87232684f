"""A guard that detects changes to a batch's code and programs while the batch executes.

A result must not be ascribed to files that did not produce it. But while a batch executes for hours, users may edit files,
pull commits or upgrade programs. Therefore the guard stores the size, inode and both times of each file, like git's index. No
program can set back the time of change (ctime), so the guard also detects a file that was changed and then changed back. No
file is read, so 50,000 files take 0.15 s. New files are not a change, because runs may leave files in the project.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

from sierra.errors import Missing
from sierra.provenance.dependency_model import NOTHING, Kind, Programs
from sierra.provenance.hash_cache import HashCache
from sierra.provenance.source import suggest_exclusions
from sierra.provenance.source.git import Git, in_repository
from sierra.provenance.source.manifest import REPOSITORY, is_blob, parts, read
from sierra.provenance.source.plain_tree import ListedFile, State, state_of
from sierra.provenance.source.selection import shown
from sierra.util.hashing import CHUNK
from sierra.util.lazy_definitions import dataclass, field, replace
from sierra.util.regular_files import open_regular


@dataclass(frozen=True, slots=True)
class ChangeGuard:
    """The states of files at one time."""

    states: dict[bytes, State]
    root: bytes
    """The project's folder; messages name its files relative to it."""
    source: tuple[bytes, ...] = ()
    """The files of the source, relative to the project's folder."""
    contents: Mapping[bytes, str] = field(default_factory=dict)
    """The hashes of files by path: git's, or the SHA-256 of those that are programs."""
    programs: Programs = NOTHING

    def doubt(self, since: str = "since the runs began") -> str | None:
        """Return one line that names the changed files, or None if nothing has changed.

        A file that has the same content again may have had another one meanwhile. It is named only if there is no other one.
        """
        paths = self.changed()
        certain = [path for path in paths if not self.has_content(path)]
        names = [path.removeprefix(self.root + b"/") for path in certain or paths]
        have = "have changed" if certain else "may have changed, as their times say,"
        return f"code or programs {have} {since}: {shown(names)} ({self.advice(names)})" if names else None

    def has_content(self, path: bytes) -> bool:
        """Check whether a file has the content that it had."""
        known = self.contents.get(path, "")
        try:
            if path.removeprefix(self.root + b"/") not in self.source:
                open_regular(path, buffering=0).close()  # nothing is written to a FIFO
                return HashCache().counted(os.fsdecode(path)) == known
            return known in _hashes(path) or known == self._committed(path)
        except (Missing, OSError):
            return False

    def has_lost(self, path: bytes, blob: str, since: int) -> bool:
        """Check whether a file that was written after `since`, or is gone, lacks the content with git's hash `blob`."""
        state = self.states[path]
        if state is not None and max(state[:2]) < since:
            return False
        try:
            if stat.S_ISLNK(os.lstat(path).st_mode):  # the file that it leads to is checked if it belongs to the source
                return not is_blob(os.readlink(path), blob)  # noqa: PTH115 - bytes
        except OSError:
            return True
        return not self.has_content(path)

    def _committed(self, path: bytes) -> str | None:
        """Return git's hash of what it would commit of a file, which it may convert; None outside git."""
        root = Path(os.fsdecode(self.root))
        return Git(root)("hash-object", "--", os.fsdecode(path)).decode().strip() if in_repository(root) else None

    def changed(self) -> list[bytes]:
        """Return the absolute paths of the changed files."""
        return [path for path, state in self.states.items() if state_of(path) != state]

    def changed_source(self) -> dict[str, bool] | None:
        """Return the absolute paths of the changed files if all of them are source; None otherwise.

        Each is True if a file of this name may have been absent for a time, because it is another file now, or there is none.
        """
        changed = self.changed()
        names = [path.removeprefix(self.root + b"/") for path in changed]
        if not frozenset(self.source).issuperset(names):
            return None
        return {os.fsdecode(path): not _is_same_file(self.states[path], state_of(path)) for path in changed}

    def advice(self, names: Iterable[bytes]) -> str:
        """Return advice for the case that the changed files are not code."""
        return suggest_exclusions.advice(names, self.source)

    def named(self, descriptor: int) -> str | None:
        """Return the name of the guarded file that is open as `descriptor`, or None if it is another file."""
        try:
            status = os.fstat(descriptor)
        except OSError:
            return None
        for path, state in self.states.items():
            if state is not None and state[-1] == status.st_ino and os.path.samestat(os.stat(path), status):  # noqa: PTH116
                return shown([path.removeprefix(self.root + b"/")])
        return None


def guard_file(path: Path) -> ChangeGuard:
    """Return a guard for one file in its current state."""
    name = os.fsencode(path)
    return ChangeGuard({name: state_of(name)}, b"")


def guard(
    root: Path,
    manifest: bytes,
    programs: Programs,
    listed: Mapping[bytes, ListedFile] = MappingProxyType({}),
    since: int | None = None,
) -> ChangeGuard:
    """Return a guard for the files of a manifest (none if it is empty) in the folder `root`, and for the programs.

    The files may have changed since the manifest was made. `listed` has their states of that time. Without them, a file that
    was written after `since` is changed unless it has the content that the manifest names.
    """
    base = os.fsencode(root)
    used = (program.path for program in programs.all if program.kind != Kind.DISTRIBUTIONS)
    paths = (*_files(base, manifest), *map(os.fsencode, used))
    blobs = {base + b"/" + path: parts(what)[1] for path, what in read(manifest).items()}
    files = blobs | {os.fsencode(program.path): program.sha256 for program in programs.all}
    before = {base + b"/" + path: file.state for path, file in listed.items()}
    states = {path: before[path] if path in before else state_of(path) for path in paths}
    taken = ChangeGuard(states, base, tuple(read(manifest)), files, programs)
    if since is None:
        return taken
    lost = [path for path, blob in blobs.items() if path in states and taken.has_lost(path, blob, since)]
    return replace(taken, states={**states, **{path: _with_other_times(states[path]) for path in lost}})


def _files(base: bytes, manifest: bytes) -> Iterator[bytes]:
    for path, what in read(manifest).items():
        if what.startswith(REPOSITORY.encode()):
            for folder, folders, files in os.walk(base + b"/" + path):  # except git's own files
                folders[:] = [name for name in folders if name not in (b".git", b"__pycache__")]
                yield from (folder + b"/" + name for name in files if name != b".git")
        else:
            yield base + b"/" + path


def _hashes(path: bytes) -> list[str]:
    """Return the hashes of a file: the SHA-256 of its content, and git's hashes. Raises OSError if it is no regular file."""
    with open_regular(path, buffering=0) as file:
        head = b"blob %d\0" % os.fstat(file.fileno()).st_size
        git = [hashlib.new(name, head, usedforsecurity=False) for name in ("sha1", "sha256")]
        hashed = [hashlib.sha256(), *git]
        while content := file.read(CHUNK):
            for digest in hashed:
                digest.update(content)
    return [digest.hexdigest() for digest in hashed]


def _with_other_times(state: State) -> State:
    """Return a state that no file has, with the inode of this one."""
    return 0, 0, 0, state[-1] if state else 0


def _is_same_file(before: State, now: State) -> bool:
    return before is not None and now is not None and before[-1] == now[-1]
