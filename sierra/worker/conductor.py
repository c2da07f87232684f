"""The conductor: executes what is around a run's command: services, and commands before and after it.

    conductor FOLDER PLAN [SHARED]

The worker starts it instead of the run's command, in the run's folder, environment and container. The run's limits,
isolation and observation therefore apply to all that it starts. FOLDER is the run's folder, and PLAN a line of JSON (`Plan`).
In the plan, the character NUL stands for the folder. NAME between two characters \\2 stands for the port of a service, also
in variables.

It starts the services one after the other, each when the one before is ready. Then it executes the commands before, the run's
command and, if that has succeeded, the commands after. At last it ends the services, the last one first. Every program has a
session (and so a process group) of its own. When its first process has ended, the rest of its group is killed.

The first failure ends everything: a service that is not ready in time, a service that ends before the last command has ended,
a command with another exit status than 0. SIGTERM is passed on to the program that is being executed, and the services are
ended after it. What is still alive when the conductor has ended, the worker ends.

Services that several runs share (`shared` in a plan) are started by a conductor of their own, whose plan has no command. It
writes SHARED when they are ready, and ends when it is told to, or when one of them ends. The conductors of the runs get
the content of this file as SHARED, and fail when one of these processes has ended.

The output of services and of the commands before and after goes to the run's standard error: a line `== before: WORDS` precedes
that of a command, and `[NAME] ` each line of a service. Standard output is that of the run's command alone.

If the plan has a marker, the command is ended so many seconds after its marker is met (`Marker`), and counts as successful.
Processes of the command that still run when it has ended by itself are killed with the rest of its group, and reported.

The conductor ends like the run's command: with the same exit status, or by the same signal. If anything else has failed, its
exit status is that of the failed command, or 1. It writes the reason to REPORT, or null. A run without a report has failed,
too, because its exit status alone does not show that everything was executed.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import signal
import subprocess
import time

from sierra.worker.files import end_of, write_all
from sierra.worker.free_ports import NoFreePort, Ports
from sierra.worker.layout import REPORT, SHARED
from sierra.worker.marker import LOOK_S, Marker
from sierra.worker.processes import (
    FIRST_LOOK_S,
    all_processes,
    environment_of,
    has_ended,
    is_alive,
    signal_group,
    still_running,
)

TYPE_CHECKING = False  # each run starts a conductor, and importing `typing` is a tenth of its time; so is `socket`
if TYPE_CHECKING:
    from typing import Callable, Iterable, Mapping, NoReturn, NotRequired, Sequence, TypedDict

    class Service(TypedDict):
        """A service: see `sierra.model.Service`."""

        name: str
        argv: Sequence[str]
        ready: Sequence[str]
        timeout: float

    class Shared(TypedDict):
        """The state of services that several runs share, as a conductor knows it."""

        ports: Mapping[str, int]
        pids: Mapping[str, int]
        log: str
        """The file with their output."""
        error: str | None
        """Why they could not be started."""

    class Plan(TypedDict):
        """The programs around a run's command, with all placeholders but NUL and the ports filled in."""

        shared: Sequence[Service]
        """Services that the worker starts once for all runs."""
        observed: bool
        """True if the worker is to observe them."""
        services: Sequence[Service]
        before: Sequence[Sequence[str]]
        argv: Sequence[str]
        after: Sequence[Sequence[str]]
        success: Sequence[int]
        """The exit statuses of the command that mean success."""
        accept: NotRequired[Sequence[int]]
        """The exit statuses that mean a result without success; the commands in `after` are not executed then."""
        grace: float
        """The seconds between SIGTERM and SIGKILL."""
        marker: NotRequired[Mapping[str, object]]
        """The limits of the run with which `Marker` begins."""


COMMAND = {"SIERRA_COMMAND": "1"}  # a variable of the run's command, which services and the tracer do not have
PORT = re.compile("\2(\\w+)\2")
LONGEST_S = 3600.0  # of one wait
LAST_WORDS_S = 1.0  # for the output of a service that has ended
CHUNK = 1 << 16


