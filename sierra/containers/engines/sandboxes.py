"""The files of an image in a folder, for apptainer where it cannot mount a squashfs.

The owner of a folder can change it. Therefore the state of each file just after unpacking is recorded (no program can set it:
`sierra.provenance.hash_cache`). A folder whose state has changed, or has no recorded state, is unpacked again. Each user has a
folder of their own beside the squashfs, because nobody can vouch for another user's folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from sierra.containers.images.sif_format import is_sif
from sierra.containers.images.sif_format import read as read_sif
from sierra.errors import Missing
from sierra.store.layout import user_engines
from sierra.util.cache import Cache
from sierra.util.lazy_logger import Log

log = Log(__name__)

MAX_ENTRIES = 64


def prepare(squashfs: Path, identity: str, folder: Path) -> Path:
    """Return `folder` with the files of a squashfs (or of the one in a SIF), unpacked if necessary. Raises Missing."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _locked(folder):
        cache = Cache(user_engines(), MAX_ENTRIES)
        key = f"sandbox {folder.resolve()} {identity}"
        if cache.get(key) == (state(folder) or "gone"):
            return folder
        _unpack(squashfs, folder)
        cache.put(key, state(folder))
        cache.save()
    return folder


def state(folder: Path) -> str:
    """Return a hash of the kernel's data about each file below a folder; empty if there is no such folder."""
    if not folder.is_dir():
        return ""
    digest = hashlib.sha256()
    for line in sorted(_lines(str(folder))):
        digest.update(line)
    return digest.hexdigest()


def _lines(top: str) -> Iterator[bytes]:
    pending = [top]
    while pending:
        folder = pending.pop()
        with contextlib.suppress(PermissionError), os.scandir(folder) as entries:
            for entry in entries:
                status = entry.stat(follow_symlinks=False)
                if entry.is_dir(follow_symlinks=False):
                    pending.append(entry.path)
                state = (status.st_mode, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
                yield os.fsencode(entry.path) + repr(state).encode() + b"\0"


def _unpack(squashfs: Path, folder: Path) -> None:
    unfinished = folder.with_name(f".{folder.name}.{os.getpid()}")
    offset = ("-offset", str(read_sif(squashfs).offset)) if is_sif(squashfs) else ()
    command = ("unsquashfs", "-no-progress", "-no-xattrs", "-quiet", *offset, "-dest", str(unfinished), str(squashfs))
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", check=False)
    except OSError as error:
        raise Missing("unsquashfs is not installed; it comes with squashfs-tools (apt-get install squashfs-tools)") from error
    log.command(command, done.returncode, done.stderr)
    try:
        if done.returncode:
            lines = (done.stderr + done.stdout).strip().splitlines() or ["it printed no error"]
            raise Missing(f"{squashfs} cannot be unpacked: {lines[0]}")
        _remove(folder)
        unfinished.rename(folder)
    finally:
        _remove(unfinished)


def _remove(folder: Path) -> None:
    """Remove a folder, even if the image has made parts of it read-only."""
    if folder.is_symlink() or not folder.is_dir():
        return
    for root, _, _ in os.walk(folder):
        with contextlib.suppress(OSError):
            Path(root).chmod(0o700)
    shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a lock, so that only one process of this user at a time works on the folder."""
    descriptor = os.open(folder.with_name(f".{folder.name}.lock"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
