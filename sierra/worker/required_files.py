"""The files and distributions that a node must have as the submitting host has them."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from typing import TYPE_CHECKING, TypedDict

from sierra.worker.errors import CannotContinue
from sierra.worker.outputs import hashed

if TYPE_CHECKING:
    from typing import NotRequired


class Need(TypedDict):
    """A file that must be the same as on the submitting host."""

    name: str
    path: str
    sha256: str
    """Empty: the file only has to exist. For a link, it is the hash of its own target path, not of the target's content."""
    search: NotRequired[str]
    """The PATH on which runs find the program `name`; empty: they use `path`."""
    link: NotRequired[bool]
    holds: NotRequired[list[str] | None]
    """If given, the folders in `path` (as in a PATH) must have exactly these distributions: see `installed`."""


class Needs:
    """The files that must be, and stay, the same as on the submitting host."""

    def __init__(self, needs: list[Need]) -> None:
        """Find the files. Raises CannotContinue if the distributions of a Python differ from those on the submitting host."""
        self._files: list[Need] = []
        for need in needs:
            holds = need.get("holds")
            if holds is None:
                self._files.append({**need, "path": path_of(need)})
            else:
                check_installed(need["name"], set(holds), set(installed(need["path"])))
        self._identities: dict[str, tuple[int, ...]] = {}

    def check(self) -> None:
        """Raise CannotContinue if a file differs. A file that seems unchanged since the last check is not read again."""
        for need in self._files:
            try:
                status = os.stat(need["path"], follow_symlinks=not need.get("link"))
                identity = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
                if self._identities.get(need["path"]) != identity and need["sha256"] not in ("", hash_of(need)):
                    raise CannotContinue("%s: %s differs from the one on the submitting host" % (need["name"], need["path"]))
            except OSError as error:
                raise CannotContinue("%s: %s: %s" % (need["name"], need["path"], error.strerror)) from error
            self._identities[need["path"]] = identity


def installed(folders: str) -> tuple[str, ...]:
    """Return the distributions in folders (as in a PATH), as the paths of their metadata, which contain name and version."""
    paths = []
    for folder in folders.split(os.pathsep):
        with contextlib.suppress(OSError):
            names = (name for name in os.listdir(folder) if name.endswith((".dist-info", ".egg-info")))
            paths += [os.path.join(folder, name) for name in names]
    return tuple(sorted(paths))


def check_installed(name: str, expected: set[str], actual: set[str]) -> None:
    """Raise CannotContinue if the distributions here differ from those on the submitting host."""
    differences = ["%s is missing here" % path for path in sorted(expected - actual)]
    differences += ["%s is only here" % path for path in sorted(actual - expected)]
    if differences:
        more = " and %d more" % (len(differences) - 3) if len(differences) > 3 else ""
        shown = ", ".join(differences[:3])
        raise CannotContinue("%s differ from those on the submitting host: %s%s" % (name, shown, more))


def path_of(need: Need) -> str:
    """Return the path of a file; for a program that runs call by name, the path found here."""
    path = shutil.which(need["name"], path=need["search"]) if need.get("search") else None
    return path or need["path"]


def hash_of(need: Need) -> str:
    """Return the SHA-256 of a file's content, or of a link's target path."""
    if need.get("link"):
        return hashlib.sha256(os.fsencode(os.readlink(need["path"]))).hexdigest()
    return hashed(need["path"])[1]
