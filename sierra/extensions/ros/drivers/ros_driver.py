"""A run of ROS: `python3 ros_driver.py LAUNCH OUTPUT roslaunch|ros2 [options]`.

SIERRA lays this file beside the launch file of each run, with `ros1_run.py` or `ros2_run.py`. They need Python 3.8 or newer;
with `roslaunch`, the Python of ROS 1. They start the launch file with a master on a port of its own (ROS 1), or in a domain of
its own (ROS 2). The exit status is 0 only if the whole time is over, and no node has died until then.

No single word of the launcher is believed, because the exit status of roslaunch is 0 even if every node has died: a node that
it reports as died fails the run, and so does one that disappears without such a report.

The time begins when all nodes are there, and when topics can be recorded. The parameter (ROS 1) or topic (ROS 2)
`/sierra/started` then becomes true. SIGTERM and SIGINT end all nodes by SIGINT to the launcher, so that bags are closed.
"""

from __future__ import annotations

import argparse
import collections
import glob
import hashlib
import importlib
import json
import os
import random
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from pathlib import Path
from typing import Any, Callable, Iterable, Mapping

TICK_S = 0.1
GONE_S = 3.0
GRACE = ((signal.SIGINT, 15.0), (signal.SIGTERM, 5.0), (signal.SIGKILL, 5.0))  # signals to the launcher, and seconds after each
LOG_LINES, CHUNK = 20, 1 << 16
KEEPER = "sierra_timekeeper"


COLOURS = re.compile(r"\x1b\[[0-9;]*m")
STARTED = re.compile(r"(?:process)?\[(\S+)\]: (?:process )?started with pid \[(\d+)\]")
DIED = re.compile(r"\[(\S+?)\]:? process has died (?:\[pid \d+, )?(exit code -?\d+|without exit code)")
FINISHED = re.compile(r"\[(\S+?)\]:? process has finished cleanly")
REQUIRED = re.compile(r"REQUIRED process \[(\S+)\] has died!")
REFUSED = re.compile(
    "(cannot launch node of type .*|failed to start local process: .*|Unable to launch .*|Caught .*exception.* in launch .*)"
)


class Failure(Exception):
    """The run has failed; the message is one line."""


class Stopped(Exception):
    """The run was told to end."""


class Died(Failure):
    """A node has died; its log says why."""

    def __init__(self, message: str, process: str) -> None:
        super().__init__(message)
        self.process = process


def node_of(process: str) -> str:
    """Return the name of a node from that of its process: `robot0/walker-2` is `/robot0/walker`."""
    return "/" + re.sub(r"-\d+$", "", process)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def is_free(port: int, kind: socket.SocketKind = socket.SOCK_STREAM) -> bool:
    """Return whether no program on this machine uses a port, of TCP or of UDP (SOCK_DGRAM)."""
    with socket.socket(socket.AF_INET, kind) as probe:
        if kind == socket.SOCK_STREAM:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True


def sourced(script: str) -> dict[str, str]:
    """Return the environment after a setup script. Raises Failure if it fails."""
    shell = 'source "$1" >&2 && exec "$2" -c "import json, os; print(json.dumps(dict(os.environ)))"'
    done = subprocess.run(["bash", "-c", shell, "bash", script, sys.executable], stdout=subprocess.PIPE, check=False)
    if done.returncode:
        raise Failure(f"the setup script {script} failed: exit status {done.returncode}")
    variables: dict[str, str] = json.loads(done.stdout)
    return variables


def given_variable(name: str, variables: Mapping[str, str] = os.environ) -> str:
    """Return a variable that SIERRA gives to programs on robots. Raises Failure if it is not there."""
    value = variables.get(name)
    if not value:
        raise Failure(f"{name} is not set; give each robot its address in [runners.robots.fleet]")
    return value


def number_of(execution: str) -> int:
    """Return a number that all parts of a run on several robots compute alike."""
    return int(hashlib.sha256(execution.encode()).hexdigest(), 16)


