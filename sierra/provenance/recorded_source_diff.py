"""The difference between two recorded states of the code: files, and the patch from one to the other.

A tree contains the content of the files, committed or not. If git has both trees, git makes the patch. Otherwise it is made
here from the contents of the files, which are in git or in the store.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal

from sierra.errors import Missing
from sierra.provenance.commits_between import HASH
from sierra.provenance.source.capture import SWHID
from sierra.provenance.source.git import Git, in_repository
from sierra.provenance.source.manifest import REPOSITORY, parts, read
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.textdiff import patch

COLORLESS = ("--no-color", "--no-ext-diff", "--no-textconv", "--find-renames=100%")


@dataclass(frozen=True, slots=True)
class State:
    """A recorded state of the code: its tree, and its manifest from the store."""

    tree: str
    manifest: bytes


@dataclass(frozen=True, slots=True)
class File:
    """One file that differs. Lines are counted if both versions are text and their contents are available."""

    path: str
    what: Literal["added", "removed", "changed", "renamed", "mode", "submodule"]
    was: str = ""
    """The old path of a renamed file, the old commit of a submodule, or the old mode."""
    now: str = ""
    added: int | None = None
    removed: int | None = None


@dataclass(frozen=True, slots=True)
class Difference:
    """The full difference between two trees."""

    files: tuple[File, ...]
    lines: tuple[str, ...]
    """The lines of the patch."""
    unknown: tuple[str, ...] = ()
    """Paths of files that the patch lacks, because their contents are neither in git nor in the store."""


def between(before: State, after: State, root: Path, content: Callable[[str], bytes | None]) -> Difference:
    """Return the difference between two trees. `content` returns a file that git does not have, by git's hash, or None."""
    git = _Git(root)
    old, new = _files(before.manifest), _files(after.manifest)
    files = list(_changed(old, new))
    trees = [state.tree.removeprefix(SWHID) for state in (before, after)]
    if all(git.has(tree, "tree") for tree in trees):
        counts = git.counts(*trees)
        return Difference(tuple(_counted(file, counts.get(file.path)) for file in files), git.patch(*trees))
    return _by_content(files, old, new, lambda blob: content(blob) if (found := git.blob(blob)) is None else found)


Files = Mapping[str, tuple[str, str]]
"""Mode and git's hash of each file, by path."""


def _files(manifest: bytes) -> Files:
    """Return the files of a manifest, which has one line per file: mode, hash, path."""
    return {path.decode("utf-8", "surrogateescape"): parts(what) for path, what in read(manifest).items()}


def changed(before: bytes, after: bytes) -> list[File]:
    """Return the files in which two manifests differ, without the numbers of lines."""
    return list(_changed(_files(before), _files(after)))


def _changed(old: Files, new: Files) -> Iterator[File]:
    """Yield the files that differ, ordered by path; an equal file under another name is renamed."""
    gone = {old[path]: path for path in sorted(old.keys() - new.keys(), reverse=True)}
    renamed = {path: gone.pop(new[path]) for path in sorted(new.keys() - old.keys()) if new[path] in gone}
    moved = set(renamed.values())
    for path in sorted(old.keys() | new.keys()):
        was, now = old.get(path), new.get(path)
        if path in renamed:
            yield File(path, "renamed", renamed[path], path)
        elif was != now and path not in moved:
            yield _file(path, was, now)


def _file(path: str, was: tuple[str, str] | None, now: tuple[str, str] | None) -> File:
    if was is None or now is None:
        return File(path, "removed" if now is None else "added")
    if REPOSITORY in (was[0], now[0]):
        return File(path, "submodule", was[1], now[1])
    if was[1] == now[1]:
        return File(path, "mode", was[0], now[0])
    return File(path, "changed")


def _counted(file: File, counts: tuple[int | None, int | None] | None) -> File:
    return File(file.path, file.what, file.was, file.now, *counts) if counts and file.what != "submodule" else file


def _by_content(files: list[File], old: Files, new: Files, content: Callable[[str], bytes | None]) -> Difference:
    """Return the difference, computed without git's patch, file by file."""
    counted: list[File] = []
    lines: list[str] = []
    unknown: list[str] = []
    for file in files:
        counted.append(file)
        if file.what in ("renamed", "mode", "submodule"):
            continue
        before, after = (b"" if file.path not in side else content(side[file.path][1]) for side in (old, new))
        if before is None or after is None:
            unknown.append(file.path)
            continue
        patched = patch(before, after, file.path)
        counted[-1] = replace(file, added=patched.added, removed=patched.removed)
        lines += patched.lines or (f"Binary files a/{file.path} and b/{file.path} differ",)
    return Difference(tuple(counted), tuple(lines), tuple(unknown))


class _Git:
    """Git in the repository of a project; without a repository, it finds nothing."""

    def __init__(self, root: Path) -> None:
        self._git = Git(root) if in_repository(root) and shutil.which("git") else None

    def has(self, thing: str, kind: str) -> bool:
        return bool(HASH.fullmatch(thing) and self._run("rev-parse", "--verify", "--quiet", f"{thing}^{{{kind}}}"))

    def blob(self, blob: str) -> bytes | None:
        return self._run("cat-file", "blob", blob) if HASH.fullmatch(blob) else None

    def counts(self, before: str, after: str) -> dict[str, tuple[int | None, int | None]]:
        """Return the numbers of added and removed lines by path; None for files that git treats as binary."""
        counts: dict[str, tuple[int | None, int | None]] = {}
        fields = iter((self._run("diff-tree", "-r", "-z", "--numstat", *COLORLESS, before, after) or b"").split(b"\0"))
        for field in fields:
            if field:
                added, removed, path = field.split(b"\t", 2)
                if not path:  # a renamed file: both names follow
                    next(fields)
                    path = next(fields)
                numbers = [None if number == b"-" else int(number) for number in (added, removed)]
                counts[path.decode("utf-8", "surrogateescape")] = (numbers[0], numbers[1])
        return counts

    def patch(self, before: str, after: str) -> tuple[str, ...]:
        found = self._run("diff-tree", "-r", "-p", *COLORLESS, before, after) or b""
        return tuple(found.decode("utf-8", "replace").removesuffix("\n").split("\n")) if found else ()

    def _run(self, *arguments: str) -> bytes | None:
        """Return git's output, or None if git fails."""
        if self._git is None:
            return None
        with contextlib.suppress(Missing):
            return self._git("-c", "core.quotePath=false", *arguments)
        return None
