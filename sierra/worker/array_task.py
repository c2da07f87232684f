"""What a task of a cluster starts on its node: it executes the runs of one element by the worker, and packs what they leave.

    python3 -I -S FOLDER/array_task.py FOLDER [--wall=SECONDS] INDEX

Three files on the standard library alone (Python 3.8 or newer) lie in the session's folder, FOLDER, on the file system that
nodes and login nodes share: this one, `worker.py`, which executes, and `machine.py`, which says what a node is. Beside them:

    element.json            what all elements of the session have in common: see `Settings`
    elements/INDEX.jobs     the element's jobs: gzip (of several members, perhaps), lines of JSON; see `jobs`
    elements/INDEX.failed   where it is there, executions, one a line, that were begun too often: they are not begun again
    elements/INDEX.alone    where it is there, executions, one a line, that may be what ended earlier attempts: each is executed
                            with the element for itself, one after the other, before all others
    results/INDEX.<attempt>.pack    what one attempt at the element has recorded
    cancelled               where it is there, nothing more is begun, and what runs is ended

An *attempt* is one time that an element is executed: a task may be requeued, its node may be lost, and the first copy may
live on beside the second. So each attempt writes into a file of its own, made with O_EXCL, and begins with reading what
other attempts at its element have recorded: it executes only what is missing, or damaged. Runs execute in a folder of the
node's own (`scratch`), which is removed at the end, or by the next attempt of the session on this node; nothing but packs is
written to the shared side, and locks are not needed there.

A pack is only ever appended to. It is a sequence of records: a line of JSON, and where that has a `size`, as many bytes and a
line feed after it. The last key of a line is `check`, the beginning of the SHA-256 of the line without it. What is not there
as a whole, to the last line feed, is not there yet (on a network file system, bytes may arrive in any order); nothing follows
it but in the writer's memory. A record that can't be written whole is taken back (truncated), and the attempt ends. Events:

    attempt     first, once: attempt, session, element, job, node, started, slots, cpus, memory (bytes), gpus, allocation (the
                scheduler's variables), facts (`machine.facts`), variables (those that `record` names), python, clock (seconds
                that the node's clock is ahead of the shared file system's)
    start       a run has begun: execution, time; and alone: where it has the element for itself
    stalled     all processes of a run are stopped by a signal: run, execution, pid, since
    end         a run has ended, by itself or by a limit: all fields of sierra.model.Result but `directory`, `attempt`
                and `environment`; `files`: a list of [path, bytes, sha256], in the order of the payload: `stdout`, `stderr`
                (left out where empty), and `output/…` for each of the outputs; `size`: all of it
    requeue     the scheduler is asked to begin the task anew: time; and refused: why it does not do that
    trouble     why the attempt could not go on, in a line: reason; and full: whether that is a disk without room
    finished    all that was missing has been executed: time

A run that was interrupted (the task was asked to end, by a time limit or by somebody) has a start and no end. A scheduler
sends its SIGTERM to all processes of a task, and a run that heeds it may look as if it had ended by itself. So nothing is
packed that ended less than HOLD_S before this process was asked. What has begun is packed at once, and what executes alone
before it begins: it may end all that there is at once.

Before anything executes, every file that `needs` names is hashed, once: where it is another than on the host that submitted,
that is the trouble, and nothing executes. Where it becomes another later, no run is packed that has ended since.
SIGTERM ends what runs, with the grace time that jobs have, a second one without. Where FOLDER, or the attempt's own pack, has
been removed, nobody waits for the results any more: what runs is ended. Exit status 0: finished; 1: asked to end; 3: trouble,
which is said on stderr too, and so is how long the task had lasted when it was asked.

A task whose time would be over before its runs are (`--wall=SECONDS`: what it has) asks its scheduler to be begun anew, once,
and shortly before: by the command `requeue` of the settings, with its own id. It does that only where a run has ended, so that
it gets on each time, and where nothing is cancelled. It submits nothing. Where it is refused, it goes on as long as it may.

    python3 -I -S FOLDER/array_task.py FOLDER --probe INDEX

does all that but execute, and records it as results/probe.<attempt>.pack.
"""

import binascii
import contextlib
import errno
import fcntl
import fnmatch
import gzip
import hashlib
import importlib.util
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
from functools import partial
from typing import Any, BinaryIO, Callable, Deque, Dict, Iterable, Iterator, List, NamedTuple, Optional, Set, Tuple

# No `from __future__ import annotations`: to a Python before 3.7, that were an error, and no line that says what is needed.

