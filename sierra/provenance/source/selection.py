"""The selection of paths that belong to a project's source: all or the named ones, minus the excluded ones."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence

from sierra.errors import ConfigError
from sierra.provenance.source.prose import is_prose
from sierra.util.text import few


class PathSelection:
    """A predicate on paths relative to the project's root: True for paths that belong to the source."""

    def __init__(self, only: Iterable[str] = (), without: Iterable[str] = (), *, prose: bool = True) -> None:
        """`prose`: files that describe the project belong to the source too (see `sierra.provenance.source.prose`)."""
        self._prose = prose
        self.only = tuple(path for path in map(inside, only) if path != b".")
        self._without = tuple(map(inside, without))
        self._never = _below(self._without)
        self._kept = _below(self.only)

    def never(self, path: bytes) -> bool:
        """Return True if a file, or a folder with all its content, is excluded."""
        return (bool(self._without) and self._never.match(path) is not None) or (not self._prose and is_prose(path))

    def __call__(self, path: bytes) -> bool:
        return not self.never(path) and (not self.only or self._kept.match(path) is not None)

    def others(self, paths: Iterable[bytes]) -> list[bytes]:
        """Return the paths that do not belong to the source."""
        kept = self._kept.match
        if self.only:
            return [path for path in paths if not kept(path) or self.never(path)]
        return [path for path in paths if self.never(path)] if self._without or not self._prose else []

    def pathspecs(self) -> list[str]:
        """Return pathspecs for git, relative to the project; a name may begin with a colon or contain a star."""
        chosen = [f":(literal){os.fsdecode(path)}" for path in self.only] or ["."]
        patterns = ["\\" + re.sub(r"(?<!^)[\\*?\[]", r"\\\g<0>", os.fsdecode(path)) for path in self._without]
        return [*chosen, *(f":(exclude,glob){pattern}{below}" for pattern in patterns for below in ("", "/**"))]


def inside(path: str) -> bytes:
    """Return a path in the form that a manifest uses."""
    return os.fsencode(os.path.normpath(path))


def check_size(path: bytes, size: int, large: int, way_out: str) -> None:
    """Raise ConfigError for a file that is too large to be stored without the user's consent."""
    if size > large:
        raise ConfigError(
            f"{shown([path])} has {_bytes(size)}, more than the {_bytes(large)} of [source] max_untracked; "
            f"{way_out}, list the code in [source] paths, or raise [source] max_untracked"
        )


def shown(paths: Sequence[bytes], most: int = 3) -> str:
    """Return the first paths, and how many more there are, in one line."""
    names = (path.decode("utf-8", "replace") for path in paths)
    return few([name if name.isprintable() else ascii(name) for name in names], most)


def _bytes(size: float) -> str:
    for unit in ("bytes", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"


def _below(paths: Sequence[bytes]) -> re.Pattern[bytes]:
    """Return a pattern that matches these paths and everything below them."""
    return re.compile(b"(?:%s)(?:/|\\Z)" % b"|".join(map(re.escape, paths)))
