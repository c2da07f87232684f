"""Observation of a run: the files that it executed, read, looked for and did not find, listed, wrote and removed.

This file needs only the standard library (Python 3.8 or newer), and works alone on a node. A *way* to observe is an object with
the methods of `Way`. There are two: `Strace`, which sees everything that is described here, and `Maps`, which needs nothing but
/proc, and sees only files that are mapped into memory. For each run, a way gives an `Observation`. A caller

1. asks `way.trouble()` once, and observes with another way if there is a reason not to use this one;
2. starts `observation.prefixed(argv, environment, cwd)` instead of argv, in the same environment, folder, session and group;
3. takes no process for one of the run's for which `observation.is_tracer(pid)` holds: it must not be signalled or counted;
4. calls `observation.look(pids)` with the run's processes while they live, as often as it likes (once a second is enough);
5. has ended all processes of the run, calls `observation.end()`, which waits for the tracer, and then `observation.trace()`.

All of this must happen before the run's folder is removed. `observation.trace(living=True)` tells what programs that go on have
done until now. Of what `trace` returns,

- `reasons` is empty if everything was seen; only such a trace is `complete`. A caller reuses no result because of another one.
- `disturbed` is not None if the observation may have changed what the run did. The caller executes this run again, unobserved.
- `notes` name what cannot be seen in principle: what a daemon or another machine has read for the run.

Then `Names.inputs` leaves out what is no input of the run, `contents` hashes the rest, and `Names.name` gives each path a name
that is the same on every machine.

What is seen
------------
`Strace` needs the program strace 5.3 or newer with all of OPTIONS, on Linux, for any user. It is started as `strace -DDD`: the
program stays the caller's own child, with its pid, group, session, exit status and signal, and its descriptors. The tracer
becomes an orphan in a session of its own, so no signal to the run's group reaches it. While a process is traced, its state in
/proc/PID/stat is `t` instead of `T` if a signal has stopped it. strace is started in the run's environment, and so an
LD_PRELOAD there is loaded into it, too. These calls are traced (CALLS), each for about 0.1 ms:

- those that execute, open, make, link, rename, remove and truncate files, list folders, or change the working directory;
- those that ask for the status of a path (stat, access, readlink): a program that tests whether a plug-in exists depends on the
  answer, and nothing else shows it. They cost most where Python imports many modules;
- those that start a process, so that a log that lacks the end of any process is known to be incomplete;
- rare ones by which a program escapes observation (see `ESCAPES`).

Measured with strace 6.1 on a machine with 2 cores and other load, the quickest of 5 to 30, in ms:

    command                                    calls   unobserved   without status calls   as it is
    true                                           7          0.8                    4.3        4.7
    sh with 200 forks of true                  2,068        146                    160        223
    the example swarm (MuJoCo)                 2,033        298                    298        377
    import pandas, pyarrow, matplotlib, scipy  8,717      1,485                  1,570      1,949

The calls that start processes cost nothing that could be measured. Reading a log takes about 10 µs a line.

A path is absolute. Relative ones are resolved with the working directory of their process, which is followed through chdir,
fchdir and new processes; the folder that strace prints for AT_FDCWD corrects it where it is printed. For an opened file it is
the real path, without links, that the kernel named when the file was opened. If the program asked for another one, `links` maps
what it asked for to the real path: if a link is changed, the run changes too. For an executed file the link is followed after
the run. Names are str with surrogate escapes (os.fsdecode), because a name need not be UTF-8.

- `executed`: programs, scripts, and what the kernel opens for them and strace does not show: the interpreter in a script's
  first line, and the loader that an ELF file names (PT_INTERP). They are derived from the files after the run.
- `read`: files that were opened for reading (also O_RDWR, unless the open call made or emptied the file), and that the run had
  not made itself. A file that the run made, emptied, or moved to this place after having made it, is not an input. A file that
  existed before and was moved or linked elsewhere by the run counts as read under its old name when it is read.
- `found`: paths that exist, and of which the run asked for the status, or that it opened as a folder or by O_PATH. Those in
  `read` are not repeated here.
- `missed`: paths that the run looked for and that did not exist (ENOENT, ENOTDIR), or are links to what does not exist, unless
  the run had removed them itself.
- `refused`: paths that exist, perhaps, and that the run was not permitted to use.
- `listed`: folders whose names the run has read.
- `written`: files, links and folders that the run made or opened for writing, and did not remove or rename later.
- `removed`: names that existed before, and that the run removed or renamed, and did not make again. What the run made and
  removed again is in neither list. Unnamed files (O_TMPFILE) count when they are linked to a name.
- `reread`: regular files that the run wrote and later read, executed, or moved into its own folder, so that another run which
  writes a file of this name at the same time may replace what it reads. A file that is opened for both counts, unless it is
  only a lock (see `is_lock`). So does a link to its own files that the run made and followed. `reread_new` has those of which
  the run made the name itself (O_EXCL, as mkstemp does) or a folder above it, and had not removed it before: no other run can
  have the same name at the same time, unless it removes that name or finds that folder.
- `channels`: names by which the run may exchange data with others on this host, each with a use (see `Channels`): ports of TCP
  and UDP, Unix sockets, multicast groups, System V keys, and POSIX message queues.

Not seen: changes of rights, owners, times and attributes; what was open before the program started; files that another process
has opened and passed through a socket (`notes` say that the run connected to one; recvmsg is not traced, because it may be
called too often); what memory that is shared by System V keys contains (`notes` say so); clients of UDP, because sends and
receives are not traced. Of a file in `found`, only its existence is seen, although a program may use its size and times.

A log is complete if each of its lines is understood, and each process that appears in it, or that a traced call has started,
has ended in it. So a log that was cut anywhere, or whose tracer was killed, is never complete. When the tracer is killed, all
traced calls of the program fail from then on (ENOSYS, because of --seccomp-bpf): such a run is disturbed. So is one in which a
program traces others or itself, or is setuid (the tracer's filter sets no_new_privs, also for root), and one on whose standard
error strace has written: it complains there if the log's disk is full, and if a thread that is not the first executes another
program. The caller calls `observation.limit()` at times while the run lives: a log of more than LOG_BYTES is emptied then, and
the observation is cut off; the run itself is not disturbed.

strace prints paths whole and escaped, whatever `-s` says, so `-s 0` leaves out only the words of commands. `trouble` checks
once that the log can be read, and that a long path in it is whole.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import shutil
import stat
import struct
import subprocess
import sys
import tempfile
import time
from typing import IO, Callable, Iterable, Iterator, Mapping, NamedTuple, Protocol, Sequence

from sierra.worker.files import entries_of, is_full
from sierra.worker.processes import all_processes, read_proc, state_of

OLDEST = (5, 3)  # the first version of strace with --seccomp-bpf
FILES = (
    "execve",
    "execveat",
    "open",
    "openat",
    "openat2",
    "creat",
    "truncate",
    "rename",
    "renameat",
    "renameat2",
    "unlink",
    "unlinkat",
    "link",
    "linkat",
    "symlink",
    "symlinkat",
    "mkdir",
    "mkdirat",
    "rmdir",
    "mknod",
    "mknodat",
    "getdents",
    "getdents64",
    "chdir",
    "fchdir",
    "name_to_handle_at",
    "open_by_handle_at",
    "uselib",
)
STATUS = (
    "access",
    "faccessat",
    "faccessat2",
    "stat",
    "lstat",
    "stat64",
    "lstat64",
    "newfstatat",
    "fstatat64",
    "statx",
    "readlink",
    "readlinkat",
)
PROCESSES = ("clone", "clone3", "fork", "vfork")
ESCAPES = {
    "io_uring_setup": "it used io_uring, whose reads cannot be seen",
    "chroot": "it changed its root folder",
    "pivot_root": "it changed its root folder",
    "mount": "it changed its mounts",
    "umount2": "it changed its mounts",
    "move_mount": "it changed its mounts",
    "open_tree": "it changed its mounts",
    "setns": "it entered another namespace",
    "pidfd_getfd": "it took an open file from another process",
    "uselib": "it loaded a library by uselib",
}
TALKS = ("socket", "bind", "connect", "listen", "setsockopt", "shmget", "semget", "msgget", "mq_open")
RARE = (*ESCAPES, "unshare", "seccomp", "ptrace", *TALKS)
CALLS = (*FILES, *STATUS, *PROCESSES, *(name for name in RARE if name not in FILES))
QUIET = ("chld", "urg", "winch", "cont", "prof", "vtalrm")
"""Signals that are frequent, or end no process. The log says that a signal has ended a process only if it notes this signal."""
OPTIONS = ("-DDD", "-f", "--seccomp-bpf", "-q", "-A", "-y", "-s", "0", "-e", "signal=!" + ",".join(QUIET))
LOG_BYTES = 256 << 20
LINE_BYTES = 1 << 18  # names of 4096 bytes, each of them as \377, and 32 words
MOST_PATHS = 1 << 20
MOST_WAITING = 1 << 16  # lines of processes whose parent is not known yet
MOST_MOVES = 10_000_000  # names to look through for renamed folders in which the run has made files
SETTLE_S = 10.0  # for the tracer to end after all processes of the run have ended
PROBE_S = 20.0
CHUNK = 1 << 20
MOST_NOTES = 100
MOST_NAMED = 3  # files that were changed while a run read them
SCRIPTS = 5  # scripts whose interpreters are scripts: the kernel allows as many
HEAD_BYTES = 4096


class Trace(NamedTuple):
    """The files that a run used and changed: see the module's text. Paths are sorted."""

    way: str
    executed: tuple[str, ...] = ()
    read: tuple[str, ...] = ()
    found: tuple[str, ...] = ()
    missed: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    listed: tuple[str, ...] = ()
    written: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    reread: tuple[str, ...] = ()
    reread_new: tuple[str, ...] = ()
    links: Mapping[str, str] = {}
    channels: tuple[tuple[str, str], ...] = ()
    reasons: tuple[str, ...] = ()
    disturbed: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """True if everything was seen."""
        return not self.reasons

    @property
    def reason(self) -> str | None:
        """Why the trace is not complete, in one line; None if it is."""
        return "; ".join(self.reasons) or None


def filled(trace: Trace, lists: Mapping[str, tuple[str, ...]]) -> Trace:
    """Return a trace with other lists, by their names (LISTS)."""
    return trace._replace(
        executed=lists["executed"],
        read=lists["read"],
        found=lists["found"],
        missed=lists["missed"],
        refused=lists["refused"],
        listed=lists["listed"],
        written=lists["written"],
        removed=lists["removed"],
    )


class Observation(Protocol):
    """The observation of one run: see the module's text for the order of calls. Nothing here raises an error of a way's own."""

    began: int
    """When it began, in ns since the epoch, by the clock that files of the log's file system get their times from."""

    def prefixed(self, argv: Sequence[str], environment: Mapping[str, str], cwd: str, *, conducted: bool = False) -> list[str]:
        """Return the words to start. They are argv itself if the program would not start: the error is then the usual one.

        `conducted`: this program only starts those of the run (see `conductor`). What it does itself is left out.
        """

    def is_tracer(self, pid: int) -> bool:
        """Return whether a process belongs to the observation, and not to the run."""

    def look(self, pids: Iterable[int]) -> None:
        """Look at living processes of the run. May be called at any time, also with processes that have ended."""

    def limit(self) -> None:
        """Keep the log below its limit. Call it at times while the run lives."""

    def end(self, candidates: Callable[[], Iterable[int]] | None = None, seconds: float = SETTLE_S) -> None:
        """Wait until the tracer has ended, and kill it after so many seconds.

        `candidates` are the processes among which it may be (by default all), for a caller that is its subreaper. A process
        whose tracer hangs does not end for its parent, even if it is killed. So call this with 0 seconds, too, if a run that
        was killed does not end.
        """

    def trace(self, stderr: str | None = None, check_stop: Callable[[], None] = ..., *, living: bool = False) -> Trace:
        """Return what was seen. Never fails, whatever the log contains; calls `check_stop` at times, which may raise.

        `stderr` is the file with the run's standard error. A tracer writes its own messages there, too. `living`: return what
        was seen until now; call it by one thread at a time.
        """