class Failed(Exception):
    """The run has failed, or was told to end: no further command is executed."""

    def __init__(self, reason: str | None, status: int = 1) -> None:
        """`status` is that of a process, as `subprocess` has it: negative for a signal."""
        super().__init__(reason)
        self.reason = reason
        self.status = status


class Started:
    """A service that was started, with the output that it has not finished yet."""

    def __init__(self, service: Service, argv: list[str]) -> None:
        self.name = service["name"]
        self.process = start(argv, output=subprocess.PIPE, errors=subprocess.STDOUT)
        self.pattern = re.compile(service["ready"][1].encode()) if service["ready"][0] == "output" else None
        self.matched = False
        self._line = b""

    @property
    def pipe(self) -> int | None:
        """Return the pipe with its output; None if it is closed."""
        output = self.process.stdout
        return None if output is None or output.closed else output.fileno()

    def read(self) -> None:
        """Copy waiting output to standard error, each line with the service's name."""
        pipe = self.pipe
        chunk = os.read(pipe, CHUNK) if pipe is not None else b""
        if not chunk and self.process.stdout is not None:
            self.process.stdout.close()
        *lines, self._line = (self._line + chunk).split(b"\n")
        if self._line and (not chunk or len(self._line) > CHUNK):
            lines, self._line = [*lines, self._line], b""
        for line in lines:
            self.matched = self.matched or bool(self.pattern and self.pattern.search(line))
            write(b"[" + self.name.encode() + b"] " + line + b"\n")

    def end(self, deadline: float) -> None:
        """End its group: by SIGTERM, and at the deadline by SIGKILL. Copy the rest of its output."""
        send(self.process.pid, signal.SIGTERM)
        while is_running(self.process) and time.monotonic() < deadline:
            self.copy(FIRST_LOOK_S)
        close_group(self.process)
        deadline = time.monotonic() + LAST_WORDS_S
        while self.pipe is not None and time.monotonic() < deadline:
            self.copy(FIRST_LOOK_S)

    def copy(self, seconds: float) -> None:
        """Wait for output, at most so many seconds, and copy it."""
        if self.pipe is None:
            time.sleep(seconds)
        elif select.select([self.pipe], [], [], seconds)[0]:
            self.read()


