"""The result log (pack) of an attempt: a file to which an array task appends the events of its runs, and the files they left.

It is a sequence of records: a line of JSON and, if that has a `size`, as many bytes followed by a line feed. The last key of a
line is `check`, the beginning of the SHA-256 of the line without it. A record that is not complete, up to its last line feed,
counts as not written (on a network file system, bytes may arrive in any order); nothing is written after it. If a record cannot
be written completely, it is removed (by truncation), and the attempt ends. The events are those in EVENTS, `stalled` (as the
worker writes it) and `end`: see `Packed`.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import json
import os
import stat
import time
from typing import TYPE_CHECKING, Callable, Iterable, Iterator, Mapping, NamedTuple, Tuple, Union

from sierra.worker.files import CHUNK
from sierra.worker.outputs import hashed

if TYPE_CHECKING:
    from typing import BinaryIO, Literal, TypedDict, final

    from sierra.worker.journal import Outcome
    from sierra.worker.machine import Fact

    class Packed(Outcome):
        """The record that a run has ended, by itself or by a limit; `size` is the total size of its files."""

        event: Literal["end"]
        files: list[File]
        """In the order of the payload: `stdout`, `stderr` (omitted if empty), `observed.json` (if the run was observed), and
        `output/…` for each of the outputs."""
        size: int

    @final
    class Other(TypedDict):
        """A record without a payload."""

        event: Literal["attempt", "start", "stalled", "requeue", "trouble", "finished"]


SYNC_S = 2.0
LINE_BYTES = 1 << 28
CHECK = b',"check":"'
CHECK_DIGITS = 16
File = Tuple[str, int, str]
"""Path, size and SHA-256 of a file."""


class Attempt(NamedTuple):
    """The first record of a pack: where and with what an attempt began."""

    attempt: str
    session: str
    element: int
    job: str
    """The task's id in its scheduler, for example `12_3` or `12[3].server`; empty without a scheduler."""
    node: str
    started: float
    """By the node's clock, in seconds since the epoch, like all times in records."""
    slots: int
    """Number of runs that execute at a time: the requested number, but at most the number of usable cores."""
    cpus: int
    """Number of allocated cores."""
    memory: int | None
    """Bytes."""
    gpus: str | None
    allocation: dict[str, str]
    """The scheduler's variables."""
    facts: dict[str, Fact]
    """See `machine.facts`."""
    variables: dict[str, str]
    """The environment variables that `record` names."""
    python: str
    clock: float
    """Seconds that the node's clock is ahead of the shared file system's."""
    end: float | None = None
    """The time at which the scheduler will end the task; None if it is unknown."""


class Started(NamedTuple):
    """A run has begun."""

    execution: str
    time: float
    alone: bool = False
    """True if no other run executes on the element meanwhile."""


class Requeued(NamedTuple):
    """The attempt requests its scheduler to start the task again, because its time is nearly over."""

    time: float
    refused: str | None
    """The reason why the scheduler refuses; None if it does not."""


class Trouble(NamedTuple):
    """The attempt could not continue."""

    reason: str
    """One line."""
    full: bool
    """True if a disk was full, so that no run is the cause."""


class Finished(NamedTuple):
    """All missing runs of the element have been executed."""

    time: float


Record = Union[Attempt, Started, Requeued, Trouble, Finished]
EVENTS = {Attempt: "attempt", Started: "start", Requeued: "requeue", Trouble: "trouble", Finished: "finished"}


def line_of(record: Mapping[str, object]) -> bytes:
    """Return the line for a record."""
    return with_check(json.dumps(record, separators=(",", ":")).encode())


def with_check(text: bytes) -> bytes:
    """Return the line for a record in JSON, with its check."""
    return text[:-1] + CHECK + hashlib.sha256(text).hexdigest()[:CHECK_DIGITS].encode() + b'"}\n'


def record_in(line: bytes) -> Packed | Other | None:
    """Return the record in a line; None if the line is incomplete or damaged."""
    text = line.rpartition(CHECK)[0] + b"}"
    if line != with_check(text):
        return None
    record: Packed | Other = json.loads(text)
    return record


def records(file: BinaryIO, offset: int) -> Iterator[tuple[Packed | Other, int, int]]:
    """Yield the complete records from `offset` on, each with the offsets of its payload and of the next record."""
    while True:
        file.seek(offset)
        line = file.readline(LINE_BYTES)
        record = record_in(line)
        if record is None:
            return
        at = offset = offset + len(line)
        if "size" in record:
            offset += record["size"] + 1
            file.seek(offset - 1)
            if file.read(1) != b"\n":
                return
        yield record, at, offset


