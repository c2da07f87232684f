"""Sessions and claims: each session has a folder whose lock is held as long as its process lives.

Claims only save work; they never guarantee correctness. If two processes execute the same run (because a file system has no
locks), two executions of it are recorded, and neither is lost. A session whose lock nobody holds is dead. The process that
finds it ends the runs that it left, records the finished ones, and removes it. Until then its claims stay valid, so that
no process executes a run again that only waits to be recorded.

A session that was submitted to a cluster (it has `submission.json`) continues when its process ends. It is then unattended
until another process takes it over, for example one that needs the same runs.

On a file system without locks, only claims of sessions on a cluster are respected. There, a session is dead once its owner's
process is gone, as far as the owner's host can tell. `owner.0` names the process that created the session, `owner.1` the
process that finishes it after the first one died, and so on. Each of these files is created by exactly one process. The
owner of a session on a cluster may be on another host: it touches its file regularly, and is dead if it stops doing so.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import platform
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypedDict

from sierra.errors import Missing
from sierra.store import ownership_marks, session_numbers
from sierra.store.layout import SessionPaths, StorePaths
from sierra.store.segments import disk_errors
from sierra.util.lazy_logger import Log
from sierra.util.regular_files import read_regular
from sierra.util.version import __version__
from sierra.worker.files import is_folder, remove
from sierra.worker.processes import birth
from sierra.worker.temporary_folders import abandoned_by

log = Log(__name__)

BEAT_S, SILENT_S = 20.0, 120.0
"""Seconds between two signs of life of an owner on a file system without locks, and the silence after which it is dead."""


class Session:
    """One session of a living process."""

    def __init__(self, store: StorePaths, elsewhere: Path | None = None, *, logged: bool = True) -> None:
        """Start a session. Its runs execute in a folder below `elsewhere`, if that is given. Raises Missing.

        If `logged`, it has a log file: see `sierra.store.session_log_file`.
        """
        self.id = os.urandom(8).hex()
        self.paths: SessionPaths = store.session(self.id)
        self.store = store
        self.number: int | None = None
        """Lamport number of the session, or None before it has taken one."""
        self.seen: frozenset[str] = frozenset()
        """Names of the segments that existed when it took its number, before it recorded anything."""
        self.recorded = True
        """True if all finished runs are recorded; otherwise the session's folder stays for the next session to recover."""
        self._generation, self._beaten = 0, time.monotonic()
        with exclusively(store), disk_errors(self.paths.root):
            self.paths.root.mkdir(parents=True)
            _own(self.paths, 0)
            self._lock = locked(self.paths.lock)
        _sign(self._lock)
        self._log_begin("started" if logged else None)
        if elsewhere is not None:
            self._execute_below(elsewhere)

    @classmethod
    def adopted(cls, store: StorePaths, paths: SessionPaths) -> Session | None:
        """Take over a session that was submitted to a cluster.

        Returns None if another process has it, or if it is gone.
        """
        session = cls.__new__(cls)
        session.id, session.paths, session.store, session.recorded = paths.root.name, paths, store, True
        session.number, session.seen = _number(paths), frozenset()
        session._generation, session._beaten = 0, time.monotonic()
        with exclusively(store):
            if not (paths.submission.exists() and ownership_marks.is_session(paths.root) and _is_own(paths)):
                return None
            try:
                session._lock = locked(paths.lock, wait=False)
            except (BlockingIOError, PermissionError):
                return None
            generation = _take_over(paths) if session._lock is None else 0
            if generation is None:
                return None
            session._generation = generation
        _sign(session._lock)
        session._log_begin(f"was taken over as generation {session._generation}")
        return session

    def _log_begin(self, what: str | None) -> None:
        """Open the log file and log how this process has got the session; with None, log nothing."""
        self._end_log: Callable[[], None] = lambda: None
        if what is None:
            return
        from sierra.store.session_log_file import open_log

        self._end_log = open_log(self.store, self.id)
        python, host = platform.python_version(), socket.gethostname()
        log.info("session %s %s: process %d on %s, SIERRA %s, Python %s", self.id, what, os.getpid(), host, __version__, python)

    def _log_end(self) -> None:
        if error := sys.exc_info()[1]:
            log.warning("session %s ended with %s: %s", self.id, type(error).__name__, error)
            log.debug("".join(traceback.format_exception(error)))
        else:
            log.info("session %s %s", self.id, "ended" if self.recorded else "was left open, to be continued")
        self._end_log()

    def _execute_below(self, folder: Path) -> None:
        try:
            with disk_errors(folder):
                self.paths = ownership_marks.make_elsewhere(self.store, self.paths, folder)
        except Missing as error:
            self.close()
            raise Missing(f"[store] work_folder: {error}") from error

    def take_number(self) -> None:
        """Take a Lamport number. Call this before anything is recorded (see `sierra.store.lamport_clock`)."""
        with exclusively(self.store), disk_errors(self.paths.root):
            living = [_number(paths) or 0 for paths in all_of(self.store)]
            self.number = session_numbers.following(self.store, living)
            self.paths.number.write_text(str(self.number))
            self.seen = frozenset(path.name for path in self.store.segments.iterdir())

    def beat(self) -> None:
        """Give a sign of life of the session's owner on a file system without locks."""
        if self._lock is None and time.monotonic() - self._beaten > BEAT_S:
            self._beaten = time.monotonic()
            with contextlib.suppress(OSError):
                os.utime(self.paths.owner(self._generation))

    def leave(self) -> None:
        """Leave the session to continue without a process."""
        self.recorded = False
        if self._lock is None:
            with contextlib.suppress(OSError):
                self.paths.left(self._generation).touch()

    def claim(self, runs: set[str]) -> set[str]:
        """Claim those of `runs` that no other session has claimed; return them (the same set object if all were free)."""
        with exclusively(self.store) as alone:
            claimed = _claimed(self.store, self.id, submitted=not alone)
            free = runs - claimed if claimed else runs
            with disk_errors(self.paths.root), self.paths.claims.open("w") as file:
                json.dump(sorted(free), file)
        return free

    def close(self) -> None:
        """Release all claims, and remove the session's folder if everything is recorded."""
        if self.recorded:
            _remove(self.store, self.paths)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        self._log_end()