class Way(Protocol):
    """A way to observe runs. An object without state except what `trouble` has found out; used by several threads."""

    name: str
    sees: frozenset[str]
    """The lists of `Trace` that it fills completely. If one is lacking, no trace of it is complete."""

    def trouble(self) -> str | None:
        """Return why this way cannot be used here, in one line; None if it can. Finds out once."""

    def begin(self, log: str, cwd: str, own: Sequence[str] = ()) -> Observation:
        """Begin to observe a run that starts in the folder `cwd`. Its own folders are that above `cwd`, and `own`.

        `log` is a file that is made, outside the run's folder and on the same file system. The caller removes it.
        """


REREAD = ("reread", "reread_new")
MOST_REREAD = 1000
TOO_MANY_REREAD = "it wrote and read more than %d files outside its folder" % MOST_REREAD
LISTS = frozenset(("executed", "read", "found", "missed", "refused", "listed", "written", "removed"))


def nothing() -> None:
    """Do nothing: the default of `check_stop`."""


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
        self._cut = False
        self._started = False
        self._conducted = False
        self._late = False
        self._unfit: str | None = None
        self._reader: Log | None = None
        self._offset = 0
        """Number of bytes of the log that were read while the programs go on."""
        self._said = 0
        """Number of bytes of standard error that were read then."""
        self._latest: Trace | None = None
        """What was seen until the last look."""
        self._prefix = (program, *OPTIONS, "-e", "trace=" + ",".join("?" + name for name in CALLS), "-o", log, "--")
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
            if self._cut or os.stat(self._log).st_size > LOG_BYTES:
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
        if not living or self._latest is None or before != self._offset or log.is_damaged or self._cut:
            self._latest = log.trace(Strace.name, cut=self._cut, living=living)
        return self._latest

    def _complains(self, stderr: str, check_stop: Callable[[], None]) -> bool:
        """Return whether the tracer has written to a file since the last look."""
        words = os.fsencode(self._program) + b": "
        begin = max(0, self._said - len(words))
        self._said = size_of(stderr)
        return contains(stderr, words, check_stop, begin)


def parsed(log: IO[bytes], cwd: str) -> Trace:
    """Return what a log of strace with OPTIONS and CALLS says; the first process began in the folder `cwd`."""
    reader = Log(os.fsencode(cwd))
    reader.read(log)
    return reader.trace(Strace.name)


def size_of(path: str) -> int:
    """Return the size of a file; 0 if there is none."""
    try:
        return os.stat(path).st_size
    except OSError:
        return 0


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


def starts(path: str, depth: int = 0) -> bool:
    """Return whether the kernel knows how to execute a file, and what it needs for this is there."""
    try:
        interpreter = interpreter_of(path)
    except (OSError, ValueError):
        return False
    if not interpreter:
        return True
    if depth > SCRIPTS or not os.path.isabs(interpreter):
        return False
    return os.access(interpreter, os.X_OK) and starts(interpreter, depth + 1)


def interpreter_of(path: str) -> str | None:
    """Return the path of the program that the kernel executes for a file, as the file names it; None for a static program.

    Raises OSError if the file cannot be read, and ValueError if it is neither ELF nor a script.
    """
    with open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
        if head.startswith(b"#!"):
            words = head[2:].split(b"\n", 1)[0].split()
            if not words or b"\0" in words[0]:
                raise ValueError("a script without an interpreter")
            return os.fsdecode(words[0])
        if not head.startswith(b"\x7fELF"):
            raise ValueError("neither ELF nor a script")
        return loader_of(head, file)


def loader_of(head: bytes, file: IO[bytes]) -> str | None:
    """Return the loader that an ELF file names (PT_INTERP, see elf(5)); None if it needs none."""
    wide, order = head[4:5] == b"\x02", ">" if head[5:6] == b"\x02" else "<"
    try:
        at, size, count = struct.unpack_from(order + ("32xQ14xHH" if wide else "28xI10xHH"), head)
        file.seek(at)
        table = file.read(size * count)
        for number in range(count):
            if wide:
                kind, offset, length = struct.unpack_from(order + "I4xQ16xQ", table, number * size)
            else:
                kind, offset, length = struct.unpack_from(order + "II8xI", table, number * size)
            if kind == 3:
                file.seek(offset)
                return os.fsdecode(file.read(min(length, HEAD_BYTES)).split(b"\0", 1)[0])
    except struct.error:
        raise ValueError("a damaged ELF file") from None
    return None


class Folder:
    """A working directory, which threads share; None if it is unknown."""

    __slots__ = ("path",)

    def __init__(self, path: bytes | None) -> None:
        self.path = path


class Process:
    """A process or thread in a log: its working directory, and the beginning of a call that has not returned."""

    __slots__ = ("begun", "folder", "moved", "seen")

    def __init__(self, folder: Folder, *, seen: bool) -> None:
        self.folder = folder
        self.seen = seen
        """Whether it has a line of its own, or only the call that started it."""
        self.begun = b""
        self.moved = False
        """Whether its call is an execve of another thread, which has taken its id."""


END = re.compile(rb"\) += ")
CALL = re.compile(rb'(\w+\((?:"(?:[^"\\]|\\.)*"|<(?:[^<>\\]|\\.)*>|[^"<])*?)\) += (?=-?\d|\?)(.*)', re.S)
RESULT = re.compile(rb"(-?\d+|\?)(?: <unavailable>)?(?:<((?:[^<>\\]|\\.)*)>(?:\(deleted\))?)?(?: (?:(E[A-Z0-9]+) )?\(.*\))?")
RESUMED = re.compile(rb"<\.\.\. (\w+) resumed>")
MOVED = re.compile(rb"(.*) <pid changed to (\d+) \.\.\.>")
SUPERSEDED = re.compile(rb"\+\+\+ superseded by execve in pid (\d+) \+\+\+")
OVER = re.compile(rb"\+\+\+ (?:exited with \d+|killed by \w+(?: \(core dumped\))?) \+\+\+")
UNFINISHED = b" <unfinished ...>"
NAME = rb'"((?:[^"\\]|\\.)*)"(\.\.\.)?'
AT = rb"(AT_FDCWD|-?\d+)(?:<((?:[^<>\\]|\\.)*)>(?:\(deleted\))?)?"
ONE = re.compile(rb"()()" + NAME)
ONE_AT = re.compile(AT + rb", " + NAME)
TWO = re.compile(rb"()()" + NAME + rb", ()()" + NAME)
TWO_AT = re.compile(AT + rb", " + NAME + rb", " + AT + rb", " + NAME)
LINK_AT = re.compile(rb"()()" + NAME + rb", " + AT + rb", " + NAME)
OPENED = re.compile(AT)
UNIX = re.compile(rb'sa_family=AF_UNIX, sun_path=(@?)"((?:[^"\\]|\\.)*)"')
INTERNET = re.compile(rb'sa_family=AF_INET6?, sin6?_port=htons\((\d+)\).*?"([^"]*)"')
ESCAPED = re.compile(rb"\\([0-7]{1,3}|x[0-9a-f]{2}|.)", re.S)
C_ESCAPES = {b"n": b"\n", b"t": b"\t", b"r": b"\r", b"v": b"\v", b"f": b"\f"}
DOTS = re.compile(rb"/(?:\.?/)+|/\.$")
MISSING = frozenset((b"ENOENT", b"ENOTDIR"))
FORBIDDEN = frozenset((b"EACCES", b"EPERM", b"EROFS"))
PRESENT = frozenset(
    (
        b"EEXIST",
        b"EISDIR",
        b"EINVAL",
        b"ELOOP",
        b"ENXIO",
        b"ETXTBSY",
        b"ENOEXEC",
        b"EBUSY",
        b"ENOTEMPTY",
        b"EXDEV",
        b"E2BIG",
        b"ELIBBAD",
        b"EFBIG",
        b"EOVERFLOW",
    )
)
CONNECTED = frozenset((None, b"EINPROGRESS", b"EAGAIN", b"EINTR"))
UNREADABLE = frozenset((b"EFAULT", b"?"))
FLAG = re.compile(rb"O_[A-Z]+")
CONTENT = frozenset((b"O_WRONLY", b"O_RDWR", b"O_ACCMODE", b"O_TRUNC"))
"""Flags of a call that may change the content of a file."""
BOTH, EMPTIED, ALONE = range(3)
"""Uses of a file that a run has written: opened for writing and reading, the same and emptied, or only read."""
LOCK_BYTES = 64
LOCK = re.compile(rb"(?:.*[/._-])?lo?ck(?:file)?|.*/server-[0-9]+\.xkm", re.I | re.S)
"""Names of locks, and of files that only the X server reads that has locked the display of this number."""
FOLDERS = frozenset((b"O_PATH", b"O_DIRECTORY"))
WRITING = frozenset((b"O_WRONLY", b"O_RDWR", b"O_ACCMODE", b"O_TRUNC", b"O_CREAT"))
MADE = b""
"""The origin of a file whose content the run has made."""


def plain(text: bytes) -> bytes:
    """Return a path that strace has printed with escapes."""
    if b"\\" in text:
        text = ESCAPED.sub(unescaped, text)
    if b"\0" in text:
        raise Damaged
    return text


def unescaped(match: re.Match[bytes]) -> bytes:
    code = match.group(1)
    if code[:1].isdigit():
        return bytes([int(code, 8) & 0xFF])
    if len(code) == 3:
        return bytes([int(code[1:], 16)])
    return C_ESCAPES.get(code, code)


LISTENED, REUSED, IN_USE, SEARCHED, TALKED = "listened", "reused", "in_use", "searched", "connected"
SOCKET = re.compile(rb"-?\d+<socket:\[(\d+)\]>")
BOUND = re.compile(rb'sa_family=AF_INET6?, sin6?_port=htons\((\d+)\), (?:sin6_flowinfo=[^,]*, )?[^"]*"([^"]*)"')
GROUP = re.compile(rb'IPV?6?_(?:ADD_MEMBERSHIP|ADD_SOURCE_MEMBERSHIP|JOIN_GROUP)\b[^"]*"([0-9a-fA-F.:]+)"')
KEY = re.compile(rb"(0x[0-9a-f]+), ")
SHARED_KEYS = {b"shmget": "shared memory", b"semget": "semaphore", b"msgget": "message queue"}
DISCOVERY = ("224.0.0.251:5353/udp", "ff02::fb:5353/udp", "239.255.255.250:1900/udp")
"""Groups by which programs only look for devices and services of the network: mDNS and SSDP."""
MOST_CHANNELS = 1000
FILE_NAMES = ("/", "{", "@/")
"""The beginnings of names of files, and of displays and daemons.

A connection to a socket with such a name says nothing, unless another run has made it.
"""
NAME_SERVER = "127.0.0.1:53"


class Socket:
    """A socket of a run: `stream` is None if its type is unknown."""

    __slots__ = ("groups", "name", "pid", "port", "reuses", "stream")

    def __init__(self, *, stream: bool | None = None) -> None:
        self.stream = stream
        self.reuses = False
        self.name: str | None = None
        self.pid = b""
        """The process that has bound it."""
        self.port = 0
        self.groups: set[str] = set()


