"""A run of ROS: `python3 ros_driver.py LAUNCH OUTPUT roslaunch|ros2 [options]`.

SIERRA lays this file beside the launch file of each run. It needs Python 3.8 or newer; with `roslaunch`, the Python of ROS 1.
It starts the launch file with a master on a port of its own (ROS 1), or in a domain of its own (ROS 2). The exit status is 0
only if the whole time is over, and no node has died until then.

With `ros2`, `ros2_watcher.py` takes part in the run: it tells which nodes are there, records topics, reads `/clock`, and
publishes `/sierra/started`. If there is no `ros2`, `ros2_launcher.py` starts the nodes.

With `--share-master`, a run on several robots has one master, on its base station. Each of them executes this file, with a
launch file of its own. They find the master by SIERRA_ADDRESS_0 and SIERRA_EXECUTION, from which its port follows, and agree by
parameters of the master:

- `/sierra/robot1/nodes`: the nodes of robot 1, as soon as the master knows them all;
- `/sierra/started`: all nodes of all robots are there; the base station sets it;
- `/sierra/robot1/finished`: the awaited nodes of robot 1 have ended; `/sierra/finished`: those of all robots;
- `/sierra/over`: the time is over, and robots end their nodes; `/sierra/robot1/closed`: robot 1 has done so.

With `--fleet`, a run of ROS 2 has a part on each robot, all in one domain: see `ros2_fleet.py`.

No single word of roslaunch is believed, because its exit status is 0 even if every node has died:

- a time keeper (`ros_timekeeper.py`, a required node) writes a file when the time is over;
- a node that the launcher reports as died fails the run, and so does one that disappears without such a report;
- as many nodes must have been started as the launch file has.

The time begins when all nodes are known to the master, and when the recorder of topics has subscribed. The parameter
`/sierra/started` then becomes true. SIGTERM and SIGINT end all nodes by SIGINT to the launcher, so that bags are closed.

`python3 ros_driver.py --nodes LAUNCH` prints the nodes of a launch file of ROS 1 as JSON, and what is wrong with them.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import glob
import hashlib
import http.client
import importlib
import json
import os
import random
import re
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import uuid
import xmlrpc.client
from pathlib import Path
from typing import Any, Callable, Iterable
from xml.etree import ElementTree

PORTS = range(20000, 32768)  # below those that Linux gives to outgoing connections
DOMAINS = range(1, 102)  # ROS_DOMAIN_ID: safe on Linux, without the default 0
USUAL_DOMAIN = 30  # of the drivers of a TurtleBot3
SYSTEM = "/usr/share"  # the packages of Debian; a setup script names others
TICK_S = 0.1
GONE_S = 3.0
CLOSED_S = 60.0  # for other parts of a run to end
SETTLED_S = 2.0  # without a new node, until all nodes of ROS 2 count as started, or those of several robots as complete
GRAPH_S = 0.5  # without a new node or publisher, until all nodes of ROS 2 count as complete
WATCHER_S = 60.0  # for the watcher to take part
WATCHED_S = 20.0  # for the watcher to close its bag
GRACE = ((signal.SIGINT, 15.0), (signal.SIGTERM, 5.0), (signal.SIGKILL, 5.0))  # signals to the launcher, and seconds after each
SIGINT_S, SIGTERM_S = 5.0, 2.0  # for each node, by roslaunch
LOG_LINES, CHUNK = 20, 1 << 16
PACKAGE, KEEPER, RECORDER = "sierra_ros", "sierra_timekeeper", "sierra_bag"
CORE = {"/master", "/rosout"}
CALLER = "/sierra_driver"
PROBE = """
import sys
from importlib.util import find_spec
find_spec("rclpy") or sys.exit(1)
print(find_spec("mcap") is not None, sys.prefix)
"""
PUSHED = ("push_ros_namespace", "push-ros-namespace")
OF_ALL = ("arg", "let", "set_env", "unset_env", "set_parameter", "set_remap", *PUSHED)  # start nothing
PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
WITHOUT_NUMBERS = ("foxy", "galactic", "humble")
"""Versions of ROS 2 whose messages have no numbers; `ros2 bag` records there."""
WITH_OLD_PROFILES = ("foxy", "galactic", "humble", "iron", "jazzy")
HERE = "127.0.0.1"

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


def reserved(kind: str, numbers: range, is_free: Callable[[int], bool]) -> tuple[socket.socket, int]:
    """Return a number that no other run on this machine has, and the lock that reserves it until it is closed.

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
            return lock, number
        lock.close()
    raise Failure(f"no {kind} from {numbers[0]} to {numbers[-1]} is free on this machine")


def is_free_port(port: int) -> bool:
    with socket.socket() as tried:
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            tried.bind(("", port))
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


