"""Executes runs, wherever they are to be executed: on this machine, in an array task, in a container, on a robot.

One file on the standard library alone (Python 3.8 or newer), so that a node needs nothing installed:

    worker.py FOLDER SLOTS < jobs

Jobs come as lines of JSON, one run each, and end with the line `{"end": true}`. An input that ends without
it means that whoever sent the jobs has died: the runs in flight are ended, and nothing more is started.
`{"stop": true}` and SIGTERM ask for the same.

For each job the worker makes the folder FOLDER/<number>/ with the input files, `home`, `tmp` and `output`,
starts the program in a session (and so a process group) of its own with `output` as its working directory,
enforces the limits, and hashes what was left in `output`. In argv and environment, the character NUL stands
for the run's folder.

What happened is appended to FOLDER/journal.jsonl, a line for each event, each written by one call: `start`
(process id and its start time, so that an orphan can be recognised) and `end` (sierra.model.Result). A line
that is cut short was never written.

Processes that leave their group are found all the same: the worker is their subreaper (Linux), so an orphan
becomes a child of the worker's main thread, which starts no process itself.
"""

from __future__ import annotations

import base64
import hashlib
import heapq
import itertools
import json
import os
import queue
import shutil
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from typing import Any, Iterator, TextIO

FOLDERS = ("home", "tmp", "output")
POLL_S = 0.25
HEAD_BYTES = 4096
CHUNK = 1 << 20
SETTLE_S = 2.0


class Journal:
    """Lines appended to one file, each whole or not at all."""

    def __init__(self, path: str) -> None:
        self._file = os.open(path, os.O_CREAT | os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC, 0o644)

    def write(self, **event: Any) -> None:
        line = json.dumps(event, separators=(",", ":")).encode() + b"\n"
        if os.write(self._file, line) != len(line):
            raise OSError("the journal could not be written: is the disk full?")