HOLD_S = 0.2
BEFORE_S = 60.0
"""How long before its end a task asks to be begun anew; a sixth of its time, where that is less."""
REQUEUE_S = 20.0
GIVE_UP_S = 5.0
"""How long what has ended is still packed once the task is asked to end."""
BUSY_S, IDLE_S = 0.02, 0.1
SYNC_S = 2.0
AHEAD, AHEAD_EACH = 64, 8
"""Runs that the worker is sent before one has ended (or is packed, where it has left much), and so many more per slot."""
CHUNK = 1 << 20
LINE_BYTES = 1 << 28
LOGS = ("stdout", "stderr")
CHECK = b',"check":"'
CHECK_DIGITS = 16
SECRET = ("TOKEN", "SECRET", "PASSWORD", "CREDENTIAL")
ALLOCATION = (
    *("SLURM_JOB_ID", "SLURM_ARRAY_JOB_ID", "SLURM_ARRAY_TASK_ID", "SLURM_RESTART_COUNT", "SLURM_JOB_NAME"),
    *("SLURM_CLUSTER_NAME", "SLURM_JOB_PARTITION", "SLURM_JOB_ACCOUNT", "SLURM_JOB_QOS", "SLURM_JOB_CONSTRAINTS"),
    *("SLURM_JOB_NODELIST", "SLURMD_NODENAME", "SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE", "SLURM_JOB_CPUS_PER_NODE"),
    *("SLURM_MEM_PER_NODE", "SLURM_MEM_PER_CPU", "SLURM_JOB_GPUS", "SLURM_GPUS_ON_NODE"),
    *("SLURM_JOB_START_TIME", "SLURM_JOB_END_TIME"),
    *("PBS_JOBID", "PBS_ARRAY_ID", "PBS_ARRAY_INDEX", "PBS_ARRAYID", "PBS_JOBNAME", "PBS_QUEUE", "PBS_SERVER"),
    *("PBS_NODENUM", "PBS_NP", "PBS_NUM_NODES", "PBS_NUM_PPN", "PBS_WALLTIME", "NCPUS"),
    *("CUDA_VISIBLE_DEVICES", "NVIDIA_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES", "GPU_DEVICE_ORDINAL"),
    "ZE_AFFINITY_MASK",
)
"""Variables of a scheduler that say what was allotted."""

Event = Dict[str, Any]
File = Tuple[str, int, str]


class Trouble(Exception):
    """Why an attempt can't go on, in a line."""


class Unwanted(Exception):
    """The task is to end, before all was read or packed that could be."""


class Changed(Exception):
    """A file is not as the worker saw it."""


class Settings(NamedTuple):
    """What `element.json` holds."""

    session: str
    slots: int
    """How many runs execute at a time, where the node has as many cores."""
    scratch: Optional[str]
    """A folder of the node, with `$NAME` or `${NAME}` of its environment; None: $SLURM_TMPDIR, $TMPDIR or /tmp."""
    needs: List[Dict[str, Any]]
    """Files that must be as they are where it was submitted: `name`, `path`, `sha256` (empty: it must be there), and `search`:
    the PATH by which runs find what they call by that name (empty: they name it by its path); where it is a `link`, what that
    says is what counts, and not what it leads to. Or, where there is a list `holds`, folders (`path`, as in a PATH) that must
    have these distributions, and no others: see `installed`.
    """
    record: List[str]
    """Names, or patterns, of variables to record."""
    requeue: Tuple[str, ...] = ()
    """The command that has a task begun anew, to which its id is added; empty: there is none."""


# ---------------------------------------------------------------- packs


def line_of(record: Event) -> bytes:
    """A record's line."""
    text = json.dumps(record, separators=(",", ":")).encode()
    return text[:-1] + CHECK + check_of(text) + b'"}\n'


def check_of(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest()[:CHECK_DIGITS].encode()


def record_in(line: bytes) -> Optional[Event]:
    """The record that a line holds; None where it is cut short or damaged."""
    text, check, rest = line.rpartition(CHECK)
    text += b"}"
    if not check or rest != check_of(text) + b'"}\n':
        return None
    record: Event = json.loads(text)
    return record


def records(file: BinaryIO, offset: int) -> Iterator[Tuple[Event, int, int]]:
    """The whole records from `offset` on, each with where its payload begins and where the next record does."""
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
    """The file of this attempt: whole records are appended, and what is not whole is taken back."""

    def __init__(self, folder: str, index: str, attempt: str) -> None:
        """Raises FileExistsError where there is one of that name."""
        self.path = os.path.join(folder, "%s.%s.pack" % (index, attempt))
        self._file = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o644)
        self._whole = self._synced = 0
        self._pending = bytearray()
        self._sync_at = 0.0

    def ahead(self) -> float:
        """Seconds that this node's clock is ahead of the file system's, which has just made the file."""
        return time.time() - os.fstat(self._file).st_mtime

    def add(self, record: Event, chunks: Iterable[bytes] = ()) -> None:
        """Append a record; its payload, where it has a `size`, comes in chunks. What they raise leaves the pack as it was."""
        line = line_of(record)
        if "size" not in record:
            self._pending += line
        elif record["size"] <= CHUNK:
            self._pending += b"".join((line, *chunks, b"\n"))
        else:
            self.flush()
            self._append(line, chunks, b"\n")
        if len(self._pending) > CHUNK:
            self.flush()

    def flush(self) -> None:
        if self._pending:
            self._append(bytes(self._pending))
            self._pending.clear()

    def _append(self, first: bytes, chunks: Iterable[bytes] = (), last: bytes = b"") -> None:
        at = self._whole
        try:
            for parts in ((first,), chunks, (last,)):
                for part in parts:
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
        """Let the disk have all of it, if it is time to: a network file system says only then that there is no room."""
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

    def say(self, reason: str, *, full: bool) -> None:
        """Record the trouble, if there is room for it."""
        with contextlib.suppress(OSError):
            self.add({"event": "trouble", "reason": reason, "full": full})
            self.sync(float("inf"))

    def is_gone(self) -> bool:
        """Whether it, or the folder that it lies in, has been removed."""
        try:
            return not os.path.samestat(os.stat(self.path), os.fstat(self._file))
        except OSError as error:
            return error.errno in (errno.ENOENT, errno.ENOTDIR, errno.ESTALE)


