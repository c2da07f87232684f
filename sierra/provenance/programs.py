"""Programs outside the source and outside an image, by fingerprint: a run is only reused where they are the same.

The fingerprint of a program is the SHA-256 of its file. For a Python interpreter, the distributions installed
beside it count too, by name and version. (What an interpreter imports from elsewhere, and the libraries that a
program loads, do not yet count.)
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sierra.errors import Missing
from sierra.hashing import digest, sha256, sha256_file


@dataclass(frozen=True, slots=True)
class Program:
    """A program as a command calls it, where it was found, and what it is."""

    name: str
    path: str
    sha256: str


@dataclass(frozen=True, slots=True)
class Programs:
    """All programs of one command; `id` is the same wherever the same programs lie."""

    all: tuple[Program, ...]

    @property
    def id(self) -> str:
        return digest("programs", {"programs": [[Path(p.name).name, p.sha256] for p in self.all]})

    def rows(self) -> list[dict[str, Any]]:
        return [{"programs": self.id, "name": p.name, "path": p.path, "sha256": p.sha256} for p in self.all]


def find(argv: Sequence[str], search: str, root: Path) -> Programs:
    """The programs that a command starts; `search` is the PATH of its runs.

    Raises Missing where the first word is no program.
    """
    first = shutil.which(argv[0], path=search)
    if first is None:
        raise Missing(f"the program {argv[0]!r} is not there; install it, or mend the command in {root / 'sierra.toml'}")
    return Programs(tuple(_programs(argv[0], first, argv[1:])))


def _programs(name: str, first: str, words: Iterable[str]) -> Iterator[Program]:
    yield Program(name, first, _fingerprint(first))
    if Path(name).name.startswith("python"):
        for folder in _site_packages(Path(first)):
            yield Program(f"{name}: installed distributions", str(folder), _distributions(folder))
    for word in words:
        if Path(word).is_absolute() and os.access(word, os.X_OK) and Path(word).is_file():
            yield Program(word, word, _fingerprint(word))


def _fingerprint(path: str) -> str:
    try:
        return sha256_file(Path(path))
    except OSError as error:
        raise Missing(f"the program {path} cannot be read: {error.strerror}") from error


def _site_packages(interpreter: Path) -> list[Path]:
    return sorted(interpreter.parent.parent.glob("lib/python3*/site-packages"))


def _distributions(folder: Path) -> str:
    names = sorted(entry.name for entry in os.scandir(folder) if entry.name.endswith((".dist-info", ".egg-info")))
    return sha256("\n".join(names).encode())
