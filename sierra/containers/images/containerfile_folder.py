"""A Containerfile folder: a `Containerfile`, and optionally a program `rootfs` that makes the base image's files."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from sierra.util.hashing import digest, sha256_file

CONTAINERFILE, ROOTFS = "Containerfile", "rootfs"
LABEL = "org.sierra.recipe"
"""The label of an image that contains the id of its Containerfile folder."""


def is_recipe(path: Path | None) -> bool:
    """Return whether a path is a folder from which an image can be built."""
    return path is not None and (path / CONTAINERFILE).is_file()


def identity(folder: Path) -> str:
    """Return the id of a Containerfile folder: a hash of its files' names and contents, and of which files are executable."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_symlink() or path.is_file())
    return digest("image recipe", {"files": [list(_file(folder, path)) for path in files]})


def text(folder: Path, label: str) -> str:
    """Return the text of `rootfs` and the Containerfile; empty if the folder's id is not the one in the label."""
    if not label or not is_recipe(folder) or identity(folder) != label:
        return ""
    files = [folder / name for name in (ROOTFS, CONTAINERFILE) if (folder / name).is_file()]
    return "\n".join(path.read_text("utf-8", "replace") for path in files)


def _file(folder: Path, path: Path) -> tuple[str, str, str]:
    name = str(path.relative_to(folder))
    if path.is_symlink():
        return name, "link", os.readlink(path)  # noqa: PTH115 - as it stands there
    return name, "program" if path.stat().st_mode & stat.S_IXUSR else "file", sha256_file(path)
