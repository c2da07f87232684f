"""The allocation that a scheduler gives to a task on its node, and the folder there for the runs of an attempt.

Also: the files and distributions that a node must have as the submitting host has them.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import re
import shutil
import stat
import tempfile
from functools import reduce
from typing import TYPE_CHECKING, Iterator, Mapping, TypedDict

from sierra.worker.devices import DEVICES
from sierra.worker.errors import CannotContinue
from sierra.worker.files import remove
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
    """The distributions that the folders in `path` (as in a PATH) must have, no others: see `installed`."""


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


VARIABLE = re.compile(r"\{(\w+)\}")


class Allocation:
    """The resources that a scheduler gives to a task, as its variables say."""

    def __init__(self, forms: dict[str, list[str]], environment: Mapping[str, str]) -> None:
        """`forms` name the variables: see `sierra.runners.schedulers.base.NodeVariables`."""
        self._forms = forms
        self._environment = environment

    def texts(self, about: str) -> Iterator[str]:
        """Yield the forms about something of which all variables are set, with their values."""
        for form in self._forms.get(about, ()):
            if all(self._environment.get(name) for name in VARIABLE.findall(form)):
                yield VARIABLE.sub(lambda match: self._environment[match[1]], form)

    def text(self, about: str) -> str:
        """Return the first of these texts, or nothing."""
        return next(self.texts(about), "")

    def number(self, about: str) -> int | None:
        """Return the first of these texts that is a whole number, or a product of whole numbers, as in `2000*4`."""
        for text in self.texts(about):
            factors = text.split("*")
            if all(factor.isdigit() for factor in factors):
                return reduce(int.__mul__, map(int, factors))
        return None

    @property
    def memory(self) -> int | None:
        """Return the bytes of memory; None if the scheduler does not tell."""
        return (self.number("memory_mib") or 0) << 20 or None

    @property
    def variables(self) -> dict[str, str]:
        """Return all variables that are about the allocation."""
        names = [name for forms in self._forms.values() for form in forms for name in VARIABLE.findall(form)]
        return {name: self._environment[name] for name in (*names, *DEVICES) if name in self._environment}


@contextlib.contextmanager
def scratch(session: str, wanted: str | None, given: Allocation) -> Iterator[tuple[str, int]]:
    """Yield a folder on the node for this attempt, and a lock that shows to other attempts that this one is alive.

    The worker holds the lock too, because it may outlive this process by the grace time of its runs.
    """
    root = scratch_root(wanted, given)
    prefix = "sierra-%s-" % session
    for name in os.listdir(root):
        if name.startswith(prefix):
            with contextlib.suppress(OSError):
                remove_dead(os.path.join(root, name))
    folder = tempfile.mkdtemp(prefix=prefix, dir=root)
    lock = os.open(os.path.join(folder, "owner"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        with contextlib.suppress(OSError):  # a file system without locks: no attempt ever considers the folder abandoned
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.write(lock, os.uname().nodename.encode())
        yield folder, lock
    finally:
        remove_own(folder)
        os.close(lock)


def scratch_root(wanted: str | None, given: Allocation) -> str:
    if wanted is None:
        named = [*given.texts("scratch"), os.environ.get("TMPDIR"), "/tmp"]  # noqa: S108 - the last resort
        writable = [path for path in named if path and os.path.isdir(path) and os.access(path, os.W_OK | os.X_OK)]
        if not writable:
            raise CannotContinue("no folder for runs: the node's own folder, $TMPDIR and /tmp cannot be written into")
        return os.path.abspath(writable[0])
    filled = re.sub(r"\$(?:\{(\w+)\}|(\w+))", lambda match: value_of(match[1] or match[2], wanted), wanted)
    folder = os.path.abspath(filled)
    if not os.path.isdir(os.path.dirname(folder) if os.path.dirname(folder) != "/" else folder):
        raise CannotContinue("scratch = %s: its parent folder does not exist; use one that exists" % wanted)
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise CannotContinue("scratch = %s: %s: %s" % (wanted, folder, error.strerror)) from error
    return folder


def value_of(name: str, wanted: str) -> str:
    if not os.environ.get(name):
        raise CannotContinue("scratch = %s: the variable $%s is not set" % (wanted, name))
    return os.environ[name]


def remove_dead(folder: str) -> None:
    """Remove the folder of an attempt that died on this host: locks of other hosts may not be seen here."""
    status = os.lstat(folder)
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
        return
    lock = os.open(os.path.join(folder, "owner"), os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.read(lock, 4096) == os.uname().nodename.encode():
            remove_own(folder)
    finally:
        os.close(lock)


def remove_own(folder: str) -> None:
    """Remove an attempt's folder, the file `owner` last. If this process is killed meanwhile, the next attempt continues."""
    with contextlib.suppress(OSError):
        for name in os.listdir(folder):
            remove(os.path.join(folder, name))
    remove(folder)