class Pack:
    """The result file of this attempt. Complete records are appended to it, and incomplete ones are removed."""

    def __init__(self, folder: str, index: str, attempt: str) -> None:
        """Create the file. Raises FileExistsError if the name is taken."""
        self.path = os.path.join(folder, "%s.%s.pack" % (index, attempt))
        self._file = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o666)
        self.started = os.fstat(self._file).st_mtime
        """When it was created, by the file system's clock."""
        self.clock = time.time() - self.started
        """The seconds that this node's clock is ahead of the file system's, by the time of the new file."""
        self._whole = self._synced = 0
        self._pending = bytearray()
        self._sync_at = 0.0

    def note(self, record: Record, *, sync: bool = False) -> None:
        """Append a record, without fields that have their default values; with `sync`, write it to the disk."""
        defaults = record._field_defaults
        fields = {name: value for name, value in record._asdict().items() if name not in defaults or value != defaults[name]}
        self.add(line_of({"event": EVENTS[type(record)], **fields}))
        if sync:
            self.sync(float("inf"))

    def add(self, line: bytes, size: int = 0, payload: Iterable[bytes] = ()) -> None:
        """Append the line of a record, and its payload of `size` bytes. If `payload` raises, the pack stays as it was."""
        if size > CHUNK:
            self.flush()
            self._append(line, payload)
        else:
            self._pending += b"".join((line, *payload))
        if len(self._pending) > CHUNK:
            self.flush()

    def flush(self) -> None:
        if self._pending:
            self._append(bytes(self._pending))
            self._pending.clear()

    def _append(self, line: bytes, payload: Iterable[bytes] = ()) -> None:
        at = self._whole
        try:
            for part in itertools.chain((line,), payload):
                at = self._write(part, at)
        except BaseException:
            self._take_back(self._whole)
            raise
        self._whole = at

    def _write(self, data: bytes, at: int) -> int:
        view = memoryview(data)
        while view:
            written = os.pwrite(self._file, view, at)
            at += written
            view = view[written:]
        return at

    def sync(self, now: float) -> None:
        """Flush the data to the disk, if it is time to: a network file system reports only then that there is no space."""
        self.flush()
        if now < self._sync_at or self._synced == self._whole:
            return
        try:
            os.fsync(self._file)
        except OSError:
            self._take_back(self._synced)
            raise
        self._synced, self._sync_at = self._whole, time.monotonic() + SYNC_S

    def _take_back(self, size: int) -> None:
        self._pending.clear()
        self._whole, self._synced = size, min(size, self._synced)
        with contextlib.suppress(OSError):
            os.ftruncate(self._file, size)

    def is_gone(self) -> bool:
        """Return whether the pack, or its folder, has been removed."""
        try:
            return not os.path.samestat(os.stat(self.path), os.fstat(self._file))
        except OSError as error:
            return error.errno in (errno.ENOENT, errno.ENOTDIR, errno.ESTALE)


def executed(folder: str, index: str, own: str, check_stop: Callable[[], None]) -> set[bytes]:
    """Return the executions whose end other attempts have recorded with all files intact. Calls `check_stop` for each chunk."""
    executions = set()
    for name in os.listdir(folder):
        path = os.path.join(folder, name)
        if name.startswith(index + ".") and name.endswith(".pack") and path != own:
            with contextlib.suppress(FileNotFoundError), open(path, "rb") as file:
                for record, at, _ in records(file, 0):
                    if record["event"] == "end" and is_sound(file, at, record["files"], check_stop):
                        executions.add(short(record["execution"]))
    return executions


def is_sound(file: BinaryIO, at: int, files: list[File], check_stop: Callable[[], None]) -> bool:
    """Return whether a payload matches its hashes. Calls `check_stop` for each chunk."""
    file.seek(at)
    for _, size, sha256 in files:
        digest = hashlib.sha256()
        while size:
            check_stop()
            chunk = file.read(min(size, CHUNK))
            if not chunk:
                return False
            digest.update(chunk)
            size -= len(chunk)
        if digest.hexdigest() != sha256:
            return False
    return True


def short(execution: str) -> bytes:
    """Return a short hash of an execution's id, to save memory."""
    return hashlib.sha256(execution.encode()).digest()[:16]


class Changed(Exception):
    """A file differs from what the worker saw."""


def opened(root: int, path: str) -> int:
    """Open a regular file below an open folder, following no links, and return its descriptor. Raises OSError."""
    *folders, name = path.encode("utf-8", "surrogateescape").split(b"/")
    with contextlib.ExitStack() as stack:
        for folder in folders:
            root = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=root)
            stack.callback(os.close, root)
        file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=root)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise OSError(errno.EINVAL, "is not a file any more", path)
    return file


def described(root: int, names: Iterable[str]) -> Iterator[File]:
    """Yield the non-empty files with these names in a run's folder."""
    for name in names:
        try:
            if not os.stat(name, dir_fd=root, follow_symlinks=False).st_size:
                continue
            descriptor = opened(root, name)
        except OSError:
            continue
        size, sha256 = hashed(descriptor)
        if size:
            yield name, size, sha256


def contents(root: int, files: Iterable[File], check_stop: Callable[[], None]) -> Iterator[bytes]:
    """Yield the contents of files, one after the other. Calls `check_stop` for each chunk.

    Raises Changed if a file does not have the expected size and hash.
    """
    for path, size, sha256 in files:
        digest = hashlib.sha256()
        try:
            with open(opened(root, path), "rb", buffering=0) as file:
                while size >= 0:
                    check_stop()
                    chunk = file.read(CHUNK)
                    if not chunk:
                        break
                    digest.update(chunk)
                    size -= len(chunk)
                    yield chunk
        except OSError as error:
            raise Changed("%s: %s" % (path, error.strerror)) from error
        if size or digest.hexdigest() != sha256:
            raise Changed("%s has changed since the run ended" % path)
