"""The products of a build: the files below the project's root that the patterns of `[build] produces` match."""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from sierra.errors import ConfigError
from sierra.store.layout import STORE
from sierra.util.hashing import merkle, sha256_file
from sierra.util.lazy_definitions import dataclass
from sierra.util.processors import ARCH

NEVER = frozenset((".git", STORE))
"""Folders that no pattern reaches."""


@dataclass(frozen=True, slots=True)
class Product:
    """A product: its path in the project, its size in bytes, and its hash."""

    name: str
    size: int
    sha256: str


def names(root: Path, patterns: Iterable[str]) -> list[str]:
    """Return the names of the files that the patterns match, sorted. Raises ConfigError for a name that is not UTF-8."""
    found = {path.relative_to(root) for pattern in patterns for path in _matched(root, pattern)}
    listed = sorted(path.as_posix() for path in found if NEVER.isdisjoint(path.parts))
    for name in listed:
        if not _is_text(name):
            raise ConfigError(f"[build] produces: the name of the file {name!a} is not UTF-8; rename the file")
    return listed


def matches(name: str, pattern: str) -> bool:
    """Check whether a pattern matches the name of a file, which need not exist. `{arch}` in the pattern is any processor."""
    return _match(PurePosixPath(name).parts, PurePosixPath(pattern.replace(ARCH, "*")).parts)


def _match(parts: Sequence[str], pattern: Sequence[str]) -> bool:
    if not pattern:
        return not parts
    if pattern[0] == "**":
        return any(_match(parts[begin:], pattern[1:]) for begin in range(len(parts) + 1))
    return bool(parts) and fnmatch.fnmatchcase(parts[0], pattern[0]) and _match(parts[1:], pattern[1:])


def unmatched(root: Path, patterns: Iterable[str]) -> list[str]:
    """Return the patterns that match no file."""
    return [pattern for pattern in patterns if not names(root, [pattern])]


def hashed(root: Path, patterns: Iterable[str]) -> tuple[Product, ...]:
    """Return the products as they are on disk; every file is read, because its times are no evidence."""
    paths = ((name, root / name) for name in names(root, patterns))
    return tuple(Product(name, path.stat().st_size, sha256_file(path)) for name, path in paths)


def result(products: Iterable[Product]) -> str:
    """Return the Merkle hash of the names and digests of products."""
    return merkle("products", (f"{one.sha256} {one.name}" for one in products))


def in_source(found: Sequence[str], held: set[bytes]) -> list[str]:
    """Return the names that belong to the source."""
    return [name for name in found if os.fsencode(name) in held]


def _matched(root: Path, pattern: str) -> Iterable[Path]:
    return (path for path in root.glob(pattern) if path.is_file())


def _is_text(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True
