"""Ways to observe runs: by strace, which sees all that they do with files, or by the files that they have mapped into memory.

`Strace` needs the program strace 5.3 or newer with all of OPTIONS, on Linux, for any user. It is started as `strace -DDD`: the
program stays the caller's own child, and the tracer becomes an orphan in a session of its own. `Maps` needs nothing but /proc.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import time
from typing import Callable, Iterable, Mapping, Sequence

from sierra.worker import trace_log
from sierra.worker.file_trace import LISTS, SETTLE_S, Observation, Trace, Way, nothing
from sierra.worker.files import CHUNK, is_full, size_of_file
from sierra.worker.processes import all_processes, read_proc, state_of
from sierra.worker.trace_log import CALLS, Log, starts

OLDEST = (5, 3)  # the first version of strace with --seccomp-bpf
QUIET = ("chld", "urg", "winch", "cont", "prof", "vtalrm")
"""Signals that are frequent, or end no process. The log says that a signal has ended a process only if it notes this signal."""
OPTIONS = ("-DDD", "-f", "--seccomp-bpf", "-q", "-A", "-y", "-s", "0", "-e", "signal=!" + ",".join(QUIET))
PROBE_S = 20.0


class Strace:
    """Observes by strace: see the module's text."""

    name = "strace"
    sees = LISTS

    def __init__(self, program: str | None = None) -> None:
        """Prepare to use a program of this path; by default the one that PATH finds."""
        self._program = program

    def trouble(self) -> str | None:
        if sys.platform != "linux":
            return "strace needs Linux"
        program = self.program
        if program is None:
            return "strace is not installed"
        return trouble_of(program)

    @property
    def program(self) -> str | None:
        found = self._program or shutil.which("strace")
        return os.path.abspath(found) if found else None

    def begin(self, log: str, cwd: str, own: Sequence[str] = ()) -> Observation:
        return Traced(self.program or "strace", os.path.abspath(log), cwd, own)


@functools.lru_cache(maxsize=None)
def trouble_of(program: str) -> str | None:
    """Return why a strace cannot be used here: its version, its options, or the right to trace. Finds out once."""
    with tempfile.TemporaryDirectory(prefix="strace-") as folder:
        return trouble_in(program, folder)