def executed(folder: str, index: str, own: str, asked: "Asked") -> Set[bytes]:
    """The executions whose end other attempts have recorded, with all files as they should be. Raises Unwanted."""

    def go_on() -> None:
        if asked.times:
            raise Unwanted

    found = set()
    for name in os.listdir(folder):
        path = os.path.join(folder, name)
        if name.startswith(index + ".") and name.endswith(".pack") and path != own:
            with contextlib.suppress(FileNotFoundError), open(path, "rb") as file:
                for record, at, _ in records(file, 0):
                    if record["event"] == "end" and is_sound(file, at, record["files"], go_on):
                        found.add(short(record["execution"]))
    return found


def listed(path: str) -> List[str]:
    """The executions in a list, in order; none where there is no list."""
    try:
        with open(path) as file:
            return [line.strip() for line in file]
    except FileNotFoundError:
        return []


def is_sound(file: BinaryIO, at: int, files: List[File], go_on: Callable[[], None] = lambda: None) -> bool:
    """Whether a payload is what was written. Calls `go_on` for each chunk."""
    file.seek(at)
    for _, size, sha256 in files:
        digest = hashlib.sha256()
        while size:
            go_on()
            chunk = file.read(min(size, CHUNK))
            if not chunk:
                return False
            digest.update(chunk)
            size -= len(chunk)
        if digest.hexdigest() != sha256:
            return False
    return True


def short(execution: str) -> bytes:
    """An execution in little memory."""
    return hashlib.sha256(execution.encode()).digest()[:16]


# ---------------------------------------------------------------- jobs


def jobs(path: str) -> Iterator[Event]:
    """The jobs of an element, as the worker takes them.

    The first line is `{"common": JOB}`, the last `{"end": how many}`. Each between is a job without what is equal there: its
    keys, and those of its `environment`. A file in it that begins and ends as the common job's of that name is
    [bytes of that beginning, what is between, bytes of that end]. Contents are base64.
    """
    count = 0
    with gzip.open(path, "rb") as lines:
        common = json.loads(next(lines))["common"]
        for line in lines:
            job = json.loads(line)
            if "end" in job:
                if job["end"] != count:
                    break
                return
            count += 1
            yield whole(job, common)
    raise Trouble("%s holds %d jobs, and should hold others" % (path, count))


def whole(job: Event, common: Event) -> Event:
    environment = {**common["environment"], **job.get("environment", {})}
    given: Dict[str, Any] = job.get("files") or common["files"]
    files = {name: content_of(file, common["files"].get(name)) for name, file in given.items()}
    return {**common, **job, "environment": environment, "files": files}


def content_of(file: Any, common: Optional[str]) -> str:
    """A file's content, in base64."""
    if isinstance(file, str):
        return file
    head, between, tail = file
    around = binascii.a2b_base64(common or "")
    content = around[:head] + binascii.a2b_base64(between) + around[len(around) - tail :]
    return binascii.b2a_base64(content, newline=False).decode()


class Feeder(threading.Thread):
    """Sends the worker what is missing, but only so many runs ahead that large outputs do not pile up on the node."""

    def __init__(self, path: str, wanted: Callable[[str], bool], ahead: int, pipe: Any, write: Any) -> None:
        super().__init__(daemon=True)
        self._path = path
        self._wanted = wanted
        self._pipe = pipe
        self._write = write
        self.permits = threading.Semaphore(ahead)
        self.spare: Deque[int] = deque()
        """Folders of runs that are packed, for others; see the worker."""
        self.sent = 0
        self.error: Optional[Trouble] = None

    def run(self) -> None:
        try:
            for job in jobs(self._path):
                if self._wanted(job["execution"]):
                    self.permits.acquire()
                    if "client" not in job:
                        job["used"] = self.spare.popleft() if self.spare else None
                    self._send(job)
                    self.sent += 1
            self._send({"end": True})
        except BrokenPipeError:
            pass  # the worker has ended, and says itself why
        except Exception as error:
            self.error = error if isinstance(error, Trouble) else Trouble("%s cannot be read: %s" % (self._path, error))
            self._pipe.close()  # ends the worker

    def _send(self, record: Event) -> None:
        self._write(self._pipe.fileno(), json.dumps(record, separators=(",", ":")).encode() + b"\n")