class Died(Failure):
    """A node has died; its log says why."""

    def __init__(self, message: str, process: str) -> None:
        super().__init__(message)
        self.process = process


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
        if found := STARTED.search(text):
            self.started[found[1]] = int(found[2])
            self.processes.add(found[1])
            self.latest = time.monotonic()
        elif self.is_over:
            return
        elif found := REQUIRED.search(text):
            self.is_over = True
            if node_of(found[1]) != "/" + KEEPER:
                raise Died(f"the required node {node_of(found[1])} ended before the time was over", found[1])
        elif found := DIED.search(text):
            self._end(found[1], found[2])
        elif found := FINISHED.search(text):
            self._end(found[1], "")
        elif found := REFUSED.search(text):
            raise Failure(found[1])

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

    def __init__(self, given: argparse.Namespace) -> None:
        self.given = given
        self.run = str(uuid.uuid4())
        self.folder = Path(tempfile.mkdtemp(prefix="ros-"))
        self.marker = self.folder / "ended"
        self.logs = self.folder / "log"
        self.environment = sourced(given.setup) if given.setup else dict(os.environ)
        self.watch = Watch()
        self.locks: list[socket.socket] = []

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

    def reserve(self, kind: str, numbers: range, is_free: Callable[[int], bool] = lambda number: True) -> str:
        lock, number = reserved(kind, numbers, is_free)
        self.locks.append(lock)
        return str(number)

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

    def started(self, words: list[str]) -> subprocess.Popen[bytes]:
        quiet, piped = subprocess.DEVNULL, subprocess.PIPE
        program = shutil.which(words[0], path=self.environment.get("PATH"))
        if program is None:
            raise Failure(f"the program {words[0]} is not installed, or setup does not add it to PATH")
        words = [program, *words[1:]]
        return subprocess.Popen(
            words, env=self.environment, stdin=quiet, stdout=piped, stderr=subprocess.STDOUT, start_new_session=True
        )

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
        pipe = process.stdout
        if pipe is None or pipe.closed:
            time.sleep(seconds)
            return False
        if not select.select([pipe], [], [], seconds)[0]:
            return False
        chunk = os.read(pipe.fileno(), CHUNK)
        if not chunk:
            pipe.close()
        self.watch.read(chunk)
        return bool(chunk)

    def check_bag(self) -> None:
        """Check that the recorder has closed its file. Raises Failure."""
        if self.given.bag and not self.written_last(self.given.output / self.given.bag).exists():
            raise Failure(f"the bag {self.given.bag} is missing or was not closed")

    def written_last(self, bag: Path) -> Path:
        """Return the file that is there only after the recorder has closed its bag."""
        return bag


