"""Files that git ignores in a project: they are not part of the source, so a checkout of the source lacks them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from sierra.provenance.source.git import Git
from sierra.provenance.source.plain_tree import LEFT_OUT
from sierra.provenance.source.selection import PathSelection

CACHES = LEFT_OUT | {".DS_Store", ".eggs", ".idea", ".ipynb_checkpoints", ".nox", ".tox", ".vscode"}
"""Files and folders of tools; no run needs them."""
SUFFIXES = (".egg-info", ".pyc")
VENV = "pyvenv.cfg"


def ignored(root: Path, without: Iterable[str]) -> list[bytes]:
    """Return the ignored files, and the folders (with a slash at the end) that git ignores completely.

    The paths in `without`, caches and virtual environments are left out. Folders that are ignored completely are not searched.
    Raises Missing if git fails.
    """
    told = Git(root)("ls-files", "--others", "--ignored", "--exclude-standard", "--directory", "-z", "--", ".")
    never = PathSelection(without=without).never
    return [path for path in told.split(b"\0") if path and not never(path) and not _is_cache(root, os.fsdecode(path))]


def _is_cache(root: Path, path: str) -> bool:
    parts = Path(path).parts
    return not CACHES.isdisjoint(parts) or parts[-1].endswith(SUFFIXES) or (root / path / VENV).is_file()
