"""Processes in a log of strace: which ones there are, in which folders they work, and the calls of each.

Also: calls in a log of strace: parsed into the call's name, its arguments and its result.

strace prints paths whole and escaped, whatever `-s` says. A call ends with `) = RESULT`, which a name may contain too.
"""

from __future__ import annotations

import re
from typing import Callable, Iterator, NamedTuple

END = re.compile(rb"\) += ")
CALL = re.compile(rb'(\w+\((?:"(?:[^"\\]|\\.)*"|<(?:[^<>\\]|\\.)*>|[^"<])*?)\) += (?=-?\d|\?)(.*)', re.S)
RESULT = re.compile(rb"(-?\d+|\?)(?: <unavailable>)?(?:<((?:[^<>\\]|\\.)*)>(?:\(deleted\))?)?(?: (?:(E[A-Z0-9]+) )?\(.*\))?")
FILE = rb"(AT_FDCWD|-?\d+)(?:<((?:[^<>\\]|\\.)*)>(?:\(deleted\))?)?"
OPENED = re.compile(FILE)
ESCAPED = re.compile(rb"\\([0-7]{1,3}|x[0-9a-f]{2}|.)", re.S)
C_ESCAPES = {b"n": b"\n", b"t": b"\t", b"r": b"\r", b"v": b"\v", b"f": b"\f"}


class Damaged(Exception):
    """A line of a log is not what strace writes, or is not understood."""


class Call(NamedTuple):
    """A call that has returned."""

    name: bytes
    words: bytes
    """Its arguments."""
    number: int
    """The number that it returned; negative for an error."""
    path: bytes | None
    """The path of the descriptor that it returned."""
    error: bytes | None

    @property
    def flags(self) -> bytes:
        """The arguments behind the last name."""
        return self.words.rpartition(b'"')[2]


def parse(text: bytes) -> Call:
    """Return the call in a line, without the id of its process. Raises Damaged or ValueError if it is not a call."""
    pieces = END.split(text)
    if len(pieces) != 2:  # the same characters are in a name
        whole = CALL.fullmatch(text)
        pieces = list(whole.groups()) if whole else [b"", b""]
    name, opened, words = pieces[0].partition(b"(")
    match = RESULT.fullmatch(pieces[1])
    if match is None or not opened:
        raise Damaged
    value, path, error = match.groups()
    number = -1 if value == b"?" else int(value, 0)
    if number < 0 and not error:
        error = b"?" if value == b"?" else b"-"
    return Call(name, words, number, path, error)


def plain(text: bytes) -> bytes:
    """Return a path that strace has printed with escapes."""
    if b"\\" in text:
        text = without_escapes(text)
    if b"\0" in text:
        raise Damaged
    return text


def without_escapes(text: bytes) -> bytes:
    return ESCAPED.sub(unescaped, text)


def unescaped(match: re.Match[bytes]) -> bytes:
    code = match.group(1)
    if code[:1].isdigit():
        return bytes([int(code, 8) & 0xFF])
    if len(code) == 3:
        return bytes([int(code[1:], 16)])
    return C_ESCAPES.get(code, code)


def opened_path(call: Call) -> bytes:
    """Return the path of the descriptor that is a call's first argument; empty if it has none."""
    match = OPENED.match(call.words)
    return plain(match.group(2)) if match and match.group(2) else b""


RESUMED = re.compile(rb"<\.\.\. (\w+) resumed>")
MOVED = re.compile(rb"(.*) <pid changed to (\d+) \.\.\.>")
SUPERSEDED = re.compile(rb"\+\+\+ superseded by execve in pid (\d+) \+\+\+")
OVER = re.compile(rb"\+\+\+ (?:exited with \d+|killed by \w+(?: \(core dumped\))?) \+\+\+")
UNFINISHED = b" <unfinished ...>"
STARTERS = (b"clone", b"clone3", b"fork", b"vfork")
KILLED = "it was killed while it started a process"
MOST_WAITING = 1 << 16  # lines of processes whose parent is not known yet


class Folder:
    """A working directory, which threads share; None if it is unknown."""

    __slots__ = ("path",)

    def __init__(self, path: bytes | None) -> None:
        self.path = path


class Process:
    """A process or thread in a log: its working directory, and the beginning of a call that has not returned."""

    __slots__ = ("begun", "folder", "moved", "pid", "seen")

    def __init__(self, pid: bytes, folder: Folder, *, seen: bool) -> None:
        self.pid, self.folder = pid, folder
        self.seen = seen
        """True if it has a line of its own, and not only the call that started it."""
        self.begun = b""
        self.moved = False
        """True if its call is an execve of another thread, which has taken its id."""


