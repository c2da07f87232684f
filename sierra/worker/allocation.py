"""The allocation that a scheduler gives to a task on its node, and the folder there for the runs of an attempt."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import stat
import tempfile
from functools import reduce
from typing import Iterator, Mapping

from sierra.worker.devices import DEVICES
from sierra.worker.errors import CannotContinue
from sierra.worker.files import remove

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
