"""Which paths of a project count as its source: all, or those that are named; without those that never do."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence

from sierra.errors import ConfigError
from sierra.util.text import few


class PathSelection:
    """Says of a path, from the project's root, whether it counts."""

    def __init__(self, only: Iterable[str] = (), without: Iterable[str] = ()) -> None:
        self.only = tuple(path for path in map(inside, only) if path != b".")
        self._without = tuple(map(inside, without))
        self._never = _below(self._without)
        self._kept = _below(self.only)

    def never(self, path: bytes) -> bool:
        """Whether a file, or all of a folder, is left out."""
        return bool(self._without) and self._never.match(path) is not None

    def __call__(self, path: bytes) -> bool:
        return not self.never(path) and (not self.only or self._kept.match(path) is not None)

    def others(self, paths: Iterable[bytes]) -> list[bytes]:
        """Those that do not count."""
        never, kept = self._never.match, self._kept.match
        if self.only:
            return [path for path in paths if not kept(path) or (self._without and never(path))]
        return [path for path in paths if never(path)] if self._without else []

    def pathspecs(self) -> list[str]:
        """What git is told to look at, relative to the project; a name may begin with a colon, or hold a star."""
        chosen = [f":(literal){os.fsdecode(path)}" for path in self.only] or ["."]
        patterns = ["\\" + re.sub(r"(?<!^)[\\*?\[]", r"\\\g<0>", os.fsdecode(path)) for path in self._without]
        return [*chosen, *(f":(exclude,glob){pattern}{below}" for pattern in patterns for below in ("", "/**"))]


def inside(path: str) -> bytes:
    """A path as it stands in a list of files."""
    return os.fsencode(os.path.normpath(path))


def check_size(path: bytes, size: int, large: int, way_out: str) -> None:
    """Raise ConfigError for a file that is too large to be kept without being asked."""
    if size > large:
        raise ConfigError(
            f"{shown([path])} has {_bytes(size)}, more than the {_bytes(large)} of [source] large; "
            f"{way_out}, name what counts in [source] paths, or raise [source] large"
        )


def shown(paths: Sequence[bytes], most: int = 3) -> str:
    """The first paths, and how many more there are, in one line."""
    names = (path.decode("utf-8", "replace") for path in paths)
    return few([name if name.isprintable() else ascii(name) for name in names], most)


def _bytes(size: float) -> str:
    for unit in ("bytes", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"


def _below(paths: Sequence[bytes]) -> re.Pattern[bytes]:
    """What matches a path that is one of these or lies below one."""
    return re.compile(b"(?:%s)(?:/|\\Z)" % b"|".join(map(re.escape, paths)))