class Conductor:
    """The programs of one run."""

    def __init__(self, folder: str, plan: Plan, shared: Shared | None = None) -> None:
        self._folder = folder
        self._shared = shared
        self._plan = plan
        self._ports = {service["name"]: 0 for service in plan["services"]}
        self._taken = Ports()
        self._services: list[Started] = []
        self._current: subprocess.Popen[bytes] | None = None
        self._told = False
        self.left: list[str] = []
        """The processes that still ran when the command had ended."""
        self.after_marker: float | None = None
        """The command was ended so many seconds after its marker was met."""
        self._kill_at = float("inf")
        self._awake, wake = os.pipe()
        for end in (self._awake, wake):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda number, frame: None)
        signal.signal(signal.SIGTERM, lambda number, frame: self.tell())

    @property
    def ports(self) -> Mapping[str, int]:
        """Return the ports of the services, by their names."""
        return self._ports

    def tell(self) -> None:
        """Note that the run was told to end. For a signal handler, which also wakes the conductor."""
        self._told = True

    def conduct(self) -> int:
        """Execute everything; return the status of the command. Raises Failed."""
        try:
            if self._shared and self._shared["error"] is not None:
                write(end_of(self._shared["log"]))
                raise Failed(self._shared["error"])
            self._check_services()
            self._choose_ports()
            for service in self._plan["services"]:
                self._start(service)
            for words in self._plan["before"]:
                self._execute("before", words)
            status = self._command() if self._plan["argv"] else self._hold()
            for words in () if status in self._plan.get("accept", ()) else self._plan["after"]:
                self._execute("after", words)
            self._check_services()
            return status
        finally:
            deadline = time.monotonic() + self._plan["grace"]
            for started in reversed(self._services):
                started.end(deadline)

    def _hold(self) -> NoReturn:
        """Tell that the shared services are ready. Wait until one of them ends, or this conductor is told to end."""
        path = os.path.join(self._folder, SHARED)
        pids = {started.name: started.process.pid for started in self._services}
        with open(path + ".new", "w", encoding="ascii") as file:
            json.dump({"ports": self._ports, "pids": pids, "log": os.path.join(self._folder, "stderr"), "error": None}, file)
        os.rename(path + ".new", path)
        try:
            while True:
                self._check_told()
                self._check_services()
                self._wait(LONGEST_S)
        finally:
            os.unlink(path)  # runs that begin later do not look for processes whose ids others may have by now

    def _choose_ports(self) -> None:
        """Choose a free port for each service, and put the ports into the variables."""
        for name in self._ports:
            try:
                self._ports[name] = self._taken.take()
            except NoFreePort as error:
                raise Failed(str(error)) from error
        self._ports.update(self._shared["ports"] if self._shared else {})
        for variable, value in os.environ.items():
            if "\2" in value:
                os.environ[variable] = self._filled(value)

    def _filled(self, word: str) -> str:
        return PORT.sub(lambda match: str(self._ports[match.group(1)]), word).replace("\0", self._folder)

    def _start(self, service: Service) -> None:
        """Start a service, and wait until it is ready."""
        name, (kind, *ready) = service["name"], map(self._filled, service["ready"])
        self._check_told()
        if kind == "file" and os.path.lexists(ready[0]):
            raise Failed("service %r: %s exists before it starts; use {port} in the name of the file" % (name, ready[0]))
        if kind == "port" and accepts(int(ready[0])):
            raise Failed("service %r: port %s is used by another program; use {port}" % (name, ready[0]))
        argv = [self._filled(word) for word in service["argv"]]
        try:
            started = Started(service, argv)
        except (OSError, ValueError) as error:
            raise Failed("service %r could not be started: %s" % (name, explain(error, argv))) from error
        self._services.append(started)
        deadline, pause = time.monotonic() + service["timeout"], FIRST_LOOK_S
        while not self._is_ready(started, kind, ready, deadline):
            if time.monotonic() >= deadline:
                raise Failed("service %r was not ready after %g s" % (name, service["timeout"]))
            self._wait(pause)
            pause = min(2 * pause, LOOK_S)
            self._check_services()
            self._check_told()
        self._check_services()

    def _is_ready(self, started: Started, kind: str, ready: Sequence[str], deadline: float) -> bool:
        if kind == "file":
            return os.path.exists(ready[0])
        if kind == "port":
            return accepts(int(ready[0]))
        if kind == "output":
            return started.matched
        return self._answers(ready, deadline)

    def _answers(self, argv: Sequence[str], deadline: float) -> bool:
        """Return whether a command that tests a service ends with exit status 0 before the deadline."""
        try:
            process = start(argv, output=subprocess.DEVNULL, errors=subprocess.DEVNULL)
        except (OSError, ValueError) as error:
            raise Failed("the command in `ready` could not be started: %s" % explain(error, argv)) from error
        return self._await(process, deadline) == 0

    def _execute(self, when: str, words: Sequence[str]) -> None:
        """Execute a command before or after the run's command."""
        argv = [self._filled(word) for word in words]
        self._check_told()
        write(os.fsencode("== %s: %s\n" % (when, " ".join(argv))))
        try:
            process = start(argv, output=2, errors=2)
        except (OSError, ValueError) as error:
            raise Failed("%s: %s" % (when, "could not be started: " + explain(error, argv)), 127) from error
        status = self._await(process)
        self._check_told()
        self._check_services()
        if status != 0:
            left = "; the run's command was not executed" if when == "before" else ""
            raise Failed("%s: %r failed: %s%s" % (when, " ".join(words_of(words)), described(status), left), status)

    def _command(self) -> int:
        """Execute the run's command; return its status."""
        argv = [self._filled(word) for word in self._plan["argv"]]
        self._check_told()
        try:
            process = start(argv, output=None, errors=None, command=True)
        except (OSError, ValueError) as error:
            raise Failed("could not be started: " + explain(error, argv), 127) from error
        marker = Marker(self._folder, self._plan["marker"]) if "marker" in self._plan else None
        status = self._await(process, marker=marker, ended=self._note_left)
        self._check_told()
        self._check_services()
        if self.after_marker is not None:
            return 0
        if self._plan["after"] and status not in (*self._plan["success"], *self._plan.get("accept", ())):
            raise Failed("%s; the commands in `after` were not executed" % described(status), status)
        return status

    def _note_left(self) -> None:
        """Note the processes of the command that still run, unless they were told to end."""
        if self._kill_at == float("inf"):
            self.left = still_running(processes_of_command)

    def _await(
        self,
        process: subprocess.Popen[bytes],
        deadline: float | None = None,
        marker: Marker | None = None,
        ended: Callable[[], None] = lambda: None,
    ) -> int:
        """Return the status of a program when it has ended. A service that ends first, or the deadline, ends it.

        A `marker` that was met long enough ago ends it, too. `ended` is called before the rest of its group is killed.
        """
        self._current, self._kill_at = process, float("inf")
        while is_running(process):
            now = time.monotonic()
            late = deadline is not None and now >= deadline
            if marker and self._kill_at == float("inf") and marker.is_over(now) and is_running(process):
                self.after_marker = marker.seconds
                self._end_current()
            if late or self._told or self._ended_service() or self._ended_shared():
                self._end_current()
            if time.monotonic() >= self._kill_at:
                send(process.pid, signal.SIGKILL)
            due = min(
                self._kill_at, float("inf") if deadline is None or late else deadline, now + LOOK_S if marker else float("inf")
            )
            self._wait(max(FIRST_LOOK_S, min(due - time.monotonic(), LOOK_S if self._shared else LONGEST_S)))
        self._current = None
        ended()
        return close_group(process)

    def _end_current(self) -> None:
        """Send SIGTERM to the program that is being executed, once; SIGKILL follows after the grace time."""
        if self._current is not None and self._kill_at == float("inf"):
            self._kill_at = time.monotonic() + self._plan["grace"]
            send(self._current.pid, signal.SIGTERM)

    def _wait(self, seconds: float) -> None:
        """Wait until a program has ended, a signal has come, or this time is over. Copies the output of services meanwhile."""
        pipes = {started.pipe: started for started in self._services if started.pipe is not None}
        readable = select.select([self._awake, *pipes], [], [], seconds)[0]
        for descriptor in readable:
            if descriptor == self._awake:
                os.read(self._awake, CHUNK)
            else:
                pipes[descriptor].read()

    def _ended_service(self) -> Started | None:
        return next((started for started in self._services if not is_running(started.process)), None)

    def _ended_shared(self) -> str | None:
        """Return the name of a shared service that has ended."""
        pids = self._shared["pids"] if self._shared else {}
        return next((name for name, pid in pids.items() if not is_alive(pid)), None)

    def _check_services(self) -> None:
        """Raise Failed if a service has ended."""
        name = self._ended_shared()
        if name is not None and self._shared:
            write(end_of(self._shared["log"]))
            raise Failed("service %r, which all runs share, ended before the run" % name)
        ended = self._ended_service()
        if ended is not None:
            status = close_group(ended.process)
            hint = "; a service must stay in the foreground" if status == 0 else ""
            raise Failed("service %r ended before the run: %s%s" % (ended.name, described(status), hint))

    def _check_told(self) -> None:
        if self._told:
            raise Failed("it was told to end (SIGTERM)", -signal.SIGTERM)