class Channels:
    """The names by which a run may exchange data with others on this host, and how it has used them.

    - `listened`: the run has bound a name that it, or its author, has chosen. Nobody else can have it at the same time, but
      another run that fails to bind it may use this run's server.
    - `reused`: the same with an option by which several programs may bind a name at the same time (SO_REUSEPORT, and for UDP
      SO_REUSEADDR), a multicast group, or a System V key or a message queue, which belong to all.
    - `in_use`: the name was bound by another program (EADDRINUSE), and not by an earlier program of the run.
    - `searched`: so was this one, but then the same process bound another one, and no process of the run connected to the
      first. The one that it found in this way has this use, too.
    - `connected`: the run has connected to a name that no process of its own has bound. UDP sockets are left out: the C library
      connects them to find its own address, and whether they were used is not seen.

    All addresses of this host count as 127.0.0.1. A port that the kernel chooses (0), and a socket in a folder that the run has
    made itself, are the run's own.
    """

    def __init__(self) -> None:
        self._sockets: dict[bytes, Socket] = {}
        self._bound: set[str] = set()
        self._in_use: dict[str, set[bytes]] = {}
        self._found: set[bytes] = set()
        """Processes that have bound something after they could not bind something else."""
        self._connected: dict[tuple[str, str], None] = {}
        """Names to which it has connected, with the address."""
        self._shared: set[str] = set()

    def socket(self, call: Call) -> Socket:
        """Return the socket in the first argument of a call."""
        match = SOCKET.match(call.words)
        return self._sockets.setdefault(match.group(1), Socket()) if match else Socket()

    def make(self, call: Call) -> None:
        """A socket is made."""
        number = (call.path or b"").partition(b"socket:[")[2].rstrip(b"]")
        if number and b"AF_INET" in call.words:
            self._sockets[number] = Socket(stream=b"SOCK_STREAM" in call.words)

    def set_option(self, call: Call) -> None:
        if call.error:
            return
        one = self.socket(call)
        if b", SO_REUSEPORT, [1" in call.words or (one.stream is False and b", SO_REUSEADDR, [1" in call.words):
            one.reuses = True
        elif match := GROUP.search(call.words):
            one.groups.add(match.group(1).decode())

    def bind(self, call: Call, unix: str | None) -> None:
        """A socket is bound; `unix` is the name of a Unix socket that others can have, too."""
        one, match = self.socket(call), BOUND.search(call.words)
        name = unix
        if match is not None:
            one.port = int(match.group(1))
            name = self._port(one) if one.port else None
        if call.error == b"EADDRINUSE":
            self._fail(name, call.pid)
        elif not call.error and (match or unix):
            self._found.add(call.pid)
            one.name, one.pid = name, call.pid
            self._bound.update([name] if name else [])

    def listen(self, call: Call) -> None:
        """A bound socket listens: with SO_REUSEADDR, only this may fail."""
        one = self.socket(call)
        if call.error == b"EADDRINUSE" and one.name:
            if not any(other.name == one.name for other in self._sockets.values() if other is not one):
                self._bound.discard(one.name)
            self._fail(one.name, call.pid)
            one.name = None

    def _fail(self, name: str | None, pid: bytes) -> None:
        if name is not None and name not in self._bound:
            self._in_use.setdefault(name, set()).add(pid)
            self._found.discard(pid)

    def connect(self, call: Call, unix: str | None, remote: re.Match[bytes] | None) -> None:
        """A socket is connected, or will be."""
        one = self.socket(call)
        if unix is not None:
            self._connected[(unix, "")] = None
        elif remote is not None and one.stream is not False and int(remote.group(1)):
            self._connected[("127.0.0.1:%d" % int(remote.group(1)), remote.group(2).decode())] = None

    def share(self, call: Call) -> None:
        """A System V key or a message queue is used."""
        if call.name == b"mq_open":
            name = call.words.partition(b'"')[2].partition(b'"')[0]
            self._shared.add("message queue /" + os.fsdecode(ESCAPED.sub(unescaped, name)).lstrip("/"))
        elif match := KEY.match(call.words):
            self._shared.add("%s %s" % (SHARED_KEYS[call.name], match.group(1).decode()))

    def _port(self, one: Socket) -> str:
        return "127.0.0.1:%d%s" % (one.port, "/udp" if one.stream is False else "")

    def used(self) -> tuple[tuple[str, str], ...]:
        """Return the names and their uses, sorted."""
        uses = {(name, REUSED) for name in self._shared}
        bound = {one.name for one in self._sockets.values() if one.name} | self._bound
        talked = {name for name, address in self._connected if name not in bound and (not address or is_own_address(address))}
        looking = {pid for name, pids in self._in_use.items() if name not in talked for pid in pids & self._found}
        uses |= {(one.name, SEARCHED) for one in self._sockets.values() if one.name and one.pid in looking}
        uses |= {(name, TALKED) for name in talked}
        for one in self._sockets.values():
            if one.groups and one.port:
                bound.discard(one.name)
                uses |= {("%s:%d/udp" % (group, one.port), REUSED) for group in one.groups}
            elif one.name and one.reuses:
                uses.add((one.name, REUSED))
        uses |= {(name, LISTENED) for name in bound if name and not uses & {(name, REUSED), (name, SEARCHED)}}
        for name, pids in self._in_use.items():
            uses.add((name, SEARCHED if pids <= self._found and name not in talked else IN_USE))
        return tuple(sorted((name, use) for name, use in uses if name not in DISCOVERY)[:MOST_CHANNELS])


def is_own_address(address: str) -> bool:
    """Return whether an IP address is one of this host: a socket can be bound to it."""
    import socket

    address = address[7:] if address.startswith("::ffff:") else address
    if address.startswith("127.") or address in ("::1", "0.0.0.0", "::"):  # noqa: S104 - compared, not bound
        return True
    try:
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.bind((address, 0))
    except OSError:
        return False
    return True


DIGITS = re.compile("[0-9]+")
DISCOVERY_OF_GAZEBO = "239.255.0.7:"


def with_channels(trace: Trace, ports: Iterable[int], theirs: Iterable[str], environment: Mapping[str, str]) -> Trace:
    """Return a trace without the channels that are a run's own, or that are shared on purpose.

    These are names with numbers in `ports`, those of shared services (`theirs`), and Gazebo's group if a partition is declared.
    """
    numbers, names = set(map(str, ports)), set(theirs)
    parted = "GZ_PARTITION" in environment or "IGN_PARTITION" in environment

    def is_own(name: str) -> bool:
        return name in names or (parted and name.startswith(DISCOVERY_OF_GAZEBO)) or bool(numbers & set(DIGITS.findall(name)))

    return trace._replace(channels=tuple(one for one in trace.channels if not is_own(one[0])))


def is_doubtful(channels: Iterable[tuple[str, str]]) -> bool:
    """Return whether a second run must be observed, to know whether it uses one of these names, too."""
    return any(
        use not in (SEARCHED, TALKED) or (use == TALKED and not name.startswith(FILE_NAMES) and name != NAME_SERVER)
        for name, use in channels
    )


class Damaged(Exception):
    """A line of a log is not what strace writes, or is not understood."""


class Call(NamedTuple):
    """A call that has returned."""

    pid: bytes
    process: Process
    name: bytes
    words: bytes
    """Its arguments."""
    number: int
    """What it returned; negative for an error."""
    path: bytes | None
    """The path of the descriptor that it returned."""
    error: bytes | None