def others(store: StorePaths, own: str) -> set[str]:
    """Return the runs that other sessions have claimed. A dead session keeps its claims until it is finished."""
    with exclusively(store) as alone:
        return _claimed(store, own, submitted=not alone)


@contextlib.contextmanager
def dead(store: StorePaths) -> Iterator[list[SessionPaths]]:
    """Yield the dead sessions that no other process finishes now; remove them at the end."""
    held: list[int] = []
    dead_sessions: list[SessionPaths] = []
    with exclusively(store):
        for paths in all_of(store):
            if paths.submission.exists():
                continue
            try:
                lock = locked(paths.lock, wait=False)
            except (BlockingIOError, PermissionError):
                continue
            if lock is not None:
                held.append(lock)
            if lock is not None or _take_over(paths) is not None:
                dead_sessions.append(paths)
    try:
        yield dead_sessions
        _remove_temporary(dead_sessions)
        for paths in dead_sessions:  # without those that the caller has taken out
            _remove(store, paths)
    finally:
        for lock in held:
            os.close(lock)


def _remove_temporary(dead: Sequence[SessionPaths]) -> None:
    """Remove what killed workers of these sessions left in the system's temporary folder."""
    folders = {folder for paths in dead for folder in (paths.root, paths.runs)}
    if folders:
        for path in abandoned_by(lambda owner: not folders.isdisjoint((Path(owner), *Path(owner).parents))):
            remove(path)


def alive(store: StorePaths) -> list[SessionPaths]:
    """Return the sessions whose lock is held, and those on a cluster.

    Call this within `exclusively`, and only if that yields True (the file system has locks).
    """
    living = []
    for paths in all_of(store):
        if paths.submission.exists():
            living.append(paths)
            continue
        try:
            lock = locked(paths.lock, wait=False)
        except (BlockingIOError, PermissionError):
            living.append(paths)
        else:
            if lock is not None:
                os.close(lock)
    return living


@contextlib.contextmanager
def exclusively(store: StorePaths) -> Iterator[bool]:
    """Hold the exclusive lock of this store's sessions, for a short time; yield False if the file system has no locks."""
    with disk_errors(store.work):
        ownership_marks.mark_work(store)
        lock = locked(store.work_lock)
    try:
        yield lock is not None
    finally:
        if lock is not None:
            os.close(lock)


def all_of(store: StorePaths) -> list[SessionPaths]:
    """Return all sessions of the store, alive or dead."""
    return list(ownership_marks.sessions(store))


def submitted(store: StorePaths) -> list[SessionPaths]:
    """Return the sessions that were submitted to a cluster, attended or not, ordered by id."""
    return sorted((paths for paths in all_of(store) if paths.submission.exists()), key=lambda paths: paths.root.name)


def _number(paths: SessionPaths) -> int | None:
    """Return the Lamport number that a session has taken; None if it has none."""
    try:
        return int(read_regular(paths.number))
    except (OSError, ValueError):
        return None


def claims(paths: SessionPaths) -> set[str]:
    """Return the runs that a session has claimed."""
    try:
        return set(json.loads(read_regular(paths.claims)))
    except (OSError, ValueError, TypeError, RecursionError):
        return set()


