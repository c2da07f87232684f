"""Folders with short paths for the temporary files of runs, in the system's temporary folders."""

from __future__ import annotations

import contextlib
import os
import re
import threading
from typing import Callable, Iterator

from sierra.worker.files import CHUNK, check_room, entries_of, is_folder, remove, write_all

OWN_TMP = "\0/tmp"  # the TMPDIR of a run in a job
TEMPORARY = re.compile(r"sierra-[0-9a-f]{8}")  # names of workers' folders in the system's temporary folder
TEMPORARY_MARK = ".sierra-runs"  # in such a folder: its host, and the folder of its worker
TEMPORARY_LENGTH = 48
"""The longest path of a temporary folder in which there are folders for runs.

`/sierra-<8>/<number>/tmp` follows it, and after that there must be room for `/pymp-<8>/listener-<8>`, the sockets of Python's
multiprocessing: the path of a socket has at most 107 characters.
"""


class Temporary:
    """A worker's folder in the system's temporary folder, with a folder for the temporary files of each run.

    Its path is short, wherever the project is. Only its user can reach it. This process holds a lock on it, which also tells
    systemd-tmpfiles to leave it alone. What a killed worker left there is removed by the next one, by the command that records
    its runs, and by `sierra gc`.
    """

    def __init__(self, owner: str) -> None:
        """Prepare for the worker in the folder `owner`. Nothing is made yet."""
        self.owner = owner
        self.path: str | None = None
        self.held = -1
        self.places: dict[str, str] = {}
        """The folder of each run that has one, by the run's folder."""
        self.making = threading.Lock()

    def make(self, folder: str) -> str | None:
        """Make the folder of a run for its temporary files, and return its TMPDIR. None: it can have none that is short."""
        with self.making:
            if self.path is None or not is_folder(self.path):  # the second: somebody has removed it
                self.close()
                self.begin()
            if self.path is None:
                return None
            temporary = os.path.join(self.path, os.path.basename(folder))
        try:
            os.mkdir(temporary, 0o700)
            os.mkdir(os.path.join(temporary, "tmp"), 0o700)
        except OSError:
            remove(temporary)
            return None
        self.places[folder] = temporary
        return os.path.join(temporary, "tmp")

    def remove(self, folder: str) -> None:
        """Remove the temporary files of a run."""
        if folder in self.places:
            remove(self.places.pop(folder))

    def begin(self) -> None:
        """Make the worker's folder if that is possible, and remove those that killed workers have left."""
        import fcntl

        for root in temporary_folders():
            for path, _ in abandoned(root):
                remove(path)
            path = os.path.join(root, "sierra-" + os.urandom(4).hex())
            with contextlib.suppress(OSError):
                os.mkdir(path, 0o700)  # fails if there is anything with that name
                self.path = path
                self.held = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
                fcntl.flock(self.held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                mark = os.open(os.path.join(path, TEMPORARY_MARK), os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
                try:
                    write_all(mark, os.fsencode("%s\n%s" % (os.uname().nodename, self.owner)))
                finally:
                    os.close(mark)
                return
            self.close()

    def close(self) -> None:
        """Remove the folder with all that is in it."""
        if self.path is not None:
            remove(self.path)
        if self.held >= 0:
            os.close(self.held)
        self.path, self.held = None, -1


def temporary_folders() -> list[str]:
    """Return the system's temporary folders in which runs can have theirs, the best first; none without locks.

    They are those of Python's tempfile, and a cluster's. One in which no program can be executed comes last.
    """
    try:
        import fcntl  # noqa: F401
    except ImportError:
        return []
    named = [os.environ.get(name, "") for name in ("TMPDIR", "SLURM_TMPDIR", "TEMP", "TMP")]
    usable: dict[str, bool] = {}
    for path in (*named, "/tmp", "/var/tmp"):  # noqa: S108 - a folder of its own is made there
        if not (os.path.isabs(path) and len(os.fsencode(path)) <= TEMPORARY_LENGTH and os.access(path, os.W_OK | os.X_OK)):
            continue
        with contextlib.suppress(OSError):
            check_room(path)
            usable[os.path.normpath(path)] = bool(os.statvfs(path).f_flag & getattr(os, "ST_NOEXEC", 0))
    return sorted(usable, key=lambda path: usable[path])


def abandoned_by(is_wanted: Callable[[str], bool]) -> list[str]:
    """Return the folders in the system's temporary folders that killed workers have left, by the workers' own folders."""
    return [path for root in temporary_folders() for path, owner in abandoned(root) if is_wanted(owner)]


def abandoned(root: str) -> Iterator[tuple[str, str]]:
    """Yield the folders of killed workers of this user and host in a temporary folder, each with the folder of its worker."""
    import fcntl

    for name in sorted(filter(TEMPORARY.fullmatch, entries_of(root))):
        path = os.path.join(root, name)
        with contextlib.suppress(OSError):
            folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                if os.fstat(folder).st_uid != os.geteuid():
                    continue
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                mark = os.open(TEMPORARY_MARK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
                with open(mark, "rb") as file:
                    host, _, owner = os.fsdecode(file.read(CHUNK)).partition("\n")
            finally:
                os.close(folder)
            if host == os.uname().nodename and owner:
                yield path, owner


def check_temporary(path: str | None) -> None:
    """Raise OSError if the file system of a run's temporary files has no space left. None: they have no folder of their own."""
    if path is not None and is_folder(path):
        try:
            check_room(path)
        except OSError as error:
            cure = "%s for the temporary files of runs; set TMPDIR to a folder on a larger disk before sierra starts"
            raise OSError(error.errno, cure % error.strerror, path) from error
