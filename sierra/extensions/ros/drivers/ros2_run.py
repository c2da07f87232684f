"""A run of ROS 2, in a domain of its own. The driver itself keeps the time.

`ros2_watcher.py` takes part in the run: it tells which nodes are there, records topics, reads `/clock`, and publishes
`/sierra/started`. If there is no `ros2`, `ros2_launcher.py` starts the nodes. With `--fleet`, the run has a part on each robot,
all in one domain: see `ros2_fleet.py`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

if TYPE_CHECKING:
    from sierra.extensions.ros.drivers import ros2_fleet
    from sierra.extensions.ros.drivers.ros_driver import TICK_S, Failure, Launch, end, is_free, is_named, node_of, output_of
else:
    import ros2_fleet
    from ros_driver import TICK_S, Failure, Launch, end, is_free, is_named, node_of, output_of

PROGRAMS = Path(__file__).resolve().parent
DOMAINS = range(1, 102)  # ROS_DOMAIN_ID: safe on Linux, without the default 0
USUAL_DOMAIN = 30  # of the drivers of a TurtleBot3
CLOSED_S = 60.0  # for other parts of a run to end
SETTLED_S = 2.0  # without a new node, until all nodes count as started, or those of several robots as complete
GRAPH_S = 0.5  # without a new node or publisher, until all nodes count as complete
WATCHER_S = 60.0  # for the watcher to take part
WATCHED_S = 20.0  # for the watcher to close its bag
SEEN = {"publishers", "nodes", "pending", "clock", "unheard", "members", "participants"}
"""What the watcher tells, and an attribute of this name keeps."""
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


class Launch2(Launch):
    """A run of ROS 2, in a domain of its own. The driver itself keeps the time."""

    written_last = "metadata.yaml"  # the folder and its other files are there from the recorder's start
    begin: float | None = None
    first: float | None = None
    """The simulated time when it was first seen."""
    latest = 0.0
    """The last simulated time."""
    watcher: Any = None
    recorder: subprocess.Popen[bytes] | None = None

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        self.fleet: Any = ros2_fleet.fleet(os.environ, has_base=given.fleet == "base") if given.fleet else None
        """The parts of the run on other robots; None if all of it is here."""
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
        if self.which(given.launcher):
            return [given.launcher, "launch", "--noninteractive", str(given.launch)]
        return [python, str(PROGRAMS / "ros2_launcher.py"), str(given.launch)]

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
            profile.write_text(ros2_fleet.profile(self.fleet.addresses if self.fleet else [ros2_fleet.HERE]))
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
        for python in dict.fromkeys([sys.executable, self.which("python3") or sys.executable]):
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
        self.watcher = Watcher(
            [python, str(PROGRAMS / "ros2_watcher.py"), *given.record, *bag, *clock, *part], self.environment
        )
        self.recorder = None if has_recorder or not given.bag else self.start_recorder()
        while not self.watcher.is_ready or (self.recorder is not None and not (given.output / given.bag).exists()):
            self.watcher.look()
            if time.monotonic() > limit:
                raise Failure(f"ROS 2 or its recorder did not start within {WATCHER_S:g} s")
            time.sleep(TICK_S)
        self.be_patient()

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
        if self.which("ros2") is None:
            raise Failure("nothing can record topics here: pip install 'sierra-experiments[ros2]', or install ros2 bag")
        options = ["-s", "mcap", "-o", str(given.output.resolve() / given.bag), "--regex", topics]
        return self.started(["ros2", "bag", "record", *options], out=sys.stderr, err=None)

    def look(self) -> bool:
        self.watcher.look()
        if self.fleet is not None:
            self.follow_others()
        if self.begin is None:
            if not (missing := self.missing() or self.unready()):
                self.watcher.send("start")
                self.begin_time()
                return False
            self.check_patience(missing)
            if self.fleet is not None and self.fleet.is_over:
                raise Failure("the run has ended before it began here")
            return False
        passed = self.passed()
        if self.fleet is not None and not self.fleet.leads:
            return self.is_ended(passed)
        if self.given.awaited:
            return self.is_finished(passed)
        return passed is not None and passed >= self.given.length and self.mark()

    def begin_time(self) -> None:
        self.begin = time.monotonic()
        self.be_patient()

    def follow_others(self) -> None:
        """Hear the other parts of the run, and tell them the state of this one. Raises Failure."""
        self.fleet.hear(self.watcher.members)
        if self.begin is None and self.watcher.has_started:
            self.begin_time()
        if self.begin is None:
            self.tell(programs=len(self.watch.processes - self.watch.ended), ready=not self.missing())
        else:
            settled = time.monotonic() - self.watch.latest > SETTLED_S
            awaited = [process for process in self.watch.processes if is_named(node_of(process), self.given.awaited)]
            self.tell(awaited=len(awaited), finished=settled and not self.awaits())

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
            self.latest = self.watcher.clock
            self.be_patient()
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

    def close_together(self) -> None:
        """Tell that the nodes of this part have ended, and wait for those of the others. Raises Failure if they do not end."""
        self.tell(closed=True)
        limit = time.monotonic() + CLOSED_S
        while (self.fleet.leads or self.given.bag) and (open_part := self.fleet.unclosed()):
            if time.monotonic() > limit:
                raise Failure(f"{open_part} has not ended its nodes within {CLOSED_S:g} s")
            self.watcher.look()
            self.fleet.hear(self.watcher.members)
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
        while chunk := output_of(self.process, 0.0):
            self._text += chunk
        *lines, self._text = self._text.split(b"\n")
        for line in lines:
            seen: dict[str, Any] = json.loads(line)
            if "failure" in seen:
                raise Failure(seen["failure"])
            self.is_ready = True
            if any(seen.get(name, getattr(self, name)) != getattr(self, name) for name in ("publishers", "nodes")):
                self.changed = time.monotonic()
            for name in SEEN & seen.keys():
                setattr(self, name, seen[name])
            self.has_started = seen.get("started", self.has_started)
            self.recorded = seen if "messages" in seen else self.recorded
        if self.process.poll() is not None and not self.recorded and self.process.returncode:
            raise Failure(f"the program that watches the run has ended (exit status {self.process.returncode})")

    def send(self, line: str) -> None:
        """Tell it the state of this part of the run, or `start`: then it tells all nodes that the time has begun."""
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


def is_free_domain(number: int) -> bool:
    """Return whether nobody on this machine discovers others in a domain: https://docs.ros.org, 'The ROS_DOMAIN_ID'."""
    return is_free(7400 + 250 * number, socket.SOCK_DGRAM)


def launch(given: argparse.Namespace) -> Launch2:
    """Return the run, or the part of it here, that was requested."""
    return Launch2(given)
