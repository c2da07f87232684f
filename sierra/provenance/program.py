"""One thing outside source and image that results depend on: a program, a library, installed distributions, a file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from sierra.hashing import digest

INSTALLED = ": installed distributions"
"""How the name ends of all that a Python has installed, whose path is folders, as in a PATH."""


class Kind(StrEnum):
    """What it is."""

    PROGRAM = "program"
    LIBRARY = "library"
    DISTRIBUTIONS = "distributions"
    """What a Python interpreter has installed, or one distribution whose content counts."""
    FILE = "file"
    LINK = "link"
    """Its hash is that of the path that it says."""


@dataclass(frozen=True, slots=True)
class Program:
    """A program as a command calls it, where it was found, and what it is."""

    name: str
    path: str
    sha256: str
    kind: Kind = Kind.PROGRAM
    version: str | None = None
    """What it says of itself; of distributions, a line for each. It is recorded, and no part of the fingerprint."""

    @property
    def called(self) -> str:
        """Its name wherever it lies."""
        return called(self.name)


@dataclass(frozen=True, slots=True)
class Programs:
    """All that was used together; `id` is the same wherever the same lies."""

    all: tuple[Program, ...]
    notes: tuple[str, ...] = ()
    """What could not be found out."""

    @property
    def id(self) -> str:
        return fingerprint((program.name, program.sha256) for program in self.all)

    def unlike(self, others: Programs) -> list[str]:
        """The names of those that are others there, or that only one side has."""
        mine, theirs = ({(called(one.name), one.sha256) for one in side.all} for side in (self, others))
        return sorted({name for name, _ in mine ^ theirs})

    def rows(self) -> list[dict[str, Any]]:
        fields = ("name", "kind", "version", "path", "sha256")
        identity = self.id
        return [{"programs": identity, **{name: getattr(program, name) for name in fields}} for program in self.all]


NOTHING = Programs(())


def fingerprint(programs: Iterable[tuple[str, str]]) -> str:
    """The hash of names and SHA-256, wherever the programs lie, and in whatever order."""
    return digest("programs", {"programs": sorted({(called(name), found) for name, found in programs})})


def versions(listed: str | None) -> dict[str, str]:
    """The versions in a list of distributions, a line `name==version` for each, by name."""
    return dict(line.partition("==")[::2] for line in (listed or "").splitlines())


def called(name: str) -> str:
    """What a program is called wherever it lies: its path's last part, or what stands for a path of the project."""
    return name if "{" in name else Path(name).name
