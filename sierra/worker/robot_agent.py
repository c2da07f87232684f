"""The agent: executes runs on one robot for a driver, and ends them if it hears no more of that driver.

A driver starts it by SSH, from the file that `sierra.extensions.robots.push` has copied to the robot:

    worker.pyz robot_agent FOLDER LOCK

Both sides exchange lines of JSON: the driver sends requests (`do`), the agent answers with events (`event`).

| `do` | answer | meaning |
|---|---|---|
| `hello` | `hello` or `refused` | lock the robot, end leftovers, execute the setup line, the stop command and a first program |
| `check` | `checked` | measure battery and disk; before a run, also read firmware and calibration, and execute the checks |
| `watch` | `watching` | begin to watch the wall clock (see `clock_watch`) |
| `clock` | `clock` | the wall clock, in ns |
| `watched` | `watched` | how even the wall clock was since `watch` |
| `arm` | `armed` or `refused` | make the run's folder, and start its worker and its container, which wait |
| `at` | `gated`, `late`, `refused` | start the run at this time (ns) of this robot's clock, if nobody set it since |
| `stop` | (`ended`) | end the run |
| `pull` | `data`, …, `pulled` | send a folder: the lines of `remote_folder` for `pull`, in pieces, as base64 |
| `done` | `removed` | remove the run's folder |
| `beat` | `beat` | the driver lives |
| `bye` | | give the robot back |

A request may have an `id`, which its answer repeats. The events `started` and `ended` come by themselves.

*Lock*: an abstract socket with the name LOCK. Only one process of a host can have it, of whatever user, and the kernel frees it
when that process ends. Whoever finds it taken connects to it, and reads who has it.

*Lease*: each byte of the driver renews it. If it has expired by the monotonic clock, or if the input has ended, nothing more
starts, a run is ended as by `stop`, and the agent ends. Therefore nothing is left to start later, also after a reboot.

*Standstill*: the agent owns the stop command of the robot. It executes the command

- at each `hello`: a robot whose command fails is refused
- at the first sign of an end, whoever or whatever ends the run: the driver, the lease, a limit, the program itself, a signal. A
  worker announces what it sees before it does anything else
- once more when the last process of the run is gone, because processes may have moved the robot since

At an end, nothing that can fail stands before the command: no file, no disk, no other process. One execution follows the other.
If the last one has failed, the robot may be moving: `ended` says so. If the agent is killed, its `Guard` does the same. After a
power cut or a restart, the next `hello` does, because motors may have a controller with power of its own, which obeys the last
command.

*End*: SIGTERM to the run (by its worker), and SIGKILL after the grace time. All processes that a run started are found: the
worker is their subreaper, and the agent is that of the worker.

A run's folder is FOLDER/runs/ATTEMPT. It has `process.json` from the time when the run is armed, and `ended.json` at its end.
An attempt whose folder exists is never started again. A worker executes one run after the other, until it has to end one.
"""

from __future__ import annotations

import base64
import collections
import contextlib
import errno
import io
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from typing import Any, Callable, Collection, Dict, Mapping, Sequence

from sierra.worker import machine, on_host, program, remote_folder
from sierra.worker.clock_watch import ClockWatch
from sierra.worker.containers import end_container
from sierra.worker.errors import explain
from sierra.worker.files import entries_of, last_line_of, remove, size_of, write_all
from sierra.worker.job import with_folder
from sierra.worker.journal import BEGUN, ENDING, GONE, OVER, READY
from sierra.worker.processes import (
    adopt_orphans,
    birth,
    descendants,
    is_ending,
    marked,
    orphans,
    read_proc,
    release,
    signal_group,
    signal_process,
    stat_of,
    stdin_of,
)
from sierra.worker.robot_condition import Condition
from sierra.worker.robot_software import Looker
from sierra.worker.worker import FULL, execute

Record = Dict[str, Any]

RUNS = "runs"
FIRST = "1"  # the folder in which a worker executes its only run
WORKER = "worker"  # the only argument of a worker
PROCESS, ENDED, WORKER_LOG = "process.json", "ended.json", "worker.log"
PROBE = "probe"  # the name of a run that only shows that runs can be executed
LEASE_S, GRACE_S, STOP_S = 5.0, 2.0, 5.0
SETUP_S = 60.0
PROBE_S = 30.0
GUARD_S = 60.0  # for the guard of an agent that was killed
IMMORTAL_S = 10.0  # for killed processes, until the run is reported although they are there
IMMORTAL = "a process of the run cannot be ended"
MOST_STOPS = 5  # when no process is left: one execution, and more if it leaves processes itself
HANG_S = 1.0  # for killed processes to be gone, before the stop command is executed nevertheless
SETTLE_S = 3.0  # after the grace time, for a worker to end what it has killed, and to hash the outputs of others
LOOK_S = 0.1  # between two looks at a run, and at the clocks
SILENT_S = 1.0  # for a holder of the lock that says nothing, because it is ending
SOON_S = 60.0  # a start that is farther away is a mistake
STEP_S = 0.05  # of the wall clock after its measurement, from which on nothing starts
TAIL_BYTES = 400
MOST_UNSENT = 1 << 22
PIECE = 1 << 16  # bytes of a folder in one message
LARGE = 1 << 20  # bytes of a folder that an agent does not send, because base64 makes it longer
PASSING = (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)  # reasons why a program cannot be started that pass
LEFT_OUT = ("_", "SHLVL", "PWD", "OLDPWD")  # variables that a shell sets