def start(argv: Sequence[str], *, output: int | None, errors: int | None, command: bool = False) -> subprocess.Popen[bytes]:
    """Start a program in a session of its own; `command`: it is the run's command.

    It inherits the lock of the run's checkpoint, the only other descriptor that this process has been given.
    """
    variables = {**os.environ, **COMMAND} if command else None
    return subprocess.Popen(
        argv,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=errors,
        start_new_session=True,
        env=variables,
        close_fds=False,
    )


def is_running(process: subprocess.Popen[bytes]) -> bool:
    """Return whether a program has not ended yet. If it has, its id still belongs to it."""
    if process.returncode is not None or not hasattr(os, "waitid"):
        return process.poll() is None
    return not has_ended(process.pid)


def processes_of_command() -> Iterable[int]:
    """Yield the living processes that the command of this run has started."""
    own = {"SIERRA_EXECUTION": os.environ.get("SIERRA_EXECUTION", ""), **COMMAND}
    marks = {os.fsencode("%s=%s" % one) for one in own.items()}
    for pid in sorted(all_processes()):
        if marks.issubset(environment_of(pid)) and is_alive(pid):
            yield pid


def close_group(process: subprocess.Popen[bytes]) -> int:
    """Kill what is left of a program's group; return its status."""
    if process.returncode is None:
        send(process.pid, signal.SIGKILL)
    return process.wait()