# ---------------------------------------------------------------- files of runs


def opened(root: int, path: str) -> int:
    """A regular file below an open folder, opened; no link on the way is followed."""
    *folders, name = path.encode("utf-8", "surrogateescape").split(b"/")
    with contextlib.ExitStack() as stack:
        for folder in folders:
            root = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=root)
            stack.callback(os.close, root)
        file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=root)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise OSError(errno.EINVAL, "is no file any more", path)
    return file


def logs_in(root: int) -> Iterator[File]:
    """What a run has printed, where it is anything."""
    for name in LOGS:
        try:
            if not os.stat(name, dir_fd=root, follow_symlinks=False).st_size:
                continue
            descriptor = opened(root, name)
        except OSError:
            continue
        with open(descriptor, "rb", buffering=0) as file:
            size, digest = 0, hashlib.sha256()
            for chunk in iter(lambda: file.read(CHUNK), b""):
                digest.update(chunk)
                size += len(chunk)
            if size:
                yield name, size, digest.hexdigest()


def contents(root: int, files: Iterable[File], go_on: Callable[[], None]) -> Iterator[bytes]:
    """What is in files, one after the other. Raises Changed where one is not as it should be. Calls `go_on` for each chunk."""
    for path, size, sha256 in files:
        digest = hashlib.sha256()
        try:
            with open(opened(root, path), "rb", buffering=0) as file:
                while size >= 0:
                    go_on()
                    chunk = file.read(CHUNK)
                    if not chunk:
                        break
                    digest.update(chunk)
                    size -= len(chunk)
                    yield chunk
        except OSError as error:
            raise Changed("%s: %s" % (path, error.strerror)) from error
        if size or digest.hexdigest() != sha256:
            raise Changed("%s has changed since" % path)


# ---------------------------------------------------------------- the node


def said_of(settings: Settings, index: int, facts: Event, slots: int) -> Event:
    """The first record, all but the attempt's own name."""
    variables = os.environ
    return {
        "event": "attempt",
        "attempt": "",
        "session": settings.session,
        "element": index,
        "job": task_of(variables),
        "node": variables.get("SLURMD_NODENAME") or os.uname().nodename,
        "started": time.time(),
        "slots": slots,
        "cpus": number(variables, "SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE", "NCPUS", "PBS_NP", "PBS_NUM_PPN")
        or usable_cores(),
        "memory": memory_of(variables),
        "gpus": variables.get("SLURM_JOB_GPUS") or variables.get("CUDA_VISIBLE_DEVICES"),
        "allocation": {name: variables[name] for name in ALLOCATION if name in variables},
        "facts": facts,
        "variables": {name: value for name, value in sorted(variables.items()) if is_recorded(name, settings.record)},
        "python": platform.python_version(),
    }


def task_of(variables: Any) -> str:
    """The task, as its scheduler calls it."""
    if "SLURM_ARRAY_JOB_ID" in variables:
        return "%s_%s" % (variables["SLURM_ARRAY_JOB_ID"], variables.get("SLURM_ARRAY_TASK_ID", ""))
    return str(variables.get("SLURM_JOB_ID") or variables.get("PBS_JOBID") or "")


def number(variables: Any, *names: str) -> Optional[int]:
    """The first of these that is a number."""
    return next((int(variables[name]) for name in names if variables.get(name, "").isdigit()), None)


def memory_of(variables: Any) -> Optional[int]:
    """Bytes that SLURM has allotted; PBS does not say."""
    megabytes, each = number(variables, "SLURM_MEM_PER_NODE"), number(variables, "SLURM_MEM_PER_CPU")
    if megabytes is None and each is not None:
        megabytes = each * (number(variables, "SLURM_CPUS_ON_NODE") or 1)
    return megabytes << 20 if megabytes else None


def is_recorded(name: str, patterns: List[str]) -> bool:
    return any(fnmatch.fnmatchcase(name, one) for one in patterns) and not any(word in name.upper() for word in SECRET)


def usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def name_of_attempt(suffix: int) -> str:
    """`job.restart.host.process`; what another attempt has taken gets a suffix."""
    job = os.environ.get("SLURM_JOB_ID") or os.environ.get("PBS_JOBID") or "none"
    process = "%d-%d" % (os.getpid(), suffix) if suffix else str(os.getpid())
    parts = (job, os.environ.get("SLURM_RESTART_COUNT") or "0", os.uname().nodename, process)
    return ".".join(re.sub(r"[^A-Za-z0-9_-]", "_", part) for part in parts)