class Refused(Exception):
    """A request that cannot be fulfilled, with the reason in one line, and the part of a `hello` that it is about."""

    def __init__(self, reason: str, about: str = "") -> None:
        super().__init__(reason)
        self.about = about


class Standstill:
    """The stop command of a robot. Each demand is fulfilled by an execution that begins after it, one after the other."""

    def __init__(self, argv: Sequence[str] = (), environment: Mapping[str, str] | None = None, limit: float = STOP_S) -> None:
        """`argv`: the command; empty: the robot needs none. `limit`: the seconds that it may take."""
        self.argv = argv
        self.environment = environment
        self.limit = limit
        self.problem: str | None = None
        """Why the last execution has failed; None if it has not."""
        self.problems: list[str] = []
        """Why executions have failed since this list was emptied."""
        self.demanded = False
        self.process: subprocess.Popen[bytes] | None = None
        self.retry_until = self.kill_at = 0.0
        """Until when a failed start is tried again, and when an execution takes too long."""
        self.said = b""
        self.null = os.open(os.devnull, os.O_RDWR)

    @property
    def pid(self) -> int:
        """Return the process of the command; 0 if it does not execute."""
        return self.process.pid if self.process else 0

    def demand(self) -> None:
        """Execute the command as soon as an execution that has begun before has ended."""
        if self.argv:
            self.demanded, self.retry_until = True, time.monotonic() + self.limit
            self.look()

    @property
    def busy(self) -> bool:
        """Return whether an execution has begun or is demanded."""
        return self.process is not None or self.demanded

    def look(self) -> bool:
        """Start or end executions that are due; return whether nothing is left to do."""
        if self.process is not None and self.has_ended(self.process):
            self.process = None
        if self.process is None and self.demanded:
            self.start()
        return not self.busy

    def execute(self) -> str | None:
        """Execute the command, and wait for its end; return why it has failed."""
        self.demand()
        while not self.look():
            select.select((), (), (), LOOK_S / 20)  # a clock that tests replace makes time.sleep fail
        return self.problem

    def start(self) -> None:
        try:
            self.process = subprocess.Popen(
                self.argv,
                stdin=self.null,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=self.environment,
                start_new_session=True,
            )
        except (OSError, ValueError) as error:
            if getattr(error, "errno", None) in PASSING and time.monotonic() < self.retry_until:
                return  # it is tried again
            self.demanded = False
            self.note("cannot be started: " + explain(error))
            return
        self.demanded, self.said, self.kill_at = False, b"", time.monotonic() + self.limit
        os.set_blocking(output_of(self.process), False)

    def has_ended(self, process: subprocess.Popen[bytes]) -> bool:
        """Return whether an execution has ended; ends it if it takes too long."""
        status = process.poll()
        with contextlib.suppress(BlockingIOError):  # it could not end if nobody read what it prints
            while data := os.read(output_of(process), 1 << 16):
                self.said = (self.said + data)[-TAIL_BYTES:]
        if status is None and time.monotonic() < self.kill_at:
            return False
        kill_all(process.pid)
        process.wait()
        close_pipes(process)
        words = self.said.decode("utf-8", "replace").strip().splitlines()[-1:]
        if status is None:
            self.note("did not end within %g s" % self.limit)
        else:
            self.note(": ".join(["ended with %s" % ending(status), *words]) if status else None)
        return True

    def note(self, problem: str | None) -> None:
        self.problem = problem and "the stop command " + problem
        if self.problem and self.problem not in self.problems:
            self.problems.append(self.problem)


class Guard:
    """A second process, which brings the robot to a standstill if the agent is killed while it has a run.

    The agent gives it the record of the run that it has, or an empty line if it has none any more.
    """

    def __init__(self, standstill: Standstill) -> None:
        """Start the process. Raises OSError."""
        own, self.pipe = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            with contextlib.suppress(BaseException):
                guard(own, standstill)
            os._exit(0)
        os.close(own)

    def is_alive(self) -> bool:
        return is_running(self.pid)

    def tell(self, run: Record | None) -> None:
        with contextlib.suppress(OSError):  # it is gone; there is a new one with the next run
            write_all(self.pipe, (json.dumps(run) if run else "").encode() + b"\n")

    def close(self) -> None:
        """End the process. The agent must not have a run."""
        os.close(self.pipe)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self.pid, 0)


def guard(pipe: int, standstill: Standstill) -> None:
    """Wait until the agent is gone. If it has a run then, end this as the agent would, with the stop command."""
    os.setsid()
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    signal.set_wakeup_fd(-1)
    keep_open(pipe, standstill.null)
    with open(pipe, "rb") as lines:
        told = collections.deque(lines, maxlen=1)
    if told and told[0].strip():
        standstill.demand()
        try:
            end_run(json.loads(told[0]), standstill)
        finally:  # the line is cut off if the agent was killed while it wrote it, before the run was armed
            standstill.execute()


def end_run(run: Record, standstill: Standstill) -> None:
    """Wait until the worker has ended a run, as it does if its agent is gone, and end what is left after its grace time."""
    give_up = time.monotonic() + run["grace"] + SETTLE_S
    while is_running(run["pid"], run["born"]) and time.monotonic() < give_up:
        standstill.look()
        select.select((), (), (), LOOK_S / 20)
    end_processes_of(run)
    if run["client"]:
        standstill.execute()  # the engine may take long
        end_container(run["client"])