def send(group: int, number: int) -> None:
    signal_group(group, number)
    if number == signal.SIGTERM:  # a stopped process reacts to SIGTERM only when it is continued
        signal_group(group, signal.SIGCONT)


def accepts(port: int) -> bool:
    """Return whether a program accepts connections to a port of this host."""
    import socket

    for family, address in ((socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")):
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_STREAM) as client:
            client.settimeout(1.0)
            client.connect((address, port))
            return bool(client.getsockname()[:2] != client.getpeername()[:2])  # else it is connected to itself
    return False


def words_of(words: Sequence[str]) -> list[str]:
    """Return words for a message, without characters that stand for something."""
    return [PORT.sub("{port}", word).replace("\0", "{run}") for word in words]


def write(data: bytes) -> None:
    """Write to standard error, as far as that is possible."""
    with contextlib.suppress(OSError):
        write_all(2, data)


def described(status: int) -> str:
    return "ended by signal %d" % -status if status < 0 else "exit status %d" % status


def explain(error: BaseException, argv: Sequence[str]) -> str:
    reason = getattr(error, "strerror", None) or "%s: %s" % (type(error).__name__, error)
    return "%s: %s" % (getattr(error, "filename", None) or argv[0], reason)


def report(folder: str, reason: str | None, conductor: Conductor) -> None:
    """Write why the run has failed, or that everything was executed; its services' ports; and how its command has ended."""
    path = os.path.join(folder, REPORT)
    with contextlib.suppress(OSError):
        os.unlink(path)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with open(descriptor, "w", encoding="ascii") as file:
        record = {
            "error": reason,
            "ports": conductor.ports,
            "left_running": conductor.left,
            "after_marker": conductor.after_marker,
        }
        json.dump(record, file)


def end_like(status: int) -> NoReturn:
    """End with an exit status, or by a signal."""
    if status < 0:
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
        if -status not in (signal.SIGKILL, signal.SIGSTOP):
            signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    os._exit(status if status >= 0 else 128 - status)  # the first process of a container ignores its own signals


def main(arguments: Sequence[str]) -> NoReturn:
    folder, plan, *shared = arguments
    reason = None
    conductor = Conductor(folder, json.loads(plan), json.loads(shared[0]) if shared else None)
    try:
        status = conductor.conduct()
    except Failed as failed:
        reason, status = failed.reason, failed.status or 1
    try:
        report(folder, reason, conductor)
    except OSError as error:
        write(os.fsencode("the report cannot be written: %s\n" % error))
    end_like(status)