class Launch1(Launch):
    """A run of ROS 1: roslaunch, its master, and the time keeper."""

    address = master_address = HERE

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        self.robots: list[str] = []
        """The other robots that use its master."""

    def find_master(self) -> tuple[str, str]:
        """Return the port of the master, and the option that starts it there or waits for it. Raises Failure."""
        port = self.reserve("port", PORTS, is_free_port)
        return port, "--port=" + port

    def command(self) -> list[str]:
        given, (port, option) = self.given, self.find_master()
        self.make_package()
        found = (str(self.folder / "packages"), *given.packages, self.environment.get("ROS_PACKAGE_PATH") or SYSTEM)
        uri = f"http://{self.master_address}:{port}"
        for name in ("ROS_HOSTNAME", "ROS_NAMESPACE"):
            self.environment.pop(name, None)
        self.environment.update(
            ROS_PACKAGE_PATH=":".join(found),
            ROS_HOME=str(self.folder / "home"),
            ROS_MASTER_URI=uri,
            ROS_IP=self.address,
            SIERRA_ROS_ROBOTS=" ".join(self.robots),
            SIERRA_ROS_RUN=self.run,
            SIERRA_ROS_MARKER=str(self.marker),
            SIERRA_ROS_PATIENCE=repr(given.patience),
            SIERRA_ROS_AWAIT=" ".join(given.awaited),
        )
        self.check_nodes()
        self.master: Any = xmlrpc.client.ServerProxy(uri)
        self.deadline = time.monotonic() + given.patience
        self.has_begun = self.has_finished = False
        limits = (f"--sigint-timeout={SIGINT_S:g}", f"--sigterm-timeout={SIGTERM_S:g}")
        quiet = ("--disable-title", "--no-summary", "--skip-log-check")
        return [given.launcher, *quiet, *limits, "--run_id=" + self.run, option, str(given.launch)]

    def make_package(self) -> None:
        """Make the package of the time keeper, which needs no build."""
        package = self.folder / "packages" / PACKAGE
        script = package / "scripts" / "timekeeper"
        script.parent.mkdir(parents=True)
        text = (Path(__file__).parent / "ros_timekeeper.py").read_text()
        script.write_text(f"#!{sys.executable}\n{text}")
        script.chmod(0o755)
        about = "<version>1.0.0</version><description>SIERRA</description><license>MIT</license>"
        person = '<maintainer email="nobody@example.org">SIERRA</maintainer>'
        (package / "package.xml").write_text(f'<package format="2"><name>{PACKAGE}</name>{about}{person}</package>')

    def check_nodes(self) -> None:
        """Let ROS read the launch file, and check that everything that it starts exists. Raises Failure."""
        words = [sys.executable, __file__, "--nodes", str(self.given.launch)]
        done = subprocess.run(words, env=self.environment, stdout=subprocess.PIPE, check=False)
        if done.returncode:
            raise Failure("the launch file cannot be read")
        answer = json.loads(done.stdout.splitlines()[-1])
        if answer["errors"]:
            raise Failure("; ".join(answer["errors"]))
        names = [node["name"] for node in answer["nodes"]]
        self.check_awaited(names)
        self.expected = len(names)
        self.watch.respawned = {node["name"] for node in answer["nodes"] if node["respawn"]}

    def check_awaited(self, names: list[str]) -> None:
        """Raise Failure if an awaited node is not among these."""
        for wanted in self.given.awaited:
            if not any(is_named(name, [wanted]) for name in names):
                raise Failure("await: there is no node {}; there are {}".format(wanted, " ".join(names) or "none"))

    def look(self) -> bool:
        if not self.has_begun and not self.missing():
            self.has_begun = self.told("started")
        if not self.has_begun and not self.watch.is_over and time.monotonic() > self.deadline:
            raise Failure(f"after {self.given.patience:g} s, {self.missing()}")
        if self.has_begun and self.given.awaited and not self.has_finished and not self.awaits():
            self.has_finished = self.told("finished")
        return False

    def told(self, name: str, value: object = True) -> bool:
        with contextlib.suppress(OSError, xmlrpc.client.Error, http.client.HTTPException):
            return bool(self.master.setParam(CALLER, "/sierra/" + name, value)[0] == 1)
        return False

    def heard(self, name: str) -> Any:
        """Return the value of a parameter that another part of the run has set; None without one."""
        with contextlib.suppress(OSError, xmlrpc.client.Error, http.client.HTTPException):
            status, _, value = self.master.getParam(CALLER, "/sierra/" + name)
            return value if status == 1 else None
        return None

    def missing(self) -> str:
        """Return what is missing until the time can begin; nothing if all nodes are there."""
        nodes = self.watch.nodes - CORE
        if len(nodes) < self.expected:
            return f"{len(nodes)} of {self.expected} nodes were started"
        try:
            waiting = nodes - self.watch.finished if self.given.barrier else {"/" + KEEPER}
            absent = sorted(name for name in waiting if self.master.lookupNode(CALLER, name)[0] != 1)
            if absent:
                return f"the node {absent[0]} is not known to the master (for programs that are no nodes: barrier = false)"
            return self.unrecorded() if self.given.record else ""
        except (OSError, xmlrpc.client.Error, http.client.HTTPException):
            return "the master does not answer"

    def unrecorded(self) -> str:
        """Return a topic that the recorder does not receive yet from all nodes that publish it.

        The recorder lists a connection before it is there, so each node must list it, too.
        """
        received = collections.Counter(topic for _, topic in self.links("/" + RECORDER, "i"))
        for topic, nodes in self.master.getSystemState(CALLER)[2][0]:
            if not any(re.fullmatch(one, topic) for one in self.given.record):
                continue
            if received[topic] < len(nodes):
                return f"the recorder has not subscribed to {topic}"
            if silent := [node for node in nodes if ("/" + RECORDER, topic) not in self.links(node, "o")]:
                return f"{silent[0]} does not send {topic} to the recorder yet"
        return ""

    def links(self, node: str, direction: str) -> list[tuple[str, str]]:
        """Return the other end and the topic of each connection of a node that is incoming ("i") or outgoing ("o")."""
        served: Any = xmlrpc.client.ServerProxy(self.master.lookupNode(CALLER, node)[2])
        return [(link[1], link[4]) for link in served.getBusInfo(CALLER)[2] if link[2] == direction]

    def check_bag(self) -> None:
        if self.given.bag and list(self.given.output.glob(self.given.bag + "*.active")):
            raise Failure(f"the bag {self.given.bag} was not closed")
        super().check_bag()


def given_variable(name: str) -> str:
    """Return a variable that SIERRA gives to programs on robots. Raises Failure if it is not there."""
    value = os.environ.get(name)
    if not value:
        raise Failure(f"{name} is not set; give each robot its address in [runners.robots.fleet]")
    return value


class Shared(Launch1):
    """The part of a robot, or of the base station, in a run of ROS 1 with one master, that of the base station."""

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        number = int(hashlib.sha256(given_variable("SIERRA_EXECUTION").encode()).hexdigest(), 16)
        self.run = str(uuid.UUID(int=number % 2**128))  # roslaunch refuses a master of another run
        self.port = PORTS[number % len(PORTS)]
        self.place = given_variable("SIERRA_ROBOT")
        self.address, self.master_address = given_variable("SIERRA_ADDRESS"), given_variable("SIERRA_ADDRESS_0")
        self.own: list[str] = []
        """Its own nodes."""

    def check_awaited(self, names: list[str]) -> None:
        """Check nothing yet: the base station does it when all robots have named their nodes."""
        self.own = names


