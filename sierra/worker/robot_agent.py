"""The agent: executes runs on one robot for a driver, and ends them if it hears no more of that driver.

It needs only the standard library (Python 3.8 or newer), and beside it the other files that `sierra.runners.robots.push` names.
A driver starts it by SSH:

    robot_agent.py FOLDER LOCK

Both sides exchange lines of JSON: the driver sends requests (`do`), the agent answers with events (`event`).

| `do` | answer | meaning |
|---|---|---|
| `hello` | `hello` or `refused` | lock the robot, end and remove leftovers, execute the setup line |
| `check` | `checked` | measure battery and disk; before a run, also read firmware and calibration, and execute the checks |
| `watch` | `watching` | begin to watch the wall clock (see `clock_watch`) |
| `clock` | `clock` | the wall clock, in ns |
| `watched` | `watched` | how even the wall clock was since `watch` |
| `arm` | `armed` or `refused` | make the run's folder, and start its worker and its container, which wait |
| `at` | `gated`, `late`, `refused` | start the run at this time (ns) of this robot's clock, if nobody set it since |
| `stop` | (`ended`) | end the run |
| `done` | `removed` | remove the run's folder |
| `beat` | `beat` | the driver lives |
| `bye` | | give the robot back |

A request may have an `id`, which its answer repeats. The events `started` and `ended` come by themselves.

*Lock*: an abstract socket with the name LOCK. Only one process of a host can have it, of whatever user, and the kernel frees it
when that process ends. Whoever finds it taken connects to it, and reads who has it.

*Lease*: each byte of the driver renews it. If it has expired by the monotonic clock, or if the input has ended, nothing more
starts, a run is ended as by `stop`, and the agent ends. Therefore nothing is left to start later, also after a reboot.

*Stop*: SIGTERM to the run (by its worker), and the stop command of the robot at the same time; after the grace time, SIGKILL.
If processes had to be killed, the stop command is executed once more, because they may have moved the robot since. It is also
executed when a run has ended by itself. If it fails or takes too long, the event `ended` says so. All processes that a run
started are found: the worker is their subreaper, and the agent is that of the worker. If an agent was killed, its worker ends
the run, and the next agent executes the stop command. So it does after a power cut or a restart in the middle of a run, because
the motors may have a controller with power of its own, which obeys the last command.

A run's folder is FOLDER/runs/ATTEMPT. It has `process.json` from the time when the run is armed, and `ended.json` at its end.
An attempt whose folder exists is never started again.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any, Callable, Dict, Mapping, Sequence

if TYPE_CHECKING:
    from types import ModuleType

Record = Dict[str, Any]

RUNS = "runs"
FIRST = "1"  # the folder in which a worker executes its only run
WORKER = "worker"  # the only argument of a worker
PROCESS, ENDED, STOP_LOG, WORKER_LOG = "process.json", "ended.json", "stop.log", "worker.log"
LEASE_S, GRACE_S, STOP_S = 5.0, 2.0, 5.0
SETUP_S, CHECK_S = 60.0, 10.0
SETTLE_S = 3.0  # after the grace time, for a worker to end what it has killed, and to hash the outputs of others
LOOK_S = 0.1  # between two looks at a run, and at the clocks
SILENT_S = 1.0  # for a holder of the lock that says nothing, because it is ending
SOON_S = 60.0  # a start that is farther away is a mistake
STEP_S = 0.05  # of the wall clock after its measurement, from which on nothing starts
TAIL_BYTES = 400
MOST_UNSENT = 1 << 20
LEFT_OUT = ("_", "SHLVL", "PWD", "OLDPWD")  # variables that a shell sets


class Refused(Exception):
    """A request that cannot be fulfilled, with the reason in one line."""


class Stopping:
    """The stop command of a robot while it executes."""

    def __init__(self, argv: Sequence[str], environment: Mapping[str, str], log: str, limit: float) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.problem: str | None = None
        self.log = log
        self.limit = limit
        self.kill_at = time.monotonic() + limit
        try:
            with open(log, "wb") as file:
                self.process = subprocess.Popen(
                    argv, stdin=subprocess.DEVNULL, stdout=file, stderr=file, env=environment, start_new_session=True
                )
        except (OSError, ValueError) as error:
            self.problem = "cannot be started: " + the_worker().explain(error)

    @property
    def problems(self) -> list[str]:
        """Return what went wrong, in at most one line."""
        return ["the stop command %s" % self.problem] if self.problem else []

    def has_ended(self) -> bool:
        """Return whether it has ended; ends it if it takes too long."""
        if self.process is None:
            return True
        status = self.process.poll()
        if status is None and time.monotonic() < self.kill_at:
            return False
        if status is None:
            self.problem = "did not end within %g s" % self.limit
        elif status:
            self.problem = "ended with %s%s" % (ending(status), last_line(self.log))
        kill_all(self.process.pid)
        self.process.wait()
        self.process = None
        return True


class Run:
    """One run on this robot, from arming to its end."""

    def __init__(
        self,
        folder: str,
        order: Record,
        worker: subprocess.Popen[bytes],
        environment: Mapping[str, str],
        stop: Sequence[str],
        grace: float,
        stop_limit: float,
    ) -> None:
        """Make its folder, and let a worker prepare the job and wait for its moment. Raises OSError.

        `worker` is one of `start_worker`. `stop` is the stop command, `stop_limit` the seconds that it may take.
        """
        self.folder = folder
        self.attempt: str = order["attempt"]
        self.job: Record = order["job"]
        self.environment = environment
        self.stop_argv = stop
        self.grace = grace
        self.stop_limit = stop_limit
        self.gated = self.begun = self.reported = self.over = self.stop_executed = False
        self.armed: Record | None = {"event": "armed", "attempt": self.attempt, "id": order.get("id")}
        """The answer to the order, until the worker is ready for the job."""
        self.why: str | None = None
        self.kill_at: float | None = None
        self.killed = False
        self.stopping: Stopping | None = None
        self.problems: list[str] = []
        os.makedirs(os.path.dirname(folder), exist_ok=True)
        os.mkdir(folder)
        self.worker = worker
        born = the_worker().birth(self.worker.pid)
        executions = [self.job["execution"]]
        self.client = (
            the_worker().with_folder(self.job["client"], os.path.join(folder, FIRST)) if "client" in self.job else None
        )
        known = {"pid": self.worker.pid, "born": born, "boot": boot_id(), "executions": executions, "client": self.client}
        write_whole(os.path.join(folder, PROCESS), {**known, "who": order.get("who")})
        self.tell_worker({"folder": folder}, {**self.job, "waits": True})

    def begin(self, moment: float, wall: float) -> None:
        """Let the worker start the program at this moment of the monotonic clock, which is this one of the wall clock."""
        self.gated = True
        self.tell_worker({"begin": moment, "wall": wall}, {"end": True})

    def tell_worker(self, *records: Record) -> None:
        try:
            pipe = the_worker().stdin_of(self.worker)
            for record in records:
                pipe.write(json.dumps(record, separators=(",", ":")).encode() + b"\n")
            pipe.flush()
        except OSError as error:
            self.problems.append("its worker is gone: " + the_worker().explain(error))

    def end(self, why: str) -> None:
        """Tell the run to end, and start the stop command. The first reason counts."""
        if self.why is not None or self.over:
            return
        self.why = why
        self.kill_at = time.monotonic() + self.grace + SETTLE_S
        self.worker.terminate()
        if self.has_begun():
            self.execute_stop_command()

    def execute_stop_command(self) -> None:
        self.stop_executed = True
        if self.stop_argv:
            log = os.path.join(self.folder, STOP_LOG)
            self.stopping = Stopping(self.stop_argv, self.environment, log, self.stop_limit)

    def look(self, now: float) -> bool:
        """Look at the run; return whether it has ended, with all of its processes."""
        if self.kill_at is not None and now >= self.kill_at:
            if self.client and not self.killed:  # which the worker did not do
                the_worker().end_container(self.client)
            self.killed = True
            kill_all(self.worker.pid)
        if self.worker.poll() is None:
            return False
        if not self.over:
            self.over = True
            self.close_pipe()
            self.killed = end_orphans(self.worker_of_stop()) or self.killed or self.was_killed()
            if self.has_begun() and not self.stop_executed:
                self.execute_stop_command()
        if self.stopping is not None:
            if not self.stopping.has_ended():
                return False
            self.problems += self.stopping.problems
            again, self.killed, self.stopping = self.killed and self.why is not None, False, None
            if again:
                self.execute_stop_command()
                return False
        return not end_orphans(0)

    def worker_of_stop(self) -> int:
        """Return the process of the stop command; 0 if there is none."""
        return self.stopping.process.pid if self.stopping and self.stopping.process else 0

    def was_killed(self) -> bool:
        """Return whether the worker had to kill the run's program."""
        record = self.record()
        return self.why is not None and record is not None and record.get("signal") == signal.SIGKILL

    def events(self) -> list[Record]:
        return events_in(self.folder)

    def has_begun(self) -> bool:
        """Return whether its program was started."""
        self.begun = self.begun or has_begun(self.events())
        return self.begun

    def is_ready(self) -> bool:
        """Return whether the run is prepared."""
        return any(event["event"] == "ready" for event in self.events())

    def record(self) -> Record | None:
        """Return the worker's report on the run's end; None without one."""
        ends = [event for event in self.events() if event["event"] == "end"]
        return ends[-1] if ends else None

    def ended(self) -> Record:
        """Return the report on the run's end."""
        record = self.record()
        status = self.worker.returncode
        if record is None and (self.has_begun() or self.why is None):
            words = last_line(os.path.join(self.folder, WORKER_LOG))
            self.problems.append("its worker ended with %s%s" % (ending(status), words))
        return {
            "attempt": self.attempt,
            "started": self.has_begun(),
            "why": self.why,
            "end": record,
            "problems": self.problems,
        }

    def close_pipe(self) -> None:
        with contextlib.suppress(OSError):
            if self.worker.stdin is not None:
                self.worker.stdin.close()


