"""What git ignores in a project: it is no code, and is missing where only the code is."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from sierra.provenance.source.git import Git
from sierra.provenance.source.paths import PathSelection
from sierra.provenance.source.plain_tree import LEFT_OUT

CACHES = LEFT_OUT | {".DS_Store", ".eggs", ".idea", ".ipynb_checkpoints", ".nox", ".tox", ".vscode"}
"""Files and folders of tools, which no run needs."""
SUFFIXES = (".egg-info", ".pyc")
VENV = "pyvenv.cfg"


def ignored(root: Path, without: Iterable[str]) -> list[bytes]:
    """Files, and folders (with a slash) of which git ignores all; without some, caches and virtual environments.

    Nothing of a folder that is ignored as a whole is looked at. Raises Missing where git can't tell.
    """
    told = Git(root)("ls-files", "--others", "--ignored", "--exclude-standard", "--directory", "-z", "--", ".")
    never = PathSelection(without=without).never
    return [path for path in told.split(b"\0") if path and not never(path) and not _is_cache(root, os.fsdecode(path))]


def _is_cache(root: Path, path: str) -> bool:
    parts = Path(path).parts
    return not CACHES.isdisjoint(parts) or parts[-1].endswith(SUFFIXES) or (root / path / VENV).is_file()