def new_pack(folder: str, index: str, told: Event) -> Pack:
    """The pack of this attempt, begun."""
    suffix = 0
    while True:
        told["attempt"] = name_of_attempt(suffix)
        try:
            pack = Pack(folder, index, told["attempt"])
        except FileExistsError:
            suffix += 1
            continue
        told["clock"] = pack.ahead()
        pack.add(told)
        pack.sync(float("inf"))
        return pack


class Needs:
    """The files that must be, and stay, as they are where it was submitted."""

    def __init__(self, needs: List[Dict[str, Any]]) -> None:
        """Raises Trouble where distributions of a Python are not what they were."""
        self._needs = [{**need, "path": found_by_name(need)} for need in needs if need.get("holds") is None]
        for need in needs:
            if need.get("holds") is not None:
                check_installed(need["name"], set(need["holds"]), set(installed(need["path"])))
        self._seen: Dict[str, Tuple[int, ...]] = {}

    def check(self) -> None:
        """Raises Trouble where one is not; what seems untouched since the last time is not read again."""
        for need in self._needs:
            try:
                found = os.stat(need["path"], follow_symlinks=not need.get("link"))
                seen = (found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)
                if self._seen.get(need["path"]) != seen and need["sha256"] not in ("", hash_of(need)):
                    raise Trouble("%s: %s is another than on the host that submitted" % (need["name"], need["path"]))
            except OSError as error:
                raise Trouble("%s: %s: %s" % (need["name"], need["path"], error.strerror)) from error
            self._seen[need["path"]] = seen


def installed(folders: str) -> Tuple[str, ...]:
    """The distributions in folders (as in a PATH), by the paths of what describes them; these have name and version."""
    found = []
    for folder in folders.split(os.pathsep):
        with contextlib.suppress(OSError):
            names = (name for name in os.listdir(folder) if name.endswith((".dist-info", ".egg-info")))
            found += [os.path.join(folder, name) for name in names]
    return tuple(sorted(found))


def check_installed(name: str, there: Set[str], here: Set[str]) -> None:
    """Raises Trouble where the distributions here are not those that were there."""
    other = ["%s is not here" % path for path in sorted(there - here)]
    other += ["%s is only here" % path for path in sorted(here - there)]
    if other:
        more = " and %d more" % (len(other) - 3) if len(other) > 3 else ""
        raise Trouble("%s are others than on the host that submitted: %s%s" % (name, ", ".join(other[:3]), more))


def found_by_name(need: Dict[str, Any]) -> str:
    """The path of a file; of what is called by its name, that which is found here."""
    found = shutil.which(need["name"], path=need["search"]) if need.get("search") else None
    return found or str(need["path"])


def hash_of(need: Dict[str, Any]) -> str:
    """Of a file's content, or of what a link says."""
    return hashlib.sha256(os.fsencode(os.readlink(need["path"]))).hexdigest() if need.get("link") else digest_of(need["path"])


def digest_of(path: str) -> str:
    digest = hashlib.sha256()
    with open(path, "rb", buffering=0) as file:
        for chunk in iter(lambda: file.read(CHUNK), b""):
            digest.update(chunk)
    return digest.hexdigest()


