"""The worker: executes runs on this machine, in an array task, in a container or on a robot.

It is one file that needs only the standard library (Python 3.8 or newer), so that nothing has to be installed on a node:

    worker.py FOLDER SLOTS [JOURNAL | - PLACES] < jobs

Jobs are lines of JSON, one for each run, and end with the line `{"end": true}`. A sender that uses a pipe keeps it open until
the worker has ended. A pipe that is closed earlier, or an input that ends without that line, means that nobody waits for the
results any more: the worker then ends the running runs and starts no others. SIGTERM requests the same, and a second SIGTERM
requests it without grace time.

For each job the worker makes the folder FOLDER/<number>/ with the input files, `home`, `tmp` and `output`. It starts the
program in a session (and so a process group) of its own with `output` as its working directory, enforces the limits, and hashes
the files that were left in `output`. In argv and environment, the character NUL stands for the run's folder. If TMPDIR would be
`tmp`, the run gets a folder with a short path instead, unless it is in a container: see `Temporary`.

A job with the key `used` lets a short run reuse a folder, because making and removing folders may take longer than the run. If
a run has left little, and has changed only outputs and logs in its folder, its `end` has the key `spare`. A sender that does
not need that folder any more may give its number as `used` in a later job (otherwise `used` is null); the worker then makes the
changed parts of the folder again. A folder is spare only if no process that its run has started is alive. If that is unknown (a
Python without ctypes, no /proc), no folder is spare.

Events are appended to JOURNAL (FOLDER/journal.jsonl), one line each: `start` (process id and its start time, so that an orphan
can be recognised) and `end` (sierra.model.Result). An incomplete line counts as not written. The exit status is 0 if all jobs
have been executed, 1 if the worker was told to stop, and 3 if it could not continue (4: a disk has no space); its last line on
stderr then gives the reason.

If the disk has no space when a run has ended, no `end` is written for it, whatever its exit status (the run may have failed for
that reason, or may not have noticed), and the worker cannot continue.

`started` is the clock's time just before the program was started. For a run that waited for its moment, it is the wall-clock
time of that moment plus the elapsed time by a monotonic clock. `ended` is `started` plus the elapsed time. So changes to the
system clock have no effect: no run has a negative duration, or a duration below its CPU time.

In argv, environment and input files, a mark that begins with PORT_MARK stands for a free port, which this worker chooses before
the run begins, and holds until it has ended (see `conductor.Ports`). Its `end` has these `ports`, in the order of the marks.
The worker in a shared container gets jobs without marks.

A job of a cluster may use the devices that its scheduler has allotted. In an environment (and in a client's argv), the
character \\1 followed by a name from DEVICES stands for the value of the worker's variable of that name, or for nothing if
there is none. If a list of several devices can be divided among the slots, each slot gets its own part.

If all processes of a run are stopped (SIGSTOP) for STALLED_S, the worker writes an event `stalled`, with `since` in seconds
since the epoch. The run's time limit continues to apply, and the run may be continued. The worker continues the processes that
it tells to end, so that a program can react to SIGTERM. Under a tracer, the state of a process is `t` both if a signal has
stopped it and if it waits for the tracer. A signal has stopped it if, between two looks, it was never on a processor, and the
tracer sleeps: the tracer has then seen the stop, and has let the process stay in it.

A run with the limit `after_marker_s` is ended so many seconds after its marker is met: the file `marker` in its output folder
(or its log of that name) exists, and contains `contains`. Such a run counts as ended by itself with status 0, and its `end` has
the key `after_marker`. Processes of a run that still run when its program has ended by itself are ended; its `end` has the
names of some of them (`left_running`). A process that ends within a moment does not count. Neither do those of a container of
one run, which end with its program.

A worker that stops, for whatever reason, continues for GIVE_UP_S to read the outputs of runs that had ended by then. Runs whose
outputs are not read by then count as interrupted. Outputs are counted, and read, by their apparent size: the size of a file
with holes is its length.

Processes that leave their group are still found: the worker is their subreaper (Linux), so an orphan becomes a child of the
worker's main thread, which starts no process itself.

The argv of a job with services, or with commands before or after its own, is CONDUCTED and a plan for `conductor.py`, which
lies beside this file. The conductor is started instead, and executes all of them. It leaves a report; without one, the run has
failed.

A job may have a `client`, which starts a container engine. The client is then executed instead of the job's own argv, in its
own environment. The run's processes are those with SIERRA_EXECUTION in their environment, wherever the engine starts them.
Their use of resources is measured from outside, at intervals of a twentieth of the time that they have run; if they end before
the first measurement, it is unknown (null). If the client was killed, its `stop` ends the container.

If a run waits for its moment, and its client has a `start_pipe`, the container is started before: see `Held`. Otherwise its
`end` has the key `delay_s`: how many seconds after its moment its program had begun, because the engine took so long.

A `shared` container executes all runs of a slot, one after the other. It is started with the first of them, with a folder of
its own (the NUL in its argv). This worker also runs inside the container: it takes jobs from its standard input and, with the
argument `-`, writes its journal to its standard output. Everything that a run leaves in one of PLACES, folders of the
container's own, is removed when the run ends, so that the next run finds them unchanged. Of the container's folder, runs can
reach only `runs`. Runs can also write to the container's standard output (/proc/1/fd/1), stop the worker in the container, or
change what earlier runs have left. Therefore each job has a `seal`, a word that its run cannot know, and events without it are
ignored. When a run has ended, none of its processes is left alive, and its folder is taken out of the container before it is
read. If the worker in a container is late in ending a run, the whole container is ended.
"""

from __future__ import annotations

import base64
import contextlib
import errno
import functools
import hashlib
import heapq
import itertools
import json
import os
import queue
import re
import select
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from typing import (
    IO,
    TYPE_CHECKING,
    Callable,
    Iterable,
    Iterator,
    Mapping,
    NamedTuple,
    Sequence,
    TextIO,
    TypedDict,
    Union,
    cast,
)

if TYPE_CHECKING:
    from resource import struct_rusage
    from types import ModuleType
    from typing import Literal, NotRequired

    from sierra.worker.conductor import Marker
    from sierra.worker.file_trace import Contents, Hashed, Names, Observation, Trace, Way

FOLDERS = ("home", "tmp", "output")
LOGS = ("stdout", "stderr")
OBSERVED = "observed.json"  # in a run's folder: what the run did with files
TRACER = "file_trace.py"  # beside this file: it observes runs
CONDUCTOR = "conductor.py"  # beside this file: it executes what is around a run's command
PROGRAM = re.compile(rb"\0-I\0-S\0[^\0]*/(?:worker|conductor)\.py\0")
"""The words of SIERRA's own program in a container."""
CONDUCTED = "\2"  # the first word of a job that the conductor executes; the second is its plan
REPORT = os.path.join("home", ".sierra-conductor")  # the conductor's, in the run's folder
REPORT_BYTES = 1 << 16
PORT_MARK = "730461892355147"  # the beginning of the marks of ports, which are numbers, so that inputs with types may have them
PORT_MARKS = re.compile(PORT_MARK + "[0-9]{2}")
UNOBSERVED = "services that all runs share were not observed"
SHARED = "shared"  # in the folder of shared services: what their conductor tells when they are ready
OF_ONE_RUN = ("SIERRA_RUN_ID", "SIERRA_SEED", "SIERRA_EXECUTION")  # variables
TRACE = ".trace"  # the end of the name of a tracer's log, beside the run's folder
RUNS = "runs"
OWN_TMP = "\0/tmp"  # the TMPDIR of a run in a job
TEMPORARY = re.compile(r"sierra-[0-9a-f]{8}")  # names of workers' folders in the system's temporary folder
TEMPORARY_MARK = ".sierra-runs"  # in such a folder: its host, and the folder of its worker
TEMPORARY_LENGTH = 48
"""The longest path of a temporary folder in which there are folders for runs.

`/sierra-<8>/<number>/tmp` follows it, and after that there must be room for `/pymp-<8>/listener-<8>`, the sockets of Python's
multiprocessing: the path of a socket has at most 107 characters.
"""
POLL_S = 0.25
HEAD_BYTES = 4096
EMPTY_LINE = re.compile(rb"(?<=\n)\r?\n")
LOG_BYTES = 256 << 20  # limit for standard output and for standard error, independent of the configured limits
CHUNK = 1 << 20
SETTLE_S = 2.0
GRACE_S = 5.0  # between SIGTERM and SIGKILL, if the job does not say
STOPPED, FAILED, FULL = 1, 3, 4  # exit statuses
CLEAN_S = 10.0  # for an engine's cleanup after its containers have ended
START_S = 60.0  # for an engine to start a container
GIVE_UP_S = 5.0  # to read the outputs of ended runs after the worker was told to stop
PROCESSORS = {  # by their numbers in ELF files (elf.h)
    3: "i686",
    21: "ppc64le",
    22: "s390x",
    40: "arm",
    62: "x86_64",
    183: "aarch64",
    243: "riscv64",
    258: "loongarch64",
}
MARKED = "marker"  # why a run was stopped that counts as ended by itself
STALLED_S = 5.0  # with only stopped processes, until a run is reported as stalled
SAMPLE_S = 0.05
LOOKS = 4  # the next look at an observed run comes after a quarter of its time, because most programs load their files early
SPREAD_S = 0.5  # for a signal to reach all processes that it was sent to
ALLOTTED = "\1"
ROCR = "ROCR_VISIBLE_DEVICES"
BELOW_ROCR = ("CUDA_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES", "GPU_DEVICE_ORDINAL")  # for AMD, indices into ROCR's list
DEVICES = (*BELOW_ROCR, ROCR, "NVIDIA_VISIBLE_DEVICES", "ZE_AFFINITY_MASK")
TRACED_S = 0.004  # by which a run takes longer under a tracer,
BYTE_S = 1e-6  # and for each byte of the log: 0.1 ms a call
SMALL, RACY_NS = 1 << 16, 2 * 10**9  # as in sierra.provenance.hash_cache
MOST_LOST = 3  # observed runs that another one replaces, because they have failed: in each experiment, and to compare runs
ANY = -1  # stands for all experiments
STOP_S = 0.5  # for SIGCONT to reach all processes that it is sent to, and much longer than the time between two looks
UNKNOWN_S = 0.1  # for an observation, while none has ended
LINE_BYTES = 1 << 16
BESIDE_NS = 946684800 * 10**9  # the modification time of files beside inputs: 2000-01-01, the same for all runs
SAFE = re.compile(r"[A-Za-z0-9/._+@~-]+(?: [A-Za-z0-9/._+@~-]+)*")  # a path that means the same in each format of inputs
LINKED = 4 << 20  # a file beside inputs that has as many bytes may be a hard link
FICLONE = 0x40049409
MOST_NAMED = 10  # entries that a run leaves and that are neither files nor folders


class Limits(TypedDict, total=False):
    """The limits of a run that are set: see `sierra.model.Limits`."""

    wall_s: float
    cpu_s: float
    memory_bytes: int
    output_bytes: int
    grace_s: float
    after_marker_s: float
    marker: str
    contains: str


class Program(TypedDict):
    """A program; `stop` is the command that ends the container of one that starts a container."""

    argv: Sequence[str]
    environment: Mapping[str, str]
    stop: NotRequired[Sequence[str]]
    start_pipe: NotRequired[str]
    """The named pipe from which a line lets the program in the container begin."""


class Helps(TypedDict):
    """Knowledge of this machine from before: a tracer that works, and a file with the SHA-256 of files."""

    tracer: str | None
    digests: str


class Job(Program):
    """A run to execute: one line of the input."""

    run: str
    execution: str
    files: dict[str, str]
    """The content of each input file, in base64."""
    limits: Limits
    client: NotRequired[Program]
    shared: NotRequired[bool]
    used: NotRequired[int | None]
    seal: NotRequired[str]
    observe: NotRequired[Mapping[str, str]]
    """The folders by which observed files are named, if this run is observed: see `file_trace.Names`."""
    beside: NotRequired[str]
    """A folder whose files lie beside the input files; the runs of a session share it."""
    folders: NotRequired[Mapping[str, str]]
    """The texts that take the place of marks in the input files; NUL stands for the run's folder."""
    ahead: NotRequired[float]
    """How many seconds this host's clock may be ahead of that of a file system with files that the run uses."""
    budget: NotRequired[float]
    """The run is in a sample: the part of the runs' time that observations of the sample may take."""
    affordable: NotRequired[float]
    """The run is observed if this takes at most so many times the mean time of a run, and while no run has ended."""
    experiment: NotRequired[int]
    """The number of its experiment. If the observed run fails, another one is observed: see `Worker.request_another`."""
    helps: NotRequired[Helps]
    compares: NotRequired[bool]
    """The worker observes this run to compare it with one that was doubtful: see `Worker.with_observation`."""
    waits: NotRequired[bool]
    """True: the run is prepared (event `ready`), and starts at the moment that the input gives later: see `Worker.read`.

    It is one of several that start together on robots, and so cannot be executed once more. Therefore no tracer observes it.
    """
    own_ports: NotRequired[Sequence[int]]
    """The ports that the worker has chosen for it."""
    again: NotRequired[bool]
    """In a request: one more run is to be observed after the next."""
    unobserved: NotRequired[str]
    """Why this run was executed before and could not be observed: it is executed once more without observation."""


