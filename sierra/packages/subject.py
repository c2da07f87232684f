"""The subject of a package: the packed batches in a store of their own, from which all parts of the package are made."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import IO, Literal

from sierra.config.project_file import LoadedProject
from sierra.store.store import Store
from sierra.util.hashing import sha256, sha256_file
from sierra.util.lazy_definitions import dataclass
from sierra.util.regular_files import open_regular

ImageForm = Literal["oci", "sif", "both", "none"]


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of one package."""

    image: ImageForm = "none"
    """The forms in which container images are packed."""
    wheels: bool = False
    """True if wheels of SIERRA and of the project's Python packages are packed."""
    pythons: tuple[str, ...] = ()
    """Versions of Python for the wheels, as 3.12; default: this one."""
    machines: tuple[str, ...] = ()
    """Processors for the wheels, as x86_64; default: this one."""
    report: bool = True
    """False if the report is left out."""
    without: tuple[str, ...] = ()
    """Kinds of deliverables that are left out."""


@dataclass(frozen=True, slots=True)
class Subject:
    """The packed batches, and where they come from."""

    project: LoadedProject
    store: Store
    """A temporary store with these batches and nothing else. Parts before `sierra.packages.parts.stored` may add segments."""
    batches: tuple[str, ...]
    """Their ids, in the order in which they were requested."""
    folder: Path
    """A folder for temporary files."""
    date: str
    """The date of the package, in ISO 8601: that of `[package]`, else of the newest record."""
    options: Options = Options()
    redacted: bool = False
    """True in an anonymous package, whose `[package]` names no authors."""


@dataclass(frozen=True, slots=True)
class Member:
    """A file of a package. Its content is in a file, or is a few bytes."""

    name: str
    content: Path | bytes
    about: str
    """A sentence for people who read the list of files."""
    executable: bool = False

    def open(self) -> IO[bytes]:
        """Return a binary stream from the beginning of the content."""
        return io.BytesIO(self.content) if isinstance(self.content, bytes) else open_regular(self.content)

    @property
    def size(self) -> int:
        """The number of bytes."""
        return len(self.content) if isinstance(self.content, bytes) else self.content.stat().st_size

    def sha256(self) -> str:
        """Return the SHA-256 of the content."""
        return sha256(self.content) if isinstance(self.content, bytes) else sha256_file(self.content)


@dataclass(frozen=True, slots=True)
class PartResult:
    """The result of a part."""

    members: Iterable[Member]
    notes: tuple[str, ...] = ()
    """One line for each thing that is left out, which the user confirms."""
    facts: tuple[str, ...] = ()
    """Lines for the reader of the package, which need no confirmation."""
    problems: tuple[str, ...] = ()
    """One line for each reason why the package must not be written."""


Part = Callable[[Subject, Mapping[str, Member]], PartResult]
"""A part of a package: a function of the subject and the members of all parts before it."""