class Agent:
    """One robot at the service of one driver."""

    def __init__(self, folder: str, lock: str) -> None:
        self.folder = folder
        self.lock_name = lock
        self.lock: socket.socket | None = None
        self.who: Record = {}
        self.lease = LEASE_S
        self.grace = GRACE_S
        self.stop_limit = STOP_S
        self.stop_argv: Sequence[str] = ()
        self.battery: Sequence[str] | str | None = None
        self.firmware: Sequence[str] | None = None
        self.calibration: str | None = None
        self.checks: Sequence[Sequence[str]] = ()
        self.topic_rates: Mapping[str, float] = {}
        self.environment: dict[str, str] = {}
        self.looker = load("robot_software").Looker()
        self.watch = load("clock_watch").ClockWatch()
        self.run: Run | None = None
        self.spare: subprocess.Popen[bytes] | None = None
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
        while not (self.leaving and self.run is None):
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
        changes = run.armed or run.why or run.over or (run.gated and not run.reported)
        return LOOK_S / 20 if changes else LOOK_S

    def wait(self, seconds: float) -> None:
        """Wait so long, or until there is a request, and execute all requests."""
        reading: list[Any] = [self.wake, *([] if self.leaving else [0]), *([self.lock] if self.lock else [])]
        ready, writable, _ = select.select(reading, [1] if self.unsent else [], [], seconds)
        if self.wake in ready:
            os.read(self.wake, 4096)
        if writable:
            self.write()
        if self.lock in ready:
            self.say_who()
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
            answer = {"event": "refused", "reason": str(error)}
        except (OSError, ValueError) as error:
            answer = {"event": "refused", "reason": the_worker().explain(error)}
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
            "done": self.done,
            "beat": lambda _: {"event": "beat"},
            "bye": lambda _: self.leave("the driver has ended it"),
        }
        if request["do"] not in known:
            raise Refused("unknown request %r" % request["do"])
        return known[request["do"]](request)

    def hello(self, request: Record) -> Record:
        """Lock the robot, remove leftovers, and execute the setup line."""
        self.lease, self.grace = request.get("lease", LEASE_S), request.get("grace", GRACE_S)
        self.who = request["who"]
        self.stop_argv, self.stop_limit = request.get("stop", ()), request.get("stop_limit", STOP_S)
        self.battery, self.checks = request.get("battery"), request.get("checks", ())
        self.topic_rates = request.get("topic_rates", {})
        self.firmware, self.calibration = request.get("firmware"), request.get("calibration")
        self.acquire(time.monotonic() + request.get("patience", 0.0))
        os.makedirs(self.folder, exist_ok=True)
        before = dict(os.environ)
        given = request.get("variables", {})
        self.environment = with_setup(request.get("setup"), {**before, **given})
        leftovers = self.end_leftovers(request.get("keep", ()))
        self.prepare_worker()
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
            "facts": load("machine").facts(),
            "utc_offset": utc_offset(self.environment.get("TZ")),
            "software": self.looker.news(self.environment),
            "home": os.path.expanduser("~"),
            "variables": variables,
            "leftovers": leftovers,
        }

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
                    raise Refused("is the same host as %s; each robot needs a host of its own" % holder.get("robot")) from None
                waits = now < give_up if holder.get("leaving") or own else not holder and now < began + SILENT_S
                if not waits:
                    raise Refused("in use by %s" % (holder.get("text") or "another process that holds its lock")) from None
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

    def end_leftovers(self, keep: Sequence[str]) -> list[Record]:
        """End what earlier agents left running, and remove the folders of their runs, except those to keep. Return them all."""
        root = os.path.join(self.folder, RUNS)
        found = []
        for attempt in sorted(the_worker().entries_of(root)):
            folder = os.path.join(root, attempt)
            record = read_record(os.path.join(folder, PROCESS)) or {}
            ended = end_processes_of(record)
            if record.get("client"):
                the_worker().end_container(record["client"])
            report = read_record(os.path.join(folder, ENDED))
            may_have_begun = record.get("boot") != boot_id() or has_begun(events_in(folder))  # a power cut loses events
            problems = []
            if ended or (report is None and may_have_begun):  # its agent was killed before it could execute the stop command
                problems = self.execute_stop_command()
            found.append({"attempt": attempt, "ended": ended, "report": report, "problems": problems})
            if attempt not in keep:
                the_worker().remove(folder)
        return found

    def execute_stop_command(self) -> list[str]:
        """Execute the stop command, and wait for its end; return its problem, if it has one."""
        if not self.stop_argv:
            return []
        stopping = Stopping(self.stop_argv, self.environment, os.path.join(self.folder, STOP_LOG), self.stop_limit)
        while not stopping.has_ended():
            time.sleep(LOOK_S / 10)
        return stopping.problems

    def check(self, request: Record) -> Record:
        """Measure battery (percent) and disk (bytes). Before a run, also describe the robot, and execute the checks."""
        space = shutil.disk_usage(self.folder)
        found: Record = {"event": "checked", "battery": self.battery_level(), "disk": space.free, "failed": []}
        if request.get("checks", True):
            found.update(firmware=self.firmware_version(), calibration=self.calibration_hash())
            found.update(software=self.looker.news(self.environment), failed=self.failed_checks())
        for path, state in request.get("unchanged", {}).items():
            if load("on_host").state(path)[1:] != state:
                found["failed"].append("%s has changed since it was verified" % path)
        return found

    def failed_checks(self) -> list[str]:
        """Execute all checks at once, because each may wait for something; return a line for each one that has failed."""
        from concurrent.futures import ThreadPoolExecutor

        with ThreadPoolExecutor(max(1, len(self.checks) + len(self.topic_rates))) as pool:
            rates = pool.map(self.slow_topic, self.topic_rates)
            ended = list(pool.map(self.output_of, self.checks))
        return [
            *(
                "%s: %s" % (" ".join(argv), words or "status %s" % status)
                for argv, (status, words) in zip(self.checks, ended)
                if status != 0
            ),
            *filter(None, rates),
        ]

    def slow_topic(self, topic: str) -> str | None:
        """Return why a topic has too few messages a second; None if it has enough."""
        found: str | None = load("topic_rates").shortfall(topic, self.topic_rates[topic], self.environment)
        return found

    def firmware_version(self) -> str | None:
        """Return what the command prints that knows the version; None without a command. Raises Refused."""
        if self.firmware is None:
            return None
        status, words = self.output_of(self.firmware)
        if status != 0 or not words:
            raise Refused("its firmware cannot be read: %s: %s" % (" ".join(self.firmware), words or "status %s" % status))
        return words

    def calibration_hash(self) -> str | None:
        """Return the SHA-256 of the calibration file; None without one. Raises Refused."""
        if self.calibration is None:
            return None
        path = os.path.expanduser(self.calibration)
        try:
            return str(the_worker().describe(path, path)["sha256"])
        except OSError as error:
            raise Refused("its calibration cannot be read: %s" % the_worker().explain(error)) from None

    def battery_level(self) -> float | None:
        """Return the first number that the battery's file or command gives; None without one. Raises Refused."""
        if self.battery is None:
            return None
        if isinstance(self.battery, str):
            with open(os.path.expanduser(self.battery), encoding="utf-8", errors="replace") as file:
                words = file.read(4096)
        else:
            status, words = self.output_of(self.battery)
            if status != 0:
                raise Refused("its battery cannot be read: %s" % (words or "status %s" % status))
        try:
            level = float(words.split()[0].rstrip("%"))
        except (IndexError, ValueError):
            raise Refused("its battery cannot be read: %r is not a number" % words[:40]) from None
        if not 0 <= level <= 100:  # also nan, which no limit would refuse, and volts or milliampere hours
            raise Refused("its battery cannot be read: %r is not a charge from 0 to 100 %%" % words[:40])
        return level

    def output_of(self, argv: Sequence[str]) -> tuple[int | None, str]:
        """Execute a command; return its status, None if it does not end in time, and its output or the error."""
        try:
            ended = subprocess.run(
                argv,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=self.environment,
                timeout=CHECK_S,
                start_new_session=True,
            )
        except subprocess.TimeoutExpired:
            return None, "did not end within %g s" % CHECK_S
        except (OSError, ValueError) as error:
            return None, the_worker().explain(error)
        return ended.returncode, " ".join(ended.stdout.decode("utf-8", "replace").split())[-TAIL_BYTES:]

    def begin_watch(self, _: Record) -> Record:
        self.watch = load("clock_watch").ClockWatch()
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
        worker = self.take_worker()
        try:
            self.run = Run(folder, order, worker, self.environment, self.stop_argv, self.grace, self.stop_limit)
        except OSError:
            end_worker(worker)
            the_worker().remove(folder)
            raise
        return None  # `attend` answers

    def prepare_worker(self) -> None:
        """Start the worker of the next run already, because a Python takes long to start.

        There is none while a run executes: it costs time of the processor, and whatever the agent has started is ended then.
        """
        if self.spare is not None:
            end_worker(self.spare)  # it has the variables of an earlier setup line
        self.spare = None
        with contextlib.suppress(OSError):  # it is tried again for the run
            self.spare = start_worker(self.environment)

    def take_worker(self) -> subprocess.Popen[bytes]:
        """Return a worker that waits for its folder. Raises OSError."""
        worker, self.spare = self.spare, None
        return worker if worker is not None and worker.poll() is None else start_worker(self.environment)

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

    def done(self, request: Record) -> Record:
        """Remove the folder of an ended run."""
        if self.run is not None and self.run.attempt == request["attempt"]:
            raise Refused("run %s is not over" % self.run.attempt)
        the_worker().remove(os.path.join(self.folder, RUNS, os.path.basename(request["attempt"])))
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
        if run.armed and run.is_ready():
            self.answer_order(run)
        if run.gated and not run.reported and run.has_begun():
            run.reported = True
            self.tell({"event": "started", "attempt": run.attempt})
        if run.look(now):
            self.run = None
            report = run.ended()
            with contextlib.suppress(OSError):  # of a full disk, the driver hears at once
                write_whole(os.path.join(run.folder, ENDED), report)
            self.tell({"event": "ended", **report})
            if run.armed:
                self.answer_order(run)
            if not self.leaving:
                self.prepare_worker()

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