class OutputFile(TypedDict):
    """A file that a run has left: see `sierra.model.OutputFile`."""

    path: str
    sha256: str
    bytes: int
    lines: int
    ended: bool
    head: str
    quotes: NotRequired[int]
    blank: NotRequired[int]
    alike: NotRequired[bool]


class Usage(TypedDict):
    """The resources that a run has used; None if this is unknown."""

    user_s: float | None
    system_s: float | None
    max_rss_bytes: int | None


UNUSED: Usage = {"user_s": 0.0, "system_s": 0.0, "max_rss_bytes": 0}


class Remains(TypedDict):
    """The outputs of a run that has ended, and why they are incomplete."""

    stopped: str | None
    outputs: list[OutputFile]
    error: str | None
    left_out: NotRequired[list[str]]
    elsewhere: NotRequired[list[str]]
    spare: NotRequired[bool]
    observed: NotRequired[bool]
    delay_s: NotRequired[float]
    left_running: NotRequired[list[str]]
    ports: NotRequired[list[int]]
    after_marker: NotRequired[float]


class Start(TypedDict):
    """The event that a run has begun."""

    event: Literal["start"]
    execution: str
    pid: int
    born: int | None


class Ready(TypedDict):
    """The event that a run is prepared, and waits for its moment."""

    event: Literal["ready"]
    execution: str


class Stalled(TypedDict):
    """The event that all processes of a run are stopped."""

    event: Literal["stalled"]
    run: str
    execution: str
    pid: int
    since: float


class Outcome(Usage, Remains):
    """The end of a run: see `sierra.model.Result`."""

    run: str
    execution: str
    started: float
    ended: float
    exit_code: int | None
    signal: int | None
    host: str
    slot: int


class End(Outcome):
    """The event that a run has ended."""

    event: Literal["end"]
    directory: str


Event = Union[Start, Ready, Stalled, End]


READY, BEGUN, ENDING, GONE, OVER = "r", "b", "e", "g", "o"
"""The states of a run that a worker announces at once: prepared, begun, told to end or ended, without a process, reported."""
Announce = Callable[[str], None]


class GivenUp(Exception):
    """The worker stops, and no longer reads the outputs of a run."""


class NotHeld(Exception):
    """A container cannot be started before its run begins, for the reason given in one line."""


class Journal:
    """A file to which lines are appended, each of them completely or not at all."""

    def __init__(self, path: str | None) -> None:
        """Open the file, or use standard output for `None`, which another process reads through a pipe."""
        flags = os.O_CREAT | os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC
        self._file = os.dup(1) if path is None else os.open(path, flags, 0o666)
        self._piped = path is None
        self._lock = threading.Lock()

    def write(self, event: Event, seal: str | None = None) -> None:
        line = json.dumps({**event, "seal": seal} if seal else event, separators=(",", ":")).encode() + b"\n"
        with self._lock:
            if self._piped:
                write_all(self._file, b"\n" + line)  # another process may have begun a line
                return
            written = os.write(self._file, line)
            if written != len(line):
                os.ftruncate(self._file, os.fstat(self._file).st_size - written)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "journal.jsonl")

    def close(self) -> None:
        os.close(self._file)


class Waker:
    """A means to wake the main thread from any thread, from a signal handler, or when a pipe is closed.

    (Python's own events and queues hold locks, so a signal handler must not use them.)
    """

    def __init__(self) -> None:
        self._read_end, self._write_end = os.pipe()
        os.set_blocking(self._read_end, False)
        os.set_blocking(self._write_end, False)
        self._poll = select.poll()
        self._poll.register(self._read_end, select.POLLIN)
        self._pipe: int | None = None

    def watch_pipe(self, pipe: int) -> None:
        """Wake also when the other end of `pipe` is closed, even if data in it is still unread."""
        self._pipe = pipe
        self._poll.register(pipe, 0)

    def wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self._write_end, b"!")

    def close(self) -> None:
        os.close(self._read_end)
        os.close(self._write_end)

    def wait(self, seconds: float) -> bool:
        """Wait for so many seconds, or until woken. Return False if the pipe was closed."""
        ready = [descriptor for descriptor, _ in self._poll.poll(seconds * 1000)]
        if self._read_end in ready:
            os.read(self._read_end, 4096)
        if self._pipe not in ready:
            return True
        self._poll.unregister(self._pipe)
        return False


