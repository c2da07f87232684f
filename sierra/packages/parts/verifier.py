"""The part `reproduce.py` of a package: the program that verifies it where SIERRA is not installed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from sierra.packages.layout import PROGRAM
from sierra.packages.subject import Member, PartResult, Subject
from sierra.util.hashing import sha256_file
from sierra.worker import reproduce


def is_ours(digest: str | None) -> bool:
    """Return whether a file with this SHA-256 is the program of this version of SIERRA."""
    return digest == sha256_file(Path(reproduce.__file__))


def members(subject: Subject, found: Mapping[str, Member]) -> PartResult:
    """Return the program, which is the same in all packages of a version."""
    return PartResult([Member(PROGRAM, Path(reproduce.__file__), "program that verifies the package; it needs only Python")])
