"""A run of ROS 1: roslaunch, its master on a port of its own, and the time keeper.

It begins when all nodes are known to the master, and when the recorder of topics has subscribed. The time keeper
(`ros_timekeeper.py`, a required node) writes a file when the time is over. As many nodes must have been started as the launch
file has.

With `--share-master`, a run on several robots has one master, on its base station. Each of them executes `ros_driver.py`, with
a launch file of its own. They find the master by SIERRA_ADDRESS_0 and SIERRA_EXECUTION, from which its port follows, and agree
by parameters of the master:

- `/sierra/robot1/nodes`: the nodes of robot 1, as soon as the master knows them all;
- `/sierra/started`: all nodes of all robots are there; the base station sets it;
- `/sierra/robot1/finished`: the awaited nodes of robot 1 have ended; `/sierra/finished`: those of all robots;
- `/sierra/over`: the time is over, and robots end their nodes; `/sierra/robot1/closed`: robot 1 has done so.

`python3 ros1_run.py LAUNCH` prints the nodes of a launch file as JSON, and what is wrong with them.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import http.client
import json
import re
import subprocess
import sys
import uuid
import xmlrpc.client
from pathlib import Path
from typing import TYPE_CHECKING, Any, Sequence

if TYPE_CHECKING:
    from sierra.extensions.ros.drivers.ros_driver import KEEPER, Failure, Launch, given_variable, is_free, is_named, number_of
else:
    from ros_driver import KEEPER, Failure, Launch, given_variable, is_free, is_named, number_of

PORTS = range(20000, 32768)  # below those that Linux gives to outgoing connections
SYSTEM = "/usr/share"  # the packages of Debian; a setup script names others
SIGINT_S, SIGTERM_S = 5.0, 2.0  # for each node, by roslaunch
PACKAGE, RECORDER = "sierra_ros", "sierra_bag"
CORE = {"/master", "/rosout"}
CALLER = "/sierra_driver"
NO_ANSWER = (OSError, xmlrpc.client.Error, http.client.HTTPException)
"""The errors of a master that does not answer."""


class Launch1(Launch):
    """A run of ROS 1: roslaunch, its master, and the time keeper."""

    address = master_address = "127.0.0.1"
    ports = PORTS
    robots: Sequence[str] = ()
    """The other robots that use its master."""

    def find_master(self) -> tuple[str, str]:
        """Return the port of the master, and the option that starts it there or waits for it. Raises Failure."""
        port = self.reserve("port", self.ports, is_free)
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
        self.be_patient()
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
        words = [sys.executable, __file__, str(self.given.launch)]
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
        missing = "" if self.has_begun else self.missing()
        self.has_begun = self.has_begun or (not missing and self.told("started"))
        if not self.has_begun and not self.watch.is_over:
            self.check_patience(missing)
        if self.has_begun and self.given.awaited and not self.has_finished and not self.awaits():
            self.has_finished = self.told("finished")
        return False

    def told(self, name: str, value: object = True) -> bool:
        with contextlib.suppress(*NO_ANSWER):
            return bool(self.master.setParam(CALLER, "/sierra/" + name, value)[0] == 1)
        return False

    def heard(self, name: str) -> Any:
        """Return the value of a parameter that another part of the run has set; None without one."""
        with contextlib.suppress(*NO_ANSWER):
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
        except NO_ANSWER:
            return "the master does not answer"

    def unrecorded(self) -> str:
        """Return a topic that the recorder does not receive yet from all nodes that publish it.

        The recorder lists a connection before it is there, so each node must list it, too.
        """
        received = collections.Counter(topic for _, topic in self.links("/" + RECORDER, "i"))
        for topic, nodes in self.master.getSystemState(CALLER)[2][0]:
            if not any(re.fullmatch(wanted, topic) for wanted in self.given.record):
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


class Shared(Launch1):
    """The part of a robot, or of the base station, in a run of ROS 1 with one master, that of the base station."""

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        number = number_of(given_variable("SIERRA_EXECUTION"))
        self.run = str(uuid.UUID(int=number % 2**128))  # roslaunch refuses a master of another run
        self.ports = PORTS[number % len(PORTS) :][:1]
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

    def missing(self) -> str:
        nodes = {robot: self.heard(robot + "/nodes") for robot in self.robots}
        absent = [robot for robot, names in nodes.items() if names is None]
        if absent:
            return f"{absent[0]} does not have all of its nodes"
        Launch1.check_awaited(self, [*self.own, *(name for names in nodes.values() for name in names)])
        return super().missing()

    def awaits(self) -> list[str]:
        return [*super().awaits(), *(robot for robot in self.robots if not self.heard(robot + "/finished"))]


class Robot(Shared):
    """The part of a robot: its own nodes. It ends when the base station says that the run is over."""

    has_told = has_heard = False

    def find_master(self) -> tuple[str, str]:
        for address, other in ((self.master_address, self.address), (self.address, self.master_address)):
            if ":" in address or (address.startswith("127.") and not other.startswith("127.")):
                raise Failure(f"{other} cannot reach {address} by ROS 1; give it another address in [runners.robots.fleet]")
        return str(self.ports[0]), "--wait"

    def look(self) -> bool:
        missing = "" if self.has_told else self.missing()
        self.has_told = self.has_told or (not missing and self.told(f"robot{self.place}/nodes", self.own))
        self.has_begun = self.has_begun or bool(self.has_told and self.heard("started"))
        if not self.has_told:
            self.check_patience(missing)
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


def launch(given: argparse.Namespace) -> Launch1:
    """Return the run, or the part of it here, that was requested."""
    if not given.share_master:
        return Launch1(given)
    return BaseStation(given) if given_variable("SIERRA_ROBOT") == "0" else Robot(given)


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
    nodes, errors = [], [" ".join(str(error).split()) for error in config.config_errors]
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


if __name__ == "__main__":
    print_nodes(sys.argv[1])