class Log:
    """The reader of a log of strace: it is fed line by line, then asked for the trace.

    Content that the run moves is followed by `_origins`: for each name that the run has given to something, where its content
    comes from. That is MADE if the run has made it, or else the name under which it was there before.
    """

    def __init__(self, cwd: bytes, own: Iterable[bytes] = (), *, conducted: bool = False) -> None:
        """Begin in the folder `cwd`. The run's own folders are that above it, and `own`.

        `conducted`: what the first process does itself is not the run's doing.
        """
        self._cwd = cwd
        self._own_folders = tuple(folder + b"/" for folder in (os.path.dirname(cwd), *own))
        self._conducted = conducted
        self._conductor: bytes | None = None
        self._processes: dict[bytes, Process] = {}
        self._any = self._started = False
        self._starting: dict[bytes, Process] = {}
        """The processes that are just starting another one, by their ids."""
        self._adopted: dict[bytes, bytes] = {}
        """Processes that appeared before the call that started them returned, by the id of their parent."""
        self._waiting: dict[bytes, list[bytes]] = {}
        """The lines of processes whose parent is not known yet, by their ids."""
        self._kept = self._strays = self._damaged = self._moves = 0
        self._reasons: dict[str, None] = {}
        self._notes: dict[str, None] = {}
        self._disturbed: str | None = None
        self._cut: str | None = None
        """Why the rest of the log was not read."""
        self._executed: dict[bytes, None] = {}
        self._read: set[bytes] = set()
        self._found: set[bytes] = set()
        self._missed: set[bytes] = set()
        self._refused: set[bytes] = set()
        self._listed: set[bytes] = set()
        self._written: set[bytes] = set()
        self._removed: set[bytes] = set()
        self._links: dict[bytes, bytes] = {}
        self._read_links: set[bytes] = set()
        self._changed: set[bytes] = set()
        """Names under which the run has written content, also if it has removed them since."""
        self._reread: dict[bytes, int] = {}
        """Those that it has used again, and the surest of BOTH, EMPTIED and ALONE."""
        self._reread_new: dict[bytes, int] = {}
        """The same for names that it has made itself, or a folder above them."""
        self._made_links: set[bytes] = set()
        """Links to its own files that it has made outside its folder."""
        self._origins: dict[bytes, bytes] = {}
        self._moved_old = False
        """Whether the run has moved anything that existed before."""
        self._new: set[bytes] = set()
        """Names that certainly did not exist before the run."""
        self._absent: set[bytes] = set()
        """Names that the run has removed."""
        self._holders: set[bytes] = set()
        """All folders above the names that the run has made."""
        self._folders: dict[bytes, bytes] = {}
        """The real paths of folders."""
        self._channels = Channels()

    def read(self, file: IO[bytes], check_stop: Callable[[], None] = nothing, *, living: bool = False) -> int:
        """Read a log, at most LOG_BYTES of it; return how many bytes it has. `living`: leave out a line without an end."""
        left, count = LOG_BYTES, 0
        for number, line in enumerate(iter(lambda: file.readline(LINE_BYTES), b"")):
            if living and not line.endswith(b"\n") and len(line) < LINE_BYTES:
                break
            count += len(line)
            if number % 4096 == 0:
                check_stop()
                if self._too_many():
                    self._cut = "it used more than %d files" % MOST_PATHS
                    break
            left -= len(line)
            if left < 0:
                self._cut = "its log is longer than %d bytes" % LOG_BYTES
                break
            self.add(line)
        if not living:
            self._adopt_all()
        return count

    def damage(self, reason: str) -> None:
        """Note that the log or the tracer is not as it should be, and so perhaps the run is not either."""
        self._reasons[reason] = None
        self._disturbed = self._disturbed or reason

    @property
    def is_damaged(self) -> bool:
        return self._disturbed is not None

    def add(self, line: bytes) -> None:
        """Add a line. One that is not understood is counted."""
        try:
            self._add(line)
        except (Damaged, ValueError):
            self._damaged += 1

    def _too_many(self) -> bool:
        return len(self._read) + len(self._found) + len(self._missed) + len(self._written) + len(self._origins) > MOST_PATHS

    def _add(self, line: bytes) -> None:
        pid, _, rest = line.partition(b" ")
        if not pid.isdigit() or not rest.endswith(b"\n"):
            raise Damaged
        rest = rest[:-1].lstrip(b" ")
        process = self._processes.get(pid) or self._appear(pid)
        if process is None:
            self._keep(pid, line)
            return
        process.seen = True
        if rest.startswith(b"+++ "):
            self._end(pid, rest)
        elif not rest.startswith(b"--- "):  # else a signal
            self._piece(pid, process, rest)

    # Processes: which ones there are, and in which folder they work

    def _appear(self, pid: bytes) -> Process | None:
        """Return the process whose first line is here; None if its parent is not known yet."""
        if not self._any:
            self._any = True
            self._conductor = pid if self._conducted else None
            return self._enter(pid, Folder(self._cwd), seen=True)
        if pid in self._waiting or len(self._starting) != 1:
            return None
        if not all(process.seen for process in self._processes.values()):
            return None  # in another namespace, its own parent may have called it by another id
        ((parent, starter),) = self._starting.items()
        del self._starting[parent]
        self._adopted[parent] = pid
        return self._enter(pid, inherited(starter.folder, starter.begun), seen=True)

    def _enter(self, pid: bytes, folder: Folder, *, seen: bool) -> Process:
        process = self._processes[pid] = Process(folder, seen=seen)
        return process

    def _keep(self, pid: bytes, line: bytes) -> None:
        """Keep a line until the parent of its process is known."""
        self._waiting.setdefault(pid, []).append(line)
        self._kept += 1
        if self._kept > MOST_WAITING:
            self._adopt_all()

    def _adopt(self, pid: bytes, folder: Folder) -> None:
        lines = self._waiting.pop(pid)
        self._kept -= len(lines)
        self._enter(pid, folder, seen=True)
        for line in lines:
            self.add(line)

    def _adopt_all(self) -> None:
        """Add the lines of processes whose parents remain unknown, and so their folders."""
        while self._waiting:
            self._strays += 1
            self._adopt(next(iter(self._waiting)), Folder(None))

    def _end(self, pid: bytes, rest: bytes) -> None:
        if OVER.fullmatch(rest):
            del self._processes[pid]
            if self._starting.pop(pid, None) is not None:
                self._reasons["it was killed while it started a process"] = None
            self._adopted.pop(pid, None)
            return
        superseded = SUPERSEDED.fullmatch(rest)
        if superseded is None:
            raise Damaged
        if not self._processes[pid].moved:  # else an earlier line has told
            thread = self._processes.get(superseded.group(1))
            if thread is None or not thread.begun.startswith(b"execve"):
                raise Damaged
            self._move_process(superseded.group(1), thread, thread.begun, pid)

    def _piece(self, pid: bytes, process: Process, rest: bytes) -> None:
        """Add a call, or a part of one."""
        if rest.startswith(b"<... "):
            match = RESUMED.match(rest)
            if match is None or not process.begun.startswith(match.group(1) + b"("):
                raise Damaged
            rest, process.begun = process.begun + rest[match.end() :], b""
        elif process.begun:
            raise Damaged
        if rest.endswith(UNFINISHED):
            process.begun = rest[: -len(UNFINISHED)]
            if process.begun.partition(b"(")[0] in STARTERS:
                self._starting[pid] = process
            return
        moved = MOVED.fullmatch(rest) if rest.endswith(b" ...>") else None
        if moved:
            self._move_process(pid, process, moved.group(1), moved.group(2))
        else:
            self._call(pid, process, rest)

    def _move_process(self, pid: bytes, process: Process, begun: bytes, leader: bytes) -> None:
        """A thread executes a program: it gets the id of its process, and all other threads end."""
        heir = self._processes.get(leader)
        if heir is None or heir is process:
            raise Damaged
        del self._processes[pid]
        self._starting.pop(leader, None)
        heir.begun, heir.folder, heir.moved = begun, process.folder, True

    def _call(self, pid: bytes, process: Process, rest: bytes) -> None:
        pieces = END.split(rest)
        if len(pieces) == 2:
            left, result = pieces
        else:  # the same characters are in a name
            whole = CALL.fullmatch(rest)
            if whole is None:
                raise Damaged
            left, result = whole.groups()
        name, opened, words = left.partition(b"(")
        action = ACTIONS.get(name)
        match = RESULT.fullmatch(result)
        if action is None or match is None or not opened:
            raise Damaged
        value, path, error = match.groups()
        number = -1 if value == b"?" else int(value, 0)
        if process.moved:  # strace misprints the result
            process.moved, number, error = False, 0, None
        elif number < 0:
            error = error or (b"?" if value == b"?" else b"-")
        if pid == self._conductor and name not in STARTERS:
            self._started = self._started or (name == b"execve" and number == 0)
        else:
            action(self, Call(pid, process, name, words, number, path, error))

    def start(self, call: Call) -> None:
        """A process starts another one, or a thread."""
        self._starting.pop(call.pid, None)
        if self._adopted.pop(call.pid, None) is None:
            if call.error == b"?":
                self._reasons["it was killed while it started a process"] = None
            elif call.number > 0:
                self._expect(b"%d" % call.number, call)
        if b"CLONE_NEWNS" in call.words and call.number > 0:
            self._reasons["it changed its mounts"] = None

    def _expect(self, child: bytes, call: Call) -> None:
        if child in self._processes:
            raise Damaged
        folder = inherited(call.process.folder, call.words)
        if child in self._waiting:
            self._adopt(child, folder)
        else:
            self._enter(child, folder, seen=False)

    def change_folder(self, call: Call) -> None:
        path = self._path(call, ONE)
        if path is None:
            return
        if call.error:
            self._failed(path, call.error)
        else:
            call.process.folder.path = path
            self._find(path)
            self._read_links.add(path)
            self._use_links(path)

    def change_to_open_folder(self, call: Call) -> None:
        match = OPENED.match(call.words)
        if not call.error:
            path = plain(match.group(2)) if match and match.group(2) else b""
            call.process.folder.path = path if path.startswith(b"/") else None

    def unshare(self, call: Call) -> None:
        if call.error:
            return
        if b"CLONE_NEWNS" in call.words:
            self._reasons["it changed its mounts"] = None
        call.process.folder = Folder(call.process.folder.path)

    # Names

    def _path(self, call: Call, form: re.Pattern[bytes], at: int = 0) -> bytes | None:
        """Return the path that a call names; None if there is none, because the call has failed."""
        match = form.match(call.words)
        if match is None:
            if call.error in UNREADABLE or b"NULL" in call.words:
                return None
            raise Damaged
        number, folder, name, cut = match.groups()[4 * at : 4 * at + 4]
        if cut:
            if call.error:
                return None
            raise Damaged
        return self._resolve(call, number, folder, plain(name))

    def _resolve(self, call: Call, number: bytes, folder: bytes | None, name: bytes) -> bytes | None:
        if number == b"AT_FDCWD" and folder:
            call.process.folder.path = plain(folder)
        if name.startswith(b"/"):
            return clean(name)
        base = call.process.folder.path if number in (b"", b"AT_FDCWD") else plain(folder or b"")
        if base is None or not base.startswith(b"/"):
            if not call.error:
                self._reasons["it used a relative name in an unknown folder"] = None
            return None
        return clean(base + b"/" + name) if name else base

    def _real_name(self, path: bytes) -> bytes:
        """Return a path with the links in its folder followed, but not a link that it names itself."""
        folder, _, name = path.rpartition(b"/")
        self._use_links(folder)
        real = self._folders.get(folder)
        if real is None:
            real = self._folders[folder] = os.path.realpath(folder or b"/").rstrip(b"/")
        return real + b"/" + name

    def _origin(self, path: bytes) -> bytes | None:
        """Return where the content of a real path comes from; None if it has always been there."""
        origin = self._origins.get(path)
        if origin is not None or not self._moved_old:
            return origin
        for folder in with_folders(path):
            origin = self._origins.get(folder)
            if origin:
                return origin + path[len(folder) :]
        return None

    def _is_own(self, path: bytes) -> bool:
        """Return whether the run has made or removed a name, or a folder above it."""
        if not self._new and not self._absent and not self._origins:
            return False
        real = self._real_name(path)
        if real in self._origins or real in self._written:
            return True
        return any(name in self._new or name in self._absent for name in with_folders(real))

    def _failed(self, path: bytes, error: bytes) -> None:
        """A path could not be used."""
        if error == b"ENOTDIR" and path not in self._missed and os.path.lexists(path):
            self._find(path)  # a file that was used like a folder
        elif error in MISSING:
            if path not in self._missed and not self._is_own(path):
                self._missed.add(path)
        elif error in FORBIDDEN:
            self._refused.add(path)
        elif error in PRESENT:
            self._find(path)

    def _find(self, path: bytes) -> None:
        if path not in self._found and not self._is_own(path):
            self._found.add(path)

    # Files

    def execute(self, call: Call) -> None:
        at = call.name == b"execveat"
        path = self._path(call, ONE_AT if at else ONE)
        if path is None:
            if not call.error:
                self._reasons["it executed a file without a name"] = None
            return
        if call.error == b"ENOENT" and os.path.exists(path):
            self._find(path)
            self._missed.update(missing_interpreter(path))
            return
        if call.error:
            self._failed(path, call.error)
            return
        self._started = True
        if path.startswith(b"/proc/") and not path.endswith(b"/exe"):
            self._reasons["it executed a file through /proc"] = None
        elif not path.startswith(b"/proc/"):
            self._executed[path] = None
            self._use_links(path)
            self._use_again(self._real_name(path))

    def open(self, call: Call) -> None:
        path = self._path(call, ONE if call.name in (b"open", b"creat") else ONE_AT)
        if path is None:
            return
        if call.error:
            self._failed(path, call.error)
            return
        flags = set(FLAG.findall(call.words.rpartition(b'"')[2]))
        if call.name == b"creat":
            flags = {b"O_WRONLY", b"O_CREAT", b"O_TRUNC"}
        real = self._real_name(path) if call.path is None else plain(call.path)
        if not real.startswith(b"/"):
            return  # a pipe or a socket
        self._use_links(path)
        if b"O_TMPFILE" in flags:
            return
        if flags & FOLDERS:
            self._find(path)
            self._follow(path, real)
            return
        self._use(path, real, flags)

    def _use(self, path: bytes, real: bytes, flags: set[bytes]) -> None:
        new = flags >= {b"O_CREAT", b"O_EXCL"}
        empty = b"O_TRUNC" in flags or new
        if b"O_WRONLY" not in flags and not empty:
            self._read_file(path, real)
        if flags & WRITING:
            self._write(real, made=empty, new=new, content=bool(flags & CONTENT))
        if not (new or b"O_WRONLY" in flags):
            self._use_again(real, EMPTIED if b"O_TRUNC" in flags else BOTH if flags & CONTENT else ALONE)

    def _use_again(self, real: bytes, use: int = ALONE) -> None:
        """A file is read, or moved, that the run may have written itself: note it then."""
        if real not in self._changed:
            return
        new = any(name in self._new for name in with_folders(real))
        names = self._reread_new if new else self._reread
        names[real] = max(use, names.get(real, use))

    def _use_links(self, path: bytes) -> None:
        """A path is followed: note those links in it that lead to the run's own files, because the run has made them."""
        if self._made_links:
            for name in self._made_links.intersection(with_folders(path)):
                self._use_again(name)

    def _read_file(self, path: bytes, real: bytes) -> None:
        origin = self._origin(real)
        if origin is None:
            self._read.add(real)
            self._follow(path, real)
        elif origin:
            self._read.add(origin)

    def _follow(self, path: bytes, real: bytes) -> None:
        """Note that a path led to another one, unless by a link that the run has made."""
        if path != real and not path.startswith(b"/proc/") and self._real_name(path) not in self._origins:
            self._links[path] = real

    def _write(self, real: bytes, *, made: bool = True, new: bool = False, content: bool = True) -> None:
        self._written.add(real)
        if content:
            self._changed.add(real)
        self._made_links.discard(real)
        new = new and real not in self._removed  # another run may make room for itself in the same way
        self._removed.discard(real)
        self._absent.discard(real)
        if made:
            self._set_origin(real, MADE)
        if new:
            self._new.add(real)

    def _set_origin(self, real: bytes, origin: bytes) -> None:
        self._origins[real] = origin
        self._moved_old = self._moved_old or origin != MADE
        for folder in with_folders(real.rpartition(b"/")[0]):
            if folder in self._holders:
                break
            self._holders.add(folder)

    def _remove(self, real: bytes) -> None:
        self._origins.pop(real, None)
        self._made_links.discard(real)
        self._written.discard(real)
        self._absent.add(real)
        if any(name in self._new for name in with_folders(real)):
            self._new.discard(real)
        else:
            self._removed.add(real)

    def handle(self, call: Call) -> None:
        """A file is opened by a handle, without a name."""
        if not call.error:
            real = plain(call.path or b"")
            if not real.startswith(b"/"):
                self._reasons["it opened a file without a name"] = None
            else:
                self._use(real, real, set(FLAG.findall(call.words)))

    def truncate(self, call: Call) -> None:
        path = self._path(call, ONE)
        if path is not None and call.error:
            self._failed(path, call.error)
        elif path is not None:
            self._use_links(path)
            self._write(os.path.realpath(path), made=False)

    def make(self, call: Call) -> None:
        """A folder, a link or a node is made."""
        form, at = MAKERS[call.name]
        path = self._path(call, form, at)
        if path is not None and call.error:
            self._failed(path, call.error)
        elif path is not None:
            self._folders.clear()
            real = self._real_name(path)
            self._write(real, new=True)
            if form in (TWO, LINK_AT):
                self._note_link(call, form, real)

    def _note_link(self, call: Call, form: re.Pattern[bytes], real: bytes) -> None:
        """A link is made: keep it if others may replace it, and it leads to what is the run's own."""
        match = form.match(call.words)
        if match and not self._is_in_own_folder(real):
            target = clean(os.path.join(os.path.dirname(real), plain(match.group(3))))
            if self._is_in_own_folder(target) or self._is_own(target):
                self._made_links.add(real)

    def _is_in_own_folder(self, path: bytes) -> bool:
        return (path + b"/").startswith(self._own_folders)

    def remove(self, call: Call) -> None:
        path = self._path(call, ONE_AT if call.name == b"unlinkat" else ONE)
        if path is not None and call.error:
            self._failed(path, call.error)
        elif path is not None:
            self._remove(self._real_name(path))

    def _pair(self, call: Call, form: re.Pattern[bytes]) -> tuple[bytes, bytes] | None:
        """Return the two paths of a call; None if they are unknown, or if the call has failed."""
        old, new = self._path(call, form), self._path(call, form, 1)
        if old is None or new is None:
            return None
        if call.error:
            self._failed_pair(old, new, call.error)
            return None
        return old, new

    def link(self, call: Call) -> None:
        pair = self._pair(call, TWO_AT if call.name == b"linkat" else TWO)
        if pair is None:
            return
        old, new = pair
        source, target = self._real_name(old), self._real_name(new)
        nameless = old.startswith(b"/proc/") or b"AT_EMPTY_PATH" in call.words.rpartition(b'"')[2]
        origin = MADE if nameless else self._origin(source)
        self._write(target, new=True)
        self._take(source, target)
        self._set_origin(target, source if origin is None else origin)

    def _take(self, source: bytes, target: bytes) -> None:
        """A name is given to something that has another one: a run that takes it into its own folder uses it."""
        if self._is_in_own_folder(target):
            self._use_again(source)

    def rename(self, call: Call) -> None:
        pair = self._pair(call, TWO if call.name == b"rename" else TWO_AT)
        if pair is None:
            return
        old, new = pair
        flags = call.words.rpartition(b'"')[2]
        if b"RENAME_EXCHANGE" in flags:
            self._reasons["it exchanged two names"] = None
        source, target = self._real_name(old), self._real_name(new)
        if source == target:
            return
        origin = self._origin(source)
        if source in self._holders:
            self._move_folder(source + b"/", target + b"/")
        self._take(source, target)
        is_link = source in self._made_links
        self._remove(source)
        self._new.discard(target)
        self._write(target, new=b"RENAME_NOREPLACE" in flags)
        if is_link:
            self._made_links.add(target)
        self._set_origin(target, source if origin is None else origin)

    def _move_folder(self, old: bytes, new: bytes) -> None:
        """Give new names to all that the run has made in a folder that it renames."""
        self._moves += len(self._written) + len(self._new) + len(self._absent) + len(self._origins)
        if self._moves > MOST_MOVES:
            self._reasons["it renamed too many folders"] = None
            return
        self._folders.clear()
        for names in (self._written, self._new, self._absent, self._changed, self._made_links):
            for name in [name for name in names if name.startswith(old)]:
                names.discard(name)
                names.add(new + name[len(old) :])
        for name in [name for name in self._origins if name.startswith(old)]:
            self._set_origin(new + name[len(old) :], self._origins.pop(name))

    def _failed_pair(self, old: bytes, new: bytes, error: bytes) -> None:
        """A call with two paths failed; the error does not tell which of them is to blame."""
        if error in MISSING:
            for path in (old, new):
                if not os.path.lexists(path):
                    self._failed(path, error)
        else:
            self._failed(new, error)

    def look(self, call: Call) -> None:
        """The status of a path is requested."""
        if b', "", ' in call.words and b"AT_FDCWD" not in call.words:
            return  # of an open file
        path = self._path(call, ONE if call.name in PLAIN else ONE_AT)
        if path is None:
            return
        if call.error:
            self._failed(path, call.error)
            return
        self._find(path)
        if call.name in (b"readlink", b"readlinkat"):
            self._read_links.add(path)
            self._use_links(path)

    def list(self, call: Call) -> None:
        match = OPENED.match(call.words)
        path = plain(match.group(2)) if match and match.group(2) else b""
        if call.error:
            return
        if not path.startswith(b"/"):
            raise Damaged
        if path not in self._listed and not self._is_own(path):
            self._listed.add(path)

    # What cannot be seen

    def escape(self, call: Call) -> None:
        if not call.error:
            self._reasons[ESCAPES[call.name.decode()]] = None

    def filter(self, call: Call) -> None:
        if b"NEW_LISTENER" in call.words and not call.error:
            self._reasons["another process answers its calls"] = None

    def trace_others(self, call: Call) -> None:
        self._reasons["it traces processes, or lets itself be traced"] = None
        self._disturbed = self._disturbed or "it traces processes, or lets itself be traced, which strace prevents"

    def make_socket(self, call: Call) -> None:
        if not call.error:
            self._channels.make(call)

    def set_option(self, call: Call) -> None:
        self._channels.set_option(call)

    def bind(self, call: Call) -> None:
        self._channels.bind(call, self._unix(call))

    def _unix(self, call: Call) -> str | None:
        """Return the name of a Unix socket in a call that others can use, too: `@name` if it is abstract, or its path."""
        local = UNIX.search(call.words)
        if local is None or not local.group(2):
            return None
        name = ESCAPED.sub(unescaped, local.group(2))
        if local.group(1):
            return "@" + os.fsdecode(name)
        if b"\0" in name or not (name.startswith(b"/") or call.process.folder.path):
            return None
        real = self._real_name(clean(os.path.join(call.process.folder.path or b"/", name)))
        own = self._is_in_own_folder(real) or any(folder in self._new for folder in with_folders(real))
        return None if own else os.fsdecode(real)

    def connect(self, call: Call) -> None:
        local, remote = UNIX.search(call.words), INTERNET.search(call.words)
        if call.error in CONNECTED:
            self._channels.connect(call, self._unix(call), remote)
        if local:
            name = ESCAPED.sub(unescaped, local.group(2))  # may be abstract, and contain any byte
            if call.error in MISSING:
                if not local.group(1) and name.startswith(b"/") and b"\0" not in name:
                    self._failed(clean(name), b"ENOENT")
            elif call.error in CONNECTED:
                self._note("may have read through the socket %s" % os.fsdecode(local.group(1) + name))
        elif remote and call.error in CONNECTED:
            self._note("may have read from %s, port %s" % (remote.group(2).decode(), remote.group(1).decode()))

    def listen(self, call: Call) -> None:
        self._channels.listen(call)
        self._note("waited for connections")

    def share(self, call: Call) -> None:
        if not call.error:
            self._channels.share(call)
            if call.name == b"shmget":
                self._note("used shared memory")

    def _note(self, note: str) -> None:
        if len(self._notes) < MOST_NOTES:
            self._notes[note] = None

    # The result

    def trace(self, way: str, *, cut: bool = False, living: bool = False) -> Trace:
        """Return what the log says; `cut`: it was emptied in between, `living`: its processes go on."""
        if cut or self._cut:
            self._reasons[self._cut or "its log is longer than %d bytes" % LOG_BYTES] = None
        else:
            self._check_lines(living=living)
        programs = self._programs()
        for path in self._read_links:
            self._follow(path, os.path.realpath(path))
        folders = {path for path in self._read if os.path.isdir(path)}
        read = self._read - folders - programs
        found = (self._found | folders) - read - programs - set(self._links)
        names: dict[str, set[bytes]] = {
            "executed": programs,
            "read": read,
            "found": found,
            "missed": self._missed,
            "refused": self._refused,
            "listed": self._listed,
            "written": self._written,
            "removed": self._removed,
        }
        trace = Trace(
            way,
            reread=tuple(sorted(os.fsdecode(path) for path, use in self._reread.items() if not is_lock(path, use))),
            reread_new=tuple(
                sorted(os.fsdecode(path) for path, use in self._reread_new.items() if not is_lock(path, use, new=True))
            ),
            links={os.fsdecode(path): os.fsdecode(self._links[path]) for path in sorted(self._links)},
            channels=tuple((one_line(name), use) for name, use in self._channels.used()),
            reasons=tuple(one_line(reason) for reason in (*self._reasons, *(self._now_unknown() if living else ()))),
            disturbed=self._disturbed and one_line(self._disturbed),
            notes=tuple(one_line(note) for note in self._notes),
        )
        return filled(trace, {name: tuple(sorted(map(os.fsdecode, paths))) for name, paths in names.items()})

    def _check_lines(self, *, living: bool) -> None:
        if self._damaged:
            self.damage("%d lines of the log are not understood" % self._damaged)
        if not living:
            self._check_end()

    def _now_unknown(self) -> Iterator[str]:
        """Yield why something that programs have done until now is not known yet."""
        if not self._started:
            yield "it had not begun"
        if self._waiting:
            yield "a process had just begun"

    def _check_end(self) -> None:
        if not self._started and not self._reasons:
            self.damage("the tracer did not start it")
        if any(process.seen for process in self._processes.values()):
            self.damage("the log ends before the run: the tracer was killed, or the log was cut")
        unseen = sum(not process.seen for process in self._processes.values())
        if unseen > self._strays:
            self.damage("a process is not in the log: it escaped the tracer, or the log was cut")

    def _programs(self) -> set[bytes]:
        """Return the real paths of all that the kernel executed, except what the run had made itself."""
        programs: set[bytes] = set()
        pending = [(path, 0) for path in self._executed]
        for path, depth in pending:
            real = os.path.realpath(path)
            own = self._origin(real)
            if own is None:
                programs.add(real)
                self._follow(path, real)
            elif own:
                programs.add(own)
            if is_privileged(real):
                reason = "%s is setuid, and could not get its rights" % os.fsdecode(real)
                self._reasons[reason] = None
                self._disturbed = self._disturbed or reason
            try:
                interpreter = interpreter_of(os.fsdecode(real))
            except (OSError, ValueError):
                self._reasons["what executes %s is unknown" % os.fsdecode(real)] = None
                continue
            if interpreter and not os.path.isabs(interpreter):
                self._reasons["%s names a relative interpreter" % os.fsdecode(real)] = None
            elif interpreter and depth <= SCRIPTS:
                pending.append((os.fsencode(interpreter), depth + 1))
        return programs


