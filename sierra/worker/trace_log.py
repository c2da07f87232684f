"""The log of strace for one run: its calls (CALLS), and what each of them means for the lists of a trace.

Also: programs as the kernel starts them: with the interpreters and loaders that their files name.
"""

from __future__ import annotations

import os
import re
import stat
import struct
from typing import IO, Any, Callable, Iterable, Iterator, Sequence

from sierra.worker.changed_names import ALONE, BOTH, EMPTIED, MADE, ChangedNames, clean, without_locks
from sierra.worker.channels import INTERNET, UNIX, Channels
from sierra.worker.file_trace import LISTS, Trace, nothing
from sierra.worker.files import HEAD_BYTES
from sierra.worker.traced_processes import (
    FILE,
    STARTERS,
    Call,
    Damaged,
    Folder,
    Process,
    Processes,
    opened_path,
    parse,
    plain,
    without_escapes,
)

SCRIPTS = 5  # scripts whose interpreters are scripts: the kernel allows as many


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


NAME = rb'"((?:[^"\\]|\\.)*)"(\.\.\.)?'
PLAIN, AT, TARGET = rb"()()" + NAME, FILE + rb", " + NAME, rb'"(?:[^"\\]|\\.)*"(?:\.\.\.)?, '
ONE, ONE_AT = re.compile(PLAIN), re.compile(AT)
"""Arguments that begin with one name, of four groups: a folder's descriptor, its path, the name, and `...` if it is cut."""
TWO, TWO_AT = re.compile(PLAIN + rb", " + PLAIN), re.compile(AT + rb", " + AT)
LINK, LINK_AT = re.compile(TARGET + PLAIN), re.compile(TARGET + AT)
FLAG = re.compile(rb"O_[A-Z]+")
MISSING = frozenset((b"ENOENT", b"ENOTDIR"))
FORBIDDEN = frozenset((b"EACCES", b"EPERM", b"EROFS"))
PRESENT = frozenset(
    b"EEXIST EISDIR EINVAL ELOOP ENXIO ETXTBSY ENOEXEC EBUSY ENOTEMPTY EXDEV E2BIG ELIBBAD EFBIG EOVERFLOW".split()
)
CONNECTED = frozenset((None, b"EINPROGRESS", b"EAGAIN", b"EINTR"))
UNREADABLE = frozenset((b"EFAULT", b"?"))
CONTENT = frozenset((b"O_WRONLY", b"O_RDWR", b"O_ACCMODE", b"O_TRUNC"))
"""Flags of a call that may change the content of a file."""
WRITING = CONTENT | {b"O_CREAT"}
FOLDERS = frozenset((b"O_PATH", b"O_DIRECTORY"))
LOG_BYTES = 256 << 20
LINE_BYTES = 1 << 18  # names of 4096 bytes, each of them as \377, and 32 words
MOST_PATHS = 1 << 20
MOST_NOTES = 100
MOUNTS = "it changed its mounts"
ESCAPES = {
    b"io_uring_setup": "it used io_uring, whose reads cannot be seen",
    b"chroot": "it changed its root folder",
    b"pivot_root": "it changed its root folder",
    **dict.fromkeys((b"mount", b"umount2", b"move_mount", b"open_tree"), MOUNTS),
    b"setns": "it entered another namespace",
    b"pidfd_getfd": "it took an open file from another process",
    b"uselib": "it loaded a library by uselib",
}