class Temporary:
    """A worker's folder in the system's temporary folder, with a folder for the temporary files of each run.

    Its path is short, wherever the project is. Only its user can reach it. This process holds a lock on it, which also tells
    systemd-tmpfiles to leave it alone. What a killed worker left there is removed by the next one, by the command that records
    its runs, and by `sierra gc`.
    """

    def __init__(self, owner: str) -> None:
        """Prepare for the worker in the folder `owner`. Nothing is made yet."""
        self.owner = owner
        self.path: str | None = None
        self.held = -1
        self.places: dict[str, str] = {}
        """The folder of each run that has one, by the run's folder."""
        self.making = threading.Lock()

    def make(self, folder: str) -> str | None:
        """Make the folder of a run for its temporary files, and return its TMPDIR. None: it can have none that is short."""
        with self.making:
            if self.path is None or not is_folder(self.path):  # the second: somebody has removed it
                self.close()
                self.begin()
            if self.path is None:
                return None
            place = os.path.join(self.path, os.path.basename(folder))
        try:
            os.mkdir(place, 0o700)
            os.mkdir(os.path.join(place, "tmp"), 0o700)
        except OSError:
            remove(place)
            return None
        self.places[folder] = place
        return os.path.join(place, "tmp")

    def remove(self, folder: str) -> None:
        """Remove the temporary files of a run."""
        if folder in self.places:
            remove(self.places.pop(folder))

    def begin(self) -> None:
        """Make the worker's folder if that is possible, and remove those that killed workers have left."""
        import fcntl

        for root in temporary_folders():
            for path, _ in abandoned(root):
                remove(path)
            path = os.path.join(root, "sierra-" + os.urandom(4).hex())
            with contextlib.suppress(OSError):
                os.mkdir(path, 0o700)  # fails if there is anything with that name
                self.path = path
                self.held = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
                fcntl.flock(self.held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                mark = os.open(os.path.join(path, TEMPORARY_MARK), os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
                try:
                    write_all(mark, os.fsencode("%s\n%s" % (os.uname().nodename, self.owner)))
                finally:
                    os.close(mark)
                return
            self.close()

    def close(self) -> None:
        """Remove the folder with all that is in it."""
        if self.path is not None:
            remove(self.path)
        if self.held >= 0:
            os.close(self.held)
        self.path, self.held = None, -1


def temporary_folders() -> list[str]:
    """Return the system's temporary folders in which runs can have theirs, the best first; none without locks.

    They are those of Python's tempfile, and a cluster's. One in which no program can be executed comes last.
    """
    try:
        import fcntl  # noqa: F401
    except ImportError:
        return []
    named = [os.environ.get(name, "") for name in ("TMPDIR", "SLURM_TMPDIR", "TEMP", "TMP")]
    usable: dict[str, bool] = {}
    for path in (*named, "/tmp", "/var/tmp"):  # noqa: S108 - a folder of its own is made there
        if not (os.path.isabs(path) and len(os.fsencode(path)) <= TEMPORARY_LENGTH and os.access(path, os.W_OK | os.X_OK)):
            continue
        with contextlib.suppress(OSError):
            check_room(path)
            usable[os.path.normpath(path)] = bool(os.statvfs(path).f_flag & getattr(os, "ST_NOEXEC", 0))
    return sorted(usable, key=lambda path: usable[path])


def abandoned_by(is_wanted: Callable[[str], bool]) -> list[str]:
    """Return the folders in the system's temporary folders that killed workers have left, by the workers' own folders."""
    return [path for root in temporary_folders() for path, owner in abandoned(root) if is_wanted(owner)]


def abandoned(root: str) -> Iterator[tuple[str, str]]:
    """Yield the folders of killed workers of this user and host in a temporary folder, each with the folder of its worker."""
    import fcntl

    for name in sorted(filter(TEMPORARY.fullmatch, entries_of(root))):
        path = os.path.join(root, name)
        with contextlib.suppress(OSError):
            folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                if os.fstat(folder).st_uid != os.geteuid():
                    continue
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                mark = os.open(TEMPORARY_MARK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
                with open(mark, "rb") as file:
                    host, _, owner = os.fsdecode(file.read(CHUNK)).partition("\n")
            finally:
                os.close(folder)
            if host == os.uname().nodename and owner:
                yield path, owner


class Running:
    """A running program. Its lock guards the moment from which its process id may belong to another process."""

    def __init__(
        self,
        job: Job,
        folder: str,
        process: subprocess.Popen[bytes],
        observation: Observation | None = None,
        announce: Announce = lambda state: None,
    ) -> None:
        self.run, self.execution = job["run"], job["execution"]
        self.announce = announce
        self.observation = observation
        self.seal = job.get("seal")
        self.conducted = is_conducted(job)
        self.folder = folder
        self.temporary: str | None = None
        """The folder for its temporary files, if that is not in its folder."""
        self.pid = process.pid
        self.limits = job["limits"]
        self.client = with_folder(job["client"], folder) if "client" in job else None
        self.meter = Meter(self) if self.client else None
        self.measured = any(self.limits.get(name) is not None for name in ("cpu_s", "memory_bytes", "output_bytes"))
        watched = self.limits.get("after_marker_s") is not None and not self.conducted
        self.marker: Marker | None = conducting().Marker(folder, self.limits) if watched else None
        self.left: list[str] = []
        """The names of processes that still ran when its program had ended by itself."""
        self.limited = self.measured or self.marker is not None or self.limits.get("wall_s") is not None
        self.started = time.monotonic()
        self.stopped: str | None = None
        self.kill_at: float | None = None
        self.look_at = self.continue_at = self.started + 1.0
        self.stalled_since: float | None = None
        self.switches: dict[int, int] = {}
        """How often each traced process had left its processor when the worker last looked at it."""
        self.over = False
        self.lock = threading.Lock()

    def deadline(self) -> float | None:
        wall = self.limits.get("wall_s")
        if wall is None or self.meter is None:
            return None if wall is None else self.started + wall
        # the time in which an engine starts a container does not count for the run
        return wall + (self.started + START_S if self.meter.since is None else self.meter.since)

    def stop(self, reason: str) -> None:
        """Tell the whole group to end; `kill` follows after the grace time."""
        with self.lock:
            if self.stopped is None and not self.over and not has_ended(self.pid):
                self.stopped = reason
                self.announce(ENDING)
                self.kill_at = time.monotonic() + self.limits.get("grace_s", GRACE_S)
                signal_group(self.pid, signal.SIGTERM)
                for pid in self.pids():  # a stopped process reacts to SIGTERM only when it is continued
                    if stat_of(pid)[:1] in ([b"T"], [b"t"]):  # t: under a tracer
                        signal_process(pid, signal.SIGCONT)

    def pids(self) -> list[int]:
        """Return the ids of the run's processes, as far as /proc lists them."""
        if self.meter:
            return self.meter.pids()
        return [pid for root in (self.pid, *self.orphans()) for pid in descendants(root)]

    def orphans(self) -> list[int]:
        """Return the ids of the run's processes whose parents have ended."""
        return [pid for pid in orphans() if belongs_to(pid, self.execution, self.pid) and not self.is_tracer(pid)]

    def note_left(self) -> None:
        """Note the processes that still run although the run's program has ended by itself."""
        if self.stopped is None and not self.client and not self.conducted and self.orphans():
            self.left = conducting().still_running(lambda: filter(conducting().is_alive, self.orphans()))

    def is_tracer(self, pid: int) -> bool:
        return self.observation is not None and self.observation.is_tracer(pid)

    def stalled(self, now: float) -> bool:
        """Check at intervals whether all processes of the run are stopped for too long. Returns True once per such period."""
        if now < self.look_at:
            return False
        self.look_at = now + 1.0
        if self.stopped is not None or not self.is_stopped():
            self.stalled_since = None
            return False
        self.stalled_since = self.stalled_since or now
        if now - self.stalled_since < STALLED_S:
            return False
        self.stalled_since = float("inf")
        return True

    def is_stopped(self) -> bool:
        """Return whether a signal has stopped all processes, and at least one exists. Call it at intervals."""
        if not self.meter and not self.conducted and stat_of(self.pid)[:1] not in ([b"T"], [b"t"]):
            return False  # so that the others need not be searched
        states = {self.state_of(pid) for pid in self.pids() if pid != self.pid or not self.conducted}
        return b"T" in states and states <= {b"T", b"Z", None}

    def continue_conductor(self, now: float) -> None:
        """Continue the conductor at intervals if it is stopped, but nothing else of the run: a run may stop its parent."""
        if now < self.continue_at or self.meter:
            return
        self.continue_at = now + 1.0
        if self.state_of(self.pid) == b"T" and all(self.state_of(pid) != b"T" for pid in self.pids() if pid != self.pid):
            signal_process(self.pid, signal.SIGCONT)

    def state_of(self, pid: int) -> bytes | None:
        """Return the state of a process: T if a signal has stopped it, also under the tracer; None if there is no process."""
        state = next(iter(stat_of(pid)), None)
        if state != b"t" or self.observation is None:
            return state
        tracer, switches = number_in(pid, b"TracerPid:"), number_in(pid, b"voluntary_ctxt_switches:")
        before, self.switches[pid] = self.switches.get(pid), switches
        asleep = self.is_tracer(tracer) and stat_of(tracer)[:1] == [b"S"]
        return b"T" if asleep and before == switches else state

    def skip_grace(self) -> None:
        """Skip the rest of the grace time."""
        if self.kill_at is not None:
            self.kill_at = 0.0

    def kill(self) -> None:
        with self.lock:
            if not self.over:
                self.kill_at = None
                for pid in descendants(self.pid):
                    signal_process(pid, signal.SIGKILL)
                signal_group(self.pid, signal.SIGKILL)


class Meter:
    """The resources that the processes of a contained run have used, measured from outside."""

    def __init__(self, running: Running) -> None:
        self._running = running
        self._roots: list[tuple[int, int | None]] = []
        self.since: float | None = None
        self.user_s = self.system_s = 0.0
        self.max_rss = 0
        self.due = 0.0

    def read(self, now: float) -> None:
        """Measure once, if a measurement is due."""
        if now < self.due:
            return
        self.due = now + min(POLL_S, max(SAMPLE_S, (now - self._running.started) / 20))
        pids = self.pids()
        if pids:
            self.since = now if self.since is None else self.since
            user, system = cpu_of(pids)
            self.user_s, self.system_s = max(user, self.user_s), max(system, self.system_s)
            self.max_rss = max(self.max_rss, max(peak_of(pid) for pid in pids))

    def pids(self) -> list[int]:
        """Return the ids of the run's living processes."""
        self._roots = [(pid, born) for pid, born in self._roots if birth(pid) == born]
        if not self._roots:
            started = [pid for root in [self._running.pid, *orphans()] for pid in descendants(root)]
            mark = b"SIERRA_EXECUTION=" + self._running.execution.encode()
            marked = [pid for pid in started if mark in environment_of(pid)]
            self._roots = [(pid, birth(pid)) for pid in marked[:1]]
        return [pid for root, _ in self._roots for pid in descendants(root)]

    def report(self) -> Usage:
        if self.since is None:
            return {"user_s": None, "system_s": None, "max_rss_bytes": None}
        return {"user_s": self.user_s, "system_s": self.system_s, "max_rss_bytes": self.max_rss}


class Held:
    """A container that is started before its run begins.

    A program in it waits to read a line from a named pipe, and then becomes the program of the run. It has opened the pipe for
    reading as soon as the pipe can be opened for writing here.
    """

    def __init__(self, job: Job, folder: str) -> None:
        client = with_folder(job["client"], folder)
        self.client = client
        self.log = os.path.join(folder, LOGS[1])
        self.path = client["start_pipe"]
        self.pipe: int | None = None
        self.grace = job["limits"].get("grace_s", GRACE_S)
        os.mkfifo(self.path, 0o600)
        self.process = start(job, folder)

    def await_ready(self, is_stopping: Callable[[], bool]) -> None:
        """Wait until the program in the container waits for its line. Raises NotHeld, OSError."""
        give_up = time.monotonic() + START_S
        while not self.is_waiting() and not is_stopping():
            self.check()
            if time.monotonic() > give_up:
                raise NotHeld("its container did not start within %g s" % START_S)
            select.select((), (), (), SAMPLE_S / 10)

    def is_waiting(self) -> bool:
        try:
            self.pipe = os.open(self.path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            if error.errno != errno.ENXIO:  # nobody has opened it for reading
                raise
        return self.pipe is not None

    def check(self) -> None:
        """Check that the container has not ended. Raises NotHeld."""
        if has_ended(self.process.pid):
            raise NotHeld("its container ended before the run began: " + (last_line_of(self.log) or "it printed no error"))

    def begin(self) -> subprocess.Popen[bytes]:
        """Let the program begin, and return its client. It may have ended by itself just before."""
        if self.pipe is not None:
            with contextlib.suppress(BrokenPipeError):
                os.write(self.pipe, b"\n")
        self.close()
        return self.process

    def end(self) -> None:
        """End the container. Its program has not begun: it ends when the pipe is closed."""
        self.close()
        signal_group(self.process.pid, signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(self.grace)
        signal_group(self.process.pid, signal.SIGKILL)
        self.process.wait()
        end_container(self.client)

    def close(self) -> None:
        if self.pipe is not None:
            os.close(self.pipe)
        unlink(self.path)


class SharedServices:
    """Services that all runs of this worker share: their conductor, which ends when one of them has ended.

    If they are observed, the files that they have used until a run ends are part of what is observed of this run.
    """

    def __init__(
        self, job: Job, plan: Mapping[str, object], folder: str, way: Way | None = None, reasons: Sequence[str] = (UNOBSERVED,)
    ) -> None:
        """Start the conductor in a new folder, with the environment of a run without what belongs to one run.

        `way` to observe them; `reasons` why this is not possible, or not complete.
        """
        self.reasons = tuple(reasons)
        self.observation = way.begin(folder + TRACE, os.path.join(folder, "output")) if way else None
        self.looking = threading.Lock()
        self.tracer = 0
        self.folder = folder
        self.path = os.path.join(folder, SHARED)
        self.grace = job["limits"].get("grace_s", GRACE_S)
        os.makedirs(os.path.join(folder, "output"))
        for name in ("home", "tmp"):
            os.mkdir(os.path.join(folder, name))
        environment = {
            name: value.replace("\0", folder) for name, value in job["environment"].items() if name not in OF_ONE_RUN
        }
        own = {**plan, "shared": [], "services": plan["shared"], "before": [], "argv": [], "after": []}
        argv = [sys.executable, "-I", "-S", beside(CONDUCTOR), folder, json.dumps(own)]
        cwd = os.path.join(folder, "output")
        if self.observation:
            argv = self.observation.prefixed(argv, environment, cwd, conducted=True)
        with open(os.path.join(folder, LOGS[1]), "ab") as log:
            self.process = subprocess.Popen(
                argv, stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=cwd, env=environment, start_new_session=True
            )

    def await_ready(self, is_stopping: Callable[[], bool]) -> None:
        """Wait until the services are ready, or have failed: the runs then fail with the reason."""
        while not os.path.exists(self.path) and self.process.poll() is None and not is_stopping():
            time.sleep(SAMPLE_S)
        if self.observation and not self.tracer:
            self.tracer = number_in(self.process.pid, b"TracerPid:")

    def seen(self) -> Trace | None:
        """Return what the services have done with files until now; None if they are not observed. Reads only what is new."""
        if self.observation is None:
            return None
        with self.looking:
            lost = self.tracer and self.process.poll() is None and number_in(self.process.pid, b"TracerPid:") != self.tracer
            trace = self.observation.trace(os.path.join(self.folder, LOGS[1]), living=True)
        return trace._replace(disturbed="their tracer has ended") if lost else trace

    def disturbed(self) -> str | None:
        """Return why the observation may have changed what the services do; None if it has not, or if there is none."""
        trace = self.seen()
        return trace.disturbed if trace else None

    def look(self) -> None:
        """Look at the living processes of the services, and keep the log of their tracer below its limit."""
        if self.observation and self.looking.acquire(blocking=False):  # else a run that has ended looks what they have done
            try:
                self.observation.limit()
                self.observation.look(pid for pid in descendants(self.process.pid) if pid != self.process.pid)
            finally:
                self.looking.release()

    def word(self) -> str:
        """Return what the conductor of a run needs to know."""
        try:
            with open(self.path, encoding="ascii") as file:
                return file.read()
        except OSError:
            reason = read_report(self.folder).error or "the services that all runs share have ended"
            return json.dumps({"ports": {}, "pids": {}, "log": os.path.join(self.folder, LOGS[1]), "error": reason})

    def end(self, skip_grace: Callable[[], bool]) -> None:
        """End the services: SIGTERM lets their conductor end them, and SIGKILL follows after the grace time."""
        self.process.terminate()
        deadline = time.monotonic() + self.grace + SETTLE_S
        while self.process.poll() is None:
            if skip_grace() or time.monotonic() >= deadline:
                for pid in descendants(self.process.pid):
                    signal_process(pid, signal.SIGKILL)
            time.sleep(SAMPLE_S)
        if self.observation:
            end_orphans(None, is_tracer=self.observation.is_tracer)  # the tracer waits for them
            self.observation.end(orphans)
            unlink(self.folder + TRACE)


class Container:
    """The container that the runs of a slot share: a client here, and this worker inside, connected by pipes."""

    def __init__(self, client: Program, folder: str) -> None:
        self.runs = os.path.join(folder, RUNS)
        os.makedirs(self.runs)
        self.client = with_folder(client, folder)
        self.log = os.path.join(folder, "log")
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(
                self.client["argv"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=self.client["environment"],
                start_new_session=True,
            )
        self.pid = self.process.pid
        self.kill_at: float | None = None
        self.deadline: float | None = None
        self.late = False
        self.lock = threading.Lock()

    def execute(self, job: Job) -> Iterator[Event]:
        """Yield the events of the worker in the container about a run, until the run or the container has ended."""
        seal = base64.b64encode(os.urandom(18)).decode()
        inner = {name: value for name, value in job.items() if name not in ("client", "shared", "observe")}
        self.allow(job["limits"], START_S)
        try:
            self.send({**inner, "seal": seal})
        except OSError:
            return
        for event in self.events(seal):
            self.allow(job["limits"], CLEAN_S)
            yield event
            if event["event"] == "end":
                self.deadline = None
                return

    def allow(self, limits: Limits, spare: float) -> None:
        """Set the deadline for a run's end: its time limit and grace time, plus `spare` seconds."""
        wall = limits.get("wall_s")
        if wall is not None:
            self.deadline = time.monotonic() + wall + limits.get("grace_s", GRACE_S) + spare

    def events(self, seal: str) -> Iterator[Event]:
        """Yield the events of the worker in the container. Lines without the seal are ignored; a run cannot know it."""
        output = self.process.stdout
        for line in iter(lambda: output.readline(LINE_BYTES) if output else b"", b""):
            try:
                event = json.loads(line)
                sealed = event.pop("seal") == seal
            except (ValueError, AttributeError, LookupError, TypeError, RecursionError):
                continue
            if sealed:
                yield event

    def send(self, record: Mapping[str, object]) -> None:
        with self.lock:
            pipe = stdin_of(self.process)
            pipe.write(json.dumps(record, separators=(",", ":")).encode() + b"\n")
            pipe.flush()

    def stop(self) -> None:
        """Close the pipe, so that the worker inside ends the running run and itself."""
        self.kill_at = self.kill_at or time.monotonic() + GRACE_S + CLEAN_S
        if self.lock.acquire(blocking=False):  # else a job is being sent that is not read yet; tried again later
            try:
                self.close_pipe()
            finally:
                self.lock.release()

    def close_pipe(self) -> None:
        with contextlib.suppress(OSError):
            stdin_of(self.process).close()

    def skip_grace(self) -> None:
        if self.kill_at is not None:
            self.kill_at = min(self.kill_at, time.monotonic() + SETTLE_S)

    def kill(self) -> None:
        self.kill_at = self.deadline = None
        signal_group(self.pid, signal.SIGKILL)

    def expire(self, now: float) -> None:
        """Kill the container if the worker in it is too late in ending a run."""
        if self.deadline is not None and now >= self.deadline:
            self.late = True
            self.kill()

    def close(self) -> str:
        """End the container, regularly if possible. Return the last line of its standard error, or else its status."""
        try:
            self.send({"end": True})
            self.process.wait(CLEAN_S)
        except (OSError, subprocess.TimeoutExpired):
            signal_group(self.pid, signal.SIGKILL)
        if self.process.wait() != 0:
            end_container(self.client)
        self.close_pipe()
        if self.process.stdout is not None:
            self.process.stdout.close()
        return last_line_of(self.log) or "status %s" % self.process.returncode


class Worker:
    """Slots, each a thread, which take jobs from a queue; and the main thread, which watches over them."""

    def __init__(
        self,
        folder: str,
        slots: int,
        *,
        journal: str | None = "",
        adopts: bool = False,
        places: tuple[str, ...] = (),
        announce: Announce = lambda state: None,
    ) -> None:
        """Prepare a worker in `folder` with `slots` slots.

        `adopts`: this process becomes the parent of all orphans of its runs. `places`: folders that runs share. `journal` is a
        file, by default in the folder; None is standard output. `announce` is called with each state of a run, before anything
        else that could fail or take long.
        """
        self.announce = announce
        self.folder = folder
        self.adopts = adopts
        self.slots = slots
        self.journal = Journal(os.path.join(folder, "journal.jsonl") if journal == "" else journal)
        self.host = os.uname().nodename
        self.jobs: queue.Queue[Job | None] = queue.Queue(maxsize=2 * slots)
        self.running: dict[int, Running] = {}
        self.containers: dict[int, Container] = {}
        self.contains = False
        self.stopping = self.terminated = self.without_grace = False
        self.stop_reading_at = 0.0
        self.waker = Waker()
        self.failure: str | None = None
        self.full = False
        self.numbers = itertools.count(1 + max([int(name) for name in os.listdir(folder) if name.isdigit()], default=0))
        self.lock = threading.Lock()
        self.spare: dict[int, RunFolder] = {}
        self.shared = {place: entries_of(place) for place in places}
        self.hashes = Hashes()
        self.temporary = Temporary(os.path.abspath(folder))
        self.observing = threading.Lock()
        self.unusable: tuple[str, ...] = ()
        """Why better ways to observe runs cannot be used here."""
        self.account = Account()
        self.services: SharedServices | None = None
        self.starting_services = threading.Lock()
        self.begin: float | None = None
        self.wall = 0.0
        self.trusts = True  # that a tracer works which has worked before
        self.parent = os.getppid()
        self.continue_at = 0.0
        self.requests: dict[int, Job] = {}
        """By experiments: a run, observed in vain, in whose place the next one is observed.

        `ANY`: a run whose use of files must be compared with that of another one.
        """
        self.lost: dict[int, int] = {}
        """By the same numbers: how many observations were requested in place of others."""

    @property
    def status(self) -> int:
        """Return the exit status of its process: see above."""
        return (FULL if self.full else FAILED) if self.failure else STOPPED if self.stopping else 0

    def report_failure(self) -> None:
        """Write why it could not continue, if it could not."""
        if self.failure:
            with contextlib.suppress(OSError):
                os.write(2, ("worker: %s\n" % self.failure).encode("utf-8", "backslashreplace"))

    def work(self, stream: TextIO) -> None:
        """Execute all jobs in `stream`, or stop before its end: see `status`."""
        kind = os.fstat(stream.fileno()).st_mode
        if stat.S_ISFIFO(kind) or stat.S_ISSOCK(kind):
            self.waker.watch_pipe(stream.fileno())
        threading.Thread(target=self.read, args=(stream,), daemon=True).start()
        threads = [threading.Thread(target=self.slot, args=(number,)) for number in range(self.slots)]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            if not self.waker.wait(self.watch()):
                self.stop()
        if self.services is not None:
            self.services.end(skip_grace=lambda: self.without_grace)
        if self.contains:
            await_orphans()
        end_orphans(None)
        self.temporary.close()

    def read(self, stream: TextIO) -> None:
        """Put the jobs into the queue, until the line that ends them.

        The line `{"begin": SECONDS, "wall": SECONDS}` gives the moment for a job that waits for it, by the monotonic clock
        and by the wall clock.
        """
        try:
            for line in stream:
                job = json.loads(line)
                if "begin" in job:
                    self.wall, self.begin = job["wall"], job["begin"]
                    continue
                if job.get("end"):
                    for _ in range(self.slots):
                        self.jobs.put(None)
                    return
                self.jobs.put(job)
        except Exception as error:
            self.fail(error)
        self.stop()

    def stop(self) -> None:
        """Start no further runs, and end the running ones. Can be called by a signal handler."""
        self.stop_reading_at = self.stop_reading_at or time.monotonic() + GIVE_UP_S
        self.stopping = True
        self.waker.wake()

    def close(self) -> None:
        """Close the files of the worker."""
        self.journal.close()
        self.waker.close()

    def check_stop(self) -> None:
        """Raise GivenUp if the worker was told to stop so long ago that outputs are no longer read."""
        if self.stopping and (self.without_grace or time.monotonic() >= self.stop_reading_at):
            raise GivenUp

    def terminate(self) -> None:
        """Stop the worker; at the second call, without grace time. For a signal handler."""
        self.without_grace, self.terminated = self.terminated, True
        self.stop()

    def fail(self, error: BaseException) -> None:
        """Note why the worker cannot continue, and stop."""
        if self.failure is None:
            self.failure = explain(error)
            self.full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        self.stop()

    def slot(self, number: int) -> None:
        while not self.stopping:
            try:
                job = self.jobs.get(timeout=2 * POLL_S)
            except queue.Empty:
                continue
            if job is None:
                break
            self.contains = self.contains or "client" in job
            try:
                job = with_own_devices(job, number, self.slots)
                self.execute_with_ports(job, number)
            except Exception as error:
                self.fail(error)
        container = self.containers.pop(number, None)
        if container is not None:
            container.close()
        self.waker.wake()

    def execute_inside(self, job: Job, slot: int) -> None:
        """Execute one run in the slot's container. Starts the container if there is none."""
        container = self.containers.get(slot)
        began, started = time.time(), time.monotonic()
        if container is None:
            try:
                container = self.containers[slot] = Container(job["client"], self.next_folder("slot-"))
            except OSError as error:
                reason = "its container could not be started: " + explain(error)
                self.report(job, slot, self.folder, began, 0.0, no_outputs(reason))
                return
        for event in container.execute(job):
            if event["event"] == "end":
                if event["stopped"] != "interrupted":
                    check_room(self.folder)
                self.journal.write(self.take_out(job, container, event, slot))
                return
            if event["event"] != "ready":
                event["pid"] = container.pid
            if event["event"] == "start":
                event["born"] = birth(container.pid)
            self.journal.write(event)
        del self.containers[slot]
        output = container.close()
        wall = time.monotonic() - started
        folder = os.path.join(container.runs, "lost")
        stopped = "interrupted" if self.stopping else "timeout" if container.late else None
        trouble = None if stopped else "its container ended: " + output
        self.report(job, slot, folder, began, wall, no_outputs(trouble, stopped))

    def take_out(self, job: Job, container: Container, event: End, slot: int) -> End:
        """Move a run's folder out of the container's reach, and return its event with its outputs."""
        folder = self.next_folder()
        inside = os.path.join(container.runs, os.path.basename(event["directory"]))
        remains = no_outputs("its folder is gone", event["stopped"])
        if is_folder(inside):
            os.rename(inside, folder)
            remains = collect_outputs(folder, inputs_of(job), job["limits"], event["stopped"], self.check_stop)
        remains["error"] = event["error"] or remains["error"]
        return {**event, "directory": folder, "slot": slot, "host": self.host, **remains}

    def next_folder(self, prefix: str = "") -> str:
        with self.lock:
            return os.path.join(self.folder, prefix + str(next(self.numbers)))

    def execute_with_ports(self, job: Job, slot: int) -> None:
        """Execute one run, which has ports of its own until it has ended, if it needs any."""
        execute = self.execute_inside if job.get("shared") else self.execute
        marks = marks_in(job)
        if not marks:
            execute(job, slot)
            return
        conductor = conducting()
        held = conductor.Ports()
        try:
            ports = {mark: held.take() for mark in marks}
        except conductor.Failed as failed:
            held.give_back()
            began, started = self.now()
            self.report(job, slot, self.next_folder(), began, time.monotonic() - started, no_outputs("{port}: %s" % failed))
            return
        try:
            execute(with_ports(job, ports), slot)
        finally:
            held.give_back()

    def execute(self, job: Job, slot: int) -> None:
        """Execute one run, from making its folder to writing its line in the journal."""
        job = self.with_observation(job)
        folder = self.next_folder()
        place = prepare(job, folder, self.spare.pop(job.get("used") or 0, None))
        services = self.shared_services(job)
        try:
            self.execute_prepared(self.with_temporary(job, folder), folder, slot, place, services)
        finally:
            self.temporary.remove(folder)

    def with_temporary(self, job: Job, folder: str) -> Job:
        """Return the job with a short path in TMPDIR, unless a container has its own, or the job names another folder."""
        if "client" in job or "seal" in job or job["environment"].get("TMPDIR") != OWN_TMP:
            return job
        short = self.temporary.make(folder)
        return {**job, "environment": {**job["environment"], "TMPDIR": short}} if short else job

    def execute_prepared(
        self, job: Job, folder: str, slot: int, place: RunFolder | None, services: SharedServices | None
    ) -> None:
        """Execute a run in its folder, which has been made."""
        observation = self.observe(job, folder)
        held = Held(job, folder) if job.get("waits") and job.get("client", {}).get("start_pipe") else None
        if job.get("waits") and not self.await_moment(job, held):
            remove(folder)
            return
        began, started = self.now()
        try:
            process = held.begin() if held else start(job, folder, observation, services)
        except (OSError, ValueError) as error:
            if observation:  # perhaps the tracer is gone
                self.trusts = False
                unlink(folder + TRACE)
                self.execute_unobserved(job, folder, slot, "it could not be started by the tracer")
                return
            wall = time.monotonic() - started
            self.report(job, slot, folder, began, wall, no_outputs("could not be started: " + why_not_started(error, job)))
            return
        running = Running(job, folder, process, observation, self.announce)
        running.temporary = self.temporary.places.get(folder)
        self.announce(BEGUN)
        if held and running.meter:
            running.meter.since = running.started
        with self.lock:
            self.running[running.pid] = running
        self.note(running, {"event": "start", "execution": running.execution, "pid": running.pid, "born": birth(running.pid)})
        if running.limited or observation or self.stopping:
            self.waker.wake()
        status, usage = await_end(running)
        wall = time.monotonic() - started
        process.returncode = status
        if running.stopped is None and os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGTERM:
            self.await_signal()
        with self.lock:
            del self.running[running.pid]
        if running.client and (running.stopped is not None or os.WIFSIGNALED(status)):
            end_container(running.client)
        report = report_of(job, folder)
        left, after_marker = running.left or report.left_running, report.after_marker
        if running.stopped == MARKED and running.marker:
            running.stopped, after_marker, status = None, running.marker.seconds, 0
        # a run with a seal is alone in its container
        alone = end_orphans(None if running.seal else running.execution, running.pid, running.is_tracer)
        if alone:
            self.announce(GONE)
        observed, disturbed = self.keep_observation(job, running, services)
        if disturbed:
            self.await_signal()  # a scheduler may kill the tracer before it tells this process to end
            self.trusts = False
            self.account.charge(wall)
        if disturbed and not self.stopping:
            self.execute_unobserved(job, folder, slot, disturbed)
            return
        self.account.add(wall)
        if disturbed or (running.stopped is None and self.stopping and os.WIFSIGNALED(status)):
            running.stopped = "interrupted"
        if running.stopped != "interrupted" and not running.seal:
            check_room(self.folder)
            check_temporary(running)
        failure = report.error or trouble_of_services(services)
        spare = alone and self.adopts and place is not None and place.is_reusable()
        if running.seal:  # the worker that takes the folder out of the container reads it
            remains = no_outputs(self.clear_shared(folder), running.stopped)
        else:
            remains = collect_outputs(folder, inputs_of(job), running.limits, running.stopped, self.check_stop, spare)
        if running.stopped is None and remains["stopped"] is None:
            remains["error"] = failure or remains["error"]
        if "beside" in job and (trouble := shared_files(job["beside"]).changed()):
            remains["error"] = remains["error"] or trouble
        if spare and place is not None and not remains["error"] and sum(file["bytes"] for file in remains["outputs"]) <= CHUNK:
            self.spare[int(os.path.basename(folder))] = place
            remains["spare"] = True
        if running.observation and (status or not observed or remains["stopped"] or remains["error"]):
            self.request_another(job)
        if observed:
            remains["observed"] = True
        if left and after_marker is None:
            remains["left_running"] = list(left)
        if after_marker is not None:
            remains["after_marker"] = after_marker
        if job.get("own_ports"):
            remains["ports"] = list(job["own_ports"])
        if job.get("waits") and not held and running.meter:
            remains["delay_s"] = wall if running.meter.since is None else running.meter.since - running.started
        self.report(job, slot, folder, began, wall, remains, status, running.meter.report() if running.meter else used(usage))

    def await_moment(self, job: Job, held: Held | None) -> bool:
        """Report that a run is prepared, and wait until its moment. Return False if the worker was told to stop before.

        Raises NotHeld if its container has ended.
        """
        come = False
        try:
            if held:
                held.await_ready(lambda: self.stopping)
            self.journal.write({"event": "ready", "execution": job["execution"]})
            self.announce(READY)
            come = self.has_time_come(held)
        finally:
            if held and not come:
                held.end()
        return come

    def now(self) -> tuple[float, float]:
        """Return the time by the wall clock and by the monotonic clock.

        The wall clock may be set after a run has got its moment. So its time is that of the moment plus the elapsed time.
        """
        now = time.monotonic()
        return time.time() if self.begin is None else self.wall + now - self.begin, now

    def has_time_come(self, held: Held | None) -> bool:
        while not self.stopping:
            if held:
                held.check()
            left = SAMPLE_S if self.begin is None else self.begin - time.monotonic()
            if left <= 0:
                return True
            select.select((), (), (), min(left, SAMPLE_S))  # a clock that tests replace makes time.sleep fail
        return False

    def shared_services(self, job: Job) -> SharedServices | None:
        """Return the services that the run shares with others, if there are any. The first of these runs starts them."""
        plan = json.loads(job["argv"][1]) if is_conducted(job) and "client" not in job else {}
        if not plan.get("shared"):
            return None
        with self.starting_services:
            if self.services is None:
                self.services = self.start_services(job, plan)
            self.services.await_ready(lambda: self.stopping)
        return self.services

    def start_services(self, job: Job, plan: Mapping[str, object]) -> SharedServices:
        """Start services that runs share. They are observed, unless this changes how they start."""
        if plan.get("observed"):
            with self.observing:
                way, unusable = self.way(job.get("helps"))
            try:
                services = self.new_services(job, plan, way, unusable)
            except (OSError, ValueError) as error:  # perhaps the tracer is gone
                disturbed: str | None = "they could not be started by the tracer: " + explain(error)
            else:
                services.await_ready(lambda: self.stopping)
                disturbed = services.disturbed()
                if not disturbed or self.stopping:
                    return services
                services.end(skip_grace=lambda: self.without_grace)
            return self.new_services(job, plan, None, ("%s: %s" % (UNOBSERVED, disturbed),))
        return self.new_services(job, plan)

    def new_services(
        self, job: Job, plan: Mapping[str, object], way: Way | None = None, reasons: Sequence[str] = (UNOBSERVED,)
    ) -> SharedServices:
        """Start services in a new folder. Raises OSError and ValueError if they cannot be started."""
        folder = self.next_folder("services-")
        return SharedServices(self.with_temporary(job, folder), plan, folder, way, reasons)

    def execute_unobserved(self, job: Job, folder: str, slot: int, reason: str) -> None:
        """Execute a run that could not be observed once more, in a new folder."""
        remove(folder)
        self.temporary.remove(folder)
        self.request_another(job)
        unobserved = job.copy()
        unobserved.pop("compares", None)
        del unobserved["observe"]
        unobserved["unobserved"] = reason
        self.execute(unobserved, slot)

    def with_observation(self, job: Job) -> Job:
        """Return the job, which is observed if a run before it was doubtful, or was observed for its experiment and failed."""
        if "client" in job or "waits" in job or "unobserved" in job:
            return job
        with self.lock:
            compares = ANY in self.requests
            first = self.requests.pop(ANY if compares else job.get("experiment", ANY), None)
        if first is None:
            return job
        job = job.copy()
        job["observe"] = first["observe"]
        if "helps" in first:
            job["helps"] = first["helps"]
        job.pop("budget", None)
        job.pop("affordable", None)
        if compares:
            job["compares"] = True
            if first.get("again"):
                again = first.copy()
                del again["again"]
                with self.lock:
                    self.requests.setdefault(ANY, again)
        elif "affordable" in first:
            job["affordable"] = first["affordable"]
        return job

    def compare(self, job: Job, trace: Trace) -> None:
        """Let the next run be observed if this one wrote and read the same files outside its folder, or used ports.

        For ports, two are observed, so that they overlap if runs do: a program that looks for a free port is recognised then.
        It most likely is one of the same experiment, of which the first run is observed. Runs of the sample are not followed.
        """
        if "compares" in job or "budget" in job:
            return
        talks = file_trace().is_doubtful(trace.channels)
        if talks or trace.reread or trace.reread_new:
            with self.lock:
                self.requests[ANY] = {**job, "again": talks}

    def request_another(self, job: Job) -> None:
        """Let another run be observed in place of one that has failed, or could not be observed; at most a few times.

        Any run may be compared with a doubtful one; else it is the next of the experiment. None replaces one of the sample.
        """
        key = ANY if "compares" in job else job.get("experiment")
        if key is None or "budget" in job:
            return
        with self.lock:
            if self.lost.setdefault(key, 0) < MOST_LOST:
                self.requests.setdefault(key, job)
            self.lost[key] += 1

    def observe(self, job: Job, folder: str) -> Observation | None:
        """Begin to observe a run, if that is requested and takes no more time than it may."""
        if "observe" not in job or "client" in job or not self.account.allows(job.get("budget"), job.get("affordable")):
            return None
        began = time.monotonic()
        with self.observing:
            way, self.unusable = file_trace().gentle() if job.get("waits") else self.way(job.get("helps"))
        own = [self.temporary.places[folder]] if folder in self.temporary.places else []
        observation = way.begin(folder + TRACE, os.path.join(folder, "output"), own) if way else None
        self.account.charge(time.monotonic() - began, sampled="budget" in job)
        return observation

    def way(self, helps: Helps | None) -> tuple[Way | None, tuple[str, ...]]:
        """Return the best way to observe runs here, and why others cannot be used. No tracer is tried that is known to work."""
        if helps is not None:
            self.hashes.learn(helps["digests"])
            if helps["tracer"] is not None and self.trusts:
                return file_trace().Strace(helps["tracer"]), ()
        found: tuple[Way | None, tuple[str, ...]] = file_trace().usable()
        return found

    def keep_observation(self, job: Job, running: Running, services: SharedServices | None = None) -> tuple[bool, str | None]:
        """Write what a run did with files to its folder.

        Return whether it was observed, and what the observation may have changed: such a run is executed again without it.
        """
        if running.observation is None:
            return "unobserved" in job and keep_reason(running.folder, job["unobserved"]), None
        began = time.monotonic()
        running.observation.end(orphans)
        path = os.path.join(running.folder, OBSERVED)
        disturbed = None
        traced = size_of_file(running.folder + TRACE)
        try:
            trace = running.observation.trace(os.path.join(running.folder, LOGS[1]), self.check_stop)
            disturbed = trace.disturbed
            shared = services.seen() if services else None
            theirs = {name for name, _ in shared.channels} if shared else ()
            trace = file_trace().with_channels(trace, own_ports(job, running.folder, services), theirs, job["environment"])
            names = file_trace().Names({"work": self.folder, **job["observe"], "run": running.folder, **own_folders(running)})
            seen = names.inputs(trace._replace(reasons=(*trace.reasons, *self.unusable)))
            self.compare(job, seen)
            with self.observing:
                contents = self.contents(job, seen, names, running.observation.began)
                if services:
                    seen = with_reasons(seen, services, shared)
                if services and services.observation and shared:
                    used = names.inputs(shared)
                    own = self.contents(job, used, names, services.observation.began)
                    seen, contents = file_trace().with_services(seen, contents, used, own)
                digests = self.hashes.news()
            gpu = any(file_trace().uses_gpu(one) for one in (trace, shared) if one)
            record = file_trace().as_record(seen, contents, names, gpu=gpu)
            record["digests"] = digests
            unlink(path)  # a link or a pipe that the run has put there
            with open(path, "x", encoding="ascii") as file:
                json.dump(record, file)
        except (OSError, GivenUp):  # the run is not observed; its result is kept, unless the observation has disturbed it
            unlink(path)
            return False, disturbed
        finally:
            unlink(running.folder + TRACE)
            took = time.monotonic() - began + TRACED_S + traced * BYTE_S
            self.account.charge(took, observations=1, sampled="budget" in job)
        return True, disturbed

    def contents(self, job: Job, trace: Trace, names: Names, began: int) -> Contents:
        """Return the contents of the files in a trace, which began at this time."""
        since = began - int(job.get("ahead", 0.0) * 1e9)
        found: Contents = file_trace().contents(trace, since, self.hashes.get, self.check_stop, names.is_listed)
        return found

    def await_signal(self) -> None:
        """Give a SIGTERM that has ended a run time to reach this process too: a scheduler sends it to one after the other."""
        deadline = time.monotonic() + SPREAD_S
        while not self.stopping and time.monotonic() < deadline:
            time.sleep(SAMPLE_S)

    def note(self, running: Running, event: Event) -> None:
        """Write an event of a run. If this fails, the worker cannot continue."""
        try:
            self.journal.write(event, running.seal)
        except OSError as error:
            self.fail(error)

    def clear_shared(self, folder: str) -> str | None:
        """Remove what a run has left in shared folders. Return why that failed, or that the run may have lacked space there."""
        full = [place for place in self.shared if is_full(place)]
        for place, before in self.shared.items():
            for path in (os.path.join(place, name) for name in sorted(entries_of(place) - before)):
                if path != folder:
                    remove(path) if is_folder(path) else unlink(path)
                    if os.path.lexists(path):
                        return "files that it left in shared folders cannot be removed: " + path
        return "no space was left in its container: " + full[0] if full else None

    def report(
        self,
        job: Job,
        slot: int,
        folder: str,
        began: float,
        wall: float,
        remains: Remains,
        status: int | None = None,
        usage: Usage = UNUSED,
    ) -> None:
        """Write that a run has ended; `began` is in seconds since the epoch, `wall` in seconds. `status`: None if not begun."""
        event: End = {
            "event": "end",
            "run": job["run"],
            "execution": job["execution"],
            "directory": folder,
            "started": began,
            "ended": began + wall,
            "exit_code": os.WEXITSTATUS(status) if status is not None and os.WIFEXITED(status) else None,
            "signal": os.WTERMSIG(status) if status is not None and os.WIFSIGNALED(status) else None,
            **usage,
            "host": self.host,
            "slot": slot,
            **remains,
        }
        self.journal.write(event, job.get("seal"))

    def continue_inside(self, now: float) -> None:
        """Continue, at intervals, a worker or a conductor in a container that is stopped: a run may stop its parent."""
        if now < self.continue_at:
            return
        self.continue_at = now + 1.0
        with self.lock:
            roots = [*self.running, *(container.pid for container in list(self.containers.values())), *orphans()]
        for pid in {pid for root in roots for pid in descendants(root)}:
            if stat_of(pid)[:1] == [b"T"] and PROGRAM.search(read_proc("%d/cmdline" % pid)):
                signal_process(pid, signal.SIGCONT)

    def watch(self) -> float:
        """Enforce the limits that are due, and return the seconds until the next check."""
        with self.lock:
            running = list(self.running.values())
        now = time.monotonic()
        due = []
        if self.contains:
            reap()
            self.continue_inside(now)
        if self.services is not None:
            self.services.look()
        continue_ending(self.parent)
        for container in list(self.containers.values()):
            if self.stopping:
                container.stop()
            if self.without_grace:
                container.skip_grace()
            if container.kill_at is not None and now >= container.kill_at:
                container.kill()
            container.expire(now)
        for one in running:
            if one.conducted:
                one.continue_conductor(now)
            if one.meter:
                one.meter.read(now)
                due.append(one.meter.due)
            if self.stopping:
                one.stop("interrupted")
            if self.without_grace:
                one.skip_grace()
            deadline = one.deadline()
            if deadline is not None and now >= deadline:
                one.stop("timeout")
            if one.marker and one.stopped is None:
                due.append(one.marker.due(now))
                if due[-1] <= now:
                    one.stop(MARKED)
            if one.stalled(now):
                since = time.time() - STALLED_S
                self.note(one, {"event": "stalled", "run": one.run, "execution": one.execution, "pid": one.pid, "since": since})
            if one.observation:
                one.observation.limit()
                one.observation.look(pid for pid in one.pids() if pid != one.pid or not one.conducted)
                due.append(now + max(SAMPLE_S, (now - one.started) / LOOKS))
            if one.stopped is None and now - one.started > POLL_S / 2:
                reason = exceeded(one)
                if reason:
                    one.stop(reason)
            if one.kill_at is not None and now >= one.kill_at:
                one.kill()
            times = [one.kill_at, deadline if one.stopped is None else None]
            if one.measured:
                times.append(now + POLL_S)
            due += [moment for moment in times if moment is not None]
        if running or self.stopping:
            due.append(now + 1.0)
        else:
            due.append(now + POLL_S)
        return max(0.005, heapq.nsmallest(1, due)[0] - time.monotonic())


class RunFolder:
    """A run's folder in the state in which it was made, so that changes by the run can be found."""

    def __init__(self, folder: str, files: list[str]) -> None:
        self.folder = folder
        self.files = files
        self.inputs = [*folders_of(files), *files]
        self.states: dict[str, tuple[object, ...]] = {}
        self.record_state("", *FOLDERS, *LOGS, *self.inputs)

    def record_state(self, *names: str) -> None:
        self.states.update((name, state_of(os.path.join(self.folder, name))) for name in names)

    def changed(self, *names: str) -> list[str]:
        return [name for name in names if state_of(os.path.join(self.folder, name)) != self.states[name]]

    def is_reusable(self) -> bool:
        """Return whether the run has changed only outputs and logs, and the logs are short."""
        try:
            sizes = [size_of_file(os.path.join(self.folder, name)) for name in LOGS]
            return sum(sizes) <= CHUNK and not self.changed("", "home", "tmp", *self.inputs)
        except OSError:
            return False

    def clear(self) -> bool:
        """Make the changed parts of the folder again. Return False if that fails."""
        try:
            for name in self.changed("output", *LOGS):
                path = os.path.join(self.folder, name)
                if name in LOGS:
                    os.unlink(path)
                    make_log(path)
                else:
                    remove(path)
                    os.mkdir(path)
                self.record_state(name)
        except OSError:
            return False
        return True

    def reuse(self, job: Job, folder: str) -> None:
        """Turn the folder into that of another run."""
        os.rename(self.folder, folder)
        self.folder = folder
        for name in job["files"]:
            with open(os.path.join(folder, name), "wb") as file:
                file.write(content_of(job, name, folder))
        self.record_state("", *self.inputs)


def folders_of(files: Iterable[str]) -> list[str]:
    """Return the folders that these files need, the outer ones first."""
    found: set[str] = set()
    for name in files:
        parts = name.split("/")[:-1]
        found.update("/".join(parts[: number + 1]) for number in range(len(parts)))
    return sorted(found)


def state_of(path: str) -> tuple[object, ...]:
    """Return values of a folder or a file that differ after it was changed (ctime may not, within one tick of the clock)."""
    status = os.lstat(path)
    inside = sorted(os.listdir(path)) if stat.S_ISDIR(status.st_mode) else status.st_size
    values = (status.st_ino, status.st_mode, status.st_nlink, status.st_uid, status.st_gid, status.st_ctime_ns)
    return (*values, inside, attributes_of(path))


def attributes_of(path: str) -> list[str]:
    """Return the names of its extended attributes, which include access control lists."""
    try:
        return os.listxattr(path, follow_symlinks=False) if hasattr(os, "listxattr") else []
    except OSError:  # a file system without extended attributes
        return []


def prepare(job: Job, folder: str, used: RunFolder | None = None) -> RunFolder | None:
    """Make the run's folder with its input files, or reuse a spare one. If that fails, the worker cannot continue."""
    if used is not None:
        if used.files == list(job["files"]) and used.clear():
            used.reuse(job, folder)
            return used
        remove(used.folder)
    os.mkdir(folder)
    for name in (*FOLDERS, *folders_of(job["files"])):
        os.mkdir(os.path.join(folder, name))
    for name in job["files"]:
        with open(os.path.join(folder, name), "xb") as file:
            file.write(content_of(job, name, folder))
    if "beside" in job:
        shared_files(job["beside"]).place(folder)
    for name in LOGS:
        make_log(os.path.join(folder, name))
    return RunFolder(folder, list(job["files"])) if "used" in job and "beside" not in job else None


def content_of(job: Job, name: str, folder: str) -> bytes:
    """Return the content of an input file, with the paths of folders in the place of their marks."""
    content = base64.b64decode(job["files"][name])
    for mark, text in job.get("folders", {}).items():
        path = text.replace("\0", folder)
        if mark.encode() in content and not SAFE.fullmatch(path):
            raise OSError(errno.EINVAL, "an input would contain this path, which some formats would read in another way", path)
        content = content.replace(mark.encode(), path.encode())
    return content


class SharedFiles:
    """The files of a folder that the runs of a session share. The folder is listed once, because nothing changes it."""

    def __init__(self, source: str) -> None:
        statuses = [(path, name, os.stat(path)) for path, name in files_below(source)]
        self.files = [(path, name, 0o755 if status.st_mode & stat.S_IXUSR else 0o644) for path, name, status in statuses]
        self.names = [name for _, name, _ in self.files]
        self.folders = folders_of(self.names)
        self.large = {name: (path, status.st_size) for path, name, status in statuses if status.st_size >= LINKED}
        """The files that may be hard links, with their sizes."""
        self.clones = True
        """Whether the file system may make files that share their data."""

    def place(self, folder: str) -> None:
        """Copy the files to a run's folder.

        A large file shares its data with the copy if the file system copies on write. Otherwise it is a hard link, which only
        its owner could make writable, and `changed` would find that. For root, whom no permission stops, it is a copy.
        """
        for name in self.folders:
            os.makedirs(os.path.join(folder, name), exist_ok=True)
        for path, name, mode in self.files:
            target = os.path.join(folder, name)
            with open(path, "rb", buffering=0) as original, open(target, "xb", buffering=0) as copy:
                if not (self.clones and cloned(copy.fileno(), original.fileno())):
                    self.clones = False
                    if name in self.large and os.geteuid() != 0 and relinked(path, target):
                        continue
                    for chunk in iter(lambda: original.read(CHUNK), b""):
                        write_all(copy.fileno(), chunk)
                os.fchmod(copy.fileno(), mode)
            os.utime(target, ns=(BESIDE_NS, BESIDE_NS))

    def changed(self) -> str | None:
        """Return why runs that share large files cannot be trusted: a run has changed one; None if none has."""
        for name, (path, size) in self.large.items():
            try:
                status = os.stat(path)
            except OSError:
                return "a run has removed %s, which all runs share" % name
            if (status.st_size, status.st_mtime_ns, status.st_mode & 0o222) != (size, BESIDE_NS, 0):
                return "a run has changed %s, which all runs share" % name
        return None


@functools.lru_cache(maxsize=None)
def shared_files(source: str) -> SharedFiles:
    """Return the files of a folder that runs share. It is read once."""
    return SharedFiles(source)


def cloned(copy: int, original: int) -> bool:
    """Return whether the file system has made a file share the data of another one, copied on write."""
    try:
        import fcntl

        fcntl.ioctl(copy, FICLONE, original)
    except (ImportError, OSError):
        return False
    return True


def relinked(path: str, target: str) -> bool:
    """Return whether an empty file was replaced by a hard link."""
    try:
        os.link(path, target + ".link")
        os.replace(target + ".link", target)
    except OSError:
        return False
    return True


def files_below(folder: str) -> Iterator[tuple[str, str]]:
    """Yield the path of each file below a folder, and its path relative to the folder."""
    for root, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(root, name)
            yield path, os.path.relpath(path, folder)


def inputs_of(job: Job) -> list[str]:
    """Return the names of all files that a run gets in its folder."""
    return [*job["files"], *shared_files(job["beside"]).names] if "beside" in job else list(job["files"])


def make_log(path: str) -> None:
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666))


def marks_in(job: Job) -> list[str]:
    """Return the marks of ports in a job: in its words, variables and input files."""
    client = job.get("client", job)
    texts = [*job["argv"], *job["environment"].values(), *client["argv"], *client["environment"].values()]
    found = {mark for text in texts if PORT_MARK in text for mark in PORT_MARKS.findall(text)}
    if "folders" in job:  # else no input has a mark
        contents = (base64.b64decode(content) for content in job["files"].values())
        found.update(mark for content in contents for mark in PORT_MARKS.findall(content.decode("latin-1")))
    return sorted(found)


def with_ports(job: Job, ports: Mapping[str, int]) -> Job:
    """Return the job with ports in the place of their marks."""

    def filled(text: str) -> str:
        return PORT_MARKS.sub(lambda mark: str(ports[mark.group()]), text) if PORT_MARK in text else text

    def program(one: Program) -> Mapping[str, object]:
        environment = {name: filled(value) for name, value in one["environment"].items()}
        return {**one, "argv": [filled(word) for word in one["argv"]], "environment": environment}

    done = cast("Job", {**program(job), "own_ports": list(ports.values())})
    if "client" in job:
        done["client"] = cast("Program", program(job["client"]))
    if "folders" in job:
        done["folders"] = {**job["folders"], **{mark: str(port) for mark, port in ports.items()}}
    return done


def own_ports(job: Job, folder: str, services: SharedServices | None) -> list[int]:
    """Return the ports that only this run uses, and those of services that runs share on purpose."""
    given = [port + number for port in job.get("own_ports", ()) for number in range(conducting().BLOCK)]
    shared = ports_of(json.loads(services.word())) if services else []
    return [*given, *report_of(job, folder).ports, *shared]


def ports_of(report: Mapping[str, object]) -> list[int]:
    """Return the ports of services in a conductor's report."""
    found = report.get("ports")
    return [port for port in found.values() if isinstance(port, int)] if isinstance(found, dict) else []


def with_own_devices(job: Job, slot: int, slots: int) -> Job:
    """Return the job with the devices of its slot, if it requests any."""
    if not any(job["environment"].get(name) == ALLOTTED + name for name in DEVICES):
        return job
    given = devices(slot, slots)
    filled: Job = {**job, "environment": with_devices(job["environment"], given)}
    if "client" in job:
        client = job["client"]
        argv = [word for word in (with_device(word, given) for word in client["argv"]) if word is not None]
        filled["client"] = {**client, "argv": argv, "environment": with_devices(client["environment"], given)}
    return filled


def with_devices(variables: Mapping[str, str], given: dict[str, str]) -> dict[str, str]:
    filled = {name: with_device(value, given) for name, value in variables.items()}
    return {name: value for name, value in filled.items() if value is not None}


def with_device(text: str, given: dict[str, str]) -> str | None:
    """Return the text with the value of the variable that it ends with; None if there is no such variable."""
    head, mark, name = text.partition(ALLOTTED)
    if not mark or name not in DEVICES:
        return text
    return head + given[name] if name in given else None


def devices(slot: int, slots: int) -> dict[str, str]:
    """Return the devices that a slot may use, from the scheduler's variables: its part of them, or all."""
    whole = {name: os.environ[name] for name in DEVICES if name in os.environ}
    parts = {name: part_of(value.split(","), slot, slots) for name, value in whole.items()}
    if parts != whole and ROCR in parts and os.path.exists("/dev/kfd"):
        return {name: value for name, value in parts.items() if name not in BELOW_ROCR}
    return parts


def part_of(values: list[str], slot: int, slots: int) -> str:
    """Return a slot's part of the devices if they can be divided equally among the slots, or the slots among them; else all."""
    if len(values) % slots == 0:
        each = len(values) // slots
        values = values[slot * each : (slot + 1) * each]
    elif slots % len(values) == 0:
        values = [values[slot % len(values)]]
    return ",".join(values)


def start(
    job: Job, folder: str, observation: Observation | None = None, services: SharedServices | None = None
) -> subprocess.Popen[bytes]:
    """Start a run's program in its folder."""
    started = with_folder(job.get("client", job), folder)
    output = os.path.join(folder, "output")
    argv = started["argv"]
    conducted = is_conducted(job) and "client" not in job
    if conducted:
        argv = [sys.executable, "-I", "-S", beside(CONDUCTOR), folder, *argv[1:]]
        argv += [services.word()] if services else []
    if observation:
        argv = observation.prefixed(argv, started["environment"], output, conducted=conducted)
    out, err = (os.open(os.path.join(folder, name), os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC) for name in LOGS)
    try:
        return subprocess.Popen(
            argv,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            cwd=output,
            env=started["environment"],
            start_new_session=True,
        )
    finally:
        os.close(out)
        os.close(err)


def is_conducted(job: Job) -> bool:
    """Return whether the conductor executes a job."""
    return list(job["argv"][:1]) == [CONDUCTED]


class Report(NamedTuple):
    """The report of a conductor."""

    error: str | None
    """Why the run has failed; None if all was executed."""
    left_running: Sequence[str] = ()
    """The processes that still ran when the command had ended."""
    after_marker: float | None = None
    """The command was ended so many seconds after its marker."""
    ports: Sequence[int] = ()
    """The ports of its services."""


def report_of(job: Job, folder: str) -> Report:
    """Return the conductor's report on a run; an empty one if there is no conductor."""
    return read_report(folder) if is_conducted(job) else Report(None)


def trouble_of_services(services: SharedServices | None) -> str | None:
    """Return why services that all runs share cannot be trusted any more; None if they can."""
    reason = services.disturbed() if services else None
    return reason and 'observing the services that all runs share may have changed them: %s; set observe = "none"' % reason


def with_reasons(trace: Trace, services: SharedServices, shared: Trace | None) -> Trace:
    """Return the trace of a run with the notes on services, and with the reasons why their observation is not complete."""
    found = shared.reasons if shared else ()
    reasons = (*trace.reasons, *services.reasons, *("services that all runs share: " + reason for reason in found))
    notes = (*trace.notes, *(shared.notes if shared else ()))
    return trace._replace(reasons=tuple(dict.fromkeys(reasons)), notes=tuple(dict.fromkeys(notes)))


def read_report(folder: str) -> Report:
    """Return the report of a conductor in its folder."""
    unread = Report("the program that executes its services and commands has ended without a report")
    try:  # a run may have put anything there
        descriptor = os.open(os.path.join(folder, REPORT), os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            record = json.loads(file.read(REPORT_BYTES))
        error, left, after = record["error"], record.get("left_running", []), record.get("after_marker")
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return unread
    texts = isinstance(left, list) and all(isinstance(name, str) for name in left)
    if not texts or not isinstance(error, (str, type(None))) or not isinstance(after, (int, float, type(None))):
        return unread
    return Report(error, left, after, ports_of(record))


def own_folders(running: Running) -> Mapping[str, str]:
    """Return the folders for temporary files of a run and its worker, by the names of the folders in whose place they are."""
    if running.temporary is None:
        return {}
    return {"work:temporary": os.path.dirname(running.temporary), "run:temporary": running.temporary}


def with_folder(client: Program, folder: str) -> Program:
    """Return the program's words and environment with the path of the given folder."""
    return {
        "argv": [word.replace("\0", folder) for word in client["argv"]],
        "environment": {name: value.replace("\0", folder) for name, value in client["environment"].items()},
        "stop": [word.replace("\0", folder) for word in client.get("stop", ())],
        "start_pipe": client.get("start_pipe", "").replace("\0", folder),
    }


def last_line_of(log: str) -> str:
    """Return the last line of a log; empty if it has none."""
    with open(log, "rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - HEAD_BYTES))
        lines = file.read().decode("utf-8", "replace").strip().splitlines()
    return lines[-1] if lines else ""


def end_container(client: Program) -> None:
    """End the container of a client that is gone or does not react."""
    if client.get("stop"):
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):  # a later check looks for the container again
            subprocess.run(
                client["stop"],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=client["environment"],
                timeout=3 * CLEAN_S,
                start_new_session=True,
            )


def await_end(running: Running) -> tuple[int, struct_rusage]:
    """Wait for the program's end, kill the rest of its group, and only then release its process id.

    If the program was told to end, the processes that it had started keep the rest of the grace time.
    """
    if hasattr(os, "waitid"):
        ended = os.waitid(os.P_PID, running.pid, os.WEXITED | os.WNOWAIT)
        running.announce(ENDING)
        while running.kill_at is not None and any(is_alive_in(pid, running.pid) for pid in orphans()):
            time.sleep(POLL_S / 10)
        if ended and ended.si_code == os.CLD_EXITED:
            running.note_left()
        with running.lock:
            running.over = True
            signal_group(running.pid, signal.SIGKILL)
    _, status, usage = os.wait4(running.pid, 0)
    running.over = True
    return status, usage


def used(usage: struct_rusage) -> Usage:
    """Return the resources that a program and its awaited children have used, as the kernel reports them."""
    unit = 1 if sys.platform == "darwin" else 1024
    return {"user_s": usage.ru_utime, "system_s": usage.ru_stime, "max_rss_bytes": usage.ru_maxrss * unit}


def is_full(place: str) -> bool:
    """Return whether a writable file system has no space left."""
    try:
        space = os.statvfs(place)
    except OSError:
        return False
    return not space.f_flag & os.ST_RDONLY and bool(space.f_blocks) and space.f_bavail == 0


def check_room(folder: str) -> None:
    """Raise OSError if a file system has no space or no inodes left."""
    space = os.statvfs(folder)
    if (space.f_blocks and space.f_bavail == 0) or (space.f_files and space.f_favail == 0):  # a ramfs reports neither
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), folder)


def check_temporary(running: Running) -> None:
    """Raise OSError if the file system of a run's temporary files has no space left."""
    if running.temporary is not None and is_folder(running.temporary):
        try:
            check_room(running.temporary)
        except OSError as error:
            cure = "%s for the temporary files of runs; set TMPDIR to a folder on a larger disk before sierra starts"
            raise OSError(error.errno, cure % error.strerror, running.temporary) from error


def collect_outputs(
    folder: str,
    inputs: Iterable[str],
    limits: Limits,
    stopped: str | None,
    check_stop: Callable[[], None],
    spare: bool = False,
) -> Remains:
    """Return why a run was stopped (as far as its files show it), and its outputs or why they cannot be read.

    Folders that are no longer needed are removed, unless the run's folder is spare. The outputs of an interrupted run are not
    read, and neither are outputs beyond the limit. `check_stop` is called for each chunk that is read; it may raise GivenUp.
    """
    allowed = limits.get("output_bytes")
    outputs: list[OutputFile] = []
    other_entries: list[str] = []
    elsewhere: list[str] = []
    error = None
    try:
        if is_folder(folder):  # a run may have put a link here, which may lead to other people's files: do not touch it
            unlock(folder, 0o700)
            elsewhere = [] if spare else list(itertools.islice(written_elsewhere(folder, inputs), MOST_NAMED))
            for name in () if spare else ("home", "tmp"):
                remove(os.path.join(folder, name))
            files, other_entries = list_files(os.path.join(folder, "output"))
            if stopped is None and allowed is not None and size_of(folder) > allowed:
                stopped = "output"
            if stopped == "output" and allowed is not None:
                files = list(limited_to(files, allowed))
            outputs = list(described(files, check_stop)) if stopped != "interrupted" else []
    except GivenUp:
        stopped = "interrupted"
    except (OSError, RecursionError) as trouble:
        error = "its outputs cannot be read: " + explain(trouble)
    remains: Remains = {"stopped": stopped, "outputs": outputs, "error": error}
    if other_entries:
        remains["left_out"] = other_entries[:MOST_NAMED]
    if elsewhere:
        remains["elsewhere"] = elsewhere
    return remains


def written_elsewhere(folder: str, inputs: Iterable[str]) -> Iterator[str]:
    """Yield the files with content that a run has left in its folder, but not in `output`: beside its input, and in `home`.

    Hidden ones are left out: programs keep their settings and caches there.
    """
    own = {*inputs, *FOLDERS, *LOGS, OBSERVED}
    beside, home = entries_of(folder) - own, entries_of(os.path.join(folder, "home"))
    pending = [*(os.path.join("home", name) for name in sorted(home, reverse=True)), *sorted(beside, reverse=True)]
    while pending:
        name = pending.pop()
        path = os.path.join(folder, name)
        if name in own or os.path.basename(name).startswith("."):
            continue
        if is_folder(path):
            pending += [os.path.join(name, entry) for entry in sorted(entries_of(path), reverse=True)]
        elif not os.path.islink(path) and os.path.isfile(path) and size_of_file(path):
            yield name


def no_outputs(error: str | None, stopped: str | None = None) -> Remains:
    return {"stopped": stopped, "outputs": [], "error": error}


def list_files(root: str) -> tuple[list[tuple[str, str]], list[str]]:
    """Return the regular files below `root` (path, and path relative to it) and all other entries but folders, sorted."""
    files, other_entries = [], []
    pending = [root] if is_folder(root) else []
    while pending:
        folder = pending.pop()
        unlock(folder, 0o700)
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    pending.append(entry.path)
                elif entry.is_file(follow_symlinks=False):
                    files.append((entry.path, os.path.relpath(entry.path, root)))
                else:
                    other_entries.append(os.path.relpath(entry.path, root))
    return sorted(files), sorted(other_entries)


def limited_to(files: Iterable[tuple[str, str]], most: int) -> Iterator[tuple[str, str]]:
    """Yield the files whose total size is at most `most` bytes, in order. A file that exceeds the rest is skipped."""
    for path, name in files:
        size = size_of_file(path)
        if size <= most:
            most -= size
            yield path, name


def described(files: Iterable[tuple[str, str]], check_stop: Callable[[], None]) -> Iterator[OutputFile]:
    """Yield the description of each file, with its hash. Makes a file readable if necessary."""
    for path, name in files:
        if os.lstat(path).st_nlink > 1:
            separate(path)
        try:
            yield describe(path, name, check_stop)
        except PermissionError:
            unlock(path, 0o400)
            yield describe(path, name, check_stop)


def separate(path: str) -> None:
    """Replace a file that has other names by a copy: who changes the file under another name would change this one."""
    unlock(path, 0o400)
    copy = os.path.join(os.path.dirname(path), "." + os.urandom(16).hex())
    shutil.copyfile(path, copy)
    shutil.copymode(path, copy)
    os.replace(copy, path)


def entries_of(folder: str) -> set[str]:
    try:
        return set(os.listdir(folder))
    except OSError:  # there is no such folder
        return set()


def unlink(path: str) -> None:
    with contextlib.suppress(OSError):  # the caller checks whether it still exists
        os.unlink(path)


def is_folder(path: str) -> bool:
    """Return whether a path is itself a folder, and not a link to one."""
    return os.path.isdir(path) and not os.path.islink(path)


def unlock(path: str, rights: int) -> None:
    """Give the owner these permissions, so that files which a program has locked can be read and removed."""
    mode = stat.S_IMODE(os.lstat(path).st_mode)
    if mode & rights != rights:
        os.chmod(path, mode | rights)


def remove(folder: str) -> None:
    """Remove a folder (never the target of a link) with its contents, also read-only folders, as far as permitted."""
    if is_folder(folder):
        shutil.rmtree(folder, ignore_errors=True)
    if is_folder(folder):
        if os.lstat(folder).st_uid == os.geteuid():  # else another user owns it
            unlock(folder, 0o700)
        for root, names, _ in os.walk(folder):
            for path in [os.path.join(root, name) for name in names]:
                if is_folder(path):
                    unlock(path, 0o700)
        shutil.rmtree(folder, ignore_errors=True)


def describe(path: str, name: str, check_stop: Callable[[], None] = lambda: None) -> OutputFile:
    """Return the description of a file. Calls `check_stop` for each chunk."""
    counts = Counts()
    check_stop()
    with open(path, "rb", buffering=0) as file:
        for chunk in iter(lambda: file.read(CHUNK), b""):
            check_stop()
            counts.add(chunk)
    return counts.report(name)


class Counts:
    """The hash of a file, fed in pieces, and its bytes, lines and quotes, from which the number of a table's rows follows.

    A file with a NUL in its first piece is not text: only its bytes and line feeds are counted, which is faster.
    """

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self._text = True
        self._head = b""
        self._size = self._lines = self._returns = self._pairs = self._quotes = self._blank = 0
        self._before = b"\n"  # the last two bytes; the beginning of a file is the beginning of a line

    def add(self, chunk: bytes) -> None:
        self._digest.update(chunk)
        if not self._size:
            self._head = chunk[:HEAD_BYTES].split(b"\n", 1)[0]
            self._text = b"\0" not in chunk
        self._size += len(chunk)
        self._lines += chunk.count(b"\n")
        if self._text:
            self._add_text(chunk)
        self._before = (self._before + chunk[-2:])[-2:]

    def _add_text(self, chunk: bytes) -> None:
        self._quotes += chunk.count(b'"')
        text = self._before + chunk
        returns = chunk.count(b"\r")
        if returns or self._before.endswith(b"\r"):
            self._returns += returns
            self._pairs += chunk.count(b"\r\n") + (self._before[-1:] + chunk[:1] == b"\r\n")
        if b"\n\n" in text or b"\n\r\n" in text:
            self._blank += sum(match.end() > len(self._before) for match in EMPTY_LINE.finditer(text))

    def report(self, name: str) -> OutputFile:
        file: OutputFile = {
            "path": name,
            "sha256": self._digest.hexdigest(),
            "bytes": self._size,
            "lines": self._lines,
            "ended": self._before.endswith(b"\n"),
            "head": self._head.decode("utf-8", "replace"),
        }
        if self._text:
            file["quotes"], file["blank"] = self._quotes, self._blank
            file["alike"] = self._returns == 0 or self._returns == self._pairs == self._lines
        return file


def exceeded(running: Running) -> str | None:
    """Return the name of the limit that a program exceeds, or None."""
    limits = running.limits
    memory_limit, cpu_limit, output_limit = limits.get("memory_bytes"), limits.get("cpu_s"), limits.get("output_bytes")
    if memory_limit is not None or cpu_limit is not None:
        memory, cpu = usage_of(running.pids())
        if memory_limit is not None and memory > memory_limit:
            return "memory"
        if cpu_limit is not None and cpu > cpu_limit:
            return "cpu"
    if output_limit is not None and sum(size_of(path) for path in (running.folder, running.temporary) if path) > output_limit:
        return "output"
    if any(size_of_file(os.path.join(running.folder, name)) > LOG_BYTES for name in LOGS):
        return "output"
    return None


def size_of_file(path: str) -> int:
    try:
        return os.lstat(path).st_size
    except OSError:
        return 0


def size_of(folder: str) -> int:
    """Return the total size in bytes of all files below a folder, as far as they can be read."""
    return sum(size_of_file(os.path.join(root, name)) for root, _, names in os.walk(folder) for name in names)


def descendants(pid: int) -> list[int]:
    """Return the ids of a process and all its descendants, as far as /proc lists them."""
    pids = [pid]
    for parent in pids:
        for task in entries_of("/proc/%d/task" % parent):
            pids += children(parent, task)
    return pids


def read_proc(path: str) -> bytes:
    """Return the content of a file in /proc; empty if it cannot be read."""
    try:
        with open("/proc/" + path, "rb") as file:
            return file.read()
    except OSError:
        return b""


def children(process: int | str, task: int | str) -> list[int]:
    return [int(word) for word in read_proc("%s/task/%s/children" % (process, task)).split()]


def usage_of(pids: list[int]) -> tuple[int, float]:
    """Return the resident bytes and the CPU seconds of processes (including their ended children's CPU seconds)."""
    page = os.sysconf("SC_PAGE_SIZE")
    resident = sum(int(fields[21]) for fields in map(stat_of, pids) if fields)
    return resident * page, sum(cpu_of(pids))


def cpu_of(pids: list[int]) -> tuple[float, float]:
    """Return the CPU seconds of processes and of their ended children, in user mode and in the kernel."""
    tick = os.sysconf("SC_CLK_TCK")
    times = [[int(field) for field in fields[11:15]] for fields in map(stat_of, pids) if fields]
    return sum(one[0] + one[2] for one in times) / tick, sum(one[1] + one[3] for one in times) / tick


def peak_of(pid: int) -> int:
    """Return the greatest resident size in bytes that a process has had; 0 if there is no such process."""
    return number_in(pid, b"VmHWM:") * 1024


def number_in(pid: int, field: bytes) -> int:
    """Return a number in /proc/PID/status; 0 if there is no such process."""
    lines = [line.split() for line in read_proc("%d/status" % pid).splitlines() if line.startswith(field)]
    return int(lines[0][1]) if lines else 0


def environment_of(pid: int) -> list[bytes]:
    """Return the environment with which a process was started, as NAME=value; nothing else if it cannot be read."""
    text = read_proc("%d/environ" % pid)
    if not text and stat_of(pid)[:1] == [b"Z"]:  # its first thread has ended, but perhaps not the others
        threads = ("%d/task/%s/environ" % (pid, task) for task in entries_of("/proc/%d/task" % pid))
        text = next(filter(None, map(read_proc, threads)), b"")
    return text.split(b"\0")


def stdin_of(process: subprocess.Popen[bytes]) -> IO[bytes]:
    """Return the pipe to a process. Raises BrokenPipeError if it is closed."""
    if process.stdin is None or process.stdin.closed:
        raise BrokenPipeError
    return process.stdin


def marked(marks: Iterable[bytes]) -> set[int]:
    """Return this host's processes that were started with one of these NAME=value (Linux): no zombies, and only this user's."""
    found = set(marks)
    return {int(pid) for pid in entries_of("/proc") if pid.isdigit() and not found.isdisjoint(environment_of(int(pid)))}


def write_all(descriptor: int, data: bytes) -> None:
    """Write all data, even if a pipe accepts only a part at a time."""
    while data:
        data = data[os.write(descriptor, data) :]


def stat_of(pid: int) -> list[bytes]:
    """Return the fields of /proc/PID/stat after the program's name; empty if there is no such process."""
    return read_proc("%d/stat" % pid).rpartition(b")")[2].split()


class Stops:
    """Looks at a process that a run may stop by SIGSTOP.

    If this process was stopped too, then no run did it, but somebody who suspends and resumes everything. Therefore a stop
    only counts if the process is still stopped `STOP_S` later, and this one has looked at it in the meantime.
    """

    def __init__(self) -> None:
        self._since: float | None = None
        self._looked = 0.0

    def seen(self, pid: int, now: float) -> bool:
        """Look once more, at this time; return whether the process has been stopped for so long."""
        suspended = now - self._looked > STOP_S
        self._looked = now
        if stat_of(pid)[:1] != [b"T"]:
            self._since = None
            return False
        if suspended or self._since is None:
            self._since = now
        if now - self._since < STOP_S:
            return False
        self._since = None
        return True


def birth(pid: int) -> int | None:
    """Return the start time of a process in clock ticks since boot. With the process id, it identifies one process for ever."""
    fields = stat_of(pid)
    return int(fields[19]) if fields else None


class Account:
    """The time that runs have taken, and that their observation has taken, in seconds, in all slots together."""

    def __init__(self) -> None:
        self._ran = self._spent = self._sampled = 0.0
        self._runs = self._observations = 0
        self._lock = threading.Lock()

    def add(self, wall: float) -> None:
        """Add a run."""
        with self._lock:
            self._ran += wall
            self._runs += 1

    def charge(self, seconds: float, observations: int = 0, *, sampled: bool = False) -> None:
        """Add time that was spent on observations (`sampled`: of the sample), and so many of them that have ended."""
        with self._lock:
            self._spent += seconds
            self._sampled += seconds if sampled else 0.0
            self._observations += observations

    def allows(self, part: float | None = None, times: float | None = None) -> bool:
        """Return whether one more observation, as long as the others, is allowed.

        With `part`: if it and those of the sample take at most this part of the runs' time. With `times`: if it takes at most
        so many times the mean time of a run; while no run has ended, each slot may observe one.
        """
        with self._lock:
            one = self._spent / self._observations if self._observations else UNKNOWN_S
            if part is not None:
                return self._sampled + one <= part * self._ran
            return times is None or one * self._runs <= times * self._ran


class Hashes:
    """The SHA-256 of files that were hashed before, as long as their inode, size and times are the same."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], str] = {}
        self._learnt: Mapping[str, object] | None = None
        self._new: dict[str, list[int | str]] = {}

    def learn(self, path: str) -> None:
        """Read once what others have hashed: `sierra.provenance.hash_cache` describes the file. A damaged one is ignored."""
        if self._learnt is None:
            self._learnt = sealed_record(path)

    def get(self, path: str, status: os.stat_result, hashed: Hashed) -> str:
        state = [status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns]
        key = (path, *state)
        if key not in self._known:
            shared = not path.endswith("/RECORD")  # of which not all bytes count: see `file_trace.counted`
            learnt = (self._learnt or {}).get(path) if shared else None
            if isinstance(learnt, list) and learnt[:-1] == state and isinstance(learnt[-1], str):
                self._known[key] = learnt[-1]
            else:
                self._known[key] = hashed()
                if shared and status.st_size > SMALL and max(state[3:]) < time.time_ns() - RACY_NS:
                    self._new[path] = [*state, self._known[key]]
        return self._known[key]

    def news(self) -> Mapping[str, list[int | str]]:
        """Return the hashes of large files that are new since the last call, as the file of `learn` has them."""
        new, self._new = self._new, {}
        return new


def sealed_record(path: str) -> Mapping[str, object]:
    """Return the JSON object in a file whose first line is the SHA-256 of the rest; empty if it is damaged or missing."""
    try:
        with open(path, "rb") as file:
            seal, _, content = file.read().partition(b"\n")
        record = json.loads(content) if hashlib.sha256(content).hexdigest().encode() == seal else {}
    except (OSError, ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def beside(name: str) -> str:
    """Return the path of a file in the folder of this one."""
    return os.path.join(os.path.dirname(os.path.abspath(__file__)), name)


def file_trace() -> ModuleType:
    """Load the module beside this file that observes runs."""
    return module_beside(TRACER)


def conducting() -> ModuleType:
    """Load the module beside this file that executes what is around a run's command."""
    return module_beside(CONDUCTOR)


@functools.lru_cache(maxsize=None)
def module_beside(name: str) -> ModuleType:
    """Load a module beside this file."""
    import importlib.util

    path = beside(name)
    spec = importlib.util.spec_from_file_location(name[: -len(".py")], path)
    if spec is None or spec.loader is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def keep_reason(folder: str, reason: str) -> bool:
    """Write why a run was not observed to its folder, as a record without files; return whether that was possible."""
    record = {"method": "none", "reason": reason, "notes": [], "distributions": [], "files": [], "listings": {}, "written": []}
    try:
        unlink(os.path.join(folder, OBSERVED))
        with open(os.path.join(folder, OBSERVED), "x", encoding="ascii") as file:
            json.dump(record, file)
    except OSError:
        return False
    return True


ENDING_MASK = sum(1 << number - 1 for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM))
"""The signals that end a program, as in /proc/PID/status."""


def continue_ending(pid: int) -> None:
    """Continue a process that is stopped, if a signal waits that would end it: a run may stop the process of its session."""
    if stat_of(pid)[:1] == [b"T"]:
        pending = [
            line.split()[1] for line in read_proc("%d/status" % pid).splitlines() if line[:7] in (b"SigPnd:", b"ShdPnd:")
        ]
        if any(int(mask, 16) & ENDING_MASK for mask in pending):
            signal_process(pid, signal.SIGCONT)


def nobody(pid: int) -> bool:
    return False


def end_orphans(execution: str | None, group: int | None = None, is_tracer: Callable[[int], bool] = nobody) -> bool:
    """Kill processes that have left their group: orphans of one execution, or (None) all. Return whether no orphan is left.

    Orphans are children of this process's main thread. An orphan whose environment does not name an execution belongs to none,
    and is ended with the worker. One that is ending has no environment: it is awaited, because its children may be the run's.
    """
    give_up = time.monotonic() + SETTLE_S
    while time.monotonic() < give_up:
        living = reap()
        own = [
            pid
            for pid in living
            if (execution is None or belongs_to(pid, execution, group) or is_ending(pid)) and not is_tracer(pid)
        ]
        if not own:
            return not living
        for pid in own:
            signal_process(pid, signal.SIGKILL)
        select.select((), (), (), POLL_S / 50)  # no wait for one of them, which may never end if it is another user's
    return False


def reap() -> list[int]:
    """Return the orphans that have not ended. Waits for those that have, because no other code does.

    A process whose first thread has ended has not ended itself before its other threads: until then, its children are not
    orphans, so it is one of those that are returned. The list is read again after each end, because it was read before.
    """
    while True:
        living, has_ended = [], False
        for pid in orphans():
            fields = stat_of(pid)
            if fields and fields[0] == b"Z" and release(pid):
                has_ended = True
            elif fields:
                living.append(pid)
        if not has_ended:
            return living


def release(pid: int) -> bool:
    """Return whether a child has ended, and let the kernel forget it."""
    try:
        return os.waitpid(pid, os.WNOHANG)[0] == pid
    except ChildProcessError:
        return False


def await_orphans() -> None:
    """Wait while an engine cleans up after containers that have ended."""
    give_up = time.monotonic() + CLEAN_S
    while reap() and time.monotonic() < give_up:
        time.sleep(POLL_S / 10)


def orphans() -> list[int]:
    """Return the children of the main thread, which starts none itself."""
    return children("self", os.getpid())


def group_of(pid: int) -> int | None:
    fields = stat_of(pid)
    return int(fields[2]) if fields else None


def is_alive_in(pid: int, group: int) -> bool:
    """Return whether a process is in a group, and is not a zombie."""
    fields = stat_of(pid)
    return bool(fields) and fields[0] != b"Z" and int(fields[2]) == group


def belongs_to(pid: int, execution: str, group: int | None) -> bool:
    if group_of(pid) in (None, group):
        return True
    return b"SIERRA_EXECUTION=" + execution.encode() in environment_of(pid)


def is_ending(pid: int) -> bool:
    """Return whether all threads of a process are ending, so that it has no environment any more."""
    return stat_of(pid)[:1] == [b"Z"] and environment_of(pid) == [b""]


def has_ended(pid: int) -> bool:
    """Return whether a child has ended, even if nobody has waited for it yet."""
    return hasattr(os, "waitid") and os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None


def signal_group(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, number)


def signal_process(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.kill(pid, number)


def explain(error: BaseException) -> str:
    name = getattr(error, "filename", None)
    if isinstance(name, bytes):
        name = os.fsdecode(name)
    if isinstance(error, NotHeld):
        return str(error)
    reason = getattr(error, "strerror", None) or "%s: %s" % (type(error).__name__, error)
    return "%s: %s" % (name, reason) if name else reason


def why_not_started(error: BaseException, job: Job) -> str:
    """Return why a program could not be started, in one line. It may be for another processor, or its loader may be missing."""
    number, name = getattr(error, "errno", None), getattr(error, "filename", None)
    if "client" in job or not isinstance(name, str) or number not in (errno.ENOEXEC, errno.ENOENT):
        return explain(error)
    path = shutil.which(name, path=job["environment"].get("PATH", os.defpath)) or name
    processor, uname = processor_of(path), os.uname()
    if number == errno.ENOEXEC and processor:
        return "%s is a program for %s, but %s is %s" % (path, processor, uname.nodename, uname.machine)
    if number == errno.ENOENT and processor:
        return "%s is a program for %s whose loader is not on %s" % (path, processor, uname.nodename)
    return explain(error)


def processor_of(path: str) -> str | None:
    """Return the processor that a program is for, by its ELF header (elf(5)); None for any other file.

    The names are those of `uname -m`; all 32-bit ARM processors are `arm`.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(20)
    except (OSError, ValueError):
        return None
    if len(head) < 20 or head[:4] != b"\x7fELF":
        return None
    number = int.from_bytes(head[18:20], "big" if head[5] == 2 else "little")
    return PROCESSORS.get(number, "another processor (number %d in ELF)" % number)


def become_subreaper(*, secretive: bool) -> bool:
    """Become the parent of orphans, and end with the process that started this one (Linux only).

    Return whether all orphans will be found. `secretive`: processes without more rights cannot read this one's memory and
    pipes.
    """
    if sys.platform != "linux":
        return False
    try:
        import ctypes

        libc = ctypes.CDLL(None, use_errno=True)
        set_child_subreaper, set_parent_death_signal, set_dumpable = 36, 1, 4
        adopts = libc.prctl(set_child_subreaper, 1, 0, 0, 0) == 0
        libc.prctl(set_parent_death_signal, signal.SIGHUP, 0, 0, 0)
        if secretive:
            libc.prctl(set_dumpable, 0, 0, 0, 0)
    except (ImportError, OSError, AttributeError):
        return False
    return adopts and os.path.exists("/proc/self/task/%d/children" % os.getpid())


def execute(arguments: Sequence[str], announce: Announce = lambda state: None) -> Worker:
    """Execute the jobs on standard input; return the worker, which has ended. See `Worker` for `announce`."""
    folder, slots = arguments[:2]
    piped = list(arguments[2:3]) == ["-"]
    journal = None if piped else "".join(arguments[2:3])
    adopts = become_subreaper(secretive=piped)
    worker = Worker(
        os.path.abspath(folder), int(slots), journal=journal, adopts=adopts, places=tuple(arguments[3:]), announce=announce
    )

    for number in (signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)  # perhaps ignored by the process that started this one in the background
    signal.signal(signal.SIGTERM, lambda number, frame: worker.terminate())
    signal.signal(signal.SIGHUP, lambda number, frame: worker.stop())
    signal.signal(signal.SIGINT, lambda number, frame: None)  # a signal that is ignored here would be ignored by all runs
    worker.work(sys.stdin)
    return worker


def main(arguments: list[str]) -> int:
    worker = execute(arguments)
    worker.report_failure()
    return worker.status


if __name__ == "__main__":
    os._exit(main(sys.argv[1:]))
