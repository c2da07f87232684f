"""Files that lie beside the inputs of all runs of a session: copies, or hard links to large files."""

from __future__ import annotations

import functools
import os
import stat

from sierra.worker.files import CHUNK, files_below, folders_of, write_all

BESIDE_NS = 946684800 * 10**9  # the modification time of files beside inputs: 2000-01-01, the same for all runs
LINKED = 4 << 20  # a file beside inputs that has as many bytes may be a hard link
FICLONE = 0x40049409


class SharedFiles:
    """The files of a folder that the runs of a session share. The folder is listed once, because nothing changes it."""

    def __init__(self, source: str) -> None:
        statuses = [(path, name, os.stat(path)) for path, name in files_below(source)]
        self.files = [(path, name, 0o755 if status.st_mode & stat.S_IXUSR else 0o644) for path, name, status in statuses]
        self.names = [name for _, name, _ in self.files]
        self.folders = folders_of(self.names)
        self.large = {name: (path, status.st_size) for path, name, status in statuses if status.st_size >= LINKED}
        """The files that may be hard links, with their sizes."""
        self.clones = True
        """True if the file system may make files that share their data."""

    def place(self, folder: str) -> None:
        """Copy the files to a run's folder.

        A large file shares its data with the copy if the file system copies on write. Otherwise it is a hard link, which only
        its owner could make writable, and `changed` would find that. For root, whom no permission stops, it is a copy.
        """
        for name in self.folders:
            os.makedirs(os.path.join(folder, name), exist_ok=True)
        for path, name, mode in self.files:
            target = os.path.join(folder, name)
            with open(path, "rb", buffering=0) as original, open(target, "xb", buffering=0) as copy:
                if not (self.clones and cloned(copy.fileno(), original.fileno())):
                    self.clones = False
                    if name in self.large and os.geteuid() != 0 and relinked(path, target):
                        continue
                    for chunk in iter(lambda: original.read(CHUNK), b""):
                        write_all(copy.fileno(), chunk)
                os.fchmod(copy.fileno(), mode)
            os.utime(target, ns=(BESIDE_NS, BESIDE_NS))

    def changed(self) -> str | None:
        """Return why runs that share large files cannot be trusted: a run has changed one; None if none has."""
        for name, (path, size) in self.large.items():
            try:
                status = os.stat(path)
            except OSError:
                return "a run has removed %s, which all runs share" % name
            if (status.st_size, status.st_mtime_ns, status.st_mode & 0o222) != (size, BESIDE_NS, 0):
                return "a run has changed %s, which all runs share" % name
        return None


@functools.lru_cache(maxsize=None)
def shared_files(source: str) -> SharedFiles:
    """Return the files of a folder that runs share. It is read once."""
    return SharedFiles(source)


def cloned(copy: int, original: int) -> bool:
    """Return whether the file system has made a file share the data of another one, copied on write."""
    try:
        import fcntl

        fcntl.ioctl(copy, FICLONE, original)
    except (ImportError, OSError):
        return False
    return True


def relinked(path: str, target: str) -> bool:
    """Return whether an empty file was replaced by a hard link."""
    try:
        os.link(path, target + ".link")
        os.replace(target + ".link", target)
    except OSError:
        return False
    return True