def holder(paths: SessionPaths) -> str:
    """Return the process that holds a session, in words, from its lock or its last owner file."""
    owners = sorted(paths.root.glob(paths.owner(0).with_suffix(".*").name), key=lambda file: int(file.suffix[1:]))
    for file in (paths.lock, *reversed(owners)):
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError, RecursionError):
            found = json.loads(read_regular(file))
            return f"process {found['pid']} on {found['where'][0]}"
    return "another process"


def _claimed(store: StorePaths, own: str, *, submitted: bool) -> set[str]:
    """Return the runs that other sessions have claimed; with `submitted`, only sessions on a cluster."""
    claimed: set[str] = set()
    for paths in all_of(store):
        if paths.root.name != own and (not submitted or paths.submission.exists()):
            claimed |= claims(paths)
    return claimed


def _remove(store: StorePaths, paths: SessionPaths) -> None:
    """Remove a session's folders.

    Its lock is removed last, together with the folder, so that no process finds half a session.
    """
    if not ownership_marks.is_session(paths.root):
        return
    if paths.elsewhere is not None:
        remove(str(paths.elsewhere))
    with contextlib.suppress(OSError):
        paths.submission.unlink(missing_ok=True)  # first, so that no process continues half a submission
        for entry in paths.root.iterdir():
            if is_folder(str(entry)):
                remove(str(entry))
            elif entry not in (paths.lock, paths.owner(0)):  # these identify the folder as a session
                entry.unlink()
    with exclusively(store):
        remove(str(paths.root))


def locked(path: Path, *, wait: bool = True) -> int | None:
    """Return a descriptor that holds the lock; None if the file system has no locks.

    Raises BlockingIOError if another process holds the lock and `wait` is False. A lock that this user may only read does.
    Raises PermissionError if the file system locks only what may be written, as NFS does, and this user may not.
    """
    flags = os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | flags, 0o666)
    except PermissionError:
        if not path.exists():
            raise
        descriptor = os.open(path, os.O_RDONLY | flags)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        os.close(descriptor)
        if error.errno == errno.EBADF:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path)) from error
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.EINVAL, errno.ENOSYS):
            raise
        return None
    return descriptor


def _sign(lock: int | None) -> None:
    """Write into a lock file which process holds it, for people."""
    if lock is not None:
        with contextlib.suppress(OSError):
            os.ftruncate(lock, 0)
            os.pwrite(lock, json.dumps(_process(os.getpid())).encode(), 0)


def _own(paths: SessionPaths, generation: int) -> bool:
    """Create the owner file of that generation for this process; return False if another process has created it."""
    try:
        with paths.owner(generation).open("x") as file:
            json.dump(_process(os.getpid()), file)
    except FileExistsError:
        return False
    return True


def _is_own(paths: SessionPaths) -> bool:
    """Check whether a session is this user's: only its owner can find or end its jobs on a cluster."""
    return os.geteuid() in (0, paths.root.stat().st_uid)


def _take_over(paths: SessionPaths) -> int | None:
    """Become the owner of a session whose last owner is gone: a dead process of this host, or one that left or fell silent.

    Returns the new generation; None if the session cannot be taken over.
    """
    generation = 0
    while paths.owner(generation + 1).exists():
        generation += 1
    file = paths.owner(generation)
    try:
        owner = json.loads(read_regular(file))
    except ValueError:  # it is being written, or its writer has died
        owner = None
    except OSError:
        return None
    gone = owner and owner.get("born") is not None and owner["where"] == _where() and owner != _process(owner["pid"])
    beats = owner is None or paths.submission.exists()
    if gone or paths.left(generation).exists() or (beats and _is_silent(file)):
        return generation + 1 if _own(paths, generation + 1) else None
    return None


def _is_silent(owner: Path) -> bool:
    """Check whether a file was not touched for more than `SILENT_S`, by the clock of the file system."""
    try:
        with tempfile.NamedTemporaryFile(dir=owner.parent) as now:
            return os.fstat(now.fileno()).st_mtime - owner.stat().st_mtime > SILENT_S
    except OSError:
        return False


class Process(TypedDict):
    """A record that identifies one process for ever."""

    pid: int
    born: int | None
    """Its start time in clock ticks since boot; None if the process cannot be found."""
    boot: str | None
    where: list[str]


def _process(pid: int) -> Process:
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        boot = None
    return {"pid": pid, "born": birth(pid) if boot else None, "boot": boot, "where": _where()}


def _where() -> list[str]:
    """Return the host and its namespace of process ids; only processes there can tell whether one of them lives.

    A container has a namespace of its own.
    """
    try:
        return [socket.gethostname(), str(Path("/proc/self/ns/pid").readlink())]
    except OSError:
        return [socket.gethostname()]