def start_worker(environment: Mapping[str, str]) -> subprocess.Popen[bytes]:
    """Start a worker that waits for its folder: see `become_worker`. Raises OSError."""
    return subprocess.Popen(
        [sys.executable, "-I", "-S", "-B", os.path.abspath(__file__), WORKER],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=dict(environment),
        start_new_session=True,
    )


def end_worker(worker: subprocess.Popen[bytes]) -> None:
    """End a worker that has got no folder."""
    worker.kill()
    worker.wait()
    with contextlib.suppress(OSError):
        the_worker().stdin_of(worker).close()


def become_worker() -> int:
    """Wait for a line with the folder of a run on standard input, and execute the jobs in the lines after it."""
    worker = the_worker()
    line = b""
    while not line.endswith(b"\n"):
        byte = os.read(0, 1)  # no more, because the worker reads the rest
        if not byte:
            return 1
        line += byte
    folder = json.loads(line)["folder"]
    with open(os.path.join(folder, WORKER_LOG), "wb") as log:
        os.dup2(log.fileno(), 2)
    return int(worker.main([folder, "1"]))


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
        raise Refused("its setup line did not end within %g s" % SETUP_S) from None
    if ended.returncode:
        words = " ".join(ended.stderr.decode("utf-8", "replace").split())[-TAIL_BYTES:]
        raise Refused("its setup line ended with %s: %s" % (ending(ended.returncode), words))
    if not ended.stdout:
        raise Refused("its setup line ended the shell (by exit or exec), so that the variables that it sets are unknown")
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