class Sending:
    """A folder that is sent to the driver by a process of its own, so that the agent stays attentive."""

    def __init__(self, line: str) -> None:
        """Start the process. `line` is the request of `remote_folder.pull`. Raises OSError."""
        self.pipe, out = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            with contextlib.suppress(BaseException):
                signal.set_wakeup_fd(-1)
                keep_open(out)
                with open(out, "wb") as file:
                    remote_folder.serve("pull", io.BytesIO(line.encode() + b"\n"), file)
            os._exit(0)
        os.close(out)

    def next(self) -> bytes:
        """Return the next piece; nothing at the end."""
        return os.read(self.pipe, PIECE)

    def close(self) -> None:
        os.close(self.pipe)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self.pid, 0)


def keep_open(*descriptors: int) -> None:
    """Close all other files of this process, which was forked. Standard input and output lead nowhere then."""
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    for descriptor in [int(name) for name in os.listdir("/proc/self/fd")]:
        if descriptor > 2 and descriptor not in descriptors:
            with contextlib.suppress(OSError):  # of that listing
                os.close(descriptor)


class Serving:
    """A worker as a process, which executes one run after the other until one of them has to be ended."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Start it; it waits for the folder of a run (see `become_worker`). Raises OSError."""
        self.process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-B", program.PROGRAM, "robot_agent", WORKER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=dict(environment),
            start_new_session=True,
        )
        self.pid = self.process.pid
        os.set_blocking(self.pipe, False)

    @property
    def pipe(self) -> int:
        """Return where it announces the states of a run."""
        return output_of(self.process)

    def is_alive(self) -> bool:
        return self.process.poll() is None

    def announced(self) -> str:
        """Return the states that it has announced since the last call."""
        try:
            return os.read(self.pipe, 1 << 10).decode("ascii", "replace")
        except (BlockingIOError, ValueError):
            return ""

    def end(self) -> None:
        """End it with all that it has started."""
        kill_all(self.pid)
        self.process.wait()
        close_pipes(self.process)