class Watch:
    """The nodes of a run, as the launcher reports them."""

    def __init__(self) -> None:
        self.respawned: set[str] = set()
        """Nodes that the launcher starts again when they end."""
        self.started: dict[str, int] = {}
        """The id of each process that was started and has not been reported as ended."""
        self.processes: set[str] = set()
        """All processes that were started. Several may have the same node, as `ros2 launch` calls it."""
        self.ended: set[str] = set()
        """Processes that have ended by themselves, without an error."""
        self.is_over = False
        """Whether the launcher ends its nodes; from then on, it is no failure if they end."""
        self.latest = 0.0
        """When the last node was started."""
        self._gone: dict[str, float] = {}
        self._line = b""
        self.last: collections.deque[str] = collections.deque(maxlen=LOG_LINES)
        """The last lines that nodes and the launcher have printed."""

    @property
    def nodes(self) -> set[str]:
        """All nodes that were started."""
        return set(map(node_of, self.processes))

    @property
    def finished(self) -> set[str]:
        """The nodes that have ended by themselves, without an error."""
        return set(map(node_of, self.ended))

    def read(self, chunk: bytes) -> None:
        """Read a part of the launcher's output, and copy it. Raises Failure."""
        *lines, self._line = (self._line + chunk).split(b"\n")
        for line in lines:
            text = COLOURS.sub("", line.decode("utf-8", "replace"))
            print(text, flush=True)
            self.last.append(text)
            self._report(text)

    def _report(self, text: str) -> None:
        if match := STARTED.search(text):
            self.started[match[1]] = int(match[2])
            self.processes.add(match[1])
            self.latest = time.monotonic()
        elif self.is_over:
            return
        elif match := REQUIRED.search(text):
            self.is_over = True
            if node_of(match[1]) != "/" + KEEPER:
                raise Died(f"the required node {node_of(match[1])} ended before the time was over", match[1])
        elif match := DIED.search(text):
            self._end(match[1], match[2])
        elif match := FINISHED.search(text):
            self._end(match[1], "")
        elif match := REFUSED.search(text):
            raise Failure(match[1])

    def _end(self, process: str, how: str) -> None:
        self.started.pop(process, None)
        node = node_of(process)
        if node in self.respawned:
            return
        if how:
            raise Died(f"the node {node} died early: {how}", process)
        self.ended.add(process)

    def check_alive(self) -> None:
        """Raise Died if a process has disappeared, and the launcher does not report it."""
        now = time.monotonic()
        gone = [name for name, pid in self.started.items() if not is_alive(pid)]
        self._gone = {name: self._gone.get(name, now) for name in gone}
        for name, since in self._gone.items():
            if now - since > GONE_S and not self.is_over:
                raise Died(f"the node {node_of(name)} ended early, and the launcher did not report it", name)


class Launch:
    """The launcher of one run, and everything that it starts."""

    written_last = ""
    """The file in a bag that is there only after the recorder has closed it; empty: the bag itself."""

    def __init__(self, given: argparse.Namespace) -> None:
        self.given = given
        self.run = str(uuid.uuid4())
        self.folder = Path(tempfile.mkdtemp(prefix="ros-"))
        self.marker = self.folder / "ended"
        self.logs = self.folder / "log"
        self.environment = sourced(given.setup) if given.setup else dict(os.environ)
        self.watch = Watch()
        self.locks: list[socket.socket] = []
        self.deadline = 0.0
        """When the patience with what is missing ends."""

    def command(self) -> list[str]:
        """Prepare the run; return the words that start it. Raises Failure."""
        raise NotImplementedError

    def look(self) -> bool:
        """Look after the run while it goes on; return whether the launcher is to be ended. Raises Failure."""
        raise NotImplementedError

    def close(self) -> None:
        """End what was started beside the launcher."""

    def is_over(self) -> bool:
        """Return whether the whole time is over."""
        return self.marker.is_file() and self.marker.read_text() == self.run

    def reserve(self, kind: str, numbers: range, is_free: Callable[[int], bool]) -> str:
        """Return a number that no other run on this machine has, and reserve it as long as this program runs. Raises Failure.

        The lock is an abstract socket: the kernel removes it with its process, and it is valid where ports are (a network
        namespace).
        """
        for number in random.sample(numbers, len(numbers)):
            lock = socket.socket(socket.AF_UNIX)
            try:
                lock.bind(f"\0sierra-ros-{kind}-{number}")
            except OSError:
                lock.close()
                continue
            if is_free(number):
                self.locks.append(lock)
                return str(number)
            lock.close()
        raise Failure(f"no {kind} from {numbers[0]} to {numbers[-1]} is free on this machine")

    def be_patient(self) -> None:
        self.deadline = time.monotonic() + self.given.patience

    def check_patience(self, missing: str) -> None:
        """Raise Failure if something is missing for too long."""
        if time.monotonic() > self.deadline:
            raise Failure(f"after {self.given.patience:g} s, {missing}")

    def awaits(self) -> list[str]:
        """Return the nodes that the run awaits, and that have not ended."""
        left = [node_of(process) for process in self.watch.processes - self.watch.ended]
        return sorted(node for node in left if is_named(node, self.given.awaited))

    def execute(self) -> None:
        """Execute the run. Raises Failure."""
        self.logs.mkdir(parents=True)
        output = str(self.given.output.resolve())
        self.environment.update(ROS_LOG_DIR=str(self.logs), PYTHONUNBUFFERED="1", SIERRA_OUTPUT=output)
        try:
            process = self.started(self.command())
            try:
                self.supervise(process)
            finally:
                end(process)
        finally:
            self.close()
        self.watch.read(b"\n")
        if not self.is_over():
            if self.marker.is_file():
                raise Failure(self.marker.read_text() or "the time keeper could not write its file")
            raise Failure(f"the launcher ended before the time was over (exit status {process.returncode})")
        self.check_bag()

    def which(self, program: str) -> str | None:
        """Return the path of a program, as nodes of the run find it; None if it is not installed."""
        return shutil.which(program, path=self.environment.get("PATH"))

    def started(self, words: list[str], out: Any = subprocess.PIPE, err: Any = subprocess.STDOUT) -> subprocess.Popen[bytes]:
        program = self.which(words[0])
        if program is None:
            raise Failure(f"the program {words[0]} is not installed, or setup does not add it to PATH")
        quiet, words = subprocess.DEVNULL, [program, *words[1:]]
        return subprocess.Popen(words, env=self.environment, stdin=quiet, stdout=out, stderr=err, start_new_session=True)

    def supervise(self, process: subprocess.Popen[bytes]) -> None:
        """Follow the launcher until it ends, or is to be ended. Raises Failure."""
        while process.poll() is None or self.goes_on(process):
            self.copy(process, TICK_S)
            self.watch.check_alive()
            if self.look():
                self.watch.is_over = True
                end(process)
        while self.copy(process, 0.0):
            pass

    def goes_on(self, process: subprocess.Popen[bytes]) -> bool:
        """Return whether the run goes on although the launcher has ended."""
        return False

    def copy(self, process: subprocess.Popen[bytes], seconds: float) -> bool:
        """Copy output of the launcher; return whether there was any within this time."""
        chunk = output_of(process, seconds)
        self.watch.read(chunk)
        return bool(chunk)

    def check_bag(self) -> None:
        """Check that the recorder has closed its file. Raises Failure."""
        if self.given.bag and not (self.given.output / self.given.bag / self.written_last).exists():
            raise Failure(f"the bag {self.given.bag} is missing or was not closed")