class BaseStation(Shared):
    """The part of the base station: the master, the time keeper, and all nodes of no single robot."""

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        self.robots = [f"robot{number}" for number in range(1, int(given_variable("SIERRA_ROBOTS")) + 1)]

    def find_master(self) -> tuple[str, str]:
        port = self.reserve("port", range(self.port, self.port + 1), is_free_port)
        return port, "--port=" + port

    def missing(self) -> str:
        nodes = {robot: self.heard(robot + "/nodes") for robot in self.robots}
        absent = [robot for robot, found in nodes.items() if found is None]
        if absent:
            return f"{absent[0]} does not have all of its nodes"
        Launch1.check_awaited(self, [*self.own, *(name for found in nodes.values() for name in found)])
        return super().missing()

    def awaits(self) -> list[str]:
        return [*super().awaits(), *(robot for robot in self.robots if not self.heard(robot + "/finished"))]


class Robot(Shared):
    """The part of a robot: its own nodes. It ends when the base station says that the run is over."""

    has_told = has_heard = False

    def find_master(self) -> tuple[str, str]:
        for one, other in ((self.master_address, self.address), (self.address, self.master_address)):
            if ":" in one or (one.startswith("127.") and not other.startswith("127.")):
                raise Failure(f"{other} cannot reach {one} by ROS 1; give it another address in [runners.robots.fleet]")
        return str(self.port), "--wait"

    def look(self) -> bool:
        if not self.has_told and not self.missing():
            self.has_told = self.told(f"robot{self.place}/nodes", self.own)
        self.has_begun = self.has_begun or bool(self.has_told and self.heard("started"))
        if not self.has_told and time.monotonic() > self.deadline:
            raise Failure(f"after {self.given.patience:g} s, {self.missing()}")
        if self.has_begun and not self.has_finished and not self.awaits():
            self.has_finished = self.told(f"robot{self.place}/finished")
        self.has_heard = self.has_begun and bool(self.heard("over"))
        return self.has_heard

    def unrecorded(self) -> str:
        return ""

    def is_over(self) -> bool:
        return self.has_heard

    def close(self) -> None:
        if self.has_heard:
            self.told(f"robot{self.place}/closed")

    def check_bag(self) -> None:
        """Do nothing: the base station records."""


