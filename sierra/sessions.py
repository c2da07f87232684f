"""Who executes what now: each asking has a session, a folder whose lock is held as long as its process lives.

Claims only save work, never guard truth: two processes that execute the same run (because a file system has no
locks) record two executions of it, and neither is lost. A session whose lock nobody holds has died; whoever
finds it ends what it left running, records what had finished, and removes it. Until then its claims hold, so
that nobody executes again what only waits to be recorded.

Where a file system has no locks, claims are not heeded, and a session has died once its owner's process is gone, as
far as its own host can tell: `owner.0` names the process that made it, `owner.1` the one that finishes it because
that has died, and so on. Each is created by one process alone.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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
            _own(self.paths, 0)
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
        for paths in all_of(store):
            try:
                lock = _locked(paths.lock, wait=False)
            except BlockingIOError:
                continue
            if lock is not None:
                held.append(lock)
            if lock is not None or _take_over(paths):
                found.append(paths)
    try:
        yield found
        for paths in found:
            _remove(store, paths)
    finally:
        for lock in held:
            os.close(lock)


def alive(store: StorePaths) -> list[SessionPaths]:
    """The sessions whose lock is held. To be called within `exclusively`, where it says that there are locks."""
    found = []
    for paths in all_of(store):
        try:
            lock = _locked(paths.lock, wait=False)
        except BlockingIOError:
            found.append(paths)
        else:
            if lock is not None:
                os.close(lock)
    return found


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


def all_of(store: StorePaths) -> list[SessionPaths]:
    """All sessions that are there, alive or not."""
    try:
        return [SessionPaths(Path(entry.path)) for entry in os.scandir(store.work) if entry.is_dir()]
    except FileNotFoundError:
        return []


def _claimed(store: StorePaths, own: str) -> set[str]:
    claimed: set[str] = set()
    for paths in all_of(store):
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
    """A descriptor that holds the lock; None where the file system has no locks. BlockingIOError: somebody else has it."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        os.close(descriptor)
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.EINVAL, errno.ENOSYS):
            raise
        return None
    return descriptor


def _own(paths: SessionPaths, generation: int) -> bool:
    """Become a session's owner of that generation; False where another process has."""
    try:
        with paths.owner(generation).open("x") as file:
            json.dump(_process(os.getpid()), file)
    except FileExistsError:
        return False
    return True


def _take_over(paths: SessionPaths) -> bool:
    """Become the owner of a session whose last owner was a process of this host that is gone."""
    generation = 0
    while paths.owner(generation + 1).exists():
        generation += 1
    try:
        owner = json.loads(paths.owner(generation).read_text())
    except (OSError, json.JSONDecodeError):
        return False
    known = owner["born"] is not None and owner["where"] == _where()
    return known and owner != _process(owner["pid"]) and _own(paths, generation + 1)


def _process(pid: int) -> dict[str, Any]:
    """What names one process for ever; `born` is None where there is none, or where that can't be told."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        boot = None
    return {"pid": pid, "born": boot and worker.birth(pid), "boot": boot, "where": _where()}


def _where() -> list[str]:
    """Who can tell whether a process lives: this host, in this namespace of process ids (a container has its own)."""
    try:
        return [socket.gethostname(), str(Path("/proc/self/ns/pid").readlink())]
    except OSError:
        return [socket.gethostname()]