def output_of(process: subprocess.Popen[bytes], seconds: float) -> bytes:
    """Return output of a process; nothing if there is none within this time. If its pipe were full, it would not end."""
    pipe = process.stdout
    if pipe is None or pipe.closed:
        time.sleep(seconds)
        return b""
    if not select.select([pipe], [], [], seconds)[0]:
        return b""
    chunk = os.read(pipe.fileno(), CHUNK)
    if not chunk:
        pipe.close()
    return chunk


def is_named(node: str, names: Iterable[str]) -> bool:
    """Return whether a node has one of these names: with its namespace (`/robot0/walker`), or without (`walker`)."""
    return any(node == name or node.rpartition("/")[2] == name for name in names)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a launcher: by SIGINT, on which it ends its nodes and closes bags, then by SIGTERM and SIGKILL."""
    for number, seconds in GRACE:
        if process.poll() is not None:
            return
        process.send_signal(number)
        deadline = time.monotonic() + seconds
        while process.poll() is None and time.monotonic() < deadline:
            os.write(1, COLOURS.sub("", output_of(process, TICK_S).decode("utf-8", "replace")).encode())


def print_log(launch: Launch, process: str) -> None:
    """Print the end of the log files of a process, and of what was printed before it died."""
    paths = sorted(launch.logs.glob(f"*/{glob.escape(process.replace('/', '-'))}*.log"), reverse=True)
    logs = {path.name: path.read_text("utf-8", "replace").splitlines() for path in paths}
    for name, lines in [*logs.items(), ("the output", list(launch.watch.last))]:
        if lines:
            print(f"== the end of {name}", *lines[-LOG_LINES:], sep="\n", file=sys.stderr)


def raise_stopped(number: int, frame: object) -> None:
    raise Stopped(f"was told to end by signal {number}")


def main() -> None:
    """Execute one run; print in one line why it failed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("launch", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("launcher")
    parser.add_argument("--ros", type=int, choices=(1, 2), default=1)
    parser.add_argument("--packages", action="append", default=[])
    parser.add_argument("--setup")
    parser.add_argument("--await", action="append", default=[], dest="awaited")
    parser.add_argument("--patience", type=float, default=60.0)
    parser.add_argument("--length", type=float)
    parser.add_argument("--sim-time", action="store_true")
    parser.add_argument("--no-barrier", action="store_false", dest="barrier")
    parser.add_argument("--record", action="append", default=[])
    parser.add_argument("--bag")
    parser.add_argument("--may-lose", action="store_true")
    parser.add_argument("--share-master", action="store_true")
    parser.add_argument("--fleet", choices=("base", "robots"), help="the parts of a run of ROS 2 on several robots")
    given = parser.parse_args()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, raise_stopped)
    launch = None
    try:
        launch = importlib.import_module(f"ros{given.ros}_run").launch(given)  # runs have only one of them
        launch.execute()
    except (Failure, Stopped) as error:
        if launch is not None and isinstance(error, Died):
            print_log(launch, error.process)
        sys.exit(f"ros: {error}")


if __name__ == "__main__":
    importlib.import_module("ros_driver").main()  # as others import it: the errors that they raise are those caught here