def is_lock(path: bytes, use: int, *, new: bool = False) -> bool:
    """Return whether a file that a run wrote and read has no content for others: a lock, or neither a file nor a link.

    A file is a lock if it has the name of one, and is small or gone. One that is gone was a lock if the run made its name, or
    did not read it for itself. Those of other names are locks if they were opened once for both and nobody has written to them.
    """
    named = LOCK.fullmatch(path) is not None
    try:
        status = os.lstat(path)
    except OSError:
        return named and (new or use < ALONE)
    if not stat.S_ISREG(status.st_mode):
        return named or not stat.S_ISLNK(status.st_mode)
    return status.st_size <= LOCK_BYTES if named else status.st_size == 0 and use == BOTH


def missing_interpreter(path: bytes) -> list[bytes]:
    """Return what the kernel has looked for and not found in order to execute a file."""
    try:
        interpreter = interpreter_of(os.fsdecode(path))
    except (OSError, ValueError):
        return []
    return [] if interpreter is None or os.path.exists(interpreter) else [os.fsencode(interpreter)]


def inherited(folder: Folder, words: bytes) -> Folder:
    """Return the folder of a process that is started by a call with these words in a process with that folder."""
    return folder if b"CLONE_FS" in words else Folder(folder.path)


def with_folders(path: bytes) -> Iterator[bytes]:
    """Yield a path and all folders above it but the root."""
    while len(path) > 1:
        yield path
        path = path.rpartition(b"/")[0]