class Running:
    """A program that runs now; its lock guards the time at which its process id stops being its own."""

    def __init__(self, job: dict[str, Any], folder: str, process: subprocess.Popen[bytes]) -> None:
        self.execution = job["execution"]
        self.folder = folder
        self.pid = process.pid
        self.limits = job.get("limits", {})
        self.measured = any(self.limits.get(name) is not None for name in ("cpu_s", "memory_bytes", "output_bytes"))
        self.limited = self.measured or self.limits.get("wall_s") is not None
        self.started = time.monotonic()
        self.stopped: str | None = None
        self.kill_at: float | None = None
        self.over = False
        self.lock = threading.Lock()

    def deadline(self) -> float | None:
        wall = self.limits.get("wall_s")
        return None if wall is None else self.started + wall

    def stop(self, reason: str) -> None:
        """Ask the whole group to end; `kill` follows after the grace time."""
        with self.lock:
            if self.stopped is None and not self.over:
                self.stopped = reason
                self.kill_at = time.monotonic() + self.limits.get("grace_s", 5.0)
                signal_group(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        with self.lock:
            if not self.over:
                self.kill_at = None
                for pid in descendants(self.pid):
                    signal_process(pid, signal.SIGKILL)
                signal_group(self.pid, signal.SIGKILL)


class Worker:
    """Slots that take jobs from a queue, each a thread, and the main thread that watches over them."""

    def __init__(self, folder: str, slots: int) -> None:
        self.folder = folder
        self.slots = slots
        self.journal = Journal(os.path.join(folder, "journal.jsonl"))
        self.host = socket.gethostname()
        self.jobs: queue.Queue[dict[str, Any] | None] = queue.Queue(maxsize=2 * slots)
        self.running: dict[int, Running] = {}
        self.stopping = threading.Event()
        self.wake = threading.Event()
        self.failure: str | None = None
        self.numbers = itertools.count(1)
        self.lock = threading.Lock()

    def work(self, stream: TextIO) -> bool:
        """Execute all jobs that `stream` holds; True if it was read to its end and none was cut off."""
        threading.Thread(target=self.read, args=(stream,), daemon=True).start()
        threads = [threading.Thread(target=self.slot, args=(number,)) for number in range(self.slots)]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            self.wake.wait(self.watch())
            self.wake.clear()
        end_orphans(None)
        return not self.stopping.is_set()

    def read(self, stream: TextIO) -> None:
        """Put the jobs in the queue until the stream says that it is over, and then mind who holds its other end."""
        for line in stream:
            job = json.loads(line)
            if job.get("stop"):
                break
            if job.get("end"):
                for _ in range(self.slots):
                    self.jobs.put(None)
                if not stat.S_ISFIFO(os.fstat(stream.fileno()).st_mode):
                    return
            else:
                self.jobs.put(job)
            if self.stopping.is_set():
                return
        self.stop()

    def stop(self) -> None:
        """Start nothing more, and end what runs."""
        self.stopping.set()
        self.wake.set()

    def slot(self, number: int) -> None:
        while not self.stopping.is_set():
            try:
                job = self.jobs.get(timeout=2 * POLL_S)
            except queue.Empty:
                continue
            if job is None:
                break
            try:
                self.execute(job, number)
            except Exception as error:
                self.failure = "%s: %s" % (type(error).__name__, error)
                self.stop()
        self.wake.set()

    def execute(self, job: dict[str, Any], slot: int) -> None:
        """One run, from its folder to the line in the journal."""
        with self.lock:
            folder = os.path.join(self.folder, str(next(self.numbers)))
        began = time.time()
        try:
            process = start(job, folder)
        except (OSError, ValueError) as error:
            self.journal.write(**self.report(job, slot, folder, began, error=explain(error)))
            return
        running = Running(job, folder, process)
        with self.lock:
            self.running[running.pid] = running
        self.journal.write(event="start", execution=job["execution"], pid=running.pid, born=birth(running.pid))
        if running.limited or self.stopping.is_set():
            self.wake.set()
        status, usage = await_end(running)
        process.returncode = status
        with self.lock:
            del self.running[running.pid]
        end_orphans(job["execution"], running.pid)
        ended = time.time()
        for name in ("home", "tmp"):
            shutil.rmtree(os.path.join(folder, name), ignore_errors=True)
        outputs = list(survey(os.path.join(folder, "output")))
        allowed = running.limits.get("output_bytes")
        if running.stopped is None and allowed is not None and size_of(folder) > allowed:
            running.stopped = "output"
        self.journal.write(
            **self.report(
                job,
                slot,
                folder,
                began,
                ended=ended,
                exit_code=os.WEXITSTATUS(status) if os.WIFEXITED(status) else None,
                signal=os.WTERMSIG(status) if os.WIFSIGNALED(status) else None,
                stopped=running.stopped,
                user_s=usage.ru_utime,
                system_s=usage.ru_stime,
                max_rss_bytes=usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024),
                outputs=outputs,
            )
        )

    def report(self, job: dict[str, Any], slot: int, folder: str, began: float, **fields: Any) -> dict[str, Any]:
        report = {
            "event": "end",
            "run": job["run"],
            "execution": job["execution"],
            "directory": folder,
            "started": began,
            "ended": time.time(),
            "exit_code": None,
            "signal": None,
            "stopped": None,
            "user_s": 0.0,
            "system_s": 0.0,
            "max_rss_bytes": 0,
            "host": self.host,
            "slot": slot,
            "outputs": [],
            "error": None,
        }
        report.update(fields)
        return report

    def watch(self) -> float:
        """Enforce what is due; the seconds until something may be due again (None: until woken)."""
        with self.lock:
            running = list(self.running.values())
        now = time.monotonic()
        due = []
        for one in running:
            if self.stopping.is_set():
                one.stop("interrupted")
            deadline = one.deadline()
            if deadline is not None and now >= deadline:
                one.stop("timeout")
            if one.measured and one.stopped is None and now - one.started > POLL_S / 2:
                reason = exceeded(one)
                if reason:
                    one.stop(reason)
            if one.kill_at is not None and now >= one.kill_at:
                one.kill()
            times = [one.kill_at, deadline if one.stopped is None else None]
            if one.measured:
                times.append(now + POLL_S)
            due += [moment for moment in times if moment is not None]
        if running or self.stopping.is_set():
            due.append(now + 1.0)
        else:
            due.append(now + POLL_S)
        return max(0.005, heapq.nsmallest(1, due)[0] - time.monotonic())