class Launch2(Launch):
    """A run of ROS 2, in a domain of its own. The driver itself keeps the time."""

    begin: float | None = None
    first: float | None = None
    """The simulated time when it was first seen."""
    latest = 0.0
    """The last simulated time."""
    watcher: Any = None
    recorder: subprocess.Popen[bytes] | None = None

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        self.parts: Any = importlib.import_module("ros2_fleet")  # in runs of ROS 1, this file is not there
        self.fleet: Any = None
        """The parts of the run on other robots; None if all of it is here."""
        if given.fleet:
            try:
                self.fleet = self.parts.fleet(os.environ, has_base=given.fleet == "base")
            except self.parts.Unfit as error:
                raise Failure(str(error)) from error
        if self.fleet is not None and not self.fleet.records:
            given.bag = None
        self.own = self.own_namespace()

    def command(self) -> list[str]:
        given = self.given
        if given.length is None:
            raise Failure("ROS 2 needs --length")
        self.environment.update(ROS_DOMAIN_ID=self.find_domain(), ROS_HOME=str(self.folder / "home"))
        self.stay_here()
        python, has_recorder = self.find_python()
        self.add_packages(python)
        self.start_watcher(python, has_recorder=has_recorder)
        if shutil.which(given.launcher, path=self.environment.get("PATH")):
            return [given.launcher, "launch", "--noninteractive", str(given.launch)]
        return [python, beside("ros2_launcher.py"), str(given.launch)]

    def find_domain(self) -> str:
        """Return a domain that nobody on this machine uses: that of all parts, or any. Raises Failure."""
        if self.fleet is None:
            return self.reserve("domain", DOMAINS, is_free_domain)
        domains = [number for number in DOMAINS if number != USUAL_DOMAIN]
        domain = domains[self.fleet.number % len(domains)]
        try:
            return self.reserve("domain", range(domain, domain + 1), is_free_domain)
        except Failure as error:
            raise Failure(
                f"another program on this robot uses the domain {domain} of ROS 2, which this run got by chance; "
                "execute the run again: it gets another one"
            ) from error

    def stay_here(self) -> None:
        """Let nodes discover those of this run only, and use no shared memory: nodes that are killed would leave it behind.

        For Fast DDS, only a profile can do this. Its file counts if there is no other one, and no other middleware is chosen.
        """
        for name in ("ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
            self.environment.pop(name, None)
        middleware = self.environment.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
        if "fastrtps" in middleware and not any(name in self.environment for name in PROFILES):
            profile = self.folder / "fastdds.xml"
            profile.write_text(self.parts.profile(self.fleet.addresses if self.fleet else [HERE]))
            is_old = self.environment.get("ROS_DISTRO") in WITH_OLD_PROFILES
            self.environment[PROFILES[is_old]] = str(profile)
        else:
            print("ros: the middleware is yours, so nodes may use shared memory and multicast", flush=True)
            self.environment.update(ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")  # Iron and newer
            if self.fleet is None:
                self.environment.update(ROS_LOCALHOST_ONLY="1")  # before
            else:
                self.environment.update(ROS_STATIC_PEERS=";".join(self.fleet.addresses))

    def find_python(self) -> tuple[str, bool]:
        """Return a Python that has rclpy, and whether it has mcap. Let its packages be found. Raises Failure."""
        tried = [sys.executable, shutil.which("python3", path=self.environment.get("PATH")) or sys.executable]
        for python in dict.fromkeys(tried):
            done = subprocess.run([python, "-c", PROBE], env=self.environment, stdout=subprocess.PIPE, check=False)
            if done.returncode == 0:
                has_mcap, _, prefix = done.stdout.decode().strip().partition(" ")
                self.add_prefix(prefix)
                return python, has_mcap == "True" and self.environment.get("ROS_DISTRO") not in WITHOUT_NUMBERS
        raise Failure(
            "no ROS 2: name its setup script in [platforms.ros], or install it by pip install 'sierra-experiments[ros2]', "
            "which is there for Python 3.10 to 3.13 on Linux on x86-64"
        )

    def add_prefix(self, folder: str) -> None:
        """Let packages in a folder be found, after those that are known."""
        known = list(filter(None, self.environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep)))
        if Path(folder, "share", "ament_index").is_dir() and folder not in known:
            self.environment["AMENT_PREFIX_PATH"] = os.pathsep.join([*known, folder])

    def add_packages(self, python: str) -> None:
        """Let the packages of the project be found as if they were installed. Raises Failure."""
        packages = [path for folder in self.given.packages for path in sorted(Path(folder).resolve().rglob("package.xml"))]
        if self.given.packages and not packages:
            raise Failure(f"there is no package.xml in {', '.join(self.given.packages)}, which packages names")
        installed = self.folder / "packages"
        index = installed / "share" / "ament_index" / "resource_index" / "packages"
        index.mkdir(parents=True)
        for path in packages:
            try:
                name = (ElementTree.parse(path).findtext("name") or "").strip()  # noqa: S314 - the project's own file
            except ElementTree.ParseError as error:
                raise Failure(f"{path} is not XML: {error}") from error
            if not re.fullmatch(r"\w+", name) or (index / name).exists():
                raise Failure(f"{path}: a package needs a name of its own, but this is {name!r}")
            (index / name).touch()
            (installed / "share" / name).symlink_to(path.parent)
            programs = installed / "lib" / name
            programs.mkdir(parents=True)
            for script in filter(Path.is_file, sorted(path.parent.glob("scripts/*"))):
                self.add_program(programs / script.name, script, python)
        before = self.environment.get("AMENT_PREFIX_PATH")
        self.environment["AMENT_PREFIX_PATH"] = os.pathsep.join(filter(None, [str(installed), before]))

    @staticmethod
    def add_program(program: Path, script: Path, python: str) -> None:
        """Make the program of a node: a script in Python is started by the Python that has rclpy."""
        with script.open("rb") as file:
            is_python = script.suffix == ".py" or re.match(rb"#!.*\bpython[0-9.]*\s", file.readline())
        if not is_python:
            program.symlink_to(script)
            return
        words = " ".join(shlex.quote(word) for word in (python, str(script)))
        program.write_text(f'#!/bin/sh\nexec {words} "$@"\n')
        program.chmod(0o755)

    def start_watcher(self, python: str, *, has_recorder: bool) -> None:
        """Start the watcher, which records, and wait until it takes part. Raises Failure."""
        given = self.given
        bag = ["--bag", str(given.output.resolve() / given.bag)] if given.bag and has_recorder else []
        clock, limit = ["--clock"] if given.sim_time else [], time.monotonic() + WATCHER_S
        part = ["--place", str(self.fleet.place), "--run", self.fleet.run] if self.fleet else []
        part += ["--own", self.own] if self.own else []
        self.watcher = Watcher([python, beside("ros2_watcher.py"), *given.record, *bag, *clock, *part], self.environment)
        self.recorder = None if has_recorder or not given.bag else self.start_recorder()
        while not self.watcher.is_ready or (self.recorder is not None and not (given.output / given.bag).exists()):
            self.watcher.look()
            if time.monotonic() > limit:
                raise Failure(f"ROS 2 or its recorder did not start within {WATCHER_S:g} s")
            time.sleep(TICK_S)
        self.deadline = time.monotonic() + given.patience

    @property
    def starts_nothing(self) -> bool:
        """Return whether the launch file of a base station has nothing to start."""
        return self.fleet is not None and self.fleet.place == 0 and all(child.tag in OF_ALL for child in self.document())

    def document(self) -> ElementTree.Element:
        return ElementTree.parse(self.given.launch).getroot()  # noqa: S314 - the run's own file

    def own_namespace(self) -> str:
        """Return the namespace of the robot here, whose topics it records; nothing if it records all."""
        if self.fleet is None or self.fleet.has_base or not self.given.bag:
            return ""
        for group in self.document().findall("group"):
            names = {child.get("name") for child in group.findall("let")}
            spaces = [child.get("namespace", "") for child in group if child.tag in PUSHED]
            if {"robot", "index"} <= names and spaces:
                return f"/{spaces[0].strip('/')}"
        return ""

    def start_recorder(self) -> subprocess.Popen[bytes]:
        """Start the recorder of ROS 2, where the package mcap is missing. Raises Failure."""
        given = self.given
        if self.own:
            raise Failure("robots without a base station record only with ROS 2 Iron or newer, and the package mcap")
        topics = "|".join(f"({topic})" if "|" in topic else topic for topic in given.record)
        words = ["bag", "record", "-s", "mcap", "-o", str(given.output.resolve() / given.bag), "--regex", topics]
        program = shutil.which("ros2", path=self.environment.get("PATH"))
        if program is None:
            raise Failure("nothing can record topics here: pip install 'sierra-experiments[ros2]', or install ros2 bag")
        return subprocess.Popen(
            [program, *words], env=self.environment, stdin=subprocess.DEVNULL, stdout=sys.stderr, start_new_session=True
        )

    def look(self) -> bool:
        self.watcher.look()
        if self.fleet is not None:
            self.follow_others()
        if self.begin is None:
            if not (missing := self.missing() or self.unready()):
                self.watcher.start()
                self.begin_time()
            elif time.monotonic() > self.deadline:
                raise Failure(f"after {self.given.patience:g} s, {missing}")
            elif self.fleet is not None and self.fleet.is_over:
                raise Failure("the run has ended before it began here")
            return False
        passed = self.passed()
        if self.fleet is not None and not self.fleet.leads:
            return self.is_ended(passed)
        if self.given.awaited:
            return self.is_finished(passed)
        return passed is not None and passed >= self.given.length and self.mark()

    def begin_time(self) -> None:
        self.begin = self.deadline = time.monotonic()
        self.deadline += self.given.patience

    def follow_others(self) -> None:
        """Hear the other parts of the run, and tell them the state of this one. Raises Failure."""
        self.hear()
        if self.begin is None and self.watcher.has_started:
            self.begin_time()
        if self.begin is None:
            self.tell(programs=len(self.watch.processes - self.watch.ended), ready=not self.missing())
        else:
            settled = time.monotonic() - self.watch.latest > SETTLED_S
            awaited = [process for process in self.watch.processes if is_named(node_of(process), self.given.awaited)]
            self.tell(awaited=len(awaited), finished=settled and not self.awaits())

    def hear(self) -> None:
        try:
            self.fleet.hear(self.watcher.members)
        except self.parts.Unfit as error:
            raise Failure(str(error)) from error

    def tell(self, **state: Any) -> None:
        """Tell the other parts what is new of the state of this one."""
        if any(self.fleet.state[name] != value for name, value in state.items()) or self.fleet.place not in self.fleet.states:
            self.fleet.state.update(state)
            self.watcher.send(json.dumps(self.fleet.state))

    def unready(self) -> str:
        """Return the other part that is not ready, if there is one. Only the leader lets the time begin."""
        if self.fleet is None:
            return ""
        if late := self.fleet.unready():
            return f"{late} does not see all nodes of the run"
        return "" if self.fleet.leads else f"{self.fleet.name(self.fleet.places[0])} has not let the time begin"

    def missing(self) -> str:
        """Return what is missing until the time can begin; nothing if all nodes are there."""
        programs = len(self.watch.processes - self.watch.ended)
        if not self.watch.processes and not self.starts_nothing:
            return "no node was started"
        if self.own and not any(name.startswith(f"{self.own}/") for name in self.watcher.nodes):
            return f"no node is in the namespace {self.own}, whose topics are recorded here"
        if self.fleet is not None:
            if absent := self.fleet.absent():
                return f"nothing was heard of {absent}; can it be reached by UDP, or does it need more than patience?"
            programs = self.fleet.programs
        known = self.watcher.participants
        if self.given.barrier and known < programs:
            names = ", ".join(self.watcher.nodes) or "none"
            return f"{known} of {programs} programs are nodes ({names}); for programs that are no nodes: barrier = false"
        if time.monotonic() - self.watcher.changed < (GRAPH_S if self.fleet is None else SETTLED_S):
            return "nodes or topics were added just now"
        if self.watcher.unheard:
            return f"subscribers of /sierra/started that would not hear it yet: {self.watcher.unheard}"
        if self.watcher.pending:
            return f"the recorder does not receive {self.watcher.pending[0]} from all who publish it"
        return ""

    def passed(self) -> float | None:
        """Return the seconds since the begin; None if the simulated time has not begun. Raises Failure."""
        if self.begin is None or not self.given.sim_time:
            return None if self.begin is None else time.monotonic() - self.begin
        if self.watcher.clock is None:
            if time.monotonic() > self.deadline:
                raise Failure("nothing has published the simulated time (/clock)")
            return None
        if self.first is None:
            self.first = self.latest = self.watcher.clock
        if self.watcher.clock != self.latest:
            if not 0 < self.watcher.clock - self.latest <= self.given.length:
                raise Failure(f"the simulated time went from {self.latest:g} s to {self.watcher.clock:g} s at once")
            self.latest, self.deadline = self.watcher.clock, time.monotonic() + self.given.patience
        elif time.monotonic() > self.deadline:
            raise Failure(f"the simulated time has been {self.latest:g} s for {self.given.patience:g} s")
        return self.latest - self.first

    def is_finished(self, passed: float | None) -> bool:
        if self.has_all_awaited() and time.monotonic() - self.watch.latest > SETTLED_S:
            return self.mark()
        if self.is_late(passed):
            late = ", ".join(self.awaits() or (self.fleet.unfinished() if self.fleet else []) or self.given.awaited)
            raise Failure(f"awaited nodes have not ended {self.given.patience:g} s after the length of the run: {late}")
        return False

    def is_late(self, passed: float | None) -> bool:
        return passed is not None and passed > self.given.length + self.given.patience

    def is_ended(self, passed: float | None) -> bool:
        """Return whether the leader has ended the run. Raises Failure if it is late."""
        if self.fleet.is_over:
            return self.mark()
        if passed is not None and self.is_late(passed - CLOSED_S):
            raise Failure(f"{self.fleet.name(self.fleet.places[0])} has not ended the run")
        return False

    def has_all_awaited(self) -> bool:
        """Return whether awaited nodes were started, and all of them have ended."""
        if self.fleet is not None:
            return self.fleet.awaited > 0 and not self.fleet.unfinished()
        return not self.awaits() and any(is_named(node, self.given.awaited) for node in self.watch.nodes)

    def goes_on(self, process: subprocess.Popen[bytes]) -> bool:
        """Return whether only other parts of the run have something to do. `ros2 launch` has ended then."""
        while self.copy(process, 0.0):
            pass
        if self.fleet is None or process.returncode or self.watch.is_over:
            return False
        return self.starts_nothing or bool(self.given.awaited and self.watch.processes and not self.awaits())

    def is_over(self) -> bool:
        """Return whether the whole time is over. `ros2 launch` ends by itself when all nodes have ended."""
        return super().is_over() or (self.fleet is None and self.begin is not None and self.has_all_awaited())

    def close(self) -> None:
        try:
            if self.fleet is not None and self.is_over():
                self.close_together()
        finally:
            if self.watcher is not None:
                self.watcher.end()
            if self.recorder is not None:
                end(self.recorder)

    def check_bag(self) -> None:
        if self.recorder is not None:
            super().check_bag()
        elif self.given.bag:
            self.watcher.check(may_lose=self.given.may_lose)

    def written_last(self, bag: Path) -> Path:
        return bag / "metadata.yaml"  # the folder and its files are there from the recorder's start

    def close_together(self) -> None:
        """Tell that the nodes of this part have ended, and wait for those of the others. Raises Failure if they do not end."""
        self.tell(closed=True)
        limit = time.monotonic() + CLOSED_S
        while (self.fleet.leads or self.given.bag) and (open_part := self.fleet.unclosed()):
            if time.monotonic() > limit:
                raise Failure(f"{open_part} has not ended its nodes within {CLOSED_S:g} s")
            self.watcher.look()
            self.hear()
            time.sleep(TICK_S)

    def mark(self) -> bool:
        if self.fleet is not None and self.fleet.leads:
            self.tell(over=True)
        self.marker.write_text(self.run)
        return True


class Watcher:
    """The program that takes part in a run of ROS 2; see `ros2_watcher.py`."""

    def __init__(self, words: list[str], environment: dict[str, str]) -> None:
        piped = subprocess.PIPE
        self.process = subprocess.Popen(words, env=environment, stdin=piped, stdout=piped, start_new_session=True)
        self.is_ready = False
        self.changed = time.monotonic()
        """When nodes or publishers were added or removed."""
        self.nodes: list[str] = []
        self.participants = 0
        """The number of programs with nodes."""
        self.pending: list[str] = []
        self.unheard = 0
        """The number of subscribers that it does not reach yet."""
        self.clock: float | None = None
        self.publishers = 0
        self.has_started = False
        """True if it has heard that the time begins."""
        self.members: list[dict[str, Any]] = []
        """The states of the parts of a run on several robots."""
        self.recorded: dict[str, Any] = {}
        self._text = b""

    def look(self) -> None:
        """Read what it has seen. Raises Failure if it has failed."""
        pipe = self.process.stdout
        while pipe is not None and select.select([pipe], [], [], 0.0)[0]:
            chunk = os.read(pipe.fileno(), CHUNK)
            if not chunk:
                break
            self._text += chunk
        *lines, self._text = self._text.split(b"\n")
        for line in lines:
            seen: dict[str, Any] = json.loads(line)
            if "failure" in seen:
                raise Failure(seen["failure"])
            self.is_ready = True
            if seen.get("publishers", self.publishers) != self.publishers or seen.get("nodes", self.nodes) != self.nodes:
                self.changed = time.monotonic()
            self.publishers = seen.get("publishers", self.publishers)
            self.nodes, self.pending = seen.get("nodes", self.nodes), seen.get("pending", self.pending)
            self.clock, self.unheard = seen.get("clock", self.clock), seen.get("unheard", self.unheard)
            self.has_started = seen.get("started", self.has_started)
            self.members = seen.get("members", self.members)
            self.participants = seen.get("participants", self.participants)
            self.recorded = seen if "messages" in seen else self.recorded
        if self.process.poll() is not None and not self.recorded and self.process.returncode:
            raise Failure(f"the program that watches the run has ended (exit status {self.process.returncode})")

    def start(self) -> None:
        """Let it tell all nodes that the time has begun."""
        self.send("start")

    def send(self, line: str) -> None:
        if self.process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                os.write(self.process.stdin.fileno(), f"{line}\n".encode())

    def end(self) -> None:
        """Let it close its bag."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(WATCHED_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def check(self, *, may_lose: bool) -> None:
        """Check that it has recorded all messages. Raises Failure."""
        self.look()
        if not self.recorded:
            raise Failure(f"the recorder ended without an account of its messages (exit status {self.process.returncode})")
        lost, late = self.recorded["lost"], self.recorded["late"]
        print(f"recorded {self.recorded['messages']} messages, lost {sum(lost.values())}", flush=True)
        for topic, count in late.items():
            print(f"{topic}: {count} published before the start, and before they could be recorded", flush=True)
        for topic in self.recorded["silent"]:
            print(f"{topic}: nothing came from a node that publishes it", flush=True)
        if lost and not may_lose:
            topics = ", ".join(f"{count} of {topic}" for topic, count in lost.items())
            raise Failure(
                f"messages were lost while they were recorded: {topics} (nodes that create publishers before they wait for "
                "/sierra/started lose none at the begin); if that is right, set may_lose = true"
            )
        if (count := self.recorded["dropped"]) and not may_lose:
            raise Failure(
                f"the last messages may be missing: in the last seconds, the kernel dropped {count} packets for the recorder; "
                "if that is right, set may_lose = true"
            )


def beside(name: str) -> str:
    """Return the path of a program that lies beside this one."""
    return str(Path(__file__).resolve().parent / name)


def is_free_domain(number: int) -> bool:
    """Return whether nobody on this machine discovers others in a domain: https://docs.ros.org, 'The ROS_DOMAIN_ID'."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tried:
        try:
            tried.bind(("", 7400 + 250 * number))
        except OSError:
            return False
    return True


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
            drain(process)


def drain(process: subprocess.Popen[bytes]) -> None:
    """Copy the last output of a process that is ending: if its pipe were full, it would not end."""
    pipe = process.stdout
    if pipe is None or pipe.closed:
        time.sleep(TICK_S)
    elif select.select([pipe], [], [], TICK_S)[0]:
        chunk = os.read(pipe.fileno(), CHUNK)
        if not chunk:
            pipe.close()
        os.write(1, COLOURS.sub("", chunk.decode("utf-8", "replace")).encode())


def print_log(launch: Launch, process: str) -> None:
    """Print the end of the log files of a process, and of what was printed before it died."""
    found = launch.logs.glob(f"*/{glob.escape(process.replace('/', '-'))}*.log")
    logs = {name.name: name.read_text("utf-8", "replace").splitlines() for name in sorted(found, reverse=True)}
    for name, lines in [*logs.items(), ("the output", list(launch.watch.last))]:
        if lines:
            print(f"== the end of {name}", *lines[-LOG_LINES:], sep="\n", file=sys.stderr)


def print_nodes(launch: str) -> None:
    """Print the nodes of a launch file of ROS 1, and what is wrong with them, as JSON."""
    try:
        import roslaunch.config
        import roslib.packages
        from rospkg import ResourceNotFound
    except ImportError as error:
        sys.exit(f'{sys.executable} has no ROS 1 ({error}); name the Python of ROS, as in: command = "/usr/bin/python3"')
    try:
        config = roslaunch.config.load_config_default([launch], None, verbose=False)
    except roslaunch.core.RLException as error:
        sys.exit(" ".join(str(error).split()))
    nodes, errors = [], [" ".join(str(one).split()) for one in config.config_errors]
    for node in config.nodes:
        name = node.namespace + node.name
        nodes.append({"name": name, "respawn": node.respawn})
        if not roslaunch.core.is_machine_local(node.machine):
            errors.append(f"the node {name} is to run on another machine")
        try:
            programs = roslib.packages.find_node(node.package, node.type)
        except ResourceNotFound:
            errors.append(f"the package {node.package} of the node {name} is unknown; packages names folders with packages")
            continue
        if not programs:
            errors.append(f"the package {node.package} has no executable file {node.type}, which the node {name} names")
    print(json.dumps({"nodes": nodes, "errors": errors}))


def kind_of(given: argparse.Namespace) -> type[Launch]:
    """Return the kind of launch that was requested."""
    if given.ros == 2:
        return Launch2
    if not given.share_master:
        return Launch1
    return BaseStation if given_variable("SIERRA_ROBOT") == "0" else Robot


def raise_stopped(number: int, frame: object) -> None:
    raise Stopped(f"was told to end by signal {number}")


def main() -> None:
    """Execute one run; print in one line why it failed."""
    if sys.argv[1] == "--nodes":
        print_nodes(sys.argv[2])
        return
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
        launch = kind_of(given)(given)
        launch.execute()
    except (Failure, Stopped) as error:
        if launch is not None and isinstance(error, Died):
            print_log(launch, error.process)
        sys.exit(f"ros: {error}")


if __name__ == "__main__":
    main()