def clean(path: bytes) -> bytes:
    """Return an absolute path without `.`, `..`, and doubled or final slashes; links are followed only before a `..`."""
    if b"/." not in path and b"//" not in path and not path.endswith(b"/"):
        return path
    path = DOTS.sub(b"/", path)
    if b"/../" in path or path.endswith(b"/.."):
        head, _, tail = path.rpartition(b"/..")
        path = os.path.realpath(head + b"/..") + tail
    return b"/" + path.strip(b"/")


def is_privileged(path: bytes) -> bool:
    """Return whether a program gets the rights of another user, or capabilities, when it is executed."""
    try:
        mode = os.stat(path).st_mode
        if mode & stat.S_ISUID or (mode & stat.S_ISGID and mode & stat.S_IXGRP):
            return True
        return hasattr(os, "listxattr") and "security.capability" in os.listxattr(path)
    except OSError:
        return False


def one_line(text: str) -> str:
    """Return a text with line breaks and the like escaped, so that it is one line."""
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


MAKERS = {
    b"mkdir": (ONE, 0),
    b"mkdirat": (ONE_AT, 0),
    b"mknod": (ONE, 0),
    b"mknodat": (ONE_AT, 0),
    b"symlink": (TWO, 1),
    b"symlinkat": (LINK_AT, 1),
}
STARTERS = frozenset(name.encode() for name in PROCESSES)
PLAIN = frozenset((b"access", b"stat", b"lstat", b"stat64", b"lstat64", b"readlink"))
ACTIONS: dict[bytes, Callable[[Log, Call], None]] = {
    **dict.fromkeys((b"execve", b"execveat"), Log.execute),
    **dict.fromkeys((b"open", b"openat", b"openat2", b"creat"), Log.open),
    **dict.fromkeys((name.encode() for name in STATUS), Log.look),
    **dict.fromkeys((b"getdents", b"getdents64"), Log.list),
    **dict.fromkeys(MAKERS, Log.make),
    **dict.fromkeys((b"rename", b"renameat", b"renameat2"), Log.rename),
    **dict.fromkeys((b"link", b"linkat"), Log.link),
    **dict.fromkeys((b"unlink", b"unlinkat", b"rmdir"), Log.remove),
    **dict.fromkeys(STARTERS, Log.start),
    **dict.fromkeys((name.encode() for name in ESCAPES), Log.escape),
    b"truncate": Log.truncate,
    b"chdir": Log.change_folder,
    b"fchdir": Log.change_to_open_folder,
    b"unshare": Log.unshare,
    b"name_to_handle_at": Log.look,
    b"open_by_handle_at": Log.handle,
    b"seccomp": Log.filter,
    b"ptrace": Log.trace_others,
    b"connect": Log.connect,
    b"listen": Log.listen,
    b"socket": Log.make_socket,
    b"bind": Log.bind,
    b"setsockopt": Log.set_option,
    **dict.fromkeys((*SHARED_KEYS, b"mq_open"), Log.share),
}


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


class File(NamedTuple):
    """The content of a file after the run, and values that differ if it is changed (inode, size, times in ns)."""

    sha256: str
    size: int
    state: tuple[int, ...]


class Contents(NamedTuple):
    """The contents that a run has read, by paths; and the paths with unknown contents, with the reason."""

    files: Mapping[str, File]
    folders: Mapping[str, str]
    """For each listed folder the SHA-256 of its names: sorted, each before a NUL, without `__pycache__` and the run's own, and
    without those that `is_listed` leaves out."""
    unusable: Mapping[str, str]
    listings: Mapping[str, Sequence[str]] = {}
    """The names behind each of these SHA-256."""
    kinds: Mapping[str, str] = {}
    """For each found path the SHA-256 of what `kind_of` returns."""


Hashed = Callable[[], str]
Cache = Callable[[str, os.stat_result, Hashed], str]
"""Returns the SHA-256 of a file with this path and status: one that it knows, or what the function returns that it is given."""


def no_cache(path: str, status: os.stat_result, hashed: Hashed) -> str:
    """Hash each file."""
    return hashed()


def everything(path: str) -> bool:
    """Return True: the default of `is_listed`."""
    return True


def contents(
    trace: Trace,
    began: int,
    cache: Cache = no_cache,
    check_stop: Callable[[], None] = nothing,
    is_listed: Callable[[str], bool] = everything,
) -> Contents:
    """Return the content of all that a run executed, read or listed: of a trace that `Names.inputs` has returned.

    `is_listed` tells which paths count in a listed folder: `Names.is_listed`.

    `began` is `Observation.began`. A file is unusable if it was changed since then, or while it is hashed, because the run may
    have read something else; and so is a link or a folder. A time in the future counts as changed if it is the ctime, which
    programs cannot set. If it is more than a day in the future, a clock is wrong: the file is unusable, but has its content.
    Also unusable: a path that is missing now or exists now, unlike in the run. Devices have no content.
    """
    reader = Reader(began, cache, check_stop)
    for path in sorted({*trace.executed, *trace.read}):
        reader.try_to(reader.read, path)
    own = set(trace.written)
    for path in trace.listed:
        reader.try_to(functools.partial(reader.list, own, is_listed), path)
    for path, real in trace.links.items():
        reader.try_to(functools.partial(reader.follow, real), path)
    for path in trace.found:
        if not os.path.lexists(path) and path not in trace.removed:
            reader.unusable[path] = "it was removed after the run had found it"
    for path in trace.missed:
        if os.path.exists(path) and path not in own:
            reader.unusable[path] = "it was made after the run had looked for it"
    kinds = {path: sha256_of_kind(path) for path in (*trace.found, *trace.refused)}
    return Contents(reader.files, reader.folders, reader.unusable, reader.listings, kinds)


def with_services(trace: Trace, contents: Contents, shared: Trace, own: Contents) -> tuple[Trace, Contents]:
    """Return the trace and the contents of a run together with those of services that it shares with other runs.

    What the services have changed is their state, and no input of the run; what they have only opened for writing is one.
    """
    state = {path for path in (*shared.written, *shared.removed) if path not in own.files}
    used = ("executed", "read", "found", "missed", "refused", "listed")
    lists = {name: tuple(sorted({*getattr(trace, name), *(set(getattr(shared, name)) - state)})) for name in used}
    trace = filled(trace, {**lists, "written": trace.written, "removed": trace.removed})
    links = {path: real for path, real in shared.links.items() if path not in state and real not in state}
    unusable = {path: reason for path, reason in own.unusable.items() if path not in state}
    return trace._replace(links={**links, **trace.links}), Contents(
        {**own.files, **contents.files},
        {**own.folders, **contents.folders},
        {**unusable, **contents.unusable},
        {**own.listings, **contents.listings},
        {**own.kinds, **contents.kinds},
    )


def sha256_of_kind(path: str) -> str:
    """Return the SHA-256 of what a program sees of a path without opening it: a folder, or a file with its size and rights.

    Times are not among it, because they differ between machines.
    """
    try:
        status = os.stat(path)
    except OSError as error:
        kind = "error %s" % error.errno
    else:
        is_file = stat.S_ISREG(status.st_mode)
        kind = "file %d %d" % (status.st_size, bool(status.st_mode & 0o111)) if is_file else "%o" % stat.S_IFMT(status.st_mode)
        kind += "" if os.access(path, os.R_OK) else " unreadable"
    return hashlib.sha256(kind.encode()).hexdigest()


class Reader:
    """Reads files, folders and links after a run."""

    def __init__(self, began: int, cache: Cache, check_stop: Callable[[], None]) -> None:
        self._began = began
        self._cache, self._check_stop = cache, check_stop
        self._environments = Environments()
        self.files: dict[str, File] = {}
        self.folders: dict[str, str] = {}
        self.unusable: dict[str, str] = {}
        self.listings: dict[str, list[str]] = {}

    def try_to(self, read: Callable[[str], None], path: str) -> None:
        self._check_stop()
        try:
            read(path)
        except FileNotFoundError:
            self.unusable[path] = "it was removed after the run had read it"
        except (OSError, ValueError) as error:
            self.unusable[path] = "it cannot be read: %s" % (getattr(error, "strerror", None) or error)

    def read(self, path: str) -> None:
        status = os.stat(path)
        kind = stat.S_IFMT(status.st_mode)
        if kind in (stat.S_IFCHR, stat.S_IFBLK):
            return
        if kind != stat.S_IFREG:
            self.unusable[path] = "it is no regular file"
            return
        if self._changed(status):
            self.unusable[path] = CHANGED
            return
        if self._is_later(status):
            self.unusable[path] = LATER  # and yet its content is recorded, for what depends on the bytes alone
        sha256 = self._cache(path, status, lambda: self._hashed(path))
        if key_of(os.stat(path)) != key_of(status):
            self.unusable[path] = CHANGED
            return
        self.files[path] = File(sha256, status.st_size, key_of(status))

    def _hashed(self, path: str) -> str:
        return sha256_of(path, self._environments, self._check_stop)

    def list(self, own: set[str], is_listed: Callable[[str], bool], path: str) -> None:
        before = os.stat(path)
        if self._changed(before):
            self.unusable[path] = "it was changed after the run had listed it"
            return
        if self._is_later(before):
            self.unusable[path] = LATER
        paths = ((name, os.path.join(path, name)) for name in os.listdir(path) if name != PYTHON_CACHE)
        kept = [name for name, entry in paths if entry not in own and is_listed(entry)]
        kept.sort(key=os.fsencode)
        if key_of(os.stat(path)) != key_of(before):
            self.unusable[path] = "it was changed after the run had listed it"
            return
        digest = hashlib.sha256(b"".join(os.fsencode(name) + b"\0" for name in kept)).hexdigest()
        self.folders[path] = digest
        self.listings[digest] = kept

    def follow(self, real: str, path: str) -> None:
        status = os.lstat(path)
        if os.path.realpath(path) != real or (stat.S_ISLNK(status.st_mode) and self._changed(status)):
            self.unusable[path] = "its link was changed after the run had followed it"
        elif self._is_later(status):
            self.unusable[path] = LATER

    def _changed(self, status: os.stat_result) -> bool:
        """Return whether a file may have been changed in the run, by its times."""
        if self._is_later(status):
            return False
        return status.st_ctime_ns >= self._began or self._began <= status.st_mtime_ns <= time.time_ns()

    def _is_later(self, status: os.stat_result) -> bool:
        """Return whether a file was changed by another clock: so long after now that no change in the run can be meant."""
        return status.st_ctime_ns > time.time_ns() + LATER_NS