def trouble_in(program: str, folder: str) -> str | None:
    """Return why a strace cannot be used, found out by tracing in a folder."""
    try:
        said = subprocess.run([program, "-V"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=PROBE_S).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        return "%s cannot be executed: %s" % (program, error)
    version = re.search(rb"version (\d+)\.(\d+)", said)
    if version is None or tuple(map(int, version.groups())) < OLDEST:
        return "%s is %s; 5.3 or newer is needed" % (program, first_line(said) or "of an unknown version")
    log = os.path.join(folder, "log")
    observation = Traced(program, log, folder)
    name = os.path.join(folder, "x" * 100)
    os.symlink(program, name)
    try:
        words = observation.prefixed([name, "-V"], {"PATH": os.defpath}, folder)
        if words[0] != program:
            return "%s is a program of an unknown format" % program
        done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, timeout=PROBE_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        return "%s cannot trace here: %s" % (program, error)
    observation.end(seconds=SETTLE_S)
    if done.returncode or done.stderr:
        return "%s cannot trace here: %s" % (program, first_line(done.stderr) or "status %d" % done.returncode)
    trace = observation.trace()
    if trace.reason or os.path.realpath(program) not in trace.executed or name not in trace.links:
        return "the log of %s is not understood: %s" % (program, trace.reason or "a name is missing")
    return None


def first_line(said: bytes) -> str:
    lines = said.decode("utf-8", "replace").strip().splitlines()
    return lines[0] if lines else ""


class Traced:
    """The observation of one run by strace."""

    def __init__(self, program: str, log: str, cwd: str, own: Sequence[str] = ()) -> None:
        self._program, self._log, self._cwd = program, log, cwd
        self._own = [os.path.realpath(folder) for folder in own]
        self._cut = self._started = self._conducted = self._late = False
        self._unfit: str | None = None
        self._reader: Log | None = None
        self._offset = 0
        """Number of bytes of the log that were read while the programs go on."""
        self._said = 0
        """Number of bytes of standard error that were read then."""
        self._latest: Trace | None = None
        """The trace until the last look."""
        self._prefix = (program, *OPTIONS, "-e", "trace=" + ",".join("?" + name.decode() for name in CALLS), "-o", log, "--")
        os.close(os.open(log, os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
        self.began = min(time.time_ns(), os.stat(log).st_ctime_ns)

    def prefixed(self, argv: Sequence[str], environment: Mapping[str, str], cwd: str, *, conducted: bool = False) -> list[str]:
        self._conducted = conducted
        self._unfit = unfit(argv, environment, cwd)
        self._cwd = cwd
        self._started = self._unfit is None
        return [*self._prefix, *argv] if self._started else list(argv)

    def is_tracer(self, pid: int) -> bool:
        words = read_proc("%d/cmdline" % pid).split(b"\0")
        prefix = [os.fsencode(word) for word in self._prefix]
        return words[: len(prefix)] == prefix and state_of(pid) not in (None, b"Z")

    def look(self, pids: Iterable[int]) -> None:
        pass

    def limit(self) -> None:
        with contextlib.suppress(OSError):
            if self._cut or os.stat(self._log).st_size > trace_log.LOG_BYTES:
                self._cut = True
                os.truncate(self._log, 0)  # strace appends

    def end(self, candidates: Callable[[], Iterable[int]] | None = None, seconds: float = SETTLE_S) -> None:
        if not self._started:
            return
        give_up = time.monotonic() + seconds
        pause = 0.001
        while True:
            tracers = [pid for pid in (candidates or all_processes)() if self.is_tracer(pid)]
            if not tracers:
                return
            if time.monotonic() >= give_up:
                break
            time.sleep(pause)
            pause = min(2 * pause, 0.05)
        self._late = True
        for pid in tracers:
            with contextlib.suppress(OSError):
                os.kill(pid, 9)

    def trace(self, stderr: str | None = None, check_stop: Callable[[], None] = nothing, *, living: bool = False) -> Trace:
        if self._unfit is not None:
            return Trace(Strace.name, reasons=("it was not observed: " + self._unfit,))
        own = map(os.fsencode, self._own)
        log = self._reader or Log(os.fsencode(os.path.realpath(self._cwd)), own, conducted=self._conducted)
        self._reader = log if living else None
        before = self._offset
        try:
            with open(self._log, "rb") as file:
                file.seek(self._offset)
                if not (living and self._cut):  # else the log was emptied
                    self._offset += log.read(file, check_stop, living=living)
            if is_full(self._log):
                log.damage("the disk of the log is full")
        except OSError as error:
            log.damage("the log cannot be read: %s" % error.strerror)
        if self._late:
            log.damage("the tracer did not end, and was killed")
        if stderr is not None and self._complains(stderr, check_stop):
            log.damage("the tracer has written to the run's standard error")
        if not living or self._latest is None or before != self._offset or log.disturbed or self._cut:
            self._latest = log.trace(Strace.name, cut=self._cut, living=living)
        return self._latest

    def _complains(self, stderr: str, check_stop: Callable[[], None]) -> bool:
        """Return whether the tracer has written to a file since the last look."""
        words = os.fsencode(self._program) + b": "
        begin = max(0, self._said - len(words))
        self._said = size_of_file(stderr)
        return contains(stderr, words, check_stop, begin)


def contains(path: str, words: bytes, check_stop: Callable[[], None], begin: int = 0) -> bool:
    """Return whether words are in a file, at `begin` or later. One that cannot be read contains them."""
    before = b""
    try:
        with open(path, "rb", buffering=0) as file:
            file.seek(begin)
            for chunk in iter(lambda: file.read(CHUNK), b""):
                check_stop()
                if words in before + chunk:
                    return True
                before = chunk[-len(words) :]
    except OSError:
        return True
    return False


def unfit(argv: Sequence[str], environment: Mapping[str, str], cwd: str) -> str | None:
    """Return why a program cannot be started by strace: it would end with status 1, instead of the caller's usual error."""
    if not argv or not argv[0] or any("\0" in word for word in argv):
        return "there is no program"
    program = argv[0]
    candidates = [program]
    if "/" not in program:
        if "PATH" not in environment:
            return "there is no PATH"  # strace finds nothing then, but others do
        candidates = [os.path.join(folder, program) for folder in environment["PATH"].split(":")]
    for candidate in candidates:
        path = os.path.join(cwd, candidate)
        try:
            mode = os.stat(path).st_mode
        except (OSError, ValueError):
            continue
        if stat.S_ISREG(mode) and mode & 0o111:  # strace takes the first such file
            return None if os.access(path, os.X_OK) and starts(path) else "%s cannot be executed" % program
    return "%s was not found" % program


class Maps:
    """Observes by reading /proc/PID/maps: it needs nothing, but sees only files that are mapped while somebody looks."""

    name = "maps"
    sees: frozenset[str] = frozenset()

    def trouble(self) -> str | None:
        try:
            mapped("self")
        except OSError as error:
            return "/proc cannot be read: %s" % error.strerror
        return None

    def begin(self, log: str, cwd: str, own: Sequence[str] = ()) -> Observation:
        return Mapped(log)


class Mapped:
    """The observation of one run by the maps of its processes."""

    def __init__(self, log: str) -> None:
        os.close(os.open(log, os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
        self.began = min(time.time_ns(), os.stat(log).st_ctime_ns)
        self._executed: set[str] = set()
        self._read: set[str] = set()

    def prefixed(self, argv: Sequence[str], environment: Mapping[str, str], cwd: str, *, conducted: bool = False) -> list[str]:
        return list(argv)

    def is_tracer(self, pid: int) -> bool:
        return False

    def look(self, pids: Iterable[int]) -> None:
        for pid in pids:
            with contextlib.suppress(OSError):
                self._executed.add(os.readlink("/proc/%d/exe" % pid))
            with contextlib.suppress(OSError):
                self._read |= mapped(str(pid))

    def limit(self) -> None:
        pass

    def end(self, candidates: Callable[[], Iterable[int]] | None = None, seconds: float = SETTLE_S) -> None:
        pass

    def trace(self, stderr: str | None = None, check_stop: Callable[[], None] = nothing, *, living: bool = False) -> Trace:
        executed = {path for path in self._executed if path.startswith("/")}
        return Trace(
            Maps.name,
            executed=tuple(sorted(executed)),
            read=tuple(sorted(self._read - executed)),
            reasons=("only files that were mapped into memory were seen",),
        )


def mapped(process: str) -> set[str]:
    """Return the paths of the files that a process has mapped. A path that has been removed ends with ` (deleted)`."""
    paths = set()
    with open("/proc/%s/maps" % process, "rb") as file:
        for line in file:
            fields = line.split(None, 5)
            if len(fields) == 6 and fields[4] != b"0" and fields[5].startswith(b"/"):
                paths.add(os.fsdecode(fields[5].rstrip(b"\n").replace(b"\\012", b"\n")))
    return paths


WAYS: tuple[Way, ...] = (Strace(), Maps())
"""The ways to observe, the best one first. The last one can always be used on Linux."""


def usable(ways: Iterable[Way] = WAYS) -> tuple[Way | None, tuple[str, ...]]:
    """Return the best way that can be used here, and why each better one cannot."""
    troubles: list[str] = []
    for way in ways:
        trouble = way.trouble()
        if trouble is None:
            return way, tuple(troubles)
        troubles.append("%s: %s" % (way.name, trouble))
    return None, tuple(troubles)


def gentle() -> tuple[Way | None, tuple[str, ...]]:
    """Return the way that cannot change what a run does, as `usable` does."""
    return usable(WAYS[-1:])
