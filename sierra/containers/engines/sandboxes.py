"""The files of an image in a folder, for apptainer where it cannot mount a squashfs.

The owner of a folder can change it. Therefore the state of each file just after unpacking is recorded (no program can set it:
`sierra.provenance.hash_cache`). A folder whose state has changed, or has no recorded state, is unpacked again. Each user has a
folder of their own beside the squashfs, because nobody can vouch for another user's folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from sierra.containers.engines.hosts import HERE, SLOWEST, Host
from sierra.containers.images.sif_format import is_sif
from sierra.containers.images.sif_format import read as read_sif
from sierra.errors import Missing
from sierra.store.layout import user_engines
from sierra.util.cache import Cache

MAX_ENTRIES = 64


def prepare(squashfs: Path, identity: str, folder: Path) -> Path:
    """Return `folder` with the files of a squashfs (or of the one in a SIF), unpacked if necessary. Raises Missing."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _locked(folder):
        unpack(HERE, squashfs, str(squashfs), identity, str(folder.resolve()))
    return folder


def unpack(host: Host, squashfs: Path, there: str, identity: str, folder: str) -> None:
    """Unpack a squashfs on a host, unless the folder has its unchanged files. It has the path `there`. Raises Missing."""
    cache = Cache(user_engines(), MAX_ENTRIES)
    key = " ".join(("sandbox", *([f"on {host.name}"] if host.name else []), folder, identity))
    limit = squashfs.stat().st_size / SLOWEST
    if cache.get(key) == (host.call("tree_state", folder, timeout=limit) or "gone"):
        return
    offset = read_sif(squashfs).offset if is_sif(squashfs) else 0
    if trouble := host.call("unpack", there, offset, folder, timeout=limit):
        raise Missing(f"{host.name}: {trouble}" if host.name else trouble)
    cache.put(key, host.call("tree_state", folder, timeout=limit))
    cache.save()


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a lock, so that only one process of this user at a time works on the folder."""
    descriptor = os.open(folder.with_name(f".{folder.name}.lock"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
