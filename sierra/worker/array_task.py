"""The program of an array task on its node: it executes the runs of one element by the worker, and packs their results.

    python3 -I -S FOLDER/worker.pyz array_task FOLDER [--wall=SECONDS] INDEX

FOLDER is the session's folder on the file system that nodes and login nodes share. It has `worker.pyz` (see `__main__`), and:

    element.json            settings that all elements of the session share: see `Settings`
    elements/INDEX.jobs     the element's jobs: gzip (possibly several members), lines of JSON; see `jobs`
    elements/INDEX.failed   optional: executions, one a line, that were started too often; they are not started again
    elements/INDEX.alone    optional: executions, one a line, that may have ended earlier attempts; each is executed alone on
                            the element, one after the other, before all others
    results/INDEX.<attempt>.pack    the records of one attempt at the element
    cancelled               if it exists, no further run is started, and running ones are ended

An *attempt* is one execution of an element. There may be several: a task may be requeued, its node may be lost, and the first
copy may still live beside the second. So each attempt writes into a file of its own, made with O_EXCL. It first reads the
records of other attempts at its element, and executes only runs whose results are missing or damaged. Runs execute in a local
folder of the node (`scratch`), which is removed at the end, or by the next attempt of the session on this node. Only packs are
written to the shared file system, and no locks are needed there.

A pack is only ever appended to. It is a sequence of records: a line of JSON and, if that has a `size`, as many bytes followed
by a line feed. The last key of a line is `check`, the beginning of the SHA-256 of the line without it. A record that is not
complete, up to its last line feed, counts as not written (on a network file system, bytes may arrive in any order); nothing is
written after it. If a record cannot be written completely, it is removed (by truncation), and the attempt ends. The events
are those in EVENTS, `stalled` (as the worker writes it) and `end`: see `Packed`.

An interrupted run (the task was told to end, by a time limit or by a user) has a start and no end. A scheduler sends its
SIGTERM to all processes of a task, and a run that reacts to it may look as if it had ended by itself. Therefore no run is
packed that ended less than HOLD_S before this process got the signal. The start of a run is packed at once. The start of a run
that executes alone is written to the disk before it begins, because the run may end the whole task at once.

Before anything executes, every file in `needs` is hashed once. If one differs from the file on the submitting host, the attempt
ends with `trouble`, and nothing executes. If one changes later, no run that has ended since is packed. SIGTERM ends the running
runs with the grace time of their jobs, a second SIGTERM without it. If FOLDER or the attempt's own pack has been removed,
nobody waits for the results any more, and running runs are ended. The exit status is 0 if finished, 1 if told to end, and 3 for
trouble. The reason is also written to stderr, and so is the time that the task had run when it was told to end.

A task whose time (`--wall=SECONDS`) will be over before its runs are finished requests its scheduler to start it again, once
and shortly before the end: by the command `requeue` of the settings, with its own id. It does so only if a run has ended, so
that each attempt makes progress, and if nothing is cancelled. It submits no new jobs. If the request is refused, it continues
as long as it may.

    python3 -I -S FOLDER/worker.pyz array_task FOLDER --probe INDEX

does all of this without executing runs, and records it in results/probe.<attempt>.pack.
"""

import binascii
import contextlib
import errno
import fcntl
import fnmatch
import gzip
import hashlib
import itertools
import json
import os
import platform
import re
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from functools import partial, reduce
from types import FrameType
from typing import TYPE_CHECKING, Callable, Dict, Iterable, Iterator, List, Mapping, NamedTuple, Optional, Set, Tuple, Union

from sierra.worker import machine, program
from sierra.worker.errors import explain
from sierra.worker.files import remove, write_all
from sierra.worker.processes import Stops, adopt_orphans, end_orphans, stdin_of

if TYPE_CHECKING:
    from typing import IO, BinaryIO, Deque, Literal, NotRequired, Sequence, TypedDict, final

    from sierra.worker.job import Job, Limits, Program
    from sierra.worker.journal import End, Event, Outcome

    Fact = Union[int, str, List[str], Dict[str, List[Optional[int]]], None]

    class Need(TypedDict):
        """A file that must be the same as on the submitting host."""

        name: str
        path: str
        sha256: str
        """Empty: the file only has to exist. For a link, it is the hash of its own target path, not of the target's content."""
        search: NotRequired[str]
        """The PATH on which runs find the program `name`; empty: they use `path`."""
        link: NotRequired[bool]
        holds: NotRequired[Optional[List[str]]]
        """If given, the folders in `path` (as in a PATH) must have exactly these distributions: see `installed`."""

    class Difference(TypedDict, total=False):
        """A job without the keys that equal those of the common job, also within `environment`."""

        run: str
        execution: str
        argv: Sequence[str]
        environment: Dict[str, str]
        files: Dict[str, "Union[str, Between]"]
        folders: Dict[str, str]
        limits: Limits
        client: Program
        shared: bool
        observe: Mapping[str, str]
        """Not in the common job; nor is the budget."""
        budget: float
        affordable: float
        experiment: int
        end: int
        """The number of jobs; only in the last line."""

    class Packed(Outcome):
        """The record that a run has ended, by itself or by a limit; `size` is the total size of its files."""

        event: Literal["end"]
        files: List["File"]
        """In the order of the payload: `stdout`, `stderr` (omitted if empty), `observed.json` (if the run was observed), and
        `output/…` for each of the outputs."""
        size: int

    @final
    class Other(TypedDict):
        """A record without a payload."""

        event: Literal["attempt", "start", "stalled", "requeue", "trouble", "finished"]


