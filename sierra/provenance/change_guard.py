"""How files were when they were taken for the code and the programs of a batch, to be asked later whether they still are.

A result must not be ascribed to files that did not make it, and while a batch executes for hours, somebody edits, pulls or
upgrades. So each file is remembered by size, inode and both its times, as in git's index: no program can set back the time of
change (ctime), so a file that was another for a while, and is as before again, is noticed too. Reading none of them, 50,000
take 0.15 s. Files that are only new are no change: runs may leave some in the project.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sierra.provenance.program import Kind, Programs
from sierra.provenance.source import narrowing
from sierra.provenance.source.manifest import REPOSITORY, read
from sierra.provenance.source.paths import shown

State = tuple[int, int, int, int] | None
"""Both times, size and inode; None where there is no file."""


@dataclass(frozen=True, slots=True)
class ChangeGuard:
    """Files as they were."""

    states: dict[bytes, State]
    root: bytes
    """The project's folder, as whose part a file is named."""
    source: tuple[bytes, ...] = ()
    """The files of the source, from there."""

    def doubt(self, since: str = "since the runs began") -> str | None:
        """What is not as it was, in a line that says why runs do not count; None where all is."""
        changed = [path for path, state in self.states.items() if _state(path) != state]
        if not changed:
            return None
        names = [path.removeprefix(self.root + b"/") for path in changed]
        return f"code or programs have changed {since}: {shown(names)} ({self.advice(names)})"

    def advice(self, names: Iterable[bytes]) -> str:
        """Return what to write where files are no code."""
        return narrowing.advice(names, self.source)

    def named(self, descriptor: int) -> str | None:
        """The one of them that is open there; None where none is."""
        try:
            status = os.fstat(descriptor)
        except OSError:
            return None
        for path, state in self.states.items():
            if state is not None and state[-1] == status.st_ino and os.path.samestat(os.stat(path), status):  # noqa: PTH116
                return shown([path.removeprefix(self.root + b"/")])
        return None


def alone(path: Path) -> ChangeGuard:
    """One file, as it is now."""
    name = os.fsencode(path)
    return ChangeGuard({name: _state(name)}, b"")


def seen(root: Path, manifest: bytes, programs: Programs) -> ChangeGuard:
    """The files of a source in the folder `root` (of none, where the list is empty), and the programs, as they are now."""
    base = os.fsencode(root)
    paths = (*_files(base, manifest), *(os.fsencode(one.path) for one in programs.all if one.kind != Kind.DISTRIBUTIONS))
    return ChangeGuard({path: _state(path) for path in paths}, base, tuple(read(manifest)))


def _files(base: bytes, manifest: bytes) -> Iterator[bytes]:
    for path, what in read(manifest).items():
        if what.startswith(REPOSITORY.encode()):
            yield from _below(base + b"/" + path)
        else:
            yield base + b"/" + path


def _below(folder: bytes) -> Iterable[bytes]:
    """The files of a repository inside, but for what git keeps there."""
    for here, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if name not in (b".git", b"__pycache__")]
        yield from (here + b"/" + name for name in files if name != b".git")


def _state(path: bytes) -> State:
    try:
        status = os.stat(path)  # noqa: PTH116 - as quick as can be
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino
