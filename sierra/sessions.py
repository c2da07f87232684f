"""Who executes what now: each asking has a session, a folder whose lock is held as long as its process lives.

Claims only save work, never guard truth: two processes that execute the same run (because a file system has no
locks) record two executions of it, and neither is lost. A session whose lock nobody holds has died; whoever
finds it ends what it left running, records what had finished, and removes it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import secrets
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

from sierra.paths import SessionPaths, StorePaths
from sierra.store.segments import disk_errors


class Session:
    """One asking, alive."""

    def __init__(self, store: StorePaths) -> None:
        self.id = secrets.token_hex(8)
        self.paths: SessionPaths = store.session(self.id)
        self.store = store
        with exclusively(store), disk_errors(self.paths.root):
            self.paths.root.mkdir(parents=True)
            self._lock = _locked(self.paths.lock)

    def claim(self, runs: set[str]) -> set[str]:
        """Claim those of `runs` that no other living session has claimed; the ones that were free."""
        with exclusively(self.store):
            free = runs - others(self.store, self.id)
            with disk_errors(self.paths.root):
                self.paths.claims.write_text(json.dumps(sorted(free)))
        return free

    def close(self) -> None:
        """Give all claims back; what is not recorded by now is lost."""
        shutil.rmtree(self.paths.root, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def others(store: StorePaths, own: str) -> set[str]:
    """The runs that other living sessions have claimed."""
    claimed: set[str] = set()
    for paths in _all(store):
        if paths.root.name != own and not _dead(paths):
            with contextlib.suppress(OSError, json.JSONDecodeError):
                claimed |= set(json.loads(paths.claims.read_text()))
    return claimed


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
            shutil.rmtree(paths.root, ignore_errors=True)
    finally:
        for lock in held:
            os.close(lock)


def end(pids: list[int]) -> None:
    """Kill processes, and the groups that they lead."""
    for pid in pids:
        for kill in (os.killpg, os.kill):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                kill(pid, signal.SIGKILL)


@contextlib.contextmanager
def exclusively(store: StorePaths) -> Iterator[None]:
    """Alone among this store's sessions, for the moment that a claim takes."""
    with disk_errors(store.work):
        store.work.mkdir(parents=True, exist_ok=True)
        lock = _locked(store.work_lock)
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


def _all(store: StorePaths) -> list[SessionPaths]:
    try:
        return [SessionPaths(Path(entry.path)) for entry in os.scandir(store.work) if entry.is_dir()]
    except FileNotFoundError:
        return []


def _dead(paths: SessionPaths) -> bool:
    lock = _locked(paths.lock, wait=False)
    if lock is None:
        return False
    os.close(lock)
    return True


def _locked(path: Path, *, wait: bool = True) -> int | None:
    """A descriptor that holds the lock; None where somebody else does.

    On a file system without locks, whoever waits gets it, and whoever asks who else is alive hears that all are.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        if not wait:
            os.close(descriptor)
            return None
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.EINVAL):
            raise
    return descriptor