class Log:
    """The reader of a log of strace: it is fed line by line, then asked for the trace."""

    def __init__(self, cwd: bytes, own: Iterable[bytes] = (), *, conducted: bool = False) -> None:
        """Begin in the folder `cwd`. The run's own folders are that above it, and `own`.

        `conducted`: what the first process does itself is not the run's doing.
        """
        self._conducted = conducted
        self._reasons: dict[str, None] = {}
        self._notes: dict[str, None] = {}
        self.disturbed: str | None = None
        self._cut: str | None = None
        """Why the rest of the log was not read."""
        self._started = False
        self._processes = Processes(cwd, self._call, self._reasons)
        self._names = ChangedNames((os.path.dirname(cwd), *own), self._reasons)
        self._channels = Channels()
        self._executed: dict[bytes, None] = {}
        self._lists: dict[str, set[bytes]] = {name: set() for name in LISTS}
        self._links: dict[bytes, bytes] = {}
        self._read_links: set[bytes] = set()

    def read(self, file: IO[bytes], check_stop: Callable[[], None] = nothing, *, living: bool = False) -> int:
        """Read a log, at most LOG_BYTES of it; return how many bytes it has. `living`: leave out a line without an end."""
        count = 0
        for number, line in enumerate(iter(lambda: file.readline(LINE_BYTES), b"")):
            if living and not line.endswith(b"\n") and len(line) < LINE_BYTES:
                break
            count += len(line)
            if number % 4096 == 0:
                check_stop()
                if self._has_too_many():
                    self._cut = "it used more than %d files" % MOST_PATHS
                    break
            if count > LOG_BYTES:
                self._cut = "its log is longer than %d bytes" % LOG_BYTES
                break
            self._processes.add(line)
        if not living:
            self._processes.adopt_all()
        return count

    def _has_too_many(self) -> bool:
        used = sum(len(self._lists[name]) for name in ("read", "found", "missed"))
        return used + len(self._names.written) + len(self._names.origins) > MOST_PATHS

    def damage(self, reason: str) -> None:
        """Note that the log or the tracer is not as it should be, and so perhaps the run is not either."""
        self._reasons[reason] = None
        self.disturbed = self.disturbed or reason

    # Calls and the paths that they name

    def _call(self, process: Process, text: bytes) -> None:
        """A call has returned."""
        call = parse(text)
        if call.name not in CALLS:
            raise Damaged
        if process.moved:  # strace misprints the result
            process.moved, call = False, call._replace(number=0, error=None)
        if self._conducted and process.pid == self._processes.first and call.name not in STARTERS:
            self._started = self._started or (call.name == b"execve" and call.number == 0)
            return
        form, effect = CALLS[call.name]
        if form is None:
            effect(self, process, call)
        elif b', "", ' in call.words and effect in LOOKS and b"AT_FDCWD" not in call.words:
            pass  # the status of an open file
        elif paths := self._paths(process, call, form):
            if call.error:
                self._fail_any(paths, call.error)
            else:
                effect(self, process, call, *paths)

    def _paths(self, process: Process, call: Call, form: re.Pattern[bytes]) -> list[bytes]:
        """Return the paths that a call names; none if one of them is unknown."""
        match = form.match(call.words)
        if match is None:
            if call.error in UNREADABLE or b"NULL" in call.words:
                return []
            raise Damaged
        groups = match.groups()
        paths = [self._path(process, call, groups[:4])]
        if len(groups) > 4:
            paths.append(self._path(process, call, groups[4:]))
        return paths if all(paths) else []

    def _path(self, process: Process, call: Call, words: Sequence[bytes]) -> bytes:
        """Return the path that the words of a form name; empty if it is unknown."""
        opened, folder, name, cut = words
        if cut:
            if call.error:
                return b""
            raise Damaged
        name = plain(name)
        if opened == b"AT_FDCWD" and folder:
            process.folder.path = plain(folder)
        if name.startswith(b"/"):
            return clean(name)
        base = process.folder.path if opened in (b"", b"AT_FDCWD") else plain(folder or b"")
        if base is None or not base.startswith(b"/"):
            if not call.error:
                self._reasons["it used a relative name in an unknown folder"] = None
            return b""
        return clean(base + b"/" + name) if name else base

    def _fail_any(self, paths: Sequence[bytes], error: bytes) -> None:
        """A call failed. If it names two paths, the error may not tell which of them is to blame."""
        if len(paths) == 1 or error not in MISSING:
            self._fail(paths[-1], error)
        else:
            for path in paths:
                if not os.path.lexists(path):
                    self._fail(path, error)

    def _fail(self, path: bytes, error: bytes) -> None:
        """A path could not be used."""
        if error == b"ENOTDIR" and path not in self._lists["missed"] and os.path.lexists(path):
            self._find(path)  # a file that was used like a folder
        elif error in MISSING:
            self._find(path, "missed")
        elif error in FORBIDDEN:
            self._lists["refused"].add(path)
        elif error in PRESENT:
            self._find(path)

    def _find(self, path: bytes, name: str = "found") -> None:
        """Add a path to the list of this name, unless the run has made or removed it itself."""
        if path not in self._lists[name] and not self._names.is_own(path):
            self._lists[name].add(path)

    # The effects of calls

    def start(self, process: Process, call: Call) -> None:
        """A process starts another one, or a thread."""
        self._processes.start(process, call)
        if b"CLONE_NEWNS" in call.words and call.number > 0:
            self._reasons[MOUNTS] = None

    def change_folder(self, process: Process, call: Call, path: bytes) -> None:
        process.folder.path = path
        self.look_at_link(process, call, path)

    def change_to_open_folder(self, process: Process, call: Call) -> None:
        if not call.error:
            path = opened_path(call)
            process.folder.path = path if path.startswith(b"/") else None

    def unshare(self, process: Process, call: Call) -> None:
        if not call.error:
            if b"CLONE_NEWNS" in call.words:
                self._reasons[MOUNTS] = None
            process.folder = Folder(process.folder.path)

    def execute(self, process: Process, call: Call) -> None:
        paths = self._paths(process, call, ONE_AT if call.name == b"execveat" else ONE)
        if not paths:
            if not call.error:
                self._reasons["it executed a file without a name"] = None
            return
        (path,) = paths
        if call.error == b"ENOENT" and os.path.exists(path):
            self._find(path)
            self._lists["missed"].update(missing_interpreter(path))
        elif call.error:
            self._fail(path, call.error)
        else:
            self._started = True
            if not path.startswith(b"/proc/"):
                self._executed[path] = None
                self._names.use_links(path)
                self._names.use(self._names.real(path))
            elif not path.endswith(b"/exe"):
                self._reasons["it executed a file through /proc"] = None

    def open(self, process: Process, call: Call, path: bytes) -> None:
        flags = {b"O_WRONLY", b"O_CREAT", b"O_TRUNC"} if call.name == b"creat" else set(FLAG.findall(call.flags))
        real = self._names.real(path) if call.path is None else plain(call.path)
        if not real.startswith(b"/"):
            return  # a pipe or a socket
        self._names.use_links(path)
        if b"O_TMPFILE" in flags:
            return
        if flags & FOLDERS:
            self._find(path)
            self._follow(path, real)
        else:
            self._use(path, real, flags)

    def open_by_handle(self, process: Process, call: Call) -> None:
        """A file is opened without a name."""
        if not call.error:
            real = plain(call.path or b"")
            if real.startswith(b"/"):
                self._use(real, real, set(FLAG.findall(call.words)))
            else:
                self._reasons["it opened a file without a name"] = None

    def _use(self, path: bytes, real: bytes, flags: set[bytes]) -> None:
        new = flags >= {b"O_CREAT", b"O_EXCL"}
        empty = b"O_TRUNC" in flags or new
        if b"O_WRONLY" not in flags and not empty:
            self._read_file(path, real)
        if flags & WRITING:
            self._names.write(real, created=empty, new=new, content=bool(flags & CONTENT))
        if not (new or b"O_WRONLY" in flags):
            self._names.use(real, EMPTIED if b"O_TRUNC" in flags else BOTH if flags & CONTENT else ALONE)

    def _read_file(self, path: bytes, real: bytes) -> None:
        origin = self._names.origin(real)
        if origin is None:
            self._lists["read"].add(real)
            self._follow(path, real)
        elif origin:
            self._lists["read"].add(origin)

    def _follow(self, path: bytes, real: bytes) -> None:
        """Note that a path led to another one, unless by a link that the run has made."""
        if path != real and not path.startswith(b"/proc/") and self._names.real(path) not in self._names.origins:
            self._links[path] = real

    def look(self, process: Process, call: Call, path: bytes) -> None:
        """Record that the status of a path is requested."""
        self._find(path)

    def look_at_link(self, process: Process, call: Call, path: bytes) -> None:
        self._find(path)
        self._read_links.add(path)
        self._names.use_links(path)

    def list(self, process: Process, call: Call) -> None:
        path = opened_path(call)
        if call.error:
            return
        if not path.startswith(b"/"):
            raise Damaged
        self._find(path, "listed")

    def truncate(self, process: Process, call: Call, path: bytes) -> None:
        self._names.use_links(path)
        self._names.write(os.path.realpath(path), created=False)

    def make(self, process: Process, call: Call, path: bytes) -> None:
        """A folder or a node is made."""
        self._names.make(path)

    def make_link(self, process: Process, call: Call, path: bytes) -> None:
        real = self._names.make(path)
        target = ONE.match(call.words)
        if target and not self._names.is_in_own_folder(real):
            self._names.note_link(real, clean(os.path.join(os.path.dirname(real), plain(target.group(3)))))

    def remove(self, process: Process, call: Call, path: bytes) -> None:
        self._names.remove(self._names.real(path))

    def link(self, process: Process, call: Call, old: bytes, new: bytes) -> None:
        source, target = self._names.real(old), self._names.real(new)
        is_nameless = old.startswith(b"/proc/") or b"AT_EMPTY_PATH" in call.flags
        self._names.link(source, target, MADE if is_nameless else self._names.origin(source))

    def rename(self, process: Process, call: Call, old: bytes, new: bytes) -> None:
        if b"RENAME_EXCHANGE" in call.flags:
            self._reasons["it exchanged two names"] = None
        source, target = self._names.real(old), self._names.real(new)
        if source != target:
            self._names.rename(source, target, new=b"RENAME_NOREPLACE" in call.flags)

    # What cannot be seen

    def escape(self, process: Process, call: Call) -> None:
        if not call.error:
            self._reasons[ESCAPES[call.name]] = None

    def filter(self, process: Process, call: Call) -> None:
        if b"NEW_LISTENER" in call.words and not call.error:
            self._reasons["another process answers its calls"] = None

    def trace_others(self, process: Process, call: Call) -> None:
        self._reasons["it traces processes, or lets itself be traced"] = None
        self.disturbed = self.disturbed or "it traces processes, or lets itself be traced, which strace prevents"

    def make_socket(self, process: Process, call: Call) -> None:
        if not call.error:
            self._channels.make(call)

    def set_option(self, process: Process, call: Call) -> None:
        self._channels.set_option(call)

    def bind(self, process: Process, call: Call) -> None:
        self._channels.bind(call, process.pid, self._unix(process, call))

    def _unix(self, process: Process, call: Call) -> str | None:
        """Return the name of a Unix socket in a call that others can use, too: `@name` if it is abstract, or its path."""
        local = UNIX.search(call.words)
        if local is None or not local.group(2):
            return None
        name, cwd = without_escapes(local.group(2)), process.folder.path
        if local.group(1):
            return "@" + os.fsdecode(name)
        if b"\0" in name or not (name.startswith(b"/") or cwd):
            return None
        real = self._names.real(clean(os.path.join(cwd or b"/", name)))
        return None if self._names.is_in_own_folder(real) or self._names.is_new(real) else os.fsdecode(real)

    def connect(self, process: Process, call: Call) -> None:
        local, remote = UNIX.search(call.words), INTERNET.search(call.words)
        if call.error in CONNECTED:
            self._channels.connect(call, self._unix(process, call), remote)
        if local:
            name = without_escapes(local.group(2))  # may be abstract, and contain any byte
            if call.error in MISSING:
                if not local.group(1) and name.startswith(b"/") and b"\0" not in name:
                    self._fail(clean(name), b"ENOENT")
            elif call.error in CONNECTED:
                self._note("may have read through the socket %s" % os.fsdecode(local.group(1) + name))
        elif remote and call.error in CONNECTED:
            self._note("may have read from %s, port %s" % (remote.group(2).decode(), remote.group(1).decode()))

    def listen(self, process: Process, call: Call) -> None:
        self._channels.listen(call, process.pid)
        self._note("waited for connections")

    def share(self, process: Process, call: Call) -> None:
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
        folders = {path for path in self._lists["read"] if os.path.isdir(path)}
        read = self._lists["read"] - folders - programs
        found_paths = (self._lists["found"] | folders) - read - programs - set(self._links)
        changed = {"written": self._names.written, "removed": self._names.removed}
        lists: dict[str, Any] = {**self._lists, **changed, "executed": programs, "read": read, "found": found_paths}
        return Trace(
            way,
            **{name: tuple(sorted(map(os.fsdecode, paths))) for name, paths in lists.items()},
            reread=without_locks(self._names.reread),
            reread_new=without_locks(self._names.reread_new, new=True),
            links={os.fsdecode(path): os.fsdecode(self._links[path]) for path in sorted(self._links)},
            channels=tuple((one_line(name), use) for name, use in self._channels.used()),
            reasons=tuple(map(one_line, (*self._reasons, *(self._now_unknown() if living else ())))),
            disturbed=self.disturbed and one_line(self.disturbed),
            notes=tuple(map(one_line, self._notes)),
        )

    def _check_lines(self, *, living: bool) -> None:
        if self._processes.damaged:
            self.damage("%d lines of the log are not understood" % self._processes.damaged)
        if not living:
            if not self._started and not self._reasons:
                self.damage("the tracer did not start it")
            for reason in self._processes.unended():
                self.damage(reason)

    def _now_unknown(self) -> Iterator[str]:
        """Yield why something that programs have done until now is not known yet."""
        if not self._started:
            yield "it had not begun"
        if self._processes.waiting:
            yield "a process had just begun"

    def _programs(self) -> set[bytes]:
        """Return the real paths of all that the kernel executed, except what the run had made itself."""
        programs: set[bytes] = set()
        pending = [(path, 0) for path in self._executed]
        for path, depth in pending:
            real = os.path.realpath(path)
            origin, name = self._names.origin(real), os.fsdecode(real)
            if origin is None:
                programs.add(real)
                self._follow(path, real)
            elif origin:
                programs.add(origin)
            if is_privileged(real):
                self.damage("%s is setuid, and could not get its rights" % name)
            try:
                interpreter = interpreter_of(name)
            except (OSError, ValueError):
                self._reasons["what executes %s is unknown" % name] = None
                continue
            if interpreter and not os.path.isabs(interpreter):
                self._reasons["%s names a relative interpreter" % name] = None
            elif interpreter and depth <= SCRIPTS:
                pending.append((os.fsencode(interpreter), depth + 1))
        return programs


