"""Who executes what now: each asking has a session, a folder whose lock is held as long as its process lives.

Claims only save work, never guard truth: two processes that execute the same run (because a file system has no
locks) record two executions of it, and neither is lost. A session whose lock nobody holds has died; whoever
finds it ends what it left running, records what had finished, and removes it. Until then its claims hold, so
that nobody executes again what only waits to be recorded.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from sierra import worker
from sierra.paths import SessionPaths, StorePaths
from sierra.store.segments import disk_errors


class Session:
    """One asking, alive."""

    def __init__(self, store: StorePaths) -> None:
        self.id = secrets.token_hex(8)
        self.paths: SessionPaths = store.session(self.id)
        self.store = store
        self.recorded = True
        """Whether all that has finished here is recorded; otherwise the session is left to whoever asks next."""
        with exclusively(store), disk_errors(self.paths.root):
            self.paths.root.mkdir(parents=True)
            self._lock = _locked(self.paths.lock)

    def claim(self, runs: set[str]) -> set[str]:
        """Claim those of `runs` that no other session has claimed; the ones that were free."""
        with exclusively(self.store) as alone:
            free = runs - _claimed(self.store, self.id) if alone else runs
            with disk_errors(self.paths.root):
                self.paths.claims.write_text(json.dumps(sorted(free)))
        return free

    def close(self) -> None:
        """Give all claims back, and remove what is recorded."""
        if self.recorded:
            _remove(self.store, self.paths)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def others(store: StorePaths, own: str) -> set[str]:
    """The runs that other sessions have claimed. Those of one that has died are its own until it is finished."""
    with exclusively(store) as alone:
        return _claimed(store, own) if alone else set()


@contextlib.contextmanager
def dead(store: StorePaths) -> Iterator[list[SessionPaths]]:
    """The sessions that have died, and that nobody else finishes now; they are removed at the end."""
    held: list[int] = []
    found: list[SessionPaths] = []
    with exclusively(store):
        for paths in _all(store):
            lock = _locked(paths.lock, wait=False)
            if lock is not None:
                held.append(lock)
                found.append(paths)
    try:
        yield found
        for paths in found:
            _remove(store, paths)
    finally:
        for lock in held:
            os.close(lock)


@contextlib.contextmanager
def exclusively(store: StorePaths) -> Iterator[bool]:
    """Alone among this store's sessions, for the moment that a claim takes; False where the file system has no locks."""
    with disk_errors(store.work):
        store.work.mkdir(parents=True, exist_ok=True)
        lock = _locked(store.work_lock)
    try:
        yield lock is not None
    finally:
        if lock is not None:
            os.close(lock)


def _all(store: StorePaths) -> list[SessionPaths]:
    try:
        return [SessionPaths(Path(entry.path)) for entry in os.scandir(store.work) if entry.is_dir()]
    except FileNotFoundError:
        return []


def _claimed(store: StorePaths, own: str) -> set[str]:
    claimed: set[str] = set()
    for paths in _all(store):
        if paths.root.name != own:
            with contextlib.suppress(OSError, json.JSONDecodeError):
                claimed |= set(json.loads(paths.claims.read_text()))
    return claimed


def _remove(store: StorePaths, paths: SessionPaths) -> None:
    """Remove a session's folder; its lock goes last, and at once with the folder, so that nobody finds half of it."""
    if not worker.is_folder(str(paths.root)):
        return
    with contextlib.suppress(OSError):
        for entry in paths.root.iterdir():
            if worker.is_folder(str(entry)):
                worker.remove(str(entry))
            elif entry != paths.lock:
                entry.unlink()
    with exclusively(store):
        worker.remove(str(paths.root))


def _locked(path: Path, *, wait: bool = True) -> int | None:
    """A descriptor that holds the lock; None where somebody else does, or where the file system has no locks.

    Without locks no session is ever taken for dead, and claims are not heeded.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        os.close(descriptor)
        if error.errno not in (errno.EWOULDBLOCK, errno.ENOLCK, errno.ENOTSUP, errno.EINVAL, errno.ENOSYS):
            raise
        return None
    return descriptor