@contextlib.contextmanager
def scratch(settings: Settings, remove: Any) -> Iterator[Tuple[str, int]]:
    """A folder of this attempt's own on its node, and the lock by which others see that it lives.

    The worker holds the lock too: it may outlive this process by the grace time of what runs.
    """
    root = scratch_root(settings.scratch)
    prefix = "sierra-%s-" % settings.session
    for name in os.listdir(root):
        if name.startswith(prefix):
            with contextlib.suppress(OSError):
                remove_dead(os.path.join(root, name), remove)
    folder = tempfile.mkdtemp(prefix=prefix, dir=root)
    lock = os.open(os.path.join(folder, "owner"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        with contextlib.suppress(OSError):  # a file system without locks: nobody ever takes it for dead
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.write(lock, owner())
        yield folder, lock
    finally:
        remove_own(folder, remove)
        os.close(lock)


def scratch_root(wanted: Optional[str]) -> str:
    if wanted is None:
        named = [os.environ.get("SLURM_TMPDIR"), os.environ.get("TMPDIR"), "/tmp"]  # noqa: S108 - the last resort
        there = [path for path in named if path and os.path.isdir(path) and os.access(path, os.W_OK | os.X_OK)]
        if not there:
            raise Trouble("no folder for runs: none of $SLURM_TMPDIR, $TMPDIR and /tmp can be written to")
        return os.path.abspath(there[0])
    filled = re.sub(r"\$(?:\{(\w+)\}|(\w+))", lambda match: value_of(match[1] or match[2], wanted), wanted)
    folder = os.path.abspath(filled)
    if not os.path.isdir(os.path.dirname(folder) if os.path.dirname(folder) != "/" else folder):
        raise Trouble("scratch = %s: there is no folder to make it in; name one that is there" % wanted)
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise Trouble("scratch = %s: %s: %s" % (wanted, folder, error.strerror)) from error
    return folder


def value_of(name: str, wanted: str) -> str:
    if not os.environ.get(name):
        raise Trouble("scratch = %s: there is no $%s" % (wanted, name))
    return os.environ[name]


def owner() -> bytes:
    """This host: its locks may be unknown to others who reach the same folder."""
    return os.uname().nodename.encode()


def remove_dead(folder: str, remove: Any) -> None:
    """Remove what an attempt has left that died on this host."""
    found = os.lstat(folder)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
        return
    lock = os.open(os.path.join(folder, "owner"), os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.read(lock, 4096) == owner():
            remove_own(folder, remove)
    finally:
        os.close(lock)


def remove_own(folder: str, remove: Any) -> None:
    """Remove an attempt's folder, last of all the file that says whose it is: who is killed meanwhile leaves it to the next."""
    with contextlib.suppress(OSError):
        for name in os.listdir(folder):
            remove(os.path.join(folder, name))
    remove(folder)


# ---------------------------------------------------------------- executing


class Asked:
    """How often this process was asked to end."""

    def __init__(self) -> None:
        self.times = 0
        self.when = 0.0
        for signalled in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(signalled, self._note)

    def _note(self, signalled: int, frame: Any) -> None:
        self.when = self.when or time.clock_gettime(time.CLOCK_BOOTTIME)
        self.times += 1


def born() -> float:
    """When the task began, by the clock since boot: its script has become this process, by `exec`."""
    with open("/proc/self/stat", "rb") as file:
        ticks = int(file.read().rpartition(b")")[2].split()[19])
    return ticks / os.sysconf("SC_CLK_TCK")


class Again:
    """Asks the scheduler to begin this task anew, before its time is over: once, and only where it has got on."""

    def __init__(self, folder: str, pack: Pack, command: Iterable[str], wall: Optional[float]) -> None:
        self._cancelled = os.path.join(folder, "cancelled")
        self._pack = pack
        self._command = [*command, task_of(os.environ)]
        self._at = born() + wall - min(BEFORE_S, wall / 6) if wall and len(self._command) > 1 else float("inf")
        self.got_on = False

    def ask(self) -> None:
        """Ask, if it is time to. Where the scheduler agrees, this task is asked to end soon."""
        if not self.got_on or time.clock_gettime(time.CLOCK_BOOTTIME) < self._at or os.path.exists(self._cancelled):
            return
        self._at = float("inf")
        self._record(None)
        try:
            subprocess.run(self._command, stdin=subprocess.DEVNULL, capture_output=True, check=True, timeout=REQUEUE_S)
        except subprocess.CalledProcessError as error:
            said = (error.stderr or error.stdout).decode("utf-8", "replace").split()
            self._record(" ".join(said) or "status %d" % error.returncode)
        except (OSError, subprocess.TimeoutExpired) as error:
            self._record(" ".join(str(error).split()))

    def _record(self, refused: Optional[str]) -> None:
        self._pack.add({"event": "requeue", "time": time.time(), "refused": refused})
        self._pack.sync(float("inf"))


class Journal:
    """What the worker says, read while it grows."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._file: Optional[int] = None
        self._offset = 0

    def read(self) -> List[Event]:
        """The next events. A line that is cut short is not there yet, and may be taken back."""
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
    """The worker at work, and what it says on the way into the pack."""

    def __init__(
        self,
        folder: str,
        session: str,
        lock: int,
        pack: Pack,
        asked: Asked,
        again: Again,
        worker: Any,
        needs: Needs,
        scratch: str,
    ) -> None:
        """`scratch`: a folder of the node, which is made; `lock`: what the worker holds as long as it lives."""
        os.mkdir(scratch)
        self._session = session
        self._lock = lock
        self._cancelled = os.path.join(folder, "cancelled")
        self._program = os.path.join(folder, "worker.py")
        self._scratch = scratch
        self._pack = pack
        self._asked = asked
        self._again = again
        self._worker = worker
        self._needs = needs
        self._journal = Journal(os.path.join(scratch, "journal.jsonl"))
        self._held: Deque[Tuple[float, Event]] = deque()
        self._begun = ""
        self._ended = 0
        self._stopping = False
        self._look_at = 0.0

    def run(self, slots: int, path: str, wanted: Callable[[str], bool]) -> bool:
        """Execute the wanted jobs of a file; whether all were. Raises Trouble, OSError where that is not to be had."""
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-X", "utf8", self._program, self._scratch, str(slots)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            bufsize=0,
            env={**os.environ, "SIERRA_SESSION": self._session},
            pass_fds=(self._lock,),
            start_new_session=True,
        )
        self._feeder = Feeder(path, wanted, AHEAD + slots * AHEAD_EACH, self._process.stdin, self._worker.write_all)
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
            events = self._journal.read()
            now = time.monotonic()
            self._heed(now)
            for event in events:
                self._hear(now, event)
            self._take(now)
            self._pack.sync(now)
            if not (over or self._stopping):
                self._again.ask()
            if over and not events and not self._held:
                return
            pause = BUSY_S if events or self._held else min(IDLE_S, 1.2 * pause)
            time.sleep(pause)

    def _hear(self, now: float, event: Event) -> None:
        """Say at once what has begun; hold what has ended."""
        if event["event"] == "end":
            self._held.append((now, event))
            if is_small(event):
                self._feeder.permits.release()
        elif event["event"] == "stalled":
            self._pack.add(event)
        elif not (self._stopping or self._asked.times):
            self.begin(event["execution"])

    def begin(self, execution: str, *, alone: bool = False) -> None:
        """Record that a run begins, once; that one will begin `alone`, on the disk."""
        if execution != self._begun:
            event = {"event": "start", "execution": execution, "time": time.time()}
            self._pack.add({**event, "alone": True} if alone else event)
        self._begun = execution
        if alone:
            self._pack.sync(float("inf"))

    def _heed(self, now: float) -> None:
        """End the worker where that is asked for, or where nobody waits any more."""
        if not self._stopping and (self._asked.times or self._is_unwanted(now)):
            self._stopping = True
            self._signal(signal.SIGHUP)  # not SIGTERM: a scheduler has sent one, perhaps, and a second one leaves no grace
        if self._asked.times > 1:
            self._signal(signal.SIGTERM)

    def _is_unwanted(self, now: float) -> bool:
        if now < self._look_at:
            return False
        self._look_at = now + SYNC_S
        return os.path.exists(self._cancelled) or self._pack.is_gone()

    def _signal(self, number: int) -> None:
        if self._process.poll() is None:
            self._process.send_signal(number)

    def _take(self, now: float) -> None:
        """Pack what is held for long enough; nothing more once this process is asked to end."""
        if self._stopping or self._process.returncode == 1:
            self._held.clear()
        if self._held and now - self._held[0][0] >= HOLD_S:
            self._needs.check()
        while self._held and now - self._held[0][0] >= HOLD_S and not self._asked.times:
            self._take_end(self._held.popleft()[1])

    def _take_end(self, event: Event) -> None:
        directory, spare = event.pop("directory"), event.pop("spare", False)
        if event["stopped"] != "interrupted":
            with contextlib.suppress(Unwanted):
                self._pack_run(event, directory)
                self._ended += 1
                self._again.got_on = True
        if spare:
            self._feeder.spare.append(int(os.path.basename(directory)))
        elif self._is_own(directory):
            self._remove(directory)
        if not is_small(event):
            self._feeder.permits.release()

    def _is_own(self, directory: str) -> bool:
        """Whether it is the folder of one run; one that could not begin has none."""
        return os.path.dirname(directory) == self._scratch and os.path.basename(directory).isdigit()

    def _remove(self, directory: str) -> None:
        self._worker.remove(directory)
        with contextlib.suppress(OSError):
            os.unlink(directory)  # a link, in its place

    def _pack_run(self, event: Event, directory: str) -> None:
        root = None
        if self._is_own(directory):
            with contextlib.suppress(OSError):
                root = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        if root is None:
            without = "its folder is gone" if event["outputs"] else None
            self._pack.add({**event, "outputs": [], "error": event["error"] or without, "files": [], "size": 0})
            return
        try:
            logs = list(logs_in(root))
            outputs = [("output/" + file["path"], file["bytes"], file["sha256"]) for file in event["outputs"]]
            try:
                self._add(event, root, logs + outputs)
            except Changed as changed:
                error = event["error"] or "its outputs cannot be read: %s" % changed
                self._add({**event, "outputs": [], "error": error}, root, logs)
        finally:
            os.close(root)

    def _add(self, event: Event, root: int, files: List[File]) -> None:
        size = sum(size for _, size, _ in files)
        self._pack.add({**event, "files": files, "size": size}, contents(root, files, self._go_on))

    def _go_on(self) -> None:
        """Raise Unwanted where a run is packed for nobody any more, or the task has no more time for it."""
        self._heed(time.monotonic())
        asked = self._asked
        if self._stopping and (asked.times != 1 or time.clock_gettime(time.CLOCK_BOOTTIME) - asked.when > GIVE_UP_S):
            raise Unwanted

    def _end(self) -> None:
        """Wait for the worker's end, whatever has happened, and end what it has left."""
        while self._process.poll() is None:
            self._stopping = True
            self._signal(signal.SIGTERM if self._asked.times > 1 else signal.SIGHUP)
            time.sleep(IDLE_S)
        self._worker.end_orphans(None)
        self._said = self._process.stderr.read() if self._process.stderr else b""

    def _is_finished(self) -> bool:
        code, error = self._process.returncode, self._feeder.error
        if self._stopping or self._asked.times:
            return False
        if error is not None:
            raise error
        if code == 0 and self._ended != self._feeder.sent:
            raise Trouble("of %d runs, the worker has told of %d" % (self._feeder.sent, self._ended))
        if code == 4:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), self._scratch)
        if code not in (0, 1):
            lines = self._said.decode("utf-8", "replace").strip().splitlines()
            raise Trouble(": ".join(["the worker ended with %s" % (code if code > 0 else "signal %d" % -code), *lines[-1:]]))
        return code == 0


def is_small(event: Event) -> bool:
    """Whether it is the end of a run that has left little."""
    return event["event"] == "end" and sum(int(file["bytes"]) for file in event["outputs"]) <= CHUNK


def adopt_orphans() -> None:
    """Become the parent of what a worker leaves that is killed (Linux only).

    (Not the worker's own function: this process must not end with the thread that started it, which a scheduler may do away
    with long before.)
    """
    with contextlib.suppress(ImportError, OSError, AttributeError):
        import ctypes

        set_child_subreaper = 36
        ctypes.CDLL(None).prctl(set_child_subreaper, 1, 0, 0, 0)


def module(folder: str, name: str) -> Any:
    """A file of the session's, as a module; it leaves none beside it."""
    sys.dont_write_bytecode = True
    spec = importlib.util.spec_from_file_location(name, os.path.join(folder, name + ".py"))
    if spec is None or spec.loader is None:
        raise Trouble("%s.py is missing in %s" % (name, folder))
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def attempt(folder: str, index: int, asked: Asked, *, wall: Optional[float] = None, probing: bool) -> bool:
    """Execute what is missing of an element; whether it is finished. Raises Trouble and OSError."""
    with open(os.path.join(folder, "element.json"), "rb") as file:
        settings = Settings(**json.load(file))
    worker, machine = module(folder, "worker"), module(folder, "machine")
    adopt_orphans()
    if os.path.exists(os.path.join(folder, "cancelled")):
        return False
    slots = min(settings.slots, usable_cores())
    results = os.path.join(folder, "results")
    pack = new_pack(results, "probe" if probing else str(index), said_of(settings, index, machine.facts(), slots))
    try:
        needs = Needs(settings.needs)
        needs.check()
        with scratch(settings, worker.remove) as (own, lock):
            named = os.path.join(folder, "elements", str(index))
            done = executed(results, str(index), pack.path, asked) | {short(one) for one in listed(named + ".failed")}
            again = Again(folder, pack, settings.requeue, wall)
            execution = partial(Execution, folder, settings.session, lock, pack, asked, again, worker, needs)
            if not probing and not execute(named, done, slots, own, execution):
                pack.sync(float("inf"))
                return False
        pack.add({"event": "finished", "time": time.time()})
        pack.sync(float("inf"))
        return True
    except Unwanted:
        return False
    except Exception as error:
        pack.say(reason_of(error), full=getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT))
        raise