def missing_interpreter(path: bytes) -> list[bytes]:
    """Return what the kernel has looked for and not found in order to execute a file."""
    try:
        interpreter = interpreter_of(os.fsdecode(path))
    except (OSError, ValueError):
        return []
    return [] if interpreter is None or os.path.exists(interpreter) else [os.fsencode(interpreter)]


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


LOOKS = frozenset((Log.look, Log.look_at_link))
EFFECTS: tuple[tuple[str, re.Pattern[bytes] | None, Callable[..., None]], ...] = (
    ("execve execveat", None, Log.execute),
    ("open creat", ONE, Log.open),
    ("openat openat2", ONE_AT, Log.open),
    ("open_by_handle_at", None, Log.open_by_handle),
    ("access stat lstat stat64 lstat64", ONE, Log.look),
    ("faccessat faccessat2 newfstatat fstatat64 statx name_to_handle_at", ONE_AT, Log.look),
    ("readlink", ONE, Log.look_at_link),
    ("readlinkat", ONE_AT, Log.look_at_link),
    ("getdents getdents64", None, Log.list),
    ("truncate", ONE, Log.truncate),
    ("mkdir mknod", ONE, Log.make),
    ("mkdirat mknodat", ONE_AT, Log.make),
    ("symlink", LINK, Log.make_link),
    ("symlinkat", LINK_AT, Log.make_link),
    ("unlink rmdir", ONE, Log.remove),
    ("unlinkat", ONE_AT, Log.remove),
    ("link", TWO, Log.link),
    ("linkat", TWO_AT, Log.link),
    ("rename", TWO, Log.rename),
    ("renameat renameat2", TWO_AT, Log.rename),
    ("chdir", ONE, Log.change_folder),
    ("fchdir", None, Log.change_to_open_folder),
    (b" ".join(STARTERS).decode(), None, Log.start),
    ("unshare", None, Log.unshare),
    (b" ".join(ESCAPES).decode(), None, Log.escape),
    ("seccomp", None, Log.filter),
    ("ptrace", None, Log.trace_others),
    ("socket", None, Log.make_socket),
    ("setsockopt", None, Log.set_option),
    ("bind", None, Log.bind),
    ("listen", None, Log.listen),
    ("connect", None, Log.connect),
    ("shmget semget msgget mq_open", None, Log.share),
)
CALLS = {name.encode(): (form, effect) for names, form, effect in EFFECTS for name in names.split()}
"""The calls that are traced: the form of their arguments, if these name paths, and what they do then."""
