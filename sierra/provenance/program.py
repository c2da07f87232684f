"""One thing outside source and image that results depend on: a program, a library, installed distributions, a file."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from sierra.util.hashing import digest

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


TOOLS = frozenset(
    (
        *("apt", "base", "build", "ca", "certifi", "coverage", "debconf", "dpkg", "hatchling", "iniconfig", "mypy", "pip"),
        *("pluggy", "pygments", "pytest", "ruff", "setuptools", "tzdata", "uv", "virtualenv", "wheel"),
    )
)
"""How the names of packages begin that hardly any result depends on."""
EVERYWHERE = frozenset(("python", "python3", "project", "input", "output", "seed", "run"))
"""Words of commands that name no package in particular."""
IMPORT = re.compile(r"^\s*(?:import|from)\s+(\w+)", re.MULTILINE)
READABLE = 1 << 20
"""Bytes of a script in which imports are looked for."""


def mentioned(command: Iterable[str], root: Path) -> frozenset[str]:
    """Return the words of a command, and what those scripts import that it names and that are in the folder `root`."""
    words: set[str] = set()
    for word in command:
        words |= set(re.findall(r"[a-z][a-z0-9_]{2,}", word.lower().replace("-", "_")))
        with contextlib.suppress(OSError, ValueError), (root / word.removeprefix("{project}/")).open("rb") as script:
            if word.endswith(".py"):
                words |= {name.lower() for name in IMPORT.findall(script.read(READABLE).decode("utf-8", "replace"))}
    return frozenset(words) - EVERYWHERE


def by_likelihood(names: Iterable[str], words: frozenset[str] = frozenset()) -> list[str]:
    """Return packages in the order in which results are likely to depend on them: what `words` name first, tools last."""

    def weight(name: str) -> tuple[bool, bool, str]:
        plain = name.lower().replace("-", "_")
        begin = plain.partition("_")[0]
        return not {plain, begin} & words, begin in TOOLS, name

    return sorted(names, key=weight)
