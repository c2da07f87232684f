"""Programs and shared libraries that would now be found elsewhere than an observed execution found them.

Programs are found by the search path (PATH), libraries by the loader's cache (/etc/ld.so.cache). The cache changes whenever any
library is installed, so its content says nothing. What counts is where it finds each library.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping

from sierra.util import bounded_program
from sierra.util.lazy_definitions import regex

CACHE = "/etc/ld.so.cache"
LINE = regex(r"\s*(\S+) \((.*)\) => (.*)")
LIMIT_S = 30


class LoaderCache:
    """The libraries that the loader's cache finds now; it is read when it is needed first."""

    def __init__(self) -> None:
        self._known: dict[str, dict[str, str]] | None = None
        """Paths by name and architecture."""
        self._unknown = False
        self._folders: set[str] = set()

    def found_elsewhere(self, used: Iterable[str]) -> str | None:
        """Return a used library in a folder of the cache that the cache would now find in another file; None if none.

        If the cache cannot be read, it could be any: return the cache itself.
        """
        known = self._read()
        if self._unknown:
            return CACHE
        for path in used:
            folder, name = os.path.split(path)
            if folder not in self._folders or name not in known:
                continue
            if os.path.realpath(path) not in map(os.path.realpath, known[name].values()):
                return path
        return None

    def _read(self) -> Mapping[str, Mapping[str, str]]:
        if self._known is None:
            self._known = {}
            cached = _cached()
            self._unknown = cached is None
            for name, architecture, path in cached or ():
                self._known.setdefault(name, {}).setdefault(architecture, path)
                self._folders.add(os.path.dirname(path))  # noqa: PTH120 - for speed
        return self._known


def _cached() -> list[tuple[str, str, str]] | None:
    """Return the entries of the loader's cache, in its order: name, architecture, path. The first of several is found.

    None if there is a cache that cannot be read.
    """
    if not os.path.exists(CACHE):  # noqa: PTH110 - for speed
        return []
    program = shutil.which("ldconfig", path=f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin")
    try:
        done = bounded_program.execute([program, "-p"], cwd="/", wall=LIMIT_S) if program else None
    except OSError:
        return None
    if done is None or done.status != 0:
        return None
    return [(match[1], match[2], match[3]) for match in map(LINE.fullmatch, os.fsdecode(done.output).splitlines()) if match]


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
        if folder in folders and shutil.which(name, path=before) is None and (path_now := shutil.which(name, path=now)):
            return path_now
    return None


def _is(path: str, found: str | None) -> bool:
    return found is not None and os.path.realpath(found) == os.path.realpath(path)
