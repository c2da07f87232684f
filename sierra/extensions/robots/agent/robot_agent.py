"""The agent: executes runs on one robot for a driver, and ends them if it hears no more of that driver.

A driver starts it by SSH, from the file that `sierra.extensions.hosts.push` has copied to the robot:

    worker.pyz sierra.extensions.robots.agent.robot_agent FOLDER LOCK

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

Also: the environment of runs on a robot: the variables that its setup line sets, its address, and its time zone.

Also: the lock of a robot: an abstract socket.

Only one process of a host can have it, of whatever user, and the kernel frees it when that process ends. Whoever finds it taken
connects to it, and reads who has it.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from typing import Any, Callable, Mapping, Sequence

from sierra.extensions.robots.agent.clock_watch import ClockWatch
from sierra.extensions.robots.agent.condition import Condition
from sierra.extensions.robots.agent.leftovers import ENDED, Guard, end_leftovers
from sierra.extensions.robots.agent.processes import LOOK_S, TAIL_BYTES, Forked, ending, keep_open
from sierra.extensions.robots.agent.records import Record, Refused, write_whole
from sierra.extensions.robots.agent.run import WORKER, Run, WorkerProcess, become_worker
from sierra.extensions.robots.agent.software import Looker
from sierra.extensions.robots.agent.standstill import STOP_S, Standstill
from sierra.worker import machine, on_host, remote_folder
from sierra.worker.containers import end_container
from sierra.worker.errors import explain
from sierra.worker.files import remove, size_of
from sierra.worker.journal import BEGUN, READY
from sierra.worker.processes import adopt_orphans, boot_id

SILENT_S = 1.0  # for a holder of the lock that says nothing, because it is ending


class Lock:
    """The lock of this robot."""

    def __init__(self, name: str) -> None:
        self.address = "\0" + name
        self.socket: socket.socket | None = None
        """The lock, if this process has it."""

    def acquire(self, who: Record, give_up: float) -> None:
        """Lock the robot. An agent that is ending, or that of the same driver, is waited for. Raises Refused."""
        began = time.monotonic()
        while self.socket is None:
            lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                lock.bind(self.address)
                lock.listen(8)
                lock.setblocking(False)
                self.socket = lock
            except OSError:
                lock.close()
                holder = self.holder()
                now = time.monotonic()
                own = holder.get("session") == who.get("session")
                if own and holder.get("robot") != who.get("robot"):
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
            lock.connect(self.address)
            with lock.makefile("rb") as file:
                who = json.loads(file.readline(1 << 16))
                return who if isinstance(who, dict) else {}
        return {}

    def tell(self, who: Record) -> None:
        """Tell another process who holds the lock."""
        with contextlib.suppress(OSError):
            if self.socket is not None:
                other, _ = self.socket.accept()
                with other:
                    other.setblocking(False)
                    other.send(json.dumps(who).encode() + b"\n")


SETUP_S = 60.0
LEFT_OUT = ("_", "SHLVL", "PWD", "OLDPWD")  # variables that a shell sets


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


RUNS = "runs"
PROBE = "probe"  # the name of a run that only shows that runs can be executed
LEASE_S, GRACE_S = 5.0, 2.0
PROBE_S = 30.0
SOON_S = 60.0  # a start that is farther away is a mistake
STEP_S = 0.05  # of the wall clock after its measurement, from which on nothing starts
MOST_UNSENT = 1 << 22
PIECE = 1 << 16  # bytes of a folder in one message
LARGE = 1 << 20  # bytes of a folder that an agent does not send, because base64 makes it longer


class Sending(Forked):
    """A folder that is sent to the driver by a process of its own, so that the agent stays attentive."""

    def __init__(self, line: str) -> None:
        """Start the process. `line` is the request of `remote_folder.pull`. Raises OSError."""
        self.line = line
        super().__init__(self.serve, reads=False)

    def serve(self, pipe: int) -> None:
        keep_open(pipe)
        with open(pipe, "wb") as file:
            remote_folder.serve("pull", io.BytesIO(self.line.encode() + b"\n"), file)

    def next(self) -> bytes:
        """Return the next piece; nothing at the end."""
        return os.read(self.pipe, PIECE)


class Agent:
    """One robot at the service of one driver."""

    def __init__(self, folder: str, lock: str) -> None:
        self.folder = folder
        self.lock = Lock(lock)
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
        self.spare: WorkerProcess | None = None
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
        reading: list[Any] = [self.wake, *([] if self.leaving else [0]), *([self.lock.socket] if self.lock.socket else [])]
        reading += [self.run.worker.pipe] if self.run and not self.run.over else []
        reading += [self.sending[1].pipe] if self.sending and len(self.unsent) < MOST_UNSENT // 2 else []
        ready, writable, _ = select.select(reading, [1] if self.unsent else [], [], seconds)
        if self.wake in ready:
            os.read(self.wake, 4096)
        if writable:
            self.write()
        if self.lock.socket in ready:
            self.lock.tell({**self.who, "leaving": bool(self.leaving)})
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
        self.lock.acquire(self.who, time.monotonic() + request.get("patience", 0.0))
        leftovers = end_leftovers(os.path.join(self.folder, RUNS))
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

    def check(self, request: Record) -> Record:
        """Measure battery (percent) and disk (bytes). Before a run, also describe the robot, and execute the checks."""
        answer: Record = {"event": "checked", "failed": [], **self.condition.measured(self.folder)}
        if request.get("checks", True):
            described = self.condition.described()
            answer = {**answer, **described, "unread": {**answer["unread"], **described["unread"]}}
            answer["software"] = self.looker.news(self.environment)
        for path, state in request.get("unchanged", {}).items():
            if on_host.state(path)[1:] != state:
                answer["failed"].append("%s has changed since it was verified" % path)
        return answer

    def begin_watch(self, _: Record) -> Record:
        self.watch = ClockWatch()
        return {"event": "watching"}

    def arm(self, order: Record) -> Record | None:
        """Prepare a run. Raises Refused if another one is not over, or if this one was armed before."""
        if self.lock.socket is None:
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
            self.spare = WorkerProcess(self.environment)

    def take_worker(self) -> WorkerProcess:
        """Return a worker that waits for its folder. Raises OSError."""
        worker, self.spare = self.spare, None
        return worker if worker is not None and worker.is_alive() else WorkerProcess(self.environment)

    def keep_worker(self, worker: WorkerProcess) -> None:
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
