"""A recipe: a folder with a `Containerfile`, and perhaps a program `rootfs` that makes the base image's files."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from sierra.util.hashing import digest, sha256_file

CONTAINERFILE, ROOTFS = "Containerfile", "rootfs"
LABEL = "org.sierra.recipe"
"""The label that an image has of the recipe that it was built by."""


def is_recipe(path: Path | None) -> bool:
    """Whether it is a folder that an image is built from."""
    return path is not None and (path / CONTAINERFILE).is_file()


def identity(folder: Path) -> str:
    """The id of a recipe: of its files' names, contents, and whether they are programs."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_symlink() or path.is_file())
    return digest("image recipe", {"files": [list(_file(folder, path)) for path in files]})


def text(folder: Path, label: str) -> str:
    """What a recipe says, its `rootfs` and its Containerfile; empty where it is not the one that the label names."""
    if not label or not is_recipe(folder) or identity(folder) != label:
        return ""
    files = [folder / name for name in (ROOTFS, CONTAINERFILE) if (folder / name).is_file()]
    return "\n".join(path.read_text("utf-8", "replace") for path in files)


def _file(folder: Path, path: Path) -> tuple[str, str, str]:
    name = str(path.relative_to(folder))
    if path.is_symlink():
        return name, "link", os.readlink(path)  # noqa: PTH115 - as it stands there
    return name, "program" if path.stat().st_mode & stat.S_IXUSR else "file", sha256_file(path)