def end_processes_of(record: Record) -> int:
    """Kill the processes of an earlier agent's run that are alive; return how many were. After a reboot there are none."""
    if record.get("boot") != boot_id():
        return 0
    worker = the_worker()
    pid = record.get("pid", 0)
    marks = [b"SIERRA_EXECUTION=" + one.encode() for one in record.get("executions", ())]
    ended: set[int] = set()
    give_up = time.monotonic() + SETTLE_S
    while time.monotonic() < give_up:
        alive = {pid} if record.get("born") is not None and worker.birth(pid) == record["born"] else set()
        alive = {one for one in (*alive, *worker.marked(marks)) if one and worker.stat_of(one)[:1] != [b"Z"]}
        if not alive:
            break
        ended |= alive
        for one in alive:
            kill_all(one)
        time.sleep(LOOK_S / 10)
    return len(ended)


def kill_all(pid: int) -> None:
    """Kill a process, its descendants and its group."""
    worker = the_worker()
    for one in worker.descendants(pid):
        worker.signal_process(one, signal.SIGKILL)
    worker.signal_group(pid, signal.SIGKILL)


def end_orphans(spared: int) -> bool:
    """Kill the processes that have lost their worker; return whether one was alive. `spared` is the stop command's."""
    worker = the_worker()
    living = 0
    for pid in worker.orphans():
        fields = worker.stat_of(pid)
        if pid == spared or not fields:
            continue
        if fields[0] != b"Z":
            living += 1
            kill_all(pid)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(pid, os.WNOHANG)
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


