"""Files and programs outside source and image that results depend on: programs, libraries, installed distributions, files."""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence, Set
from enum import StrEnum
from pathlib import Path

from sierra.model import IN_PROJECT
from sierra.store.row_types import ProgramRow
from sierra.util.hashing import digest
from sierra.util.lazy_definitions import dataclass, regex

INSTALLED = ": installed distributions"
"""Suffix of the name for all distributions of a Python; the path of that entry is a list of folders, as in PATH."""


class Kind(StrEnum):
    """The kind of a program."""

    PROGRAM = "program"
    LIBRARY = "library"
    DISTRIBUTIONS = "distributions"
    """The distributions that a Python interpreter has installed, or one distribution that is identified by content."""
    FILE = "file"
    LINK = "link"
    """A symbolic link; its hash is that of the path that it contains."""


RENAMED = frozenset((Kind.PROGRAM, Kind.DISTRIBUTIONS))
"""Kinds that may have another name without a difference, as a Python and its distributions; those of others are their roles."""
Role = tuple[Kind, str, str]
"""The kind, the name as in `roles`, and the SHA-256."""
Identified = tuple[str, str | None, str | None]
"""The name, the path and the SHA-256 of a program."""


@dataclass(frozen=True, slots=True)
class Program:
    """A program: its name in a command, its path, its hash and its kind."""

    name: str
    path: str
    sha256: str
    kind: Kind = Kind.PROGRAM
    version: str | None = None
    """The version that the program reports; for distributions, one line for each. It is not part of the fingerprint."""

    @property
    def called(self) -> str:
        """The name without its location."""
        return called(self.name)

    @property
    def identified(self) -> Identified:
        return self.name, self.path, self.sha256


@dataclass(frozen=True, slots=True)
class Programs:
    """All programs that are used together; `id` does not depend on their locations."""

    all: tuple[Program, ...]
    notes: tuple[str, ...] = ()
    """Messages about facts that could not be determined."""

    @property
    def id(self) -> str:
        return fingerprint(program.identified for program in self.all)

    def unlike(self, others: Programs) -> list[str]:
        """Return the names of programs that differ between the two, or that only one of them has.

        A program that has only another name is left out; the name of a file or a library is its role.
        """
        role = roles(*([one.identified for one in side.all] for side in (self, others)))
        mine, theirs = ({(one.kind, role[one.identified], one.sha256) for one in side.all} for side in (self, others))
        lost, come = mine - theirs, theirs - mine
        renamed = _without_shared_names(lost, come) & _without_shared_names(come, lost)
        return sorted({name for kind, name, sha256 in lost | come if (kind, sha256) not in renamed})

    def rows(self) -> list[ProgramRow]:
        identity = self.id
        return [ProgramRow(identity, one.name, one.kind, one.version, one.path, one.sha256) for one in self.all]


def _without_shared_names(some: Set[Role], others: Set[Role]) -> set[tuple[str, str]]:
    """Return the kind and content of programs whose names none of the others has: contents that change places differ."""
    names = {name for _, name, _ in others}
    return {(kind, sha256) for kind, name, sha256 in some if kind in RENAMED and name not in names}


NOTHING = Programs(())


def fingerprint(programs: Iterable[Identified]) -> str:
    """Return the hash of names and SHA-256, independent of order, and of location unless names are ambiguous (see `roles`)."""
    role = roles(list(programs))
    return _fingerprint((name, sha256) for (_, _, sha256), name in role.items())


def fingerprint_by_name(programs: Iterable[Identified]) -> str:
    """Return the fingerprint of earlier versions, which did not tell programs of the same name apart."""
    return _fingerprint((called(name), sha256) for name, _, sha256 in programs)


def _fingerprint(programs: Iterable[tuple[str, str | None]]) -> str:
    return digest("programs", {"programs": sorted(set(programs))})


def roles(*sets: Collection[Identified]) -> dict[Identified, str]:
    """Return the name under which each program is compared: the name without its location.

    If a set has several contents of that name, it is the full name; if several have that too (libraries that two programs load
    under one name), the path comes before it.
    """
    names = _ambiguous(sets, lambda program: called(program[0]))
    full = _ambiguous(sets, lambda program: program[0])

    def role(program: Identified) -> str:
        name, path, _ = program
        if called(name) not in names:
            return called(name)
        return f"{path}: {name}" if name in full else name

    return {each: role(each) for programs in sets for each in programs}


def _ambiguous(sets: Iterable[Iterable[Identified]], named: Callable[[Identified], str]) -> set[str]:
    """Return the names that several contents of one set have."""
    found = ({(named(one), one[2]) for one in programs} for programs in sets)
    counted = [Counter(name for name, _ in pairs) for pairs in found]
    return {name for counts in counted for name, count in counts.items() if count > 1}


def versions(listed: str | None) -> dict[str, str]:
    """Return the versions by name from a list of distributions, which has a line `name==version` for each."""
    pairs = (line.partition("==")[::2] for line in (listed or "").splitlines())
    return {normalized(name): version for name, version in pairs}


def normalized(name: str) -> str:
    """Return the name of a distribution as it is compared: `JSBSim` and `jsbsim` are one (see PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def called(name: str) -> str:
    """Return a program's name without its location: the last part of its path, or the placeholder form of a project path."""
    return name if "{" in name else Path(name).name


TOOLS = frozenset(
    (
        *("apt", "base", "build", "ca", "certifi", "coverage", "debconf", "dpkg", "hatchling", "iniconfig", "mypy", "pip"),
        *("pluggy", "pygments", "pytest", "ruff", "setuptools", "tzdata", "uv", "virtualenv", "wheel"),
    )
)
"""First words of the names of packages that hardly any result depends on."""
EVERYWHERE = frozenset(("python", "python3", "project", "input", "output", "seed", "run"))
"""Words of commands that do not name a particular package."""
IMPORT = regex(r"^\s*(?:import|from)\s+(\w+)", re.MULTILINE)
MAX_SEARCHED = 1 << 20
"""Maximum number of bytes of a script that are searched for imports."""


def mentioned(command: Iterable[str], root: Path) -> frozenset[str]:
    """Return the words of a command, and the imports of the scripts in the folder `root` that the command names."""
    words: set[str] = set()
    for word in command:
        words |= set(re.findall(r"[a-z][a-z0-9_]{2,}", word.lower().replace("-", "_")))
        with contextlib.suppress(OSError, ValueError), (root / word.removeprefix(IN_PROJECT)).open("rb") as script:
            if word.endswith(".py"):
                words |= {name.lower() for name in IMPORT.findall(script.read(MAX_SEARCHED).decode("utf-8", "replace"))}
    return frozenset(words) - EVERYWHERE


def by_likelihood(names: Iterable[str], words: frozenset[str] = frozenset(), used: Sequence[str] = ()) -> list[str]:
    """Return packages ordered by how likely results depend on them: those named in `words` first, tools last.

    Those that executions were observed to use (`used`) come before the rest, in their order.
    """
    ranks = {name: rank for rank, name in enumerate(used)}

    def weight(name: str) -> tuple[bool, int, bool, str]:
        plain = name.lower().replace("-", "_")
        begin = plain.partition("_")[0]
        return not {plain, begin} & words, ranks.get(name, len(ranks)), begin in TOOLS, name

    return sorted(names, key=weight)