HOLD_S = 0.2
BEFORE_S = 60.0
"""The seconds before its end at which a task requests to be started again; at most a sixth of its time."""
REQUEUE_S = 20.0
GIVE_UP_S = 5.0
"""The seconds in which ended runs are still packed after the task was told to end."""
BUSY_S, IDLE_S = 0.02, 0.1
SYNC_S = 2.0
AHEAD, AHEAD_EACH = 64, 8
"""The number of runs that are sent to the worker in advance, plus so many for each slot.

A run that has left little frees its place when it has ended, any other run when it is packed.
"""
CHUNK = 1 << 20
LINE_BYTES = 1 << 28
LOGS = ("stdout", "stderr")
OBSERVED = "observed.json"
VARIABLE = re.compile(r"\{(\w+)\}")
CHECK = b',"check":"'
CHECK_DIGITS = 16
SECRET = ("TOKEN", "SECRET", "PASSWORD", "CREDENTIAL")
GPUS = (
    *("CUDA_VISIBLE_DEVICES", "NVIDIA_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES", "GPU_DEVICE_ORDINAL"),
    "ZE_AFFINITY_MASK",
)
"""The variables of any scheduler that name allocated devices."""

File = Tuple[str, int, str]
"""Path, size and SHA-256 of a file."""
Between = Tuple[int, str, int]
"""A file that begins and ends like the common job's: bytes of the common beginning, the rest in base64, bytes of the end."""


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
    memory: Optional[int]
    """Bytes."""
    gpus: Optional[str]
    allocation: Dict[str, str]
    """The scheduler's variables."""
    facts: "Dict[str, Fact]"
    """See `machine.facts`."""
    variables: Dict[str, str]
    """Those that `record` names."""
    python: str
    clock: float
    """Seconds that the node's clock is ahead of the shared file system's."""
    end: Optional[float] = None
    """When the scheduler will end the task; None if it did not say so."""


class Started(NamedTuple):
    """A run has begun."""

    execution: str
    time: float
    alone: bool = False
    """True if no other run executes on the element meanwhile."""


class Requeued(NamedTuple):
    """The attempt requests its scheduler to start the task again, because its time is nearly over."""

    time: float
    refused: Optional[str]
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


class CannotContinue(Exception):
    """The reason, in one line, why an attempt cannot continue."""


class Unwanted(Exception):
    """The task must end before everything was read or packed."""


class Changed(Exception):
    """A file differs from what the worker saw."""


class Settings(NamedTuple):
    """The contents of `element.json`."""

    session: str
    slots: int
    """The greatest number of runs at a time; fewer if the node has fewer cores."""
    scratch: Optional[str]
    """A folder of the node, in which `$NAME` and `${NAME}` are its variables. None: that of the scheduler, $TMPDIR or /tmp."""
    needs: "List[Need]"
    record: List[str]
    """The names, or patterns of names, of variables to record."""
    requeue: Tuple[str, ...] = ()
    """The command that starts a task again, to which the task's id is added; empty: there is none."""
    node: "Dict[str, List[str]]" = {}  # noqa: RUF012 - nobody changes it
    """The variables by which the scheduler tells what it gives: see `sierra.runners.schedulers.base.NodeVariables`."""


def event_of(record: Record) -> Dict[str, object]:
    """Return a record with its event, and without a field that has its default value."""
    defaults = record._field_defaults
    fields = {name: value for name, value in record._asdict().items() if name not in defaults or value != defaults[name]}
    return {"event": EVENTS[type(record)], **fields}


def line_of(record: Mapping[str, object]) -> bytes:
    """Return the line for a record."""
    text = json.dumps(record, separators=(",", ":")).encode()
    return text[:-1] + CHECK + check_of(text) + b'"}\n'