LATER = "its times are in the future, so that a clock is or was wrong"
LATER_NS = 24 * 3600 * 10**9
CHANGED = "it was changed after the run had opened it"
SMALL = 1 << 16
"""The largest file in a virtual environment in which paths are looked for."""
VENV = "pyvenv.cfg"
COSMETIC = frozenset((b"command", b"executable", b"prompt", b"relocatable", b"uv", b"virtualenv"))
"""Keys of pyvenv.cfg that Python does not read, and that did not count in earlier versions of this program."""
COUNTED = frozenset((b"home", b"include-system-site-packages"))
"""Keys of pyvenv.cfg that Python reads. All others say which tool has made the environment."""
OF_INSTALLER = re.compile(rb"[^/,]+\.dist-info/(?:INSTALLER|REQUESTED|uv_cache\.json|uv_build\.json),")
"""Lines of RECORD about files in which a tool notes its own work."""
PYTHON_LINE = re.compile(rb"\A(#!(?:/bin/sh\n'''exec' )?[\"']?\{prefix\}/bin/python)(?:\d(?:\.\d+)?t?)?(?=[\"'\s])")
CALLER = re.compile(
    rb"(#!.*\n(?:'''exec' .*\n' '''\n)?)(?:# -\*- coding: utf-8 -\*-\n)?(?:import re\n)?import sys\n+"
    rb"from ([\w.]+) import (\w+)\n+if __name__ == ['\"]__main__['\"]:\n"
    rb"(?:    (?:el)?if sys\.argv\[0\]\.endswith\(['\"](?:-script\.pyw|\.exe)['\"]\):\n"
    rb"        sys\.argv\[0\] = sys\.argv\[0\]\[:-\d+\]\n"
    rb"|    sys\.argv\[0\] = sys\.argv\[0\]\.removesuffix\(['\"]\.exe['\"]\)\n"
    rb"|    sys\.argv\[0\] = re\.sub\(r['\"]\(-script\\\.pyw\??\|\\\.exe\)\?\$['\"], ['\"]{2}, sys\.argv\[0\]\)\n)*"
    rb"    sys\.exit\((\3[\w.]*)\(\)\)\n?"
)
"""A script that only calls a function of a package. Each tool has its own words for it."""
CALL_BY_PIP = rb"""\1# -*- coding: utf-8 -*-
import re
import sys
from \2 import \3
if __name__ == '__main__':
    sys.argv[0] = re.sub(r'(-script\\.pyw|\\.exe)?$', '', sys.argv[0])
    sys.exit(\4())
"""
NAME_BYTE = rb"[\w.+~\x80-\xff-]"


class Environments:
    """The virtual environments of Python that files are in, known by their `pyvenv.cfg`. Each folder is looked at once."""

    def __init__(self) -> None:
        self._known: dict[str, str | None] = {"/": None, "": None}

    def of(self, path: str) -> str | None:
        """Return the environment that a file is in; None if it is in none."""
        return self._above(os.path.dirname(path))

    def _above(self, folder: str) -> str | None:
        if folder not in self._known:
            inside = os.path.isfile(os.path.join(folder, VENV))
            self._known[folder] = folder if inside else self._above(os.path.dirname(folder))
        return self._known[folder]


