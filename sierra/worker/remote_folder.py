"""The part of an exchange of folders that executes on the host: it needs Python 3.8 or newer and nothing else there.

`push` reads a line of JSON from standard input, `[target, entries]`, and answers with the line `{"state": "there"}` if the
target has these entries, or `{"state": "send"}`. Then it reads the contents of all files, one after the other, and answers with
`{"state": "done"}`. `pull` reads `[folder, way]`, and answers with `{"entries": …, "left_out": …}`. That is all if the way is
`compare`. If it is `copy`, files are read once: their entries have no hash (null), the contents of all files follow, and then
`{"state": "done", "digests": […]}` with the hashes in the order of the files, or a problem if one has changed meanwhile.
Problems are answered with `{"error": text}`. Empty lines before an answer are signs of life.

An entry is `["file", path, sha256, bytes, executable]`, `["folder", path]` or `["link", path, target]`. Names are UTF-8 with
surrogate escapes, so that each sequence of bytes has a text. The same functions make the entries on this machine.

A program of this size takes as long to start as 20 MB to copy. So modules that not every exchange needs are imported late.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import re
import signal
import stat
import sys
import time

TYPE_CHECKING = False  # the host needs no types
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Any

CHUNK = 1 << 18
CHANGED, YOUNG = "changed while it was copied; try again", "was changed just before"
YOUNG_S = 2.0
"""Seconds after its last change in which a file is read twice: another change might leave no trace in its times."""
SILENCE_S = 600
"""Seconds without input after which the transfer ends and removes what it wrote: the connection is lost."""
FREE = re.compile(r"(\.\./)*[^/]+(/[^/]+)*")
UNFINISHED = b".sierra-unfinished"


class Problem(Exception):
    """An obstacle to the transfer, in one line."""


def stays_within(path: str, target: str) -> bool:
    """Check that a link stays within the folder: `..` is allowed at its beginning only, because later parts may be links."""
    if not FREE.fullmatch(target) or "\0" in target:
        return False
    parts = target.split("/")
    ups = next((number for number, part in enumerate(parts) if part != ".."), len(parts))
    return ups <= path.count("/") and not {".", ".."} & set(parts[ups:])


def entries(root: bytes, alive: Callable[[], None] = lambda: None, hashed: bool = True) -> tuple[list[list[Any]], list[str]]:
    """Return the entries of a folder, sorted, and the paths of all that is neither file nor folder nor link within it.

    Unless they are `hashed`, files have None in the place of their hash.
    """
    listed: list[list[Any]] = []
    left_out: list[str] = []

    def visit(folder: bytes, prefix: str) -> None:
        for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
            path = prefix + text(entry.name)
            status = entry.stat(follow_symlinks=False)
            if stat.S_ISDIR(status.st_mode):
                listed.append(["folder", path])
                visit(entry.path, path + "/")
            elif stat.S_ISREG(status.st_mode):
                listed.append(file_entry(entry.path, path, alive) if hashed else unread(status, path))
            elif stat.S_ISLNK(status.st_mode) and stays_within(path, text(os.readlink(entry.path))):
                listed.append(["link", path, text(os.readlink(entry.path))])
            else:
                left_out.append(path)

    visit(root, "")
    return listed, left_out


def file_entry(file: bytes, path: str, alive: Callable[[], None] = lambda: None) -> list[Any]:
    """Return the entry of a file."""
    digest, size = hash_of(file, alive)
    return ["file", path, digest, size, bool(os.stat(file).st_mode & 0o111)]


def unread(status: os.stat_result, path: str) -> list[Any]:
    """Return the entry of a file without its hash."""
    return ["file", path, None, status.st_size, bool(status.st_mode & 0o111)]


def hash_of(path: bytes, alive: Callable[[], None]) -> tuple[str, int]:
    digest, size = hashlib.sha256(), 0
    with open(path, "rb") as file:
        while True:
            data = file.read(CHUNK)
            alive()
            if not data:
                return digest.hexdigest(), size
            digest.update(data)
            size += len(data)


def text(name: bytes) -> str:
    return name.decode("utf-8", "surrogateescape")


def raw(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")


@contextlib.contextmanager
def unfinished(target: bytes) -> Iterator[bytes]:
    """Yield a new folder beside the target, which is removed unless it was renamed. Those that were left are removed, too."""
    import shutil

    beside, name = os.path.split(target)
    os.makedirs(beside, exist_ok=True)
    prefix = UNFINISHED + b"-" + hashlib.sha256(name).hexdigest()[:16].encode() + b"-"
    for leftover in os.listdir(beside):
        if leftover.startswith(prefix):
            remove_left(os.path.join(beside, leftover))
    folder = os.path.join(beside, prefix + os.urandom(8).hex().encode())
    os.mkdir(folder, 0o700)
    held = lock(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def remove_left(path: bytes) -> None:
    """Remove the folder of a transfer that is gone; that of a running one is locked."""
    import shutil

    with contextlib.suppress(OSError):
        held = lock(path)
        shutil.rmtree(path, ignore_errors=True)
        os.close(held)


def lock(folder: bytes) -> int:
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(opened)
        raise
    return opened


def write(root: bytes, listed: list[list[Any]], read: Callable[[int], bytes]) -> list[str]:
    """Write entries into an empty folder, with the contents of files from `read`; return the hashes of these."""
    digests = []
    for entry in listed:
        path = os.path.join(root, raw(entry[1]))
        if entry[0] == "folder":
            os.mkdir(path, 0o777)
        elif entry[0] == "file":
            digests.append(write_file(path, entry, read))
    for entry in listed:
        if entry[0] == "link":
            os.symlink(raw(entry[2]), os.path.join(root, raw(entry[1])))
    return digests


def write_file(path: bytes, entry: list[Any], read: Callable[[int], bytes]) -> str:
    digest, left = hashlib.sha256(), entry[3]
    opened = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o777 if entry[4] else 0o666)
    with open(opened, "wb", buffering=0) as file:
        while left:
            data = read(min(CHUNK, left))
            if not data:
                raise Problem("the connection ended")
            digest.update(data)
            while data:
                written = file.write(data)
                left -= written
                data = data[written:]
    return digest.hexdigest()


def verify(listed: list[list[Any]], written: list[str], expected: list[Any]) -> None:
    """Compare the hashes of all files, in their order, with the expected ones. Raises Problem."""
    files = [entry[1] for entry in listed if entry[0] == "file"]
    for path, digest, right in zip(files, written, expected):
        if digest != right:
            raise Problem("%s %s" % (ascii(path)[1:-1], CHANGED))


def finish(made: bytes, target: bytes) -> None:
    """Give a complete folder its name."""
    sync(made)
    os.chmod(made, 0o777 & ~umask())
    try:
        os.rename(made, target)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise Problem("it is there already, with other contents; remove it or choose another name") from None
        raise


def sync(folder: bytes) -> None:
    """Write everything to the disk of a folder: one call for all files, and for no other disk if the C library has it."""
    import ctypes

    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        ctypes.CDLL(None).syncfs(opened)
    except (OSError, AttributeError):
        os.sync()
    finally:
        os.close(opened)


def umask() -> int:
    now = os.umask(0o077)
    os.umask(now)
    return now


def push(read: Callable[[int], bytes], line: bytes, answer: Callable[..., None], alive: Callable[[], None]) -> None:
    target, listed = json.loads(line)
    target = os.path.abspath(os.path.join(raw(os.path.expanduser("~")), raw(target)))
    if os.path.lexists(target):
        if os.path.isdir(target) and entries(target, alive) == (listed, []):
            return answer(state="there")
        raise Problem("it is there already, with other contents; remove it or choose another name")
    with unfinished(target) as folder:
        answer(state="send")
        verify(listed, write(folder, listed, read), [entry[2] for entry in listed if entry[0] == "file"])
        finish(folder, target)
    return answer(state="done")


def pull(line: bytes, answer: Callable[..., None], alive: Callable[[], None], out: Any) -> None:
    folder, way = json.loads(line)
    folder = os.path.join(raw(os.path.expanduser("~")), raw(folder))
    listed, left_out = entries(folder, alive, hashed=way == "compare")
    answer(entries=listed, left_out=left_out)
    if way == "compare":
        return
    files = [entry for entry in listed if entry[0] == "file"]
    sent = [send(os.path.join(folder, raw(path)), size, out) for _, path, _, size, _ in files]
    for (_, path, *_), (digest, reason) in zip(files, sent):
        if reason == YOUNG:
            again, _ = hash_of(os.path.join(folder, raw(path)), alive)
            reason = "" if again == digest else CHANGED
        if reason:
            raise Problem("%s %s" % (ascii(path)[1:-1], reason))
    answer(state="done", digests=[digest for digest, _ in sent])


def send(path: bytes, size: int, out: Any) -> tuple[str, str]:
    """Send exactly this number of bytes of a file; return their hash, and why it may be none of the file, or nothing."""
    digest, left, reason = hashlib.sha256(), size, CHANGED
    try:
        with open(path, "rb") as file:
            before, now = os.fstat(file.fileno()), time.time()
            while left:
                data = file.read(min(CHUNK, left))
                if not data:
                    break
                signal.alarm(SILENCE_S)
                digest.update(data)
                left -= out.write(data)
            after = os.fstat(file.fileno())
        if after.st_size == size and state(before) == state(after):
            reason = YOUNG if now - after.st_mtime < YOUNG_S else ""
    except OSError as error:
        reason = "cannot be read: %s" % error.strerror
    while left:
        left -= out.write(bytes(min(CHUNK, left)))
    return digest.hexdigest(), reason


def state(status: os.stat_result) -> tuple[int, ...]:
    """Return what differs after a change of a file."""
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def contents(path: bytes, size: int) -> Iterator[bytes]:
    """Yield exactly this number of bytes: those of a file that has become shorter are filled up, and have another hash."""
    with open(path, "rb") as file:
        while size:
            data = file.read(min(CHUNK, size)) or bytes(min(CHUNK, size))
            size -= len(data)
            yield data


def serve(way: str, source: Any, out: Any) -> None:
    """Execute `push` or `pull` with what is read from a file, and write to another one."""
    last = [time.monotonic()]

    def answer(**fields: Any) -> None:
        out.write(json.dumps(fields).encode() + b"\n")
        out.flush()

    def alive() -> None:
        if time.monotonic() - last[0] > 1:
            last[0] = time.monotonic()
            signal.alarm(SILENCE_S)
            out.write(b"\n")
            out.flush()

    def read(size: int) -> bytes:
        signal.alarm(SILENCE_S)
        alive()  # what was sent may take long to arrive
        data: bytes = source.read1(size)
        return data

    def end(*_: object) -> None:
        raise Problem("the connection is lost")

    for number in (signal.SIGALRM, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end)
    signal.alarm(SILENCE_S)
    line = source.readline()
    try:
        push(read, line, answer, alive) if way == "push" else pull(line, answer, alive, out)
    except Problem as error:
        answer(error=str(error))
    except OSError as error:
        answer(error=error.strerror or str(error))


if __name__ == "__main__":
    serve(sys.argv[1], sys.stdin.buffer, sys.stdout.buffer)
