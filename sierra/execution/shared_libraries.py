"""Shared libraries that the loader's cache (/etc/ld.so.cache) would now find elsewhere than an observed execution did.

The cache changes whenever any library is installed, so its content says nothing. What counts is where it finds each library.
"""

from __future__ import annotations

import functools
import os
import re
import shutil
import subprocess
from collections.abc import Collection, Iterable, Mapping

CACHE = "/etc/ld.so.cache"
LINE = re.compile(r"\s*(\S+) \((.*)\) => (.*)")
LIMIT_S = 30


def found_elsewhere(used: Iterable[str]) -> str | None:
    """Return a used library in a folder of the loader's cache that the cache would now find in another file; None if none."""
    try:
        known = _known(os.stat(CACHE).st_mtime_ns)  # noqa: PTH116 - for speed
    except FileNotFoundError:
        return None
    folders = {os.path.dirname(path) for paths in known.values() for path in paths}  # noqa: PTH120 - for speed
    for path in used:
        folder, name = os.path.split(path)
        if folder in folders and name in known and os.path.realpath(path) not in map(os.path.realpath, known[name]):
            return path
    return None


@functools.lru_cache(maxsize=1)
def _known(changed: int) -> Mapping[str, Collection[str]]:
    """Return where the loader's cache, which was last `changed` then, finds each library: a path for each architecture."""
    program = shutil.which("ldconfig", path=f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin")
    if program is None:
        return {}
    done = subprocess.run([program, "-p"], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    found: dict[str, dict[str, str]] = {}
    for match in map(LINE.fullmatch, done.stdout.splitlines()):
        if match:
            found.setdefault(match[1], {}).setdefault(match[2], match[3])
    return {name: paths.values() for name, paths in found.items()}
