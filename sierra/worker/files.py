"""Files and folders that a run may have locked, replaced by links, or removed."""

from __future__ import annotations

import contextlib
import errno
import os
import stat

TYPE_CHECKING = False  # each run starts a conductor, and importing `typing` is a tenth of its time
if TYPE_CHECKING:
    from typing import Iterable, Iterator

HEAD_BYTES = 4096
CHUNK = 1 << 20


def folders_of(files: Iterable[str]) -> list[str]:
    """Return the folders that these files need, the outer ones first."""
    found: set[str] = set()
    for name in files:
        parts = name.split("/")[:-1]
        found.update("/".join(parts[: number + 1]) for number in range(len(parts)))
    return sorted(found)


def files_below(folder: str) -> Iterator[tuple[str, str]]:
    """Yield the path of each file below a folder, and its path relative to the folder."""
    for root, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(root, name)
            yield path, os.path.relpath(path, folder)


def end_of(path: str, most: int = HEAD_BYTES) -> bytes:
    """Return the last bytes of a file; empty if it cannot be read."""
    try:
        with open(path, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - most))
            return file.read()
    except OSError:
        return b""


def last_line_of(log: str, most: int = HEAD_BYTES) -> str:
    """Return the last line of a log, of at most so many bytes; empty if it has none."""
    lines = end_of(log, most).decode("utf-8", "replace").strip().splitlines()
    return lines[-1] if lines else ""


def is_full(place: str) -> bool:
    """Return whether a writable file system has no space left."""
    try:
        space = os.statvfs(place)
    except OSError:
        return False
    return not space.f_flag & os.ST_RDONLY and bool(space.f_blocks) and space.f_bavail == 0


def check_room(folder: str) -> None:
    """Raise OSError if a file system has no space or no inodes left."""
    space = os.statvfs(folder)
    if (space.f_blocks and space.f_bavail == 0) or (space.f_files and space.f_favail == 0):  # a ramfs reports neither
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), folder)


def entries_of(folder: str) -> set[str]:
    try:
        return set(os.listdir(folder))
    except OSError:  # there is no such folder
        return set()


def unlink(path: str) -> None:
    with contextlib.suppress(OSError):  # the caller checks whether it still exists
        os.unlink(path)


def is_folder(path: str) -> bool:
    """Return whether a path is itself a folder, and not a link to one."""
    return os.path.isdir(path) and not os.path.islink(path)


def unlock(path: str, rights: int) -> None:
    """Give the owner these permissions, so that files which a program has locked can be read and removed."""
    mode = stat.S_IMODE(os.lstat(path).st_mode)
    if mode & rights != rights:
        os.chmod(path, mode | rights)


def remove(folder: str) -> None:
    """Remove a folder (never the target of a link) with its contents, also read-only folders, as far as permitted."""
    import shutil  # which a conductor does not need

    if is_folder(folder):
        shutil.rmtree(folder, ignore_errors=True)
    if is_folder(folder):
        if os.lstat(folder).st_uid == os.geteuid():  # else another user owns it
            unlock(folder, 0o700)
        for root, names, _ in os.walk(folder):
            for path in [os.path.join(root, name) for name in names]:
                if is_folder(path):
                    unlock(path, 0o700)
        shutil.rmtree(folder, ignore_errors=True)


def size_of_file(path: str) -> int:
    try:
        return os.lstat(path).st_size
    except OSError:
        return 0


def size_of(folder: str) -> int:
    """Return the total size in bytes of all files below a folder, as far as they can be read."""
    return sum(size_of_file(os.path.join(root, name)) for root, _, names in os.walk(folder) for name in names)


def write_all(descriptor: int, data: bytes) -> None:
    """Write all data, even if a pipe accepts only a part at a time."""
    while data:
        data = data[os.write(descriptor, data) :]