def start(job: dict[str, Any], folder: str) -> subprocess.Popen[bytes]:
    """Make the run's folder and start its program there."""
    os.mkdir(folder)
    for name in FOLDERS:
        os.mkdir(os.path.join(folder, name))
    for name, content in job["files"].items():
        with open(os.path.join(folder, name), "xb") as file:
            file.write(base64.b64decode(content))
    environment = {name: value.replace("\0", folder) for name, value in job["environment"].items()}
    flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC
    out = os.open(os.path.join(folder, "stdout"), flags, 0o644)
    err = os.open(os.path.join(folder, "stderr"), flags, 0o644)
    try:
        return subprocess.Popen(
            [word.replace("\0", folder) for word in job["argv"]],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            cwd=os.path.join(folder, "output"),
            env=environment,
            start_new_session=True,
        )
    finally:
        os.close(out)
        os.close(err)


def await_end(running: Running) -> tuple[int, Any]:
    """Wait for the program's end, kill what is left of its group, and only then give its process id back.

    Where the program was asked to end, what it had started keeps the rest of the grace time.
    """
    if hasattr(os, "waitid"):
        os.waitid(os.P_PID, running.pid, os.WEXITED | os.WNOWAIT)
        while running.kill_at is not None and any(group_of(pid) == running.pid for pid in orphans()):
            time.sleep(POLL_S / 10)
        with running.lock:
            running.over = True
            signal_group(running.pid, signal.SIGKILL)
    _, status, usage = os.wait4(running.pid, 0)
    running.over = True
    return status, usage


def survey(root: str) -> Iterator[dict[str, Any]]:
    """Each regular file below `root`, hashed, in the order of its path. Links are not followed."""
    found = []
    pending = [root]
    while pending:
        folder = pending.pop()
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    pending.append(entry.path)
                elif entry.is_file(follow_symlinks=False):
                    found.append(entry.path)
    for path in sorted(found):
        yield describe(path, os.path.relpath(path, root))


def describe(path: str, name: str) -> dict[str, Any]:
    digest, size, lines, last, head = hashlib.sha256(), 0, 0, b"\n", None
    with open(path, "rb", buffering=0) as file:
        while True:
            chunk = file.read(CHUNK)
            if not chunk:
                break
            if head is None:
                head = chunk[:HEAD_BYTES].split(b"\n", 1)[0]
            digest.update(chunk)
            size += len(chunk)
            lines += chunk.count(b"\n")
            last = chunk[-1:]
    return {
        "path": name,
        "bytes": size,
        "sha256": digest.hexdigest(),
        "lines": lines,
        "ended": last == b"\n",
        "head": (head or b"").decode("utf-8", "replace"),
    }


def exceeded(running: Running) -> str | None:
    """The name of the limit that a program is over, or None."""
    limits = running.limits
    if limits.get("memory_bytes") is not None or limits.get("cpu_s") is not None:
        memory, cpu = usage_of(descendants(running.pid))
        if limits.get("memory_bytes") is not None and memory > limits["memory_bytes"]:
            return "memory"
        if limits.get("cpu_s") is not None and cpu > limits["cpu_s"]:
            return "cpu"
    if limits.get("output_bytes") is not None and size_of(running.folder) > limits["output_bytes"]:
        return "output"
    return None


def size_of(folder: str) -> int:
    """Bytes of all files below a folder, as far as they can be read."""
    total = 0
    for root, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(root, name)).st_size
            except OSError:
                continue
    return total


def descendants(pid: int) -> list[int]:
    """A process and all that it started, as far as /proc tells."""
    found = [pid]
    for parent in found:
        try:
            tasks = os.listdir("/proc/%d/task" % parent)
        except OSError:
            continue
        for task in tasks:
            found += children("/proc/%d/task/%s/children" % (parent, task))
    return found