class Processes:
    """Joins the lines of each process to whole calls, and hands these over."""

    def __init__(self, cwd: bytes, call: Callable[[Process, bytes], None], reasons: dict[str, None]) -> None:
        """The first process begins in the folder `cwd`. `reasons`: here it is noted why the log does not tell everything."""
        self._cwd, self._call, self._reasons = cwd, call, reasons
        self.first = b""
        """The id of the first process; empty before its first line."""
        self.damaged = self._kept = self._strays = 0
        self._living: dict[bytes, Process] = {}
        self._starting: dict[bytes, Process] = {}
        """The processes that are just starting another one, by their ids."""
        self._adopters: set[bytes] = set()
        """The starting processes whose new process appeared before the call that started it returned."""
        self.waiting: dict[bytes, list[bytes]] = {}
        """The lines of processes whose parent is not known yet, by their ids."""

    def add(self, line: bytes) -> None:
        """Add a line. One that is not understood is counted."""
        try:
            self._add(line)
        except (Damaged, ValueError):
            self.damaged += 1

    def _add(self, line: bytes) -> None:
        pid, _, rest = line.partition(b" ")
        if not pid.isdigit() or rest[-1:] != b"\n":
            raise Damaged
        rest = rest[:-1].lstrip(b" ")
        process = self._living.get(pid) or self._appear(pid)
        if process is None:
            self._keep(pid, line)
            return
        process.seen = True
        if rest.startswith(b"+++ "):
            self._end(process, rest)
        elif not rest.startswith(b"--- "):  # else a signal
            self._piece(process, rest)

    def _appear(self, pid: bytes) -> Process | None:
        """Return the process whose first line is here; None if its parent is not known yet."""
        if not self.first:
            self.first = pid
            return self._enter(pid, Folder(self._cwd))
        if pid in self.waiting or len(self._starting) != 1:
            return None
        if not all(process.seen for process in self._living.values()):
            return None  # in another namespace, its own parent may have called it by another id
        parent, starter = self._starting.popitem()
        self._adopters.add(parent)
        return self._enter(pid, inherited(starter, starter.begun))

    def _enter(self, pid: bytes, folder: Folder, *, seen: bool = True) -> Process:
        process = self._living[pid] = Process(pid, folder, seen=seen)
        return process

    def _keep(self, pid: bytes, line: bytes) -> None:
        """Keep a line until the parent of its process is known."""
        self.waiting.setdefault(pid, []).append(line)
        self._kept += 1
        if self._kept > MOST_WAITING:
            self.adopt_all()

    def _adopt(self, pid: bytes, folder: Folder) -> None:
        lines = self.waiting.pop(pid)
        self._kept -= len(lines)
        self._enter(pid, folder)
        for line in lines:
            self.add(line)

    def adopt_all(self) -> None:
        """Add the lines of processes whose parents remain unknown, and so their folders."""
        while self.waiting:
            self._strays += 1
            self._adopt(next(iter(self.waiting)), Folder(None))

    def _end(self, process: Process, rest: bytes) -> None:
        if OVER.fullmatch(rest):
            del self._living[process.pid]
            if self._starting.pop(process.pid, None) is not None:
                self._reasons[KILLED] = None
            self._adopters.discard(process.pid)
            return
        superseded = SUPERSEDED.fullmatch(rest)
        if superseded is None:
            raise Damaged
        if not process.moved:  # else an earlier line has told
            thread = self._living.get(superseded.group(1))
            if thread is None or not thread.begun.startswith(b"execve"):
                raise Damaged
            self._move(thread, thread.begun, process.pid)

    def _piece(self, process: Process, rest: bytes) -> None:
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
                self._starting[process.pid] = process
            return
        moved = MOVED.fullmatch(rest) if rest.endswith(b" ...>") else None
        if moved:
            self._move(process, *moved.groups())
        else:
            self._call(process, rest)

    def _move(self, thread: Process, begun: bytes, leader: bytes) -> None:
        """A thread executes a program: it gets the id of its process, and all other threads end."""
        heir = self._living.get(leader)
        if heir is None or heir is thread:
            raise Damaged
        del self._living[thread.pid]
        self._starting.pop(leader, None)
        heir.begun, heir.folder, heir.moved = begun, thread.folder, True

    def start(self, process: Process, call: Call) -> None:
        """A process has started another one, or a thread."""
        self._starting.pop(process.pid, None)
        if process.pid in self._adopters:
            self._adopters.remove(process.pid)
        elif call.error == b"?":
            self._reasons[KILLED] = None
        elif call.number > 0:
            self._expect(b"%d" % call.number, inherited(process, call.words))

    def _expect(self, child: bytes, folder: Folder) -> None:
        if child in self._living:
            raise Damaged
        if child in self.waiting:
            self._adopt(child, folder)
        else:
            self._enter(child, folder, seen=False)

    def unended(self) -> Iterator[str]:
        """Yield why the log does not tell of all processes until they end."""
        if any(process.seen for process in self._living.values()):
            yield "the log ends before the run: the tracer was killed, or the log was cut"
        if sum(not process.seen for process in self._living.values()) > self._strays:
            yield "a process is not in the log: it escaped the tracer, or the log was cut"


def inherited(parent: Process, words: bytes) -> Folder:
    """Return the folder of a process that its parent starts by a call with these arguments."""
    return parent.folder if b"CLONE_FS" in words else Folder(parent.folder.path)
