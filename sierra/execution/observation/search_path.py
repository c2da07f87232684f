"""Programs that another search path (PATH) would find elsewhere than the one that an observed execution had."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable


def found_elsewhere(executed: Iterable[str], missed: Iterable[str], before: str | None, now: str) -> str | None:
    """Return a program that was found on the search path `before`, or missed there, and that `now` would find elsewhere.

    None if there is none. `executed` are files and the links to them; those that were executed by their whole path are not
    searched for. If `before` is unknown, every file that either path could have found counts as found elsewhere, unless `now`
    finds just this file.
    """
    if before == now:
        return None
    for path in executed:
        name = os.path.basename(path)  # noqa: PTH119 - for speed
        if (before is None or _is(path, shutil.which(name, path=before))) and not _is(path, shutil.which(name, path=now)):
            return path
    folders = set((before or "").split(os.pathsep))
    for path in missed:
        folder, name = os.path.split(path)
        if folder in folders and shutil.which(name, path=before) is None and (found := shutil.which(name, path=now)):
            return found
    return None


def _is(path: str, found: str | None) -> bool:
    return found is not None and os.path.realpath(found) == os.path.realpath(path)
