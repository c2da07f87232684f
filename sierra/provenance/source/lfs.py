"""Checks for files that git-lfs manages: git stores a pointer to such a file, and git-lfs fetches the data.

If git-lfs is not installed, or its data was not fetched, a checkout contains the pointers instead of the data. A run that
reads pointers is not the intended run, and git cannot see the difference. Therefore a remaining pointer is an error.
Pointers are specified in git-lfs's docs/spec.md.
"""

from __future__ import annotations

import os
from pathlib import Path

from sierra.errors import Missing
from sierra.provenance.source.git import Git
from sierra.provenance.source.manifest import Files
from sierra.provenance.source.selection import shown
from sierra.util.regular_files import open_regular

POINTER = b"version https://git-lfs.github.com/spec/v1\n"
ATTRIBUTES = ".gitattributes"


def check(git: Git, index: Path, files: Files) -> None:
    """Raise Missing if a file of the source is still a pointer."""
    if _used(git, git.root, files):
        check_all(git, index, files)


def check_all(git: Git, index: Path | None = None, files: Files | None = None) -> None:
    """Raise Missing if one of these files, or of all files in a repository, is still a pointer."""
    managed = git("ls-files", "-z", "--", ":(attr:filter=lfs)", index=index).split(b"\0")[:-1]
    selected = [path for path in managed if files is None or path in files]
    if pointers := [path for path in selected if _is_pointer(git.root / os.fsdecode(path))]:
        raise Missing(
            f"{shown(pointers)}: git-lfs pointers without their data; fetch the data with git lfs pull,"
            " or exclude these files ([source] paths)"
        )


def check_restored(git: Git, target: Path, files: Files) -> None:
    """Raise Missing if a file that git wrote into `target` is still a pointer."""
    attributes = [target / os.fsdecode(path) for path in files if path.endswith(ATTRIBUTES.encode())]
    if any(b"filter=lfs" in _head(path, 1 << 20) for path in attributes):
        pointers = [path for path, what in files.items() if what[:3] == b"100" and _is_pointer(target / os.fsdecode(path))]
        if pointers:
            raise Missing(f"{shown(pointers)}: git-lfs does not have the data; run git lfs pull in {git.root}")


def _used(git: Git, root: Path, files: Files) -> bool:
    """Return True if an attributes file in the git directory, above or below these files mentions git-lfs."""
    above = [folder / ATTRIBUTES for folder in (root, *root.parents) if folder.is_relative_to(git.top)]
    below = [root / os.fsdecode(path) for path in files if path.endswith(b".gitattributes")]
    return any(b"filter=lfs" in _head(path, 1 << 20) for path in (*above, *below, git.folder / "info" / "attributes"))


def _is_pointer(path: Path) -> bool:
    return not path.is_symlink() and _head(path, len(POINTER)) == POINTER


def _head(path: Path, size: int) -> bytes:
    try:
        with open_regular(path) as file:
            return file.read(size)
    except OSError:
        return b""