def execute(named: str, done: Set[bytes], slots: int, scratch: str, execution: Callable[[str], Execution]) -> bool:
    """Execute what is not done of an element, first what may be dangerous to others, by itself; whether all was."""
    for number, one in enumerate(listed(named + ".alone")):
        if short(one) not in done:
            done.add(short(one))
            alone = execution(os.path.join(scratch, "alone%d" % number))
            alone.begin(one, alone=True)
            if not alone.run(1, named + ".jobs", one.__eq__):
                return False
    return execution(os.path.join(scratch, "runs")).run(slots, named + ".jobs", lambda one: short(one) not in done)


def reason_of(error: BaseException) -> str:
    """In one line, and on which node."""
    if isinstance(error, Trouble):
        reason = str(error)
    else:
        name, why = getattr(error, "filename", None), getattr(error, "strerror", None)
        reason = why or "%s: %s" % (type(error).__name__, error)
        reason = "%s: %s" % (name, reason) if name else reason
    return "%s: %s" % (os.uname().nodename, " ".join(reason.split()))


def say(text: str) -> None:
    with contextlib.suppress(OSError):
        os.write(2, ("element: %s\n" % text).encode("utf-8", "backslashreplace"))


def main(arguments: List[str]) -> int:
    if sys.version_info < (3, 8):  # noqa: UP036 - that is what is to be said
        say("Python %s on %s is too old; 3.8 or newer is needed" % (platform.python_version(), os.uname().nodename))
        return 3
    asked = Asked()
    try:
        folder, index = os.path.abspath(arguments[0]), int(arguments[-1])
        probing = "--probe" in arguments
        wall = next((float(one.partition("=")[2]) for one in arguments if one.startswith("--wall=")), None)
        if attempt(folder, index, asked, wall=wall, probing=probing):
            return 0
        if asked.times and not probing:
            say("asked to end after %.0f s" % (asked.when - born()))
        return 1
    except Exception as error:
        say(reason_of(error))
        return 3


if __name__ == "__main__":
    os._exit(main(sys.argv[1:]))