def last_line(path: str) -> str:
    """Return `: ` and the last line of a log; empty if there is none."""
    try:
        with open(path, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
            lines = file.read().decode("utf-8", "replace").strip().splitlines()
    except OSError:
        return ""
    return ": " + lines[-1] if lines else ""


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
    return the_worker().read_proc("sys/kernel/random/boot_id").decode().strip()  # type: ignore[no-any-return]


def beside(name: str) -> str:
    """Return the path of a file in the folder of this one."""
    return os.path.join(os.path.dirname(os.path.abspath(__file__)), name)


def the_worker() -> ModuleType:
    """Return the module of the worker."""
    return load("worker")


@functools.lru_cache(maxsize=None)
def load(name: str) -> ModuleType:
    """Load a module that lies beside this file."""
    import importlib.util

    path = beside(name + ".py")
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise FileNotFoundError(path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def become_subreaper() -> None:
    """Become the parent of processes whose worker has died (Linux only)."""
    import ctypes

    ctypes.CDLL(None, use_errno=True).prctl(36, 1, 0, 0, 0)


def main(arguments: list[str]) -> int:
    if arguments == [WORKER]:
        return become_worker()
    folder, lock = arguments
    with contextlib.suppress(ImportError, OSError, AttributeError):
        become_subreaper()
    agent = Agent(os.path.abspath(os.path.expanduser(folder)), lock)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    for number in (signal.SIGHUP, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)  # the end of a login ends nothing; the input ends too
    signal.signal(signal.SIGTERM, lambda number, frame: setattr(agent, "terminated", True))
    agent.serve()
    return 0


if __name__ == "__main__":
    os._exit(main(sys.argv[1:]))
