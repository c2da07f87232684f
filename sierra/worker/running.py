"""A running program: its start, its processes, its limits and its end.

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

A job may have a `client`, which starts a container engine. The client is then executed instead of the job's own argv, in its
own environment. The run's processes are those with SIERRA_EXECUTION in their environment, wherever the engine starts them.
Their use of resources is measured from outside, at intervals of a twentieth of the time that they have run; if they end before
the first measurement, it is unknown (null).
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING

from sierra.worker import program
from sierra.worker.files import size_of, size_of_file
from sierra.worker.job import GRACE_S, Job, is_conducted, with_folder
from sierra.worker.journal import ENDING, Announce, Usage
from sierra.worker.layout import LOGS
from sierra.worker.marker import Marker
from sierra.worker.processes import (
    POLL_S,
    SAMPLE_S,
    belongs_to,
    birth,
    cpu_of,
    descendants,
    environment_of,
    has_ended,
    is_alive,
    is_alive_in,
    number_in,
    orphans,
    peak_of,
    signal_group,
    signal_process,
    state_of,
    still_running,
    usage_of,
)

if TYPE_CHECKING:
    from resource import struct_rusage

    from sierra.worker.file_trace import Observation
    from sierra.worker.nvml import GpuUsage
    from sierra.worker.shared_services import SharedServices

LOG_BYTES = 256 << 20  # limit for standard output and for standard error, independent of the configured limits
START_S = 60.0  # for an engine to start a container
MARKED = "marker"  # why a run was stopped that counts as ended by itself
STALLED_S = 5.0  # with only stopped processes, until a run is reported as stalled


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
        self.checkpoint = job["claim"]["path"] if "claim" in job else None
        """The folder of its checkpoint, if that is not in its folder."""
        self.pid = process.pid
        self.limits = job["limits"]
        self.client = with_folder(job["client"], folder) if "client" in job else None
        self.meter = Meter(self) if self.client else None
        self.gpu_usage: GpuUsage | None = None
        self.measured = any(self.limits.get(name) is not None for name in ("cpu_s", "memory_bytes", "output_bytes"))
        watched = self.limits.get("after_marker_s") is not None and not self.conducted
        self.marker: Marker | None = Marker(folder, self.limits) if watched else None
        self.left: list[str] = []
        """The names of processes that still ran when its program had ended by itself."""
        self.limited = self.measured or self.marker is not None or self.limits.get("wall_s") is not None
        self.started = time.monotonic()
        self.stopped: str | None = None
        self.kill_at: float | None = None
        self.look_at = self.continue_at = self.started + 1.0
        self.stalled_since: float | None = None
        self.switches: dict[int, int] = {}
        """Number of times that each traced process had left its processor at the last look."""
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
                    if state_of(pid) in (b"T", b"t"):  # t: under a tracer
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
            self.left = still_running(lambda: filter(is_alive, self.orphans()))

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
        if not self.meter and not self.conducted and state_of(self.pid) not in (b"T", b"t"):
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
        state = state_of(pid)
        if state != b"t" or self.observation is None:
            return state
        tracer, switches = number_in(pid, b"TracerPid:"), number_in(pid, b"voluntary_ctxt_switches:")
        before, self.switches[pid] = self.switches.get(pid), switches
        asleep = self.is_tracer(tracer) and state_of(tracer) == b"S"
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


def start(
    job: Job, folder: str, observation: Observation | None = None, services: SharedServices | None = None
) -> subprocess.Popen[bytes]:
    """Start a run's program in its folder."""
    started = with_folder(job.get("client", job), folder)
    output = os.path.join(folder, "output")
    argv = started["argv"]
    conducted = is_conducted(job) and "client" not in job
    if conducted:
        argv = program.words("conductor", folder, *argv[1:])
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
            pass_fds=(job["claim"]["lock"],) if "claim" in job else (),
        )
    finally:
        os.close(out)
        os.close(err)


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
    places = (running.folder, running.temporary, running.checkpoint)
    if output_limit is not None and sum(size_of(path) for path in places if path) > output_limit:
        return "output"
    if any(size_of_file(os.path.join(running.folder, name)) > LOG_BYTES for name in LOGS):
        return "output"
    return None