def children(path: str) -> list[int]:
    try:
        with open(path) as file:
            return [int(word) for word in file.read().split()]
    except OSError:
        return []


def usage_of(pids: list[int]) -> tuple[int, float]:
    """Resident bytes and CPU seconds (their ended children's too) of processes."""
    page, tick = os.sysconf("SC_PAGE_SIZE"), os.sysconf("SC_CLK_TCK")
    memory, cpu = 0, 0.0
    for pid in pids:
        fields = stat_of(pid)
        if fields:
            memory += int(fields[21]) * page
            cpu += sum(int(field) for field in fields[11:15]) / tick
    return memory, cpu


def stat_of(pid: int) -> list[bytes]:
    """The fields of /proc/PID/stat after the program's name; empty where there is no such process."""
    try:
        with open("/proc/%d/stat" % pid, "rb") as file:
            return file.read().rpartition(b")")[2].split()
    except OSError:
        return []


def birth(pid: int) -> int | None:
    """When a process was started, in clock ticks since boot: with its id, it names one process for ever."""
    fields = stat_of(pid)
    return int(fields[19]) if fields else None


def end_orphans(execution: str | None, group: int | None = None) -> None:
    """Kill what has left its group: orphans of one execution, or (None) all of them.

    Orphans are children of this process's main thread. One whose environment does not say whose it is
    belongs to nobody, and is ended with the worker.
    """
    give_up = time.monotonic() + SETTLE_S
    while time.monotonic() < give_up:
        mine = [pid for pid in orphans() if execution is None or belongs(pid, execution, group)]
        if not mine:
            return
        for pid in mine:
            signal_process(pid, signal.SIGKILL)
            try:
                os.waitpid(pid, 0)
            except ChildProcessError:
                continue


def orphans() -> list[int]:
    """The children of the main thread, which has none of its own."""
    return children("/proc/self/task/%d/children" % os.getpid())


def group_of(pid: int) -> int | None:
    fields = stat_of(pid)
    return int(fields[2]) if fields else None


def belongs(pid: int, execution: str, group: int | None) -> bool:
    if group_of(pid) in (None, group):
        return True
    try:
        with open("/proc/%d/environ" % pid, "rb") as file:
            return b"SIERRA_EXECUTION=" + execution.encode() in file.read().split(b"\0")
    except OSError:
        return False


def signal_group(pid: int, number: int) -> None:
    try:
        os.killpg(pid, number)
    except (ProcessLookupError, PermissionError):
        pass


def signal_process(pid: int, number: int) -> None:
    try:
        os.kill(pid, number)
    except (ProcessLookupError, PermissionError):
        pass


def explain(error: BaseException) -> str:
    name = getattr(error, "filename", None)
    if isinstance(name, bytes):
        name = os.fsdecode(name)
    reason = getattr(error, "strerror", None) or str(error)
    return "%s: %s" % (name, reason) if name else reason


def become_subreaper() -> None:
    """Ask to be told of orphans, and to be ended with the process that started this one (Linux only)."""
    if sys.platform != "linux":
        return
    try:
        import ctypes

        libc = ctypes.CDLL(None, use_errno=True)
        set_child_subreaper, set_parent_death_signal = 36, 1
        libc.prctl(set_child_subreaper, 1, 0, 0, 0)
        libc.prctl(set_parent_death_signal, signal.SIGTERM, 0, 0, 0)
    except (ImportError, OSError, AttributeError):
        pass


def main(arguments: list[str]) -> int:
    folder, slots = arguments
    become_subreaper()
    worker = Worker(os.path.abspath(folder), int(slots))

    signal.signal(signal.SIGTERM, lambda number, frame: worker.stop())
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    finished = worker.work(sys.stdin)
    if worker.failure:
        sys.stderr.write("worker: %s\n" % worker.failure)
        return 3
    return 0 if finished else 1


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stdout.flush()
    os._exit(code)
