"""Files: names that must stay inside a folder, records that are read back, and files that are written whole."""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from sierra.errors import Damaged
from sierra.util.hashing import sha256, unsealed
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import read_regular


def inside(root: Path, name: str, *, link: bool = False) -> Path:
    """Return the path of a name from a record in the folder `root`. Every such name must pass this check before it is used.

    Raises Damaged for an empty name, a name with the character NUL, and a name that leads outside: an absolute path, a path
    with `..`, or a path through a symbolic link to somewhere else. `link`: the last part may be a link to any place, because
    the caller does not follow it.
    """
    parts = PurePosixPath(name).parts
    if not parts or "\0" in name or parts[0].startswith("/") or ".." in parts:
        raise Damaged(_outside(root, name))
    path = root.joinpath(*parts)
    target = path.parent if link else path
    try:
        end = target.resolve()
    except (OSError, RuntimeError) as error:  # a link to itself, before Python 3.13
        raise Damaged(_outside(root, name)) from error
    if not end.is_relative_to(root.resolve()) or _is_loop(target):
        raise Damaged(_outside(root, name))
    return path


def _is_loop(path: Path) -> bool:
    """Check whether a path leads through a symbolic link to itself, which Python 3.13 and newer resolve without an error."""
    try:
        path.stat()
    except OSError as error:
        return error.errno == errno.ELOOP
    return False


def _outside(root: Path, name: str) -> str:
    return f"the record names the path {name!r}, which is not inside {root}; SIERRA did not write this record"


RACY_NS = 2 * 10**9
"""The age of a file's last change after which a further change certainly gives it another time."""


def state(path: str | bytes) -> list[int]:
    """Return the facts that change with a file's content: device, inode, size, and the times of writing and of any change.

    The kernel sets the last one (ctime), and no program can set it. Two changes within the same tick of the file system's clock
    give it the same time, so that whatever is known of a file that is younger than `RACY_NS` must not be kept.
    """
    status = os.stat(path)  # noqa: PTH116 - for speed
    return [status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns]


def read_sealed(path: Path) -> bytes:
    """Return the data that was written to a file as `hashing.sealed`; nothing if it cannot be read, or has changed."""
    try:
        return unsealed(read_regular(path)) or b""
    except OSError:
        return b""


def read_record(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file of a session. Raises OSError, and Damaged if the file is not a JSON object."""
    try:
        record = json.loads(read_regular(path))
        if isinstance(record, dict):
            return record
    except (ValueError, RecursionError):  # not UTF-8, not JSON, or nested too deeply
        pass
    raise Damaged(f"{path}: not a record that SIERRA wrote; move {path.parent} away: its contents are not recorded yet")


MOST_BYTES = 200
"""The length of a name that leaves room for an ending, and for what `unfinished_beside` adds: file systems allow 255 bytes."""


def fitting(name: str) -> str:
    """Return a name that is not too long for a file: a long one is cut, and digits of its hash tell it from others."""
    data = name.encode("utf-8", "surrogateescape")
    if len(data) <= MOST_BYTES:
        return name
    return f"{data[: MOST_BYTES - 11].decode('utf-8', 'ignore')}_{sha256(data)[:10]}"


ESCAPED = regex(rb"\\x([0-9a-f]{2})")
UNFINISHED_END = r"(\.[0-9a-f]{8})?\.\d+"
"""The end of names by `unfinished_beside`, as a regular expression. Earlier versions wrote only the id of the process."""


def write_whole(path: Path, data: bytes) -> Path:
    """Write a file completely or not at all, replacing an existing one."""
    with replacing(path) as unfinished:
        unfinished.write_bytes(data)
    return path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new path for a file that gets its name at the end of the `with` block, replacing an existing one; not after an
    error.
    """
    unfinished = unfinished_beside(path)
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def is_gone(path: str) -> bool:
    """Check that there is nothing of this name, not even a symbolic link to something that does not exist."""
    try:
        os.lstat(path)
    except OSError as error:
        return isinstance(error, FileNotFoundError)
    return False


def write_once(path: Path, data: bytes) -> None:
    """Write a file completely or not at all, unless one exists: of all that write it at once, the first wins."""
    unfinished = unfinished_beside(path)
    try:
        unfinished.write_bytes(data)
        try:
            os.link(unfinished, path)
        except OSError:  # the target exists, or the file system has no hard links
            if not os.path.lexists(path):
                unfinished.rename(path)
    finally:
        unfinished.unlink(missing_ok=True)


def unfinished_beside(path: Path) -> Path:
    """Return a new path beside a file that is being written: no other thread, process or computer gets the same.

    It ends with the id of this process. If that is gone, `sierra gc` removes the file.
    """
    return path.with_name(f".{fitting(path.name)}.{os.urandom(4).hex()}.{os.getpid()}")


def unescaped(path: str) -> str:
    """Return a path with the bytes that are not UTF-8, for which a record has escapes."""
    return os.fsdecode(ESCAPED.sub(lambda found: bytes.fromhex(found[1].decode()), os.fsencode(path)))
