"""The manifest: the stored list of a source's files, with mode, git's hash and path for each, ordered by path.

Each line is `<mode> <hash>\\t<path>` and ends with NUL, because a path may contain any other byte. `git update-index
--index-info` reads this format.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import re
from collections.abc import Iterable, Iterator, Mapping

from sierra.util.lazy_definitions import dataclass

LINK, REPOSITORY = "120000", "160000"
"""Git's modes for a symbolic link and for a repository inside a repository."""

Files = Mapping[bytes, bytes]
"""Entries of a manifest by path: `<mode> <hash>`."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One file of a tree: git's mode and blob hash, and the path from the project's root."""

    mode: str
    blob: str
    path: bytes


def listed(entries: Iterable[Entry]) -> bytes:
    """Return the manifest of these files."""
    return written({entry.path: b"%s %s" % (entry.mode.encode(), entry.blob.encode()) for entry in entries})


def written(files: Files) -> bytes:
    return b"".join([b"%s\t%s\0" % (files[path], path) for path in sorted(files)])


def read(manifest: bytes) -> dict[bytes, bytes]:
    lines = (line.partition(b"\t") for line in manifest.split(b"\0") if line)
    return {path: what for what, _, path in lines}


def of_ls_tree(listing: bytes) -> dict[bytes, bytes]:
    """Return the files in the output of `git ls-tree -z`, whose lines have the kind of each file too."""
    return {path: b"%s %s" % (what[:6], what.rpartition(b" ")[2]) for path, what in read(listing).items()}


def parts(what: bytes) -> tuple[str, str]:
    """Return the mode and the hash."""
    mode, _, blob = what.decode("ascii", "replace").partition(" ")
    return mode, blob


def repositories(files: Files) -> Iterator[tuple[bytes, str]]:
    """Yield the nested repositories among the files: path, and commit (or tree)."""
    yield from [(path, parts(what)[1]) for path, what in files.items() if what[:6] == REPOSITORY.encode()]


def paths(manifest: bytes) -> set[bytes]:
    """Return the paths in a manifest."""
    return set(read(manifest))


def holds(manifest: bytes, path: str, content: bytes) -> bool:
    """Return True if a manifest has a file with this path and content."""
    mode, blob = parts(read(manifest).get(os.fsencode(path), b""))
    return mode not in ("", LINK, REPOSITORY) and is_blob(content, blob)


def blobs(manifest: bytes) -> set[str]:
    """Return git's hashes of the files in a manifest."""
    return {parts(what)[1] for what in read(manifest).values()}


def tree_of(manifest: bytes) -> str | None:
    """Return the hash of the tree that a manifest describes, or None if its hashes are not SHA-1."""
    files = read(manifest)
    return tree_hash(files) if all(re.fullmatch(rb"\d+ [0-9a-f]{40}", what) for what in files.values()) else None


def changed(before: bytes, after: bytes) -> list[str]:
    """Return the paths in which two manifests differ."""
    old, new = read(before), read(after)
    differing = {path for path in old.keys() | new.keys() if old.get(path) != new.get(path)}
    return [path.decode("utf-8", "replace") for path in sorted(differing)]


def git_hash(kind: bytes, content: bytes, algorithm: str = "sha1") -> str:
    """Return the hash that git gives to a file or a tree."""
    return hashlib.new(algorithm, b"%s %d\0%s" % (kind, len(content), content), usedforsecurity=False).hexdigest()


def is_blob(content: bytes, blob: str) -> bool:
    """Return True if git's hash of the content is `blob`, in a SHA-1 or a SHA-256 repository."""
    return git_hash(b"blob", content, "sha1" if len(blob) == 40 else "sha256") == blob


def tree_hash(files: Files) -> str:
    """Return the hash that git gives to a tree with these files, in a SHA-1 or a SHA-256 repository."""
    algorithm = "sha256" if any(len(parts(what)[1]) == 64 for what in itertools.islice(files.values(), 1)) else "sha1"
    folders: dict[bytes, list[tuple[bytes, bytes, bytes, str]]] = {b"": []}
    for path, what in files.items():
        folder, _, name = path.rpartition(b"/")
        mode, blob = parts(what)
        folders.setdefault(folder, []).append((name, mode.encode(), name, blob))
    for folder in list(folders):
        for above in _above(folder):
            folders.setdefault(above, [])
    for folder in sorted(folders, key=lambda path: path.count(b"/") + bool(path), reverse=True):
        entries = sorted(folders[folder])  # git compares a folder's name as if it ended with a slash
        content = b"".join([b"%s %s\0%s" % (mode, name, bytes.fromhex(blob)) for _, mode, name, blob in entries])
        hashed = git_hash(b"tree", content, algorithm)
        above, _, name = folder.rpartition(b"/")
        folders[above].append((name + b"/", b"40000", name, hashed))
    return hashed


def _above(folder: bytes) -> Iterator[bytes]:
    while folder:
        folder = folder.rpartition(b"/")[0]
        yield folder
