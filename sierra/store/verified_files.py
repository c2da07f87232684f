"""Verification of the files of segments before they are read: each is hashed once for each of its states.

The SHA-256 of a file must be the one in its segment's MANIFEST, and that of MANIFEST must begin with the digits at the end of
the segment's name. The state of a verified file (see `sierra.util.fs.state`) is kept in the user's cache folder, in one file
for each store, under the names of the segment and the file: the segment's name stands for the hash. A file is hashed again
when it has another state. The cache is not in the store, so that users who share a store do not depend on each other, and a
store may be read-only. If the cache is lost or damaged, all files are hashed once more.

A file that was changed within the last seconds is not kept in the cache (see `RACY_NS`). Only the hashes of files that this
process has just written are kept, in memory. A change that leaves the state as it was, such as that of a failing disk, is
found by `sierra fsck`, which trusts no cache.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from sierra.errors import DamagedFile, Missing
from sierra.store.layout import user_verified
from sierra.util.cache import Cache
from sierra.util.fs import RACY_NS, is_gone, state
from sierra.util.hashing import sha256, sha256_file
from sierra.util.regular_files import read_regular
from sierra.util.shortage import shortage

MANIFEST = "MANIFEST"
FOLDER = "/segments"
"""The end of the path of a folder of segments."""
THREADS = 4
LARGE = 1 << 22
"""The number of bytes from which several threads hash files; to start them takes as long as to hash half of it."""
MAX_ENTRIES = 1 << 18
"""The number of files that are kept for one store."""
MAX_STORES = 64
"""The number of stores whose files are kept."""
AGAIN_S = 1.0
"""The time for which a cache that has been written is not written again, except at the end of the process."""
PART = 0.02
"""The largest part of the time that goes to writing a cache before the end of the process."""

damage: dict[str, None] = {}
"""Messages about the damaged files that this process has found. The command line reports them if nobody else has."""
_caches: dict[str, Cache] = {}
"""The cache of each store that was read, by the path of its folder of segments."""
_saved: dict[str, float] = {}
"""The time from which each cache may be written again."""
_written: dict[tuple[int, ...], str] = {}
"""The SHA-256 of files that this process has written, by their state."""


class _File(NamedTuple):
    """A file of a segment."""

    path: str
    store: str
    """The path of the folder of segments."""
    segment: str
    name: str

    @property
    def key(self) -> str:
        return f"{self.segment}/{self.name}"


def changed(path: str) -> str:
    """Return the message about a file of a segment that is not the recorded one."""
    return f"{path} has other bytes than SIERRA wrote ({_batch(path)}): run sierra fsck"


def lost(path: str) -> str:
    """Return the message about a file of a segment that does not exist, perhaps because a symbolic link leads nowhere."""
    for link in (Path(path), Path(path).parent):
        if link.is_symlink() and not link.exists():
            gone = f"{link} is a symbolic link to {link.readlink()}, which does not exist"
            return f"{gone}: restore that, or run sierra fsck --repair"
    return f"{path} is missing: run sierra fsck --repair"


def _batch(path: str) -> str:
    return f"batch {Path(path).parent.name[:10]}"


def verify(files: Iterable[str]) -> None:
    """Check that files of segments have the bytes that were recorded. Raises Damaged, with the name of a file that has others.

    Files outside segments, and files that do not exist, are passed over: whoever reads these finds out.
    """
    try:
        _verify(files)
    except DamagedFile as error:
        damage[str(error)] = None
        raise


def are_sound(files: Iterable[str]) -> bool:
    """Check that files of segments have the bytes that were recorded, for a caller that can do without those that have not."""
    try:
        _verify(files)
    except DamagedFile:
        return False
    return True


def size_of(path: str) -> int:
    """Return the size of a file in bytes; 0 for one that is not there, which whoever reads it finds out."""
    try:
        return os.stat(path).st_size  # noqa: PTH116 - for speed
    except OSError:
        return 0


def begins_with(path: Path, digits: str) -> bool:
    """Check that the SHA-256 of a file that is no segment's begins with these digits; hash it once for each of its states.

    The files of each folder have a cache of their own, because that of segments takes long to read. Raises OSError.
    """
    folder = str(path.parent)
    cache = _cache_of(folder)
    began, before = time.time_ns(), state(str(path))
    if cache.get(path.name) == _fact(before):
        return True
    if not sha256_file(path).startswith(digits) or state(str(path)) != before:
        return False
    if before[-1] < began - RACY_NS:
        cache.put(path.name, _fact(before))
        _save(folder)
    return True


def _verify(files: Iterable[str]) -> None:
    new = [file for file in _in_segments(files) if not _is_known(file)]
    if not new:
        return
    if len(new) == 1 or sum(size_of(file.path) for file in new) < LARGE:
        _note(new, map(_hashed, new))
    else:
        from concurrent.futures import ThreadPoolExecutor  # takes longer to load than verified files to look up

        with ThreadPoolExecutor(THREADS) as pool:
            _note(new, pool.map(_hashed, new))
    for store in {file.store for file in new}:
        _save(store)


def _note(files: Sequence[_File], verified: Iterable[list[int] | None]) -> None:
    for file, now in zip(files, verified, strict=True):
        if now is not None:
            _caches[file.store].put(file.key, _fact(now))


def hash_written(path: Path) -> str:
    """Return the SHA-256 of a file that this process has written for a segment, and keep it for `verify`."""
    digest = sha256_file(path)
    _written[tuple(state(str(path)))] = digest
    return digest


def _in_segments(files: Iterable[str]) -> Iterable[_File]:
    for path in files:
        store, *names = path.rsplit("/", 2)
        if store.endswith(FOLDER) and len(names) == 2:
            yield _File(path, store, *names)


def _is_known(file: _File) -> bool:
    """Check whether a file has been verified in its present state, or does not exist."""
    cache = _cache_of(file.store)
    with contextlib.suppress(OSError):
        return cache.get(file.key) == _fact(state(file.path))
    return is_gone(file.path)


def _fact(state: Iterable[int]) -> str:
    """Return the state of a file as a text: a cache of many files is read in a third of the time that numbers take."""
    return " ".join(map(str, state))


def _cache_of(store: str) -> Cache:
    if store not in _caches:
        _caches[store] = Cache(user_verified(store), MAX_ENTRIES)
    return _caches[store]


def _hashed(file: _File) -> list[int] | None:
    """Verify a file; return its state if that may be kept. Raises Damaged, Missing if it may not or cannot be read now."""
    began = time.time_ns()
    try:
        before = state(file.path)
        digest = _written.get(tuple(before)) or sha256_file(Path(file.path))
        after = state(file.path)
        recorded = _recorded(file)
    except FileNotFoundError:
        if is_gone(file.path):  # another process removed the segment meanwhile
            return None
        absent = file.path if not Path(file.path).exists() else str(Path(file.path).with_name(MANIFEST))
        raise DamagedFile(lost(absent)) from None
    except OSError as error:
        if (lack := shortage(error)) is not None:
            raise Missing(f"{error.filename or file.path} cannot be read: {lack}") from error
        raise DamagedFile(
            f"{error.filename or file.path} cannot be read: {error.strerror} ({_batch(file.path)}): run sierra fsck"
        ) from error
    if digest != recorded:
        raise DamagedFile(changed(file.path))
    return after if after == before and after[-1] < began - RACY_NS else None


def _recorded(file: _File) -> str:
    """Return the SHA-256 that a file must have. Raises Damaged and OSError."""
    found = recorded_hashes(Path(file.path).parent)
    if file.name not in found:
        raise DamagedFile(f"{file.path} is not listed in the segment's MANIFEST ({_batch(file.path)}): run sierra fsck")
    return found[file.name]


def recorded_hashes(segment: Path) -> dict[str, str]:
    """Return the SHA-256 that each file of a segment must have, by name. Raises Damaged and OSError."""
    path = segment / MANIFEST
    text = read_regular(path)
    if sha256(text)[:16] != segment.name.rpartition("-")[2]:
        raise DamagedFile(changed(str(path)))
    lines = (line.partition("  ") for line in text.decode("utf-8", "replace").splitlines())
    return {name: digest for digest, _, name in lines}


def _save(store: str) -> None:
    """Write the cache of a store, but seldom: many calls of `verify` with few files each must not write it each time."""
    began = time.monotonic()
    if began < _saved.get(store, 0.0):
        return
    _make_room(_caches[store].path)
    _caches[store].save()
    now = time.monotonic()
    _saved[store] = now + max(AGAIN_S, (now - began) / PART)


@atexit.register
def _save_all() -> None:
    """Write what is not written yet, at the end of the process."""
    for cache in _caches.values():
        cache.save()


def _make_room(path: Path) -> None:
    """Remove the oldest caches if there are too many with a new one."""
    with contextlib.suppress(OSError):
        if not path.exists():
            for old in sorted(path.parent.iterdir(), key=lambda one: one.stat().st_mtime_ns)[: 1 - MAX_STORES]:
                old.unlink()