class Run:
    """One run on this robot, from arming to its end."""

    def __init__(
        self,
        folder: str,
        order: Record,
        worker: Serving,
        standstill: Standstill,
        grace: float,
        spared: Collection[int] = (),
        guard: int | None = None,
    ) -> None:
        """Make its folder, and let a worker prepare the job and wait for its moment. Raises OSError.

        `spared` are processes of the agent that belong to no run; `guard` is its guard.
        """
        self.folder = folder
        self.spared = spared
        self.attempt: str = order["attempt"]
        self.job: Record = order["job"]
        self.worker = worker
        self.standstill = standstill
        self.grace = grace
        self.states: set[str] = set()
        """The states that its worker has announced."""
        self.gated = self.reported = self.ending = self.over = self.last_stop = False
        self.owed = True
        """True if the stop command must be executed once more when no process is left."""
        self.stops = 0
        """The number of executions after the last process was gone."""
        self.give_up: float | None = None
        """When processes that were killed are not waited for any more."""
        self.immortal = False
        """True if a process of the run cannot be ended."""
        self.armed: Record | None = {"event": "armed", "attempt": self.attempt, "id": order.get("id")}
        """The answer to the order, until the worker is ready for the job."""
        self.why: str | None = None
        self.kill_at: float | None = None
        self.problems: list[str] = []
        standstill.problems = []
        os.makedirs(os.path.dirname(folder), exist_ok=True)
        os.mkdir(folder)
        self.client = with_folder(self.job["client"], os.path.join(folder, FIRST)) if "client" in self.job else None
        self.known: Record = {
            "pid": worker.pid,
            "born": birth(worker.pid),
            "boot": boot_id(),
            "executions": [self.job["execution"]],
            "client": self.client,
            "who": order.get("who"),
            "execution": self.job["execution"],
            "place": order.get("place"),
            "grace": grace,
            "guard": guard,
        }
        """The data with which another process can end the run."""
        write_whole(os.path.join(folder, PROCESS), self.known)
        self.tell_worker({"folder": folder}, {**self.job, "waits": True})

    def begin(self, moment: float, wall: float) -> None:
        """Let the worker start the program at this moment of the monotonic clock, which is this one of the wall clock."""
        self.gated = True
        self.tell_worker({"begin": moment, "wall": wall}, {"end": True})

    def tell_worker(self, *records: Record) -> None:
        try:
            pipe = stdin_of(self.worker.process)
            for record in records:
                pipe.write(json.dumps(record, separators=(",", ":")).encode() + b"\n")
            pipe.flush()
        except OSError as error:
            self.problems.append("its worker is gone: " + explain(error))

    def end(self, why: str) -> None:
        """Tell the run to end. The first reason counts."""
        if self.why is not None or self.over:
            return
        self.why = why
        self.begin_end()
        self.kill_at = time.monotonic() + self.grace + SETTLE_S
        self.worker.process.terminate()

    def begin_end(self) -> None:
        """Demand a standstill at the first sign of an end."""
        if not self.ending:
            self.ending = True
            self.demand_standstill()

    def demand_standstill(self) -> None:
        """Demand a standstill, if the program may have begun."""
        if self.gated:
            self.standstill.demand()

    def look(self, now: float) -> bool:
        """Look at the run; return whether it has ended, with all of its processes, and the stop command after them."""
        gone = not self.worker.is_alive()
        self.hear()
        if not self.over and self.kill_at is not None and now >= self.kill_at:
            self.kill()
        if not self.over and (gone or OVER in self.states):
            self.over = True
            self.give_up = self.give_up or now + HANG_S
        if not self.over or self.end_remains():
            if not self.is_hanging(now):
                self.standstill.look()
                return False
        elif self.owed and self.stops < MOST_STOPS:
            self.owed = False
            self.stops += 1
            self.demand_standstill()
        return self.standstill.look()

    def is_hanging(self, now: float) -> bool:
        """Return whether processes have survived SIGKILL for too long. Before, demand a standstill in spite of them, once."""
        if self.give_up is None or now < self.give_up:
            return False
        if not self.last_stop:
            self.last_stop = True
            self.demand_standstill()
        self.immortal = now >= self.give_up + IMMORTAL_S
        return self.immortal

    def kill(self) -> None:
        """Kill the worker and all that it has started."""
        kill_all(self.worker.pid)
        if self.give_up is None:
            self.owed = True
            if self.client:  # which the worker did not do
                end_container(self.client)
            self.give_up = time.monotonic() + HANG_S

    def hear(self) -> None:
        """Take what the worker announces, and react to the first sign of an end, and to the last process being gone."""
        announced = self.worker.announced()
        self.states.update(announced)
        if ENDING in announced:
            self.begin_end()
        if GONE in announced:
            self.owed = False
            self.demand_standstill()

    def end_remains(self) -> bool:
        """Kill the processes that the run has left; return whether one was alive."""
        alive = end_children({self.standstill.pid, self.worker.pid, *self.spared})
        if self.worker.is_alive():  # it says that none is left
            for pid in descendants(self.worker.pid):
                if pid != self.worker.pid and is_running(pid):
                    alive = True
                    kill_all(pid)
        self.owed = self.owed or alive
        return alive

    def events(self) -> list[Record]:
        return events_in(self.folder)

    def has_begun(self) -> bool:
        """Return whether its program was started."""
        return BEGUN in self.states or has_begun(self.events())

    def record(self) -> Record | None:
        """Return the worker's report on the run's end; None without one."""
        ends = [event for event in self.events() if event["event"] == "end"]
        return ends[-1] if ends else None

    def ended(self) -> Record:
        """Return the report on the run's end."""
        record = self.record()
        begun = self.has_begun()
        if record is None and (begun or self.why is None):
            self.problems.append(self.failure_of_worker())
        return {
            "attempt": self.attempt,
            "started": begun,
            "why": self.why,
            "end": record,
            "problems": [*self.problems, *self.standstill.problems, *([IMMORTAL] if self.immortal else [])],
            "moving": (IMMORTAL if self.immortal else self.standstill.problem) if self.gated else None,
        }

    def failure_of_worker(self) -> str:
        """Return why the worker has left no report."""
        status = self.worker.process.returncode
        if status == FULL:
            return "its disk is full"
        line = last_line_of(os.path.join(self.folder, WORKER_LOG), TAIL_BYTES)
        return "its worker ended with %s%s" % (ending(status or 0), ": " + line if line else "")