def sha256_of(path: str, environments: Environments, check_stop: Callable[[], None] = nothing, *, former: bool = False) -> str:
    """Return the SHA-256 of a file's content, or of what counts of it if it is a small file in a virtual environment.

    `former`: what counted of it in earlier versions of this program.
    """
    digest = hashlib.sha256()
    folder = environments.of(path)
    with open(path, "rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        if folder and (size <= SMALL or is_record(path)):
            return hashlib.sha256(counted(path, file.read(), folder, former=former)).hexdigest()
        for chunk in iter(lambda: file.read(CHUNK), b""):
            check_stop()
            digest.update(chunk)
    return digest.hexdigest()


def counted(path: str, content: bytes, environment: str, *, former: bool = False) -> bytes:
    """Return what counts of the content of a file in a virtual environment: the same wherever and however it was made.

    The path of the environment itself does not count: it is in the first line of each script, for example. Nor does it count
    by which of its names a script calls the environment's Python (`python3.11`), and how a tool writes a script that only calls
    a function. All other words count, and so does the path of another environment. Only what Python reads of `pyvenv.cfg`
    counts. What RECORD says about scripts, about compiled modules and about the tool that has installed it does not count.
    """
    kept = content
    if path == os.path.join(environment, VENV):
        lines = (line.strip() for line in content.splitlines())
        keys = ((line.partition(b"=")[0].strip().lower(), line) for line in lines)
        kept = b"\n".join(sorted(line for key, line in keys if (key not in COSMETIC if former else key in COUNTED)))
        kept = without(kept, os.path.expanduser("~"), b"{home}")
    elif is_record(path):
        lines = (line.rstrip() for line in content.splitlines())
        lines = (line for line in lines if not line.startswith(b"..") and b".pyc," not in line)
        kept = b"\n".join(sorted(line for line in lines if former or not OF_INSTALLER.match(line)))
    elif b"\0" not in content:
        for folder in {environment, os.path.realpath(environment)}:
            kept = without(kept, folder, b"{prefix}")
        kept = kept if former else CALLER.sub(CALL_BY_PIP, PYTHON_LINE.sub(rb"\g<1>3", kept))
    return content if kept == content else b"{prefix}\0" + kept


def is_record(path: str) -> bool:
    """Return whether a file is the list of the files of an installed distribution of Python."""
    return path.endswith(".dist-info/RECORD")


def without(content: bytes, folder: str, name: bytes) -> bytes:
    """Return a text in which a name stands for the path of a folder. Longer names that contain the path stay."""
    path = os.fsencode(folder)
    if path == b"/" or path not in content:
        return content
    return re.sub(b"(?<!" + NAME_BYTE + b")" + re.escape(path) + b"(?!" + NAME_BYTE + b")", lambda _: name, content)


def key_of(status: os.stat_result) -> tuple[int, ...]:
    """Return values of a file that differ after it was changed."""
    return (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)


KERNEL = ("/proc", "/sys", "/dev")
SHARED_MEMORY = "/dev/shm"  # noqa: S108 - what another program has left there may be an input
OWN_ROOTS = {"run": "the run's own folder", "work": "a folder of runs", "store": "the store"}
OF_RUNS = ("project", "work", "store")
"""Folders in which there are no caches, but files that several runs may use."""
UNLISTED = "unlisted"
CACHES = ("/var/cache/fontconfig", "/usr/share/fonts/.uuid", "/usr/lib/fontconfig/cache")
CACHING = ("fontconfig", "matplotlib", "mesa_shader_cache", "mesa_shader_cache_db", "nvidia", "pip", "uv/.lock")
"""Folders in a user's cache that only make programs faster. All else there may be an input: an environment, a model."""
KEPT = (
    r"s?ccache|numba|triton|theano|pycuda|cupy|pocl|pyopencl|keops[\d.]*|jax|ptxas|torchinductor_[^/]*|torch_extensions|"
    r"ComputeCache|GLCache|OptixCache[^/]*|mesa_shader_cache\w*|qtshadercache[\w.-]*|qtpipelinecache[\w.-]*|QtProject|"
    r"gstreamer-\d[\w.]*|huggingface/(?:hub|datasets|modules|xet)|fontconfig|font[\w-]*cache|matplotlib|ksycoca[\w=+-]*|dconf"
)
KEPT_IN_CACHE = re.compile(r"(?:[^/]+/)?(?:%s)(?:/.*)?" % KEPT, re.S)
"""Files that programs keep to be faster, as they are named in a user's cache, perhaps in a program's own folder there."""
KEPT_IN_HOME = re.compile(
    r"\.(?:%s|nv|aesara|pytensor|julia/compiled/v\d+\.\d+|config/(?:dconf|QtProject\.conf))(?:/.*)?" % KEPT, re.S
)
KEPT_IN_TMP = re.compile(r"/(?:var/)?tmp/(?:torchinductor_[^/]*|OptixCache[^/]*|numba_cache|jax_cache|kdecache-[^/]*)/.*", re.S)
KEPT_ANYWHERE = re.compile(r".*/__pycache__/.*|.*\.py[co](?:\.\d+)?", re.S)
CHANNELS = re.compile(r"/dev/shm/(?:sem\.)?(?:fastrtps|fastdds|fast_datasharing|iceoryx|iox)[^/]*", re.S)  # noqa: S108 - no file is made there
"""Memory by which programs talk to each other."""
PYTHON_CACHE = "__pycache__"


class Names:
    """Names of files that are the same on every machine, and rules for what is no input at all.

    `roots` maps names to folders, for example project, home, prefix (the virtual environment of the runs' Python), run (the
    run's own folder, with its output and temporary files), work (where runs have their folders), store, cache
    (XDG_CACHE_HOME). A path below a root is named `{root}/…`, by the deepest root. All other paths are their own names. If
    several folders have one name, their keys end in a colon and a word: `project`, `project:given`. No path is named by `work`:
    only files that runs share have names there, and these are different files in each session.

    Left out: what the kernel makes up (/proc, /sys, and /dev except the shared memory in /dev/shm); what is below run, work
    and store, unless a deeper root is not among these (a checkout of the project in the store); what is in a cache only for
    speed (CACHES, and CACHING in cache and in home's `.cache`); and Python's compiled modules (`__pycache__`), if their source
    is there. Python has compared its size and time then, and so the source counts; a compiled module that says that it is not
    to be compared counts itself. Listed folders of a Python's packages are kept: a program may try to import an optional one.
    The existence of roots and of the folders above them is no input, because it depends on where the run's folder is.

    Paths with the name `unlisted` are those that a checkout of the project lacks, for example the template: they do not count
    in a listed folder. If there is `project:given`, the runs are executed in a checkout, where they are not missed either.
    """

    def __init__(self, roots: Mapping[str, str]) -> None:
        named = [(name.partition(":")[0], given) for name, given in roots.items()]
        pairs = {(real(given), name) for name, given in named for real in (os.path.abspath, os.path.realpath)}
        self._unlisted = frozenset(folder for folder, name in pairs if name == UNLISTED)
        self._roots = sorted((pair for pair in pairs if pair[1] != UNLISTED), key=lambda pair: (-len(pair[0]), pair))
        self._lacking = tuple(lacking(roots)) if "project:given" in roots else ()
        self._above = {"/", *(above for folder, _ in self._roots for above in folders_to(folder))}
        kept = [folder for folder, name in pairs if name == "cache"]
        kept += [os.path.join(folder, ".cache") for folder, name in pairs if name == "home"]
        self._caches = (*CACHES, *(os.path.join(folder, name) for folder in kept for name in CACHING))
        homes = [(folder, KEPT_IN_HOME) for folder, name in pairs if name == "home"]
        self._keepers = (*((folder, KEPT_IN_CACHE) for folder in kept), *homes)

    def name(self, path: str) -> str:
        """Return the name of an absolute path."""
        for folder, name in self._roots:
            if name != "work" and is_below(path, folder):
                return "{%s}%s" % (name, path[len(folder.rstrip("/")) :])
        return path

    def _root_of(self, path: str) -> str | None:
        return next((name for folder, name in self._roots if is_below(path, folder)), None)

    def left_out(self, path: str) -> str | None:
        """Return what makes a path no input; None if it is one."""
        if any(is_below(path, folder) for folder in KERNEL) and not is_below(path, SHARED_MEMORY):
            return "the kernel"
        root = self._root_of(path)
        if root in OWN_ROOTS:
            return OWN_ROOTS[root]
        if any(is_below(path, folder) for folder in self._caches):
            return "a cache"
        if "/%s/" % PYTHON_CACHE in path + "/" and not (path.endswith(".pyc") and counts_itself(path)):
            return "Python's compiled modules"
        return None

    def is_listed(self, path: str) -> bool:
        """Return whether a path counts in the folder that it is in, if a run lists this folder."""
        return path not in self._unlisted and not self.left_out(path)

    def _is_data(self, path: str) -> bool:
        """Return whether a file that a run wrote and read may have data of another run. Only its own folder is its own."""
        root = self._root_of(path)
        if root == "run" or KEPT_ANYWHERE.fullmatch(path):
            return False
        return root in OF_RUNS or not (self.left_out(path) or self._is_kept(path))

    def _is_kept(self, path: str) -> bool:
        """Return whether a program keeps a file to be faster, or in order to talk to others."""
        if KEPT_IN_TMP.fullmatch(path) or CHANNELS.fullmatch(path):
            return True
        return any(is_below(path, folder) and form.fullmatch(path[len(folder) + 1 :]) for folder, form in self._keepers)

    def inputs(self, trace: Trace) -> Trace:
        """Return a trace without what is left out.

        A Python source of which only the status was requested counts as read: Python has read its compiled copy instead.
        """
        lists = {name: [path for path in getattr(trace, name) if not self.left_out(path)] for name in LISTS}
        sources = {os.path.realpath(path) for path in lists["found"] if path.endswith(".py") and os.path.isfile(path)}
        compiled = {source_of(path) for path in trace.read if path.endswith(".pyc")}
        sources |= {os.path.realpath(path) for path in compiled if path is not None and not self.left_out(path)}
        lists["read"] = sorted((sources | set(lists["read"])) - set(trace.executed))
        lists["missed"] = [path for path in lists["missed"] if not any(is_below(path, one) for one in self._lacking)]
        lists["found"] = [path for path in lists["found"] if path not in self._above and os.path.realpath(path) not in sources]
        links = {path: real for path, real in trace.links.items() if not self.left_out(path) and not self.left_out(real)}
        again, new = (list(filter(self._is_data, paths)) for paths in (trace.reread, trace.reread_new))
        reasons = (*trace.reasons, TOO_MANY_REREAD) if max(len(again), len(new)) > MOST_REREAD else trace.reasons
        channels = tuple((self.name(name) if name.startswith("/") else name, use) for name, use in trace.channels)
        trace = trace._replace(channels=channels)
        trace = trace._replace(links=links, reread=most_lasting(again), reread_new=most_lasting(new), reasons=reasons)
        return filled(trace, {name: tuple(paths) for name, paths in lists.items()})


def most_lasting(paths: Sequence[str]) -> tuple[str, ...]:
    """Return as many paths as are recorded, sorted; names that still exist come first, because others may use them, too."""
    if len(paths) <= MOST_REREAD:
        return tuple(paths)
    return tuple(sorted(sorted(paths, key=lambda path: not os.path.lexists(path))[:MOST_REREAD]))


def lacking(roots: Mapping[str, str]) -> Iterator[str]:
    """Yield the paths that a checkout of a project lacks, as they would be in the checkout."""
    for checkout in {os.path.abspath(roots["project"]), os.path.realpath(roots["project"])}:
        for name, path in roots.items():
            if name.partition(":")[0] == UNLISTED:
                yield os.path.join(checkout, os.path.relpath(path, roots["project:given"]))


GPU = "{gpu}"
"""Stands among the files for the graphics processors with their drivers, if a run has used one. It is no path."""
GPU_DEVICE = re.compile(r"/dev/(?:nvidia|dri/|kfd)")
GPU_LIBRARY = re.compile(
    r".*/lib(?:cuda|cudart|cublas|cudnn|nvrtc|nvidia-\w+|amdhip64|hsa-runtime64|rocm\w*|OpenCL|ze_loader)(?![a-z])[^/]*\.so[^/]*"
)


def uses_gpu(trace: Trace) -> bool:
    """Return whether a run has opened a graphics processor, or loaded a library that computes on one."""
    used = (*trace.executed, *trace.read, *trace.written, *trace.links)
    return any(GPU_DEVICE.match(path) or GPU_LIBRARY.fullmatch(path) for path in used)


def graphics(root: str = "/") -> list[str]:
    """Return the graphics processors, each with its driver, as the kernel describes them below a folder."""
    found = ["driver " + line for line in lines_of(os.path.join(root, "proc/driver/nvidia/version")) if line]
    cards = os.path.join(root, "proc/driver/nvidia/gpus")
    for name in sorted(entries_of(cards)):
        found += [line for line in lines_of(os.path.join(cards, name, "information")) if line.startswith("Model:")]
    devices = os.path.join(root, "sys/class/drm")
    for name in sorted(entries_of(devices)):
        if re.fullmatch(r"card\d+", name):
            device = os.path.join(devices, name, "device")
            ids = [line for key in ("vendor", "device") for line in lines_of(os.path.join(device, key))]
            driver = os.path.basename(os.path.realpath(os.path.join(device, "driver")))
            version = lines_of(os.path.join(device, "driver/module/version"))
            found.append(" ".join((*ids, driver, *version)))
    return found


def graphics_sha256(root: str = "/") -> str:
    """Return a hash of the graphics processors and their drivers."""
    return hashlib.sha256("".join(line + "\n" for line in graphics(root)).encode("utf-8", "surrogateescape")).hexdigest()


def lines_of(path: str) -> list[str]:
    """Return the lines of a file, each with single blanks; none if it cannot be read."""
    return [" ".join(line.split()) for line in os.fsdecode(content_of(path)).splitlines()]


def as_record(trace: Trace, contents: Contents, names: Names, *, gpu: bool = False) -> dict[str, object]:
    """Return a trace and the contents of its files as JSON; `files` are name, use, SHA-256 and size (null if there is none).

    `gpu` is what `uses_gpu` says about the whole trace.
    A path that was missed and then found is not among the missed ones: the run has waited for it. A file that was opened for
    writing, too, but that has not changed is an input like others, and was not written.
    """
    files: list[tuple[str, str, str | None, int | None]] = []
    for use in ("executed", "read"):
        for path in getattr(trace, use):
            file = contents.files.get(path)
            files.append((names.name(path), use, file and file.sha256, file and file.size))
    found = {*trace.found, *trace.refused}
    files += [(names.name(path), "found", contents.kinds.get(path), None) for path in found]
    seen = {*trace.executed, *trace.read, *found, *trace.links}
    files += [(names.name(path), "missed", None, None) for path in trace.missed if path not in seen]
    files += [(names.name(path), "listed", contents.folders.get(path), None) for path in trace.listed]
    for path, real in trace.links.items():
        file = contents.files.get(real)
        named = hashlib.sha256(os.fsencode(names.name(real))).hexdigest()
        if file is not None and real not in trace.executed:  # a program may look beside its real path for libraries
            files.append((names.name(path), "linked", file.sha256, file.size))
        else:
            files.append((names.name(path), "link", named, None))
    files += [(GPU, "read", graphics_sha256(), None)] if gpu else []
    sizes = ((path, file.size) for path, file in contents.files.items())
    changed = ["%s: %s" % (names.name(path), reason) for path, reason in sorted(contents.unusable.items())]
    reasons = (*trace.reasons, *changed[:MOST_NAMED])
    return {
        "method": trace.way,
        "reason": "; ".join(reasons) or None,
        "disturbed": trace.disturbed,
        "notes": list(trace.notes),
        "distributions": DISTRIBUTIONS.used(sizes),
        "files": sorted(set(files), key=lambda file: file[:2]),
        "listings": contents.listings,
        "channels": trace.channels,
        "written": sorted(
            {
                (names.name(path), use)
                for use in ("written", "removed", *REREAD)
                for path in getattr(trace, use)
                if path not in contents.files
            }
        ),
    }


def folders_to(path: str) -> Iterator[str]:
    """Yield a path and all folders above it but the root."""
    return map(os.fsdecode, with_folders(os.fsencode(path)))


def is_below(path: str, folder: str) -> bool:
    """Return whether a path is a folder or below it."""
    return path == folder or path.startswith(folder.rstrip("/") + "/")


def source_of(path: str) -> str | None:
    """Return the source of a compiled module of Python in a folder `__pycache__`; None if there is none."""
    folder, _, name = path.rpartition("/")
    if not folder.endswith("/" + PYTHON_CACHE):
        return None
    source = "%s/%s.py" % (folder[: -len(PYTHON_CACHE) - 1], name.split(".", 1)[0])
    return source if os.path.isfile(source) else None


def counts_itself(path: str) -> bool:
    """Return whether Python executes a compiled module without a look at its source (see PEP 552), or without one."""
    if source_of(path) is None:
        return True
    try:
        with open(path, "rb") as file:
            head = file.read(8)
    except OSError:
        return False
    return len(head) == 8 and struct.unpack("<I", head[4:])[0] & 3 == 1


class Distributions:
    """Installed distributions of Python by their files, from the RECORD files beside them; each folder is read once."""

    def __init__(self) -> None:
        self._folders: dict[str, Mapping[str, list[str]]] = {}

    def of(self, path: str) -> str | None:
        """Return the distribution of a file, for example `numpy-2.3.1`; None if none has installed it.

        A distribution without a RECORD, as Debian installs them, has the modules of its top_level.txt, or of its own name.
        """
        match = INSTALLED.fullmatch(path)
        if match is None:
            return None
        folder, name = match.groups()
        if folder not in self._folders:
            self._folders[folder] = owners(folder)
        top = name.partition("/")[0]
        found = self._folders[folder].get(top, [])
        several = (one for one in found if len(found) == 1 or name in recorded(folder, one))
        unrecorded = self._folders[folder].get("=" + normalized(top.partition(".")[0]), [])[:1]
        return next(iter((*several, *unrecorded)), None)

    def used(self, files: Iterable[tuple[str, int]]) -> list[str]:
        """Return the distributions whose code is in files with these sizes, as `name==version`, those with most bytes first."""
        sizes: dict[str, int] = {}
        for path, size in files:
            one = None if METADATA.search(path) else self.of(path)
            if one is not None:
                sizes[one] = sizes.get(one, 0) + size
        named = (one.partition("-") for one in sorted(sizes, key=lambda one: (-sizes[one], one)))
        return ["%s==%s" % (normalized(name), version) for name, _, version in named]


INSTALLED = re.compile(r"(.*/(?:site|dist)-packages)/(.*)", re.S)
METADATA = re.compile(r"\.(?:dist|egg)-info(?:/|$)|\.pth$")
"""Files that tools read although nobody imports the distribution."""
TOP = re.compile(rb"^\"?([^/,\"\n]+)", re.M)
DISTRIBUTIONS = Distributions()


def normalized(name: str) -> str:
    """Return the name of a distribution as it is compared: `JSBSim` and `jsbsim` are one (see PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def owners(folder: str) -> dict[str, list[str]]:
    """Return the distributions that have installed something in a folder, by the first part of its path.

    Modules of a distribution without a RECORD are there by their names, after `=`.
    """
    found: dict[str, list[str]] = {}
    for entry in sorted(entries_of(folder)):
        name, _, kind = entry.rpartition(".")
        if kind not in ("dist-info", "egg-info"):
            continue
        tops = {os.fsdecode(top) for top in TOP.findall(content_of(os.path.join(folder, entry, "RECORD")))}
        if not tops:
            modules = os.fsdecode(content_of(os.path.join(folder, entry, "top_level.txt"))).split()
            tops = {"=" + normalized(module) for module in modules or [name.partition("-")[0]]}
        for top in tops:
            found.setdefault(top, []).append(re.sub(r"-py\d.*", "", name))
    return found


def recorded(folder: str, distribution: str) -> Iterator[str]:
    """Yield the files that a distribution has installed in a folder."""
    for line in os.fsdecode(content_of(os.path.join(folder, distribution + ".dist-info", "RECORD"))).splitlines():
        yield line[1:].partition('"')[0] if line.startswith('"') else line.partition(",")[0]


def content_of(path: str) -> bytes:
    """Return the content of a file; empty if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read()
    except OSError:
        return b""