def check_of(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest()[:CHECK_DIGITS].encode()


def record_in(line: bytes) -> "Union[Packed, Other, None]":
    """Return the record in a line; None if the line is incomplete or damaged."""
    text, check, rest = line.rpartition(CHECK)
    text += b"}"
    if not check or rest != check_of(text) + b'"}\n':
        return None
    record: Union[Packed, Other] = json.loads(text)
    return record


def records(file: "BinaryIO", offset: int) -> "Iterator[Tuple[Union[Packed, Other], int, int]]":
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
        self.clock = time.time() - os.fstat(self._file).st_mtime
        """The seconds that this node's clock is ahead of the file system's, by the time of the new file."""
        self._whole = self._synced = 0
        self._pending = bytearray()
        self._sync_at = 0.0

    def note(self, record: Record, *, sync: bool = False) -> None:
        """Append a record; with `sync`, write it to the disk."""
        self.add(line_of(event_of(record)))
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


def executed(folder: str, index: str, own: str, check_stop: Callable[[], None]) -> Set[bytes]:
    """Return the executions whose end other attempts have recorded with all files intact. Calls `check_stop` for each chunk."""
    found = set()
    for name in os.listdir(folder):
        path = os.path.join(folder, name)
        if name.startswith(index + ".") and name.endswith(".pack") and path != own:
            with contextlib.suppress(FileNotFoundError), open(path, "rb") as file:
                for record, at, _ in records(file, 0):
                    if record["event"] == "end" and is_sound(file, at, record["files"], check_stop):
                        found.add(short(record["execution"]))
    return found


def read_lines(path: str) -> List[str]:
    """Return the executions in a list, in order; none if there is no such file."""
    try:
        with open(path) as file:
            return [line.strip() for line in file]
    except FileNotFoundError:
        return []


def is_sound(file: "BinaryIO", at: int, files: List[File], check_stop: Callable[[], None]) -> bool:
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


def jobs(path: str) -> "Iterator[Job]":
    """Yield the jobs of an element, in the form that the worker reads. Raises CannotContinue if their number is wrong.

    The first line is `{"common": JOB}`, the last line is `{"end": COUNT}`. Each line between is a `Difference`.
    """
    count = 0
    with gzip.open(path, "rb") as lines:
        common: Job = json.loads(next(lines))["common"]
        for line in lines:
            job: Difference = json.loads(line)
            if "end" in job:
                if job["end"] != count:
                    break
                return
            count += 1
            yield complete(job, common)
    raise CannotContinue("%s contains %d jobs, which is not the expected number" % (path, count))


def complete(job: "Difference", common: "Job") -> "Job":
    """Return the job that differs in this from the common job."""
    files = common["files"]
    if job.get("files"):
        files = {name: content_of(file, common["files"].get(name, "")) for name, file in job["files"].items()}
    environment = {**common["environment"], **job.get("environment", {})}
    return {**common, **job, "environment": environment, "files": files}  # type: ignore[typeddict-unknown-key]  # `end` is not there


def content_of(file: Union[str, Between], common: str) -> str:
    """Return a file's content in base64."""
    if isinstance(file, str):
        return file
    head, between, tail = file
    outer = binascii.a2b_base64(common)
    content = outer[:head] + binascii.a2b_base64(between) + outer[len(outer) - tail :]
    return binascii.b2a_base64(content, newline=False).decode()


class Observing(NamedTuple):
    """The facts about this node that the worker needs to observe a run."""

    scratch: str
    """The attempt's folder, in which runs have their folders."""
    ahead: float
    """Seconds that the node's clock is ahead of the shared file system's."""


class Feeder(threading.Thread):
    """A thread that sends missing jobs to the worker; few in advance, so that large outputs do not fill up the node."""

    def __init__(
        self,
        path: str,
        wanted: Callable[[str], bool],
        ahead: int,
        more: "Observing",
        pipe: "IO[bytes]",
    ) -> None:
        super().__init__(daemon=True)
        self._path = path
        self._more = more
        self._wanted = wanted
        self._pipe = pipe
        self.permits = threading.Semaphore(ahead)
        self.spare: Deque[int] = deque()
        """The numbers of folders of packed runs, which other runs can reuse; see the worker."""
        self.sent = 0
        self.error: Optional[CannotContinue] = None

    def run(self) -> None:
        try:
            for job in jobs(self._path):
                if self._wanted(job["execution"]):
                    self.permits.acquire()
                    if "client" not in job:
                        job["used"] = self.spare.popleft() if self.spare else None
                    if "observe" in job:
                        job["observe"] = {**job["observe"], "work": self._more.scratch}
                        job["ahead"] = self._more.ahead
                    self._send(job)
                    self.sent += 1
            self._send({"end": True})
        except BrokenPipeError:
            pass  # the worker has ended, and reports the reason itself
        except Exception as error:
            own = error if isinstance(error, CannotContinue) else None
            self.error = own or CannotContinue("%s cannot be read: %s" % (self._path, error))
            self._pipe.close()  # closing the pipe ends the worker

    def _send(self, record: Mapping[str, object]) -> None:
        write_all(self._pipe.fileno(), json.dumps(record, separators=(",", ":")).encode() + b"\n")


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


def first_record(
    settings: Settings, given: "Allocation", index: int, facts: "Dict[str, Fact]", slots: int, cores: int
) -> Attempt:
    """Return the first record, without the attempt's own name and clock."""
    variables = os.environ
    return Attempt(
        attempt="",
        session=settings.session,
        element=index,
        job=given.text("task"),
        node=given.text("host") or os.uname().nodename,
        started=time.time(),
        slots=slots,
        cpus=given.number("cores") or cores,
        memory=given.memory,
        gpus=given.text("gpus") or variables.get("CUDA_VISIBLE_DEVICES"),
        allocation=given.variables,
        facts=facts,
        variables={name: value for name, value in sorted(variables.items()) if is_recorded(name, settings.record)},
        python=platform.python_version(),
        clock=0.0,
        end=given.number("end"),
    )


class Allocation:
    """The resources that a scheduler gives to a task, as its variables say."""

    def __init__(self, forms: "Dict[str, List[str]]", environment: Mapping[str, str]) -> None:
        """`forms` name the variables: see `sierra.runners.schedulers.base.NodeVariables`."""
        self._forms = forms
        self._environment = environment

    def texts(self, about: str) -> Iterator[str]:
        """Yield the forms about something of which all variables are set, with their values."""
        for form in self._forms.get(about, ()):
            if all(self._environment.get(name) for name in VARIABLE.findall(form)):
                yield VARIABLE.sub(lambda match: self._environment[match[1]], form)

    def text(self, about: str) -> str:
        """Return the first of these texts, or nothing."""
        return next(self.texts(about), "")

    def number(self, about: str) -> Optional[int]:
        """Return the first of these texts that is a whole number, or a product of whole numbers, as in `2000*4`."""
        for text in self.texts(about):
            factors = text.split("*")
            if all(factor.isdigit() for factor in factors):
                return reduce(int.__mul__, map(int, factors))
        return None

    @property
    def memory(self) -> Optional[int]:
        """Return the bytes of memory; None if the scheduler does not tell."""
        return (self.number("memory_mib") or 0) << 20 or None

    @property
    def variables(self) -> Dict[str, str]:
        """Return all variables that are about the allocation."""
        names = [name for forms in self._forms.values() for form in forms for name in VARIABLE.findall(form)]
        return {name: self._environment[name] for name in (*names, *GPUS) if name in self._environment}


def is_recorded(name: str, patterns: List[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, one) for one in patterns) and not any(word in name.upper() for word in SECRET)


def name_of_attempt(given: Allocation, suffix: int) -> str:
    """Return the name `job.restart.host.process`, with a suffix if another attempt has taken it."""
    process = "%d-%d" % (os.getpid(), suffix) if suffix else str(os.getpid())
    parts = (given.text("job") or given.text("task") or "none", given.text("restarts") or "0", os.uname().nodename, process)
    return ".".join(re.sub(r"[^A-Za-z0-9_-]", "_", part) for part in parts)


def new_pack(folder: str, index: str, first: Attempt, given: Allocation) -> Pack:
    """Create the pack of this attempt, with its first record."""
    for name in map(partial(name_of_attempt, given), itertools.count()):
        with contextlib.suppress(FileExistsError):
            pack = Pack(folder, index, name)
            break
    pack.note(first._replace(attempt=name, clock=pack.clock), sync=True)
    return pack


class Needs:
    """The files that must be, and stay, the same as on the submitting host."""

    def __init__(self, needs: "List[Need]") -> None:
        """Find the files. Raises CannotContinue if the distributions of a Python differ from those on the submitting host."""
        self._files: List[Need] = []
        for need in needs:
            holds = need.get("holds")
            if holds is None:
                self._files.append({**need, "path": path_of(need)})
            else:
                check_installed(need["name"], set(holds), set(installed(need["path"])))
        self._identities: Dict[str, Tuple[int, ...]] = {}

    def check(self) -> None:
        """Raise CannotContinue if a file differs. A file that seems unchanged since the last check is not read again."""
        for need in self._files:
            try:
                status = os.stat(need["path"], follow_symlinks=not need.get("link"))
                identity = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
                if self._identities.get(need["path"]) != identity and need["sha256"] not in ("", hash_of(need)):
                    raise CannotContinue("%s: %s differs from the one on the submitting host" % (need["name"], need["path"]))
            except OSError as error:
                raise CannotContinue("%s: %s: %s" % (need["name"], need["path"], error.strerror)) from error
            self._identities[need["path"]] = identity


def installed(folders: str) -> Tuple[str, ...]:
    """Return the distributions in folders (as in a PATH), as the paths of their metadata, which contain name and version."""
    found = []
    for folder in folders.split(os.pathsep):
        with contextlib.suppress(OSError):
            names = (name for name in os.listdir(folder) if name.endswith((".dist-info", ".egg-info")))
            found += [os.path.join(folder, name) for name in names]
    return tuple(sorted(found))


def check_installed(name: str, expected: Set[str], actual: Set[str]) -> None:
    """Raise CannotContinue if the distributions here differ from those on the submitting host."""
    differences = ["%s is missing here" % path for path in sorted(expected - actual)]
    differences += ["%s is only here" % path for path in sorted(actual - expected)]
    if differences:
        more = " and %d more" % (len(differences) - 3) if len(differences) > 3 else ""
        shown = ", ".join(differences[:3])
        raise CannotContinue("%s differ from those on the submitting host: %s%s" % (name, shown, more))


def path_of(need: "Need") -> str:
    """Return the path of a file; for a program that runs call by name, the path found here."""
    found = shutil.which(need["name"], path=need["search"]) if need.get("search") else None
    return found or need["path"]


def hash_of(need: "Need") -> str:
    """Return the SHA-256 of a file's content, or of a link's target path."""
    if need.get("link"):
        return hashlib.sha256(os.fsencode(os.readlink(need["path"]))).hexdigest()
    return hashed(need["path"])[1]


def hashed(path: Union[str, int]) -> Tuple[int, str]:
    """Return the size and the SHA-256 of a file."""
    size, digest = 0, hashlib.sha256()
    with open(path, "rb", buffering=0) as file:
        for chunk in iter(lambda: file.read(CHUNK), b""):
            digest.update(chunk)
            size += len(chunk)
    return size, digest.hexdigest()


@contextlib.contextmanager
def scratch(settings: Settings, given: Allocation) -> Iterator[Tuple[str, int]]:
    """Yield a folder on the node for this attempt, and a lock that shows to other attempts that this one is alive.

    The worker holds the lock too, because it may outlive this process by the grace time of its runs.
    """
    root = scratch_root(settings.scratch, given)
    prefix = "sierra-%s-" % settings.session
    for name in os.listdir(root):
        if name.startswith(prefix):
            with contextlib.suppress(OSError):
                remove_dead(os.path.join(root, name))
    folder = tempfile.mkdtemp(prefix=prefix, dir=root)
    lock = os.open(os.path.join(folder, "owner"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        with contextlib.suppress(OSError):  # a file system without locks: no attempt ever considers the folder abandoned
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.write(lock, owner())
        yield folder, lock
    finally:
        remove_own(folder)
        os.close(lock)


def scratch_root(wanted: Optional[str], given: Allocation) -> str:
    if wanted is None:
        named = [*given.texts("scratch"), os.environ.get("TMPDIR"), "/tmp"]  # noqa: S108 - the last resort
        writable = [path for path in named if path and os.path.isdir(path) and os.access(path, os.W_OK | os.X_OK)]
        if not writable:
            raise CannotContinue("no folder for runs: the node's own folder, $TMPDIR and /tmp cannot be written into")
        return os.path.abspath(writable[0])
    filled = re.sub(r"\$(?:\{(\w+)\}|(\w+))", lambda match: value_of(match[1] or match[2], wanted), wanted)
    folder = os.path.abspath(filled)
    if not os.path.isdir(os.path.dirname(folder) if os.path.dirname(folder) != "/" else folder):
        raise CannotContinue("scratch = %s: its parent folder does not exist; use one that exists" % wanted)
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise CannotContinue("scratch = %s: %s: %s" % (wanted, folder, error.strerror)) from error
    return folder


def value_of(name: str, wanted: str) -> str:
    if not os.environ.get(name):
        raise CannotContinue("scratch = %s: the variable $%s is not set" % (wanted, name))
    return os.environ[name]


def owner() -> bytes:
    """Return this host's name. Other hosts that reach the same folder may not see this host's locks."""
    return os.uname().nodename.encode()


def remove_dead(folder: str) -> None:
    """Remove the folder of an attempt that died on this host."""
    found = os.lstat(folder)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
        return
    lock = os.open(os.path.join(folder, "owner"), os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.read(lock, 4096) == owner():
            remove_own(folder)
    finally:
        os.close(lock)


def remove_own(folder: str) -> None:
    """Remove an attempt's folder, the file `owner` last. If this process is killed meanwhile, the next attempt continues."""
    with contextlib.suppress(OSError):
        for name in os.listdir(folder):
            remove(os.path.join(folder, name))
    remove(folder)


class StopSignals:
    """A counter of the signals that told this process to end."""

    def __init__(self) -> None:
        self.times = 0
        self.when = 0.0
        for signalled in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(signalled, self._note)

    def check(self) -> None:
        """Raise Unwanted if there was a signal."""
        if self.times:
            raise Unwanted

    def _note(self, signalled: int, frame: Optional[FrameType]) -> None:
        self.when = self.when or time.clock_gettime(time.CLOCK_BOOTTIME)
        self.times += 1


def start_of_task() -> float:
    """Return the start of the task in seconds since boot: the job script has become this process, by `exec`."""
    with open("/proc/self/stat", "rb") as file:
        ticks = int(file.read().rpartition(b")")[2].split()[19])
    return ticks / os.sysconf("SC_CLK_TCK")


class Requeue:
    """The request to the scheduler to start this task again before its time is over: once, and only after progress."""

    def __init__(self, folder: str, pack: Pack, command: Iterable[str], wall: Optional[float], task: str) -> None:
        self._cancelled = os.path.join(folder, "cancelled")
        self._pack = pack
        self._command = [*command, task]
        self._at = start_of_task() + wall - min(BEFORE_S, wall / 6) if wall and len(self._command) > 1 else float("inf")
        self.progressed = False

    def send_if_due(self) -> None:
        """Send the request if it is time to. If the scheduler agrees, it soon tells this task to end."""
        if not self.progressed or time.clock_gettime(time.CLOCK_BOOTTIME) < self._at or os.path.exists(self._cancelled):
            return
        self._at = float("inf")
        self._record(None)
        try:
            subprocess.run(self._command, stdin=subprocess.DEVNULL, capture_output=True, check=True, timeout=REQUEUE_S)
        except subprocess.CalledProcessError as error:
            words = (error.stderr or error.stdout).decode("utf-8", "replace").split()
            self._record(" ".join(words) or "status %d" % error.returncode)
        except (OSError, subprocess.TimeoutExpired) as error:
            self._record(" ".join(str(error).split()))

    def _record(self, refused: Optional[str]) -> None:
        self._pack.note(Requeued(time.time(), refused), sync=True)


class Journal:
    """The worker's journal, read while it grows."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._file: Optional[int] = None
        self._offset = 0

    def read(self) -> "List[Event]":
        """Return the next events. An incomplete line counts as not written, and may be removed."""
        if self._file is None:
            try:
                self._file = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)
            except FileNotFoundError:
                return []
        data = more = os.pread(self._file, CHUNK, self._offset)
        while more and b"\n" not in data:
            more = os.pread(self._file, CHUNK, self._offset + len(data))
            data += more
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        return [json.loads(line) for line in whole.splitlines()]


class Execution:
    """A worker process, and the transfer of its events into the pack."""

    def __init__(
        self,
        folder: str,
        session: str,
        lock: int,
        pack: Pack,
        stop: StopSignals,
        requeue: Requeue,
        needs: Needs,
        scratch: str,
    ) -> None:
        """Make `scratch`, a folder of the node. The worker holds `lock` as long as it lives."""
        os.mkdir(scratch)
        self._session = session
        self._lock = lock
        self._cancelled = os.path.join(folder, "cancelled")
        self._scratch = scratch
        self._pack = pack
        self._stop = stop
        self._requeue = requeue
        self._needs = needs
        self._journal = Journal(os.path.join(scratch, "journal.jsonl"))
        self._held: Deque[Tuple[float, End]] = deque()
        self._begun: Set[str] = set()
        self._ended = 0
        self._stopping = False
        self._continued = self._killed = False
        self._stops = Stops()
        self._check_at = 0.0

    def run(self, slots: int, path: str, wanted: Callable[[str], bool]) -> bool:
        """Execute the wanted jobs of a file, and return whether all were executed. Raises CannotContinue, OSError."""
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-B", "-X", "utf8", program.PROGRAM, self._scratch, str(slots)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            bufsize=0,
            env={**os.environ, "SIERRA_SESSION": self._session, "TMPDIR": os.path.dirname(os.path.dirname(self._scratch))},
            pass_fds=(self._lock,),
            start_new_session=True,
        )
        pipe = stdin_of(self._process)
        observing = Observing(os.path.dirname(self._scratch), max(0.0, self._pack.clock))
        self._feeder = Feeder(path, wanted, AHEAD + slots * AHEAD_EACH, observing, pipe)
        self._feeder.start()
        try:
            self._follow()
        finally:
            self._end()
        return self._is_finished()

    def _follow(self) -> None:
        pause = BUSY_S
        while True:
            over = self._process.poll() is not None
            if not over and self._is_stopped():
                self._continue()
            events = self._journal.read()
            now = time.monotonic()
            self._check_stop(now)
            for event in events:
                self._handle(now, event)
            self._pack_due(now)
            self._pack.sync(now)
            if not (over or self._stopping) and (self._feeder.is_alive() or self._ended < self._feeder.sent):
                self._requeue.send_if_due()
            if over and not events and not self._held:
                return
            pause = BUSY_S if events or self._held else min(IDLE_S, 1.2 * pause)
            time.sleep(pause)

    def _is_stopped(self) -> bool:
        """Return whether a signal has stopped the worker, which a run may do to its parent."""
        stopped: bool = self._stops.seen(self._process.pid, time.monotonic())
        return stopped

    def _continue(self) -> None:
        """Continue the worker that a run has stopped; kill it the second time, unless it is to end anyway."""
        if self._continued and not self._stopping:
            self._killed = True
            self._process.kill()
        else:
            self._continued = True
            self._process.send_signal(signal.SIGCONT)

    def _handle(self, now: float, event: "Event") -> None:
        """Record at once that a run has begun; hold a run's end back."""
        if event["event"] == "end":
            self._held.append((now, event))
            if is_small(event):
                self._feeder.permits.release()
        elif event["event"] == "stalled":
            self._pack.add(line_of(event))
        elif not (self._stopping or self._stop.times):
            self.begin(event["execution"])

    def begin(self, execution: str, *, alone: bool = False) -> None:
        """Record once that a run begins. With `alone`, write that to the disk first."""
        if execution not in self._begun:  # else it begins again, because its observation has changed it
            self._pack.note(Started(execution, time.time(), alone), sync=alone)
        self._begun.add(execution)

    def _check_stop(self, now: float) -> None:
        """End the worker if that was requested, or if nobody waits for the results any more."""
        if not self._stopping and (self._stop.times or self._is_unwanted(now)):
            self._stopping = True
            self._signal(signal.SIGHUP)  # not SIGTERM: the scheduler may have sent one, and a second skips the grace time
        if self._stop.times > 1:
            self._signal(signal.SIGTERM)

    def _is_unwanted(self, now: float) -> bool:
        if now < self._check_at:
            return False
        self._check_at = now + SYNC_S
        return os.path.exists(self._cancelled) or self._pack.is_gone()

    def _signal(self, number: int) -> None:
        if self._process.poll() is None:
            self._process.send_signal(number)

    def _pack_due(self, now: float) -> None:
        """Pack the ends that were held back long enough; none after this process was told to end."""
        if self._stopping or self._process.returncode == 1:
            self._held.clear()
        if self._held and now - self._held[0][0] >= HOLD_S:
            self._needs.check()
        while self._held and now - self._held[0][0] >= HOLD_S and not self._stop.times:
            self._take_end(self._held.popleft()[1])

    def _take_end(self, event: "End") -> None:
        directory = event["directory"]
        if event["stopped"] != "interrupted":
            with contextlib.suppress(Unwanted):
                self._pack_run(event, directory)
                self._ended += 1
                self._requeue.progressed = True
        if event.get("spare"):
            self._feeder.spare.append(int(os.path.basename(directory)))
        elif self._is_own(directory):
            self._remove(directory)
        if not is_small(event):
            self._feeder.permits.release()

    def _is_own(self, directory: str) -> bool:
        """Return whether it is the folder of one run. A run that could not be prepared has none."""
        return os.path.dirname(directory) == self._scratch and os.path.basename(directory).isdigit()

    def _remove(self, directory: str) -> None:
        remove(directory)
        with contextlib.suppress(OSError):
            os.unlink(directory)  # a link in place of the folder

    def _pack_run(self, event: "End", directory: str) -> None:
        root = None
        if self._is_own(directory):
            with contextlib.suppress(OSError):
                root = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        if root is None:
            error = event["error"] or ("its folder is gone" if event["outputs"] else None)
            self._add({**event, "outputs": [], "error": error}, -1, [])
            return
        try:
            logs = list(described(root, LOGS))
            seen = list(described(root, [OBSERVED])) if event.get("observed") else []
            outputs = [("output/" + file["path"], file["bytes"], file["sha256"]) for file in event["outputs"]]
            try:
                self._add({**event, "observed": bool(seen)}, root, logs + seen + outputs)
            except Changed as changed:
                error = event["error"] or "its outputs cannot be read: %s" % changed
                self._add({**event, "outputs": [], "error": error, "observed": False}, root, logs)
        finally:
            os.close(root)

    def _add(self, event: "End", root: int, files: List[File]) -> None:
        size = sum(size for _, size, _ in files)
        fields = {name: value for name, value in event.items() if name not in ("directory", "spare")}
        payload = itertools.chain(contents(root, files, self._check_time), (b"\n",))
        self._pack.add(line_of({**fields, "files": files, "size": size}), size, payload)

    def _check_time(self) -> None:
        """Raise Unwanted if nobody waits for the results any more, or if there is no time left for packing."""
        self._check_stop(time.monotonic())
        stop = self._stop
        if self._stopping and (stop.times != 1 or time.clock_gettime(time.CLOCK_BOOTTIME) - stop.when > GIVE_UP_S):
            raise Unwanted

    def _end(self) -> None:
        """Wait for the worker's end in any case, and end the processes that it has left."""
        while self._process.poll() is None:
            self._stopping = True
            self._signal(signal.SIGTERM if self._stop.times > 1 else signal.SIGHUP)
            if self._is_stopped():
                self._continue()
            time.sleep(IDLE_S)
        end_orphans(None)
        self._stderr = self._process.stderr.read() if self._process.stderr else b""

    def _is_finished(self) -> bool:
        code, error = self._process.returncode, self._feeder.error
        if self._stopping or self._stop.times:
            return False
        if error is not None:
            raise error
        if code == 0 and self._ended != self._feeder.sent:
            raise CannotContinue("the worker reported %d of %d runs" % (self._ended, self._feeder.sent))
        if code == 4:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), self._scratch)
        if code not in (0, 1):
            lines = self._stderr.decode("utf-8", "replace").strip().splitlines()
            reason = "the worker ended with %s" % (code if code > 0 else "signal %d" % -code)
            reason = "a run stopped the worker (SIGSTOP) although it had been continued before" if self._killed else reason
            raise CannotContinue(": ".join([reason, *lines[-1:]]))
        return code == 0


def is_small(event: "End") -> bool:
    """Return whether a run has left small outputs."""
    return sum(file["bytes"] for file in event["outputs"]) <= CHUNK


def attempt(folder: str, index: int, stop: StopSignals, *, wall: Optional[float] = None, probing: bool) -> bool:
    """Execute the missing runs of an element, and return whether it is finished. Raises CannotContinue and OSError."""
    with open(os.path.join(folder, "element.json"), "rb") as file:
        settings = Settings(**json.load(file))
    adopt_orphans()
    if os.path.exists(os.path.join(folder, "cancelled")):
        return False
    cores = machine.usable_cores()
    slots = min(settings.slots, cores)
    results = os.path.join(folder, "results")
    given = Allocation(settings.node, os.environ)
    first = first_record(settings, given, index, machine.facts(), slots, cores)
    pack = new_pack(results, "probe" if probing else str(index), first, given)
    try:
        needs = Needs(settings.needs)
        needs.check()
        with scratch(settings, given) as (own, lock):
            named = os.path.join(folder, "elements", str(index))
            done = executed(results, str(index), pack.path, stop.check)
            done |= {short(one) for one in read_lines(named + ".failed")}
            requeue = Requeue(folder, pack, settings.requeue, wall, given.text("task"))
            execution = partial(Execution, folder, settings.session, lock, pack, stop, requeue, needs)
            if not probing and not execute(named, done, slots, own, execution):
                pack.sync(float("inf"))
                return False
        pack.note(Finished(time.time()), sync=True)
        return True
    except Unwanted:
        return False
    except Exception as error:
        with contextlib.suppress(OSError):  # if there is space for it
            pack.note(Trouble(reason_of(error), getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)), sync=True)
        raise


def execute(named: str, done: Set[bytes], slots: int, scratch: str, execution: Callable[[str], Execution]) -> bool:
    """Execute an element's runs that are not done, first those that must be alone. Return whether all were executed."""
    for number, one in enumerate(read_lines(named + ".alone")):
        if short(one) not in done:
            done.add(short(one))
            alone = execution(os.path.join(scratch, "alone%d" % number))
            alone.begin(one, alone=True)
            if not alone.run(1, named + ".jobs", one.__eq__):
                return False
    return execution(os.path.join(scratch, "runs")).run(slots, named + ".jobs", lambda one: short(one) not in done)


def reason_of(error: BaseException) -> str:
    """Return the reason of an error in one line, with the node's name."""
    reason = str(error) if isinstance(error, CannotContinue) else explain(error)
    return "%s: %s" % (os.uname().nodename, " ".join(reason.split()))


def print_error(text: str) -> None:
    with contextlib.suppress(OSError):
        os.write(2, ("array task: %s\n" % text).encode("utf-8", "backslashreplace"))


def main(arguments: List[str]) -> int:
    stop = StopSignals()
    try:
        folder, index = os.path.abspath(arguments[0]), int(arguments[-1])
        probing = "--probe" in arguments
        wall = next((float(one.partition("=")[2]) for one in arguments if one.startswith("--wall=")), None)
        if attempt(folder, index, stop, wall=wall, probing=probing):
            return 0
        if stop.times and not probing:
            print_error("asked to end after %.0f s" % (stop.when - start_of_task()))
        return 1
    except Exception as error:
        print_error(reason_of(error))
        return 3