class Agent:
    """One robot at the service of one driver."""

    def __init__(self, folder: str, lock: str) -> None:
        self.folder = folder
        self.lock_name = lock
        self.lock: socket.socket | None = None
        self.who: Record = {}
        self.lease = LEASE_S
        self.grace = GRACE_S
        self.standstill = Standstill()
        self.guard: Guard | None = None
        self.condition = Condition({}, {})
        self.environment: dict[str, str] = {}
        self.looker = Looker()
        self.watch = ClockWatch()
        self.run: Run | None = None
        self.spare: Serving | None = None
        self.sending: tuple[int, Sending] | None = None
        """The folder that is sent, with the number of its request."""
        self.heard = time.monotonic()
        self.leaving: str | None = None
        self.terminated = False
        self.unread = bytearray()
        self.unsent = bytearray()
        self.wake, wake = os.pipe()
        for end in (self.wake, wake, 1):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)

    def serve(self) -> None:
        """Serve the driver until it says good-bye, or is not heard of any more."""
        while not (self.leaving and self.run is None and self.standstill.look()):
            self.wait(self.until_next())
            now = time.monotonic()
            self.watch.look()
            if self.terminated:
                self.leave("a signal has ended the agent")
            if not self.leaving and now - self.heard > self.lease:
                self.leave("lost the driver: it was not heard of for %g s" % self.lease)
            self.attend(now)
        self.write(0.2)

    def until_next(self) -> float:
        """Return the seconds until something must be done, whatever the driver does."""
        now = time.monotonic()
        run = self.run
        if run is None:
            return max(0.0, min(1.0, self.heard + self.lease - now + 0.001))
        return LOOK_S / 20 if run.why or run.over or run.standstill.busy else LOOK_S

    def wait(self, seconds: float) -> None:
        """Wait so long, or until there is a request, and execute all requests."""
        reading: list[Any] = [self.wake, *([] if self.leaving else [0]), *([self.lock] if self.lock else [])]
        reading += [self.run.worker.pipe] if self.run and not self.run.over else []
        reading += [self.sending[1].pipe] if self.sending and len(self.unsent) < MOST_UNSENT // 2 else []
        ready, writable, _ = select.select(reading, [1] if self.unsent else [], [], seconds)
        if self.wake in ready:
            os.read(self.wake, 4096)
        if writable:
            self.write()
        if self.lock in ready:
            self.say_who()
        if self.sending and self.sending[1].pipe in ready:
            self.send_piece(*self.sending)
        if 0 in ready:
            self.read()

    def read(self) -> None:
        data = os.read(0, 1 << 20)
        if not data:
            self.leave("lost the driver: its connection has ended")
            return
        self.heard = time.monotonic()
        self.unread += data
        if b"\n" not in data:
            return
        *lines, rest = self.unread.split(b"\n")
        self.unread = bytearray(rest)
        for line in lines:
            if not self.leaving:
                self.handle(json.loads(line))
        self.heard = time.monotonic()  # also after a request that took long

    def handle(self, request: Record) -> None:
        """Execute a request, and send its answer."""
        try:
            answer = self.answer(request)
        except Refused as error:
            answer = {"event": "refused", "reason": str(error), "about": error.about}
        except (OSError, ValueError) as error:
            answer = {"event": "refused", "reason": explain(error)}
        if answer is not None:
            self.tell({**answer, "id": request.get("id")})

    def answer(self, request: Record) -> Record | None:
        """Execute a request, and return its answer. Raises Refused, OSError, ValueError."""
        known: dict[str, Callable[[Record], Record | None]] = {
            "hello": self.hello,
            "check": self.check,
            "watch": self.begin_watch,
            "clock": lambda _: {"event": "clock", "wall": time.time_ns()},
            "watched": lambda _: {"event": "watched", **self.watch.course()._asdict()},
            "arm": self.arm,
            "at": self.at,
            "stop": self.stop,
            "pull": self.pull,
            "done": self.done,
            "beat": lambda _: {"event": "beat"},
            "bye": lambda _: self.leave("the driver has ended it"),
        }
        if request["do"] not in known:
            raise Refused("unknown request %r" % request["do"])
        return known[request["do"]](request)

    def hello(self, request: Record) -> Record:
        """Lock the robot, bring it to a standstill, end leftovers, and show that runs can be executed."""
        if self.run is not None:
            raise Refused("run %s is not over" % self.run.attempt)
        self.lease, self.grace = request.get("lease", LEASE_S), request.get("grace", GRACE_S)
        self.who = request["who"]
        self.acquire(time.monotonic() + request.get("patience", 0.0))
        leftovers = self.end_leftovers()
        before = dict(os.environ)
        given = request.get("variables", {})
        try:
            self.environment, refusal = with_setup(request.get("setup"), {**before, **given}), None
        except (Refused, OSError, ValueError) as error:
            self.environment, refusal = {**before, **given}, error
        self.stand(request.get("stop", ()), request.get("stop_limit", STOP_S))
        if refusal:
            raise refusal
        for left in leftovers:
            if left["client"]:
                end_container(left["client"])
        os.makedirs(self.folder, exist_ok=True)
        self.condition = Condition(request, self.environment)
        self.prepare_worker()
        self.probe()
        changed = [name for name, value in self.environment.items() if before.get(name) != value]
        names = {*changed, *given, "PATH"}  # the login may have the same value for a given one
        variables = {name: self.environment[name] for name in sorted(names & self.environment.keys())}
        return {
            "event": "hello",
            "folder": os.path.abspath(self.folder),
            "boot": boot_id(),
            "address": own_address(),
            "python": "%d.%d.%d" % sys.version_info[:3],
            "executable": sys.executable,
            "facts": machine.facts(),
            "utc_offset": utc_offset(self.environment.get("TZ")),
            "software": self.looker.news(self.environment),
            "home": os.path.expanduser("~"),
            "variables": variables,
            "leftovers": [{key: value for key, value in left.items() if key != "client"} for left in leftovers],
        }

    def stand(self, argv: Sequence[str], limit: float) -> None:
        """Execute the stop command, and be ready to do so at any time. Raises Refused if it fails."""
        if self.guard is not None:
            self.guard.close()
        self.guard = None
        self.standstill = Standstill(argv, self.environment, limit)
        if problem := self.standstill.execute():
            raise Refused("may be moving: " + problem, "stop")

    def probe(self) -> None:
        """Execute a program in the folder, as runs do. Raises Refused."""
        folder, program = (os.path.join(self.folder, name) for name in (PROBE, PROBE + ".sh"))
        remove(folder)
        with open(program, "w", encoding="ascii") as file:
            file.write("#!/bin/sh\n")
        os.chmod(program, 0o700)
        job = {"run": PROBE, "execution": PROBE, "argv": [program], "environment": {}, "files": {}, "limits": {}}
        run = Run(folder, {"attempt": PROBE, "job": job}, self.take_worker(), Standstill(), self.grace, self.spared())
        run.begin(time.monotonic(), time.time())
        give_up = time.monotonic() + PROBE_S
        while not run.look(time.monotonic()):
            if time.monotonic() > give_up:
                run.end("no program has ended within %g s" % PROBE_S)
            select.select([run.worker.pipe], [], [], LOOK_S / 20)
        self.keep_worker(run.worker)
        report = run.ended()
        remove(folder)
        os.unlink(program)
        end = report["end"]
        if end is None:
            raise Refused("cannot execute runs: %s" % (*report["problems"], report["why"])[0], "runs")
        if end["error"] or end["exit_code"] != 0:
            why = end["error"] or "its program ended with status %s" % end["exit_code"]
            raise Refused("cannot execute programs in %s: %s; set folder in [runners.robots]" % (self.folder, why), "runs")

    def acquire(self, give_up: float) -> None:
        """Lock the robot. An agent that is ending, or that of the same driver, is waited for. Raises Refused."""
        began = time.monotonic()
        while self.lock is None:
            lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                lock.bind("\0" + self.lock_name)
                lock.listen(8)
                lock.setblocking(False)
                self.lock = lock
            except OSError:
                lock.close()
                holder = self.holder()
                now = time.monotonic()
                own = holder.get("session") == self.who.get("session")
                if own and holder.get("robot") != self.who.get("robot"):
                    same = "is the same host as %s; each robot needs a host of its own" % holder.get("robot")
                    raise Refused(same, "lock") from None
                waits = now < give_up if holder.get("leaving") or own else not holder and now < began + SILENT_S
                if not waits:
                    text = holder.get("text") or "another process that holds its lock"
                    raise Refused("in use by %s" % text, "lock") from None
                time.sleep(LOOK_S)

    def holder(self) -> Record:
        """Return who holds the lock; empty if nobody says so."""
        with contextlib.suppress(OSError, ValueError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as lock:
            lock.settimeout(2.0)
            lock.connect("\0" + self.lock_name)
            with lock.makefile("rb") as file:
                who = json.loads(file.readline(1 << 16))
                return who if isinstance(who, dict) else {}
        return {}

    def say_who(self) -> None:
        """Tell another process who holds the lock."""
        with contextlib.suppress(OSError):
            if self.lock is not None:
                other, _ = self.lock.accept()
                with other:
                    other.setblocking(False)
                    other.send(json.dumps({**self.who, "leaving": bool(self.leaving)}).encode() + b"\n")

    def end_leftovers(self) -> list[Record]:
        """End what earlier agents left running; return a description of each of their runs, whose folders stay."""
        root = os.path.join(self.folder, RUNS)
        found = []
        for attempt in sorted(entries_of(root)):
            folder = os.path.join(root, attempt)
            record = read_record(os.path.join(folder, PROCESS)) or {}
            await_guard(record)
            ended = end_processes_of(record)
            report = read_record(os.path.join(folder, ENDED))
            known = {name: record.get(name) for name in ("who", "execution", "place", "client")}
            known["files"] = os.path.isdir(os.path.join(folder, FIRST))
            found.append({"attempt": attempt, "ended": ended, "report": report, **known})
        return found

    def check(self, request: Record) -> Record:
        """Measure battery (percent) and disk (bytes). Before a run, also describe the robot, and execute the checks."""
        found: Record = {"event": "checked", "failed": [], **self.condition.measured(self.folder)}
        if request.get("checks", True):
            described = self.condition.described()
            found = {**found, **described, "unread": {**found["unread"], **described["unread"]}}
            found["software"] = self.looker.news(self.environment)
        for path, state in request.get("unchanged", {}).items():
            if on_host.state(path)[1:] != state:
                found["failed"].append("%s has changed since it was verified" % path)
        return found

    def begin_watch(self, _: Record) -> Record:
        self.watch = ClockWatch()
        return {"event": "watching"}

    def arm(self, order: Record) -> Record | None:
        """Prepare a run. Raises Refused if another one is not over, or if this one was armed before."""
        if self.lock is None:
            raise Refused("arming needs a hello first")
        if self.run is not None:
            raise Refused("run %s is not over" % self.run.attempt)
        folder = os.path.join(self.folder, RUNS, order["attempt"])
        if os.path.lexists(folder):
            raise Refused("attempt %s was armed before" % order["attempt"])
        if self.guard is not None and not self.guard.is_alive():
            self.guard.close()
            self.guard = None
        self.guard = self.guard or Guard(self.standstill)
        worker = self.take_worker()
        try:
            order["who"] = self.who
            self.run = Run(folder, order, worker, self.standstill, self.grace, self.spared(), self.guard.pid)
        except OSError:
            worker.end()
            remove(folder)
            raise
        self.guard.tell(self.run.known)
        return None  # `attend` answers

    def spared(self) -> list[int]:
        """Return the processes of this agent that belong to no run."""
        return [*([self.guard.pid] if self.guard else []), *([self.sending[1].pid] if self.sending else [])]

    def prepare_worker(self) -> None:
        """Start the worker of the next run already, because a Python takes long to start."""
        if self.spare is not None:
            self.spare.end()  # it has the variables of an earlier setup line
        self.spare = None
        with contextlib.suppress(OSError):  # it is tried again for the run
            self.spare = Serving(self.environment)

    def take_worker(self) -> Serving:
        """Return a worker that waits for its folder. Raises OSError."""
        worker, self.spare = self.spare, None
        return worker if worker is not None and worker.is_alive() else Serving(self.environment)

    def keep_worker(self, worker: Serving) -> None:
        """Use a worker for the next run, too, unless it has ended with its last one."""
        if worker.is_alive():
            self.spare = worker
        else:
            worker.end()
            self.prepare_worker()

    def at(self, request: Record) -> Record:
        """Start the armed run at a time of this robot's wall clock (ns)."""
        run = self.run
        if run is None or run.armed or run.gated or run.why is not None or run.attempt != request["attempt"]:
            raise Refused("attempt %s is not armed" % request["attempt"])
        moved = self.watch.moved_ns() / 1e9
        if abs(moved) > STEP_S:
            raise Refused("its wall clock has moved by %+.3g s since it was measured, just before the start" % moved)
        wait = (request["at"] - self.watch.now_ns()) / 1e9
        if not 0 <= wait <= SOON_S:
            run.end("late")
            return {"event": "late", "by": -wait}
        run.begin(time.monotonic() + wait, request["at"] / 1e9)
        return {"event": "gated"}

    def stop(self, request: Record) -> Record | None:
        if self.run is not None and self.run.attempt == request["attempt"]:
            self.run.end(request["why"])
        return None

    def pull(self, request: Record) -> None:
        """Begin to send a folder. Raises Refused if another one is sent, or if it is large."""
        if self.sending is not None:
            raise Refused("it sends another folder")
        if size_of(json.loads(request["line"])[0]) > LARGE:
            raise Refused("the folder is large", "large")
        self.sending = request["id"], Sending(request["line"])

    def send_piece(self, number: int, sending: Sending) -> None:
        piece = sending.next()
        if piece:
            self.tell({"event": "data", "id": number, "data": base64.b64encode(piece).decode()})
            return
        sending.close()
        self.sending = None
        self.tell({"event": "pulled", "id": number})

    def done(self, request: Record) -> Record:
        """Remove the folder of an ended run."""
        if self.run is not None and self.run.attempt == request["attempt"]:
            raise Refused("run %s is not over" % self.run.attempt)
        remove(os.path.join(self.folder, RUNS, os.path.basename(request["attempt"])))
        return {"event": "removed"}

    def leave(self, why: str) -> None:
        """End the run, and then this agent."""
        self.leaving = self.leaving or why
        if self.run is not None:
            self.run.end(why)

    def attend(self, now: float) -> None:
        """Report when the run is ready, when it has begun, and its end."""
        run = self.run
        if run is None:
            return
        over = run.look(now)
        if run.armed and READY in run.states:
            self.answer_order(run)
        if run.gated and not run.reported and BEGUN in run.states:
            run.reported = True
            self.tell({"event": "started", "attempt": run.attempt})
        if over:
            self.run = None
            if self.guard is not None:
                self.guard.tell(None)
            report = run.ended()
            with contextlib.suppress(OSError):  # of a full disk, the driver hears at once
                write_whole(os.path.join(run.folder, ENDED), report)
            self.tell({"event": "ended", **report})
            if run.armed:
                self.answer_order(run)
            if not self.leaving and not run.immortal:
                self.keep_worker(run.worker)

    def answer_order(self, run: Run) -> None:
        """Answer that a run is armed. If it has ended already, the driver has heard of this before."""
        if run.armed:
            self.tell(run.armed)
        run.armed = None

    def tell(self, event: Record) -> None:
        """Send an event. A driver that does not read loses it."""
        if len(self.unsent) < MOST_UNSENT:
            self.unsent += json.dumps(event, separators=(",", ":")).encode() + b"\n"
        self.write()

    def write(self, patience: float = 0.0) -> None:
        """Send what is unsent as far as the driver takes it, and wait for it so many seconds."""
        give_up = time.monotonic() + patience
        while self.unsent:
            try:
                del self.unsent[: os.write(1, self.unsent)]
            except BlockingIOError:
                if time.monotonic() >= give_up:
                    return
                time.sleep(LOOK_S / 10)
            except OSError:  # nobody is there any more
                self.unsent.clear()


def become_worker() -> int:
    """Execute runs one after the other, until one of them has to be ended.

    Each is a line with its folder on standard input, and the lines of a worker. Its states are announced on standard output.
    """
    told, null = os.dup(1), os.dup(2)
    os.dup2(null, 1)

    def announce(state: str) -> None:
        with contextlib.suppress(OSError):  # the agent is gone
            os.write(told, state.encode())

    for line in iter(sys.stdin.readline, ""):
        folder = json.loads(line)["folder"]
        with open(os.path.join(folder, WORKER_LOG), "wb") as log:
            os.dup2(log.fileno(), 2)
        done = execute([folder, "1"], announce)
        done.report_failure()
        if done.status:
            return int(done.status)
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        done.close()
        os.dup2(null, 2)  # nothing of the run stays open
        announce(OVER)
    return 0


def with_setup(line: str | None, environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that are set after bash has executed a line. Raises Refused if it fails."""
    own = {name: value for name, value in environment.items() if not name.startswith("SSH_")}
    if not line:
        return own
    script = "exec 3>&1 >&2\n%s\nstatus=$?; [ $status = 0 ] || exit $status\nexec env -0 >&3" % line
    try:
        ended = subprocess.run(
            ["bash", "-c", script],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=own,
            timeout=SETUP_S,
            start_new_session=True,
        )
    except subprocess.TimeoutExpired:
        raise Refused("its setup line did not end within %g s" % SETUP_S, "setup") from None
    if ended.returncode:
        words = " ".join(ended.stderr.decode("utf-8", "replace").split())[-TAIL_BYTES:]
        raise Refused("its setup line ended with %s: %s" % (ending(ended.returncode), words), "setup")
    if not ended.stdout:
        unknown = "its setup line ended the shell (by exit or exec), so that the variables that it sets are unknown"
        raise Refused(unknown, "setup")
    pairs = (pair.partition("=") for pair in ended.stdout.decode("utf-8", "surrogateescape").split("\0") if "=" in pair)
    return {name: value for name, _, value in pairs if name not in LEFT_OUT and not name.startswith("BASH_FUNC_")}


def events_in(folder: str) -> list[Record]:
    """Return all complete lines of a worker's journal; none if it cannot be read."""
    with contextlib.suppress(OSError, ValueError), open(os.path.join(folder, "journal.jsonl"), "rb") as file:
        return [json.loads(line) for line in file.read().split(b"\n")[:-1]]
    return []


def has_begun(events: Sequence[Record]) -> bool:
    """Return whether a program was started, by the events of its worker."""
    return any(event["event"] in ("start", "end") for event in events)


def await_guard(record: Record) -> None:
    """Wait until the guard of a killed agent has ended the run in this record, so that it does not disturb the next one."""
    give_up = time.monotonic() + GUARD_S
    while record.get("boot") == boot_id() and is_guard(record.get("guard")) and time.monotonic() < give_up:
        select.select((), (), (), LOOK_S / 10)


def is_guard(pid: int | None) -> bool:
    """Return whether a process is an agent, as guards are."""
    return pid is not None and is_running(pid) and b"robot_agent" in read_proc("%d/cmdline" % pid)


def end_processes_of(record: Record) -> int:
    """Kill the processes of an earlier agent's run that are alive; return how many were. After a reboot there are none."""
    if record.get("boot") != boot_id():
        return 0
    pid = record.get("pid", 0)
    marks = [b"SIERRA_EXECUTION=" + one.encode() for one in record.get("executions", ())]
    ended: set[int] = set()
    give_up = time.monotonic() + SETTLE_S
    while time.monotonic() < give_up:
        alive = {pid} if record.get("born") is not None and is_running(pid, record["born"]) else set()
        alive |= {one for one in marked(marks) if is_running(one)}
        if not alive:
            break
        ended |= alive
        for one in alive:
            kill_all(one)
        time.sleep(LOOK_S / 10)
    return len(ended)


def is_running(pid: int, born: int | None = None) -> bool:
    """Return whether a process, or one of its threads, is alive; `born`: it must have been born then."""
    return bool(stat_of(pid)) and not is_ending(pid) and born in (None, birth(pid))


def kill_all(pid: int) -> None:
    """Kill a process, its descendants and its group."""
    for one in descendants(pid):
        signal_process(one, signal.SIGKILL)
    signal_group(pid, signal.SIGKILL)


def end_children(spared: Collection[int]) -> bool:
    """Kill the processes that have lost their worker; return whether one was alive."""
    living = 0
    for pid in orphans():
        fields = stat_of(pid)
        if pid in spared or not fields:
            continue
        if fields[0] != b"Z" or not release(pid):
            living += 1
            kill_all(pid)
            release(pid)
    return living > 0


def write_whole(path: str, record: Record) -> None:
    """Write a record to a file that appears whole or not at all."""
    with open(path + ".part", "w", encoding="ascii") as file:
        json.dump(record, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(path + ".part", path)


def read_record(path: str) -> Record | None:
    """Return the record in a file; None if there is none, or if it is damaged."""
    try:
        with open(path, encoding="ascii") as file:
            record = json.load(file)
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) else None


def close_pipes(process: subprocess.Popen[bytes]) -> None:
    for file in (process.stdin, process.stdout):
        with contextlib.suppress(OSError):
            if file is not None:
                file.close()


def output_of(process: subprocess.Popen[bytes]) -> int:
    """Return the descriptor of the pipe from which the output of a process is read."""
    return process.stdout.fileno() if process.stdout else -1


def ending(status: int) -> str:
    return "signal %d" % -status if status < 0 else "status %d" % status


def own_address() -> str | None:
    """Return the address of this robot at which its driver has reached it, in the robot's own network; None without SSH."""
    words = os.environ.get("SSH_CONNECTION", "").split()  # address and port of the client, then of the server
    return words[2] if len(words) == 4 else None


def utc_offset(zone: str | None) -> int:
    """Return the seconds by which local time is ahead of UTC now, with this value of TZ; None: in the system's time zone."""
    before = os.environ.get("TZ")
    try:
        set_zone(zone)
        return time.localtime().tm_gmtoff
    finally:
        set_zone(before)


def set_zone(zone: str | None) -> None:
    os.environ.pop("TZ", None)
    if zone is not None:
        os.environ["TZ"] = zone
    time.tzset()


def boot_id() -> str:
    """Return the name that the kernel has given to this boot."""
    return read_proc("sys/kernel/random/boot_id").decode().strip()


def main(arguments: list[str]) -> int:
    if arguments == [WORKER]:
        return become_worker()
    folder, lock = arguments
    adopt_orphans()
    agent = Agent(os.path.abspath(os.path.expanduser(folder)), lock)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    for number in (signal.SIGHUP, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)  # the end of a login ends nothing; the input ends too
    signal.signal(signal.SIGTERM, lambda number, frame: setattr(agent, "terminated", True))
    agent.serve()
    return 0
