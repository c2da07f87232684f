"""Start of the agent on a robot, and its first request: the robot is locked, stands still, and can execute runs after that."""

from __future__ import annotations

import getpass
import os
from pathlib import Path

from sierra.errors import Missing
from sierra.extensions.hosts.push import has_python, push_programs
from sierra.extensions.robots import agent as programs_of_agent
from sierra.extensions.robots.agent.records import AGENT
from sierra.extensions.robots.agent_link import LOCK, AgentLink
from sierra.extensions.robots.agent_messages import Record
from sierra.extensions.robots.fleet_table import FleetTable, RobotTable
from sierra.extensions.robots.trial import SETTLE_S
from sierra.worker import program

HELLO_S = 120.0
"""The seconds in which an agent that has the robot must have executed its setup line, the stop command and a first program."""


def start(agent: AgentLink, robot: RobotTable, table: FleetTable, session: str, store: str) -> Record:
    """Start the agent of a robot; return its description of the robot. Raises Missing, Unreachable, UntrustedHost.

    `session` is shown to others who want the robot. `store` is the id of the store for which robots keep files.
    """
    python, root = table.python, table.folder.removeprefix("~/")
    if not has_python(agent.link, python):
        raise Missing(f"{agent.name}: needs Python 3.8 or newer as {python!r}; set python in [runners.robots]")
    programs = push_programs(agent.link, root, Path(programs_of_agent.__file__).parent)
    agent.start((python, "-I", "-S", "-B", f"{programs}/{program.NAME}", AGENT, root, LOCK))
    text = f"{getpass.getuser()} on {os.uname().nodename} (session {session})"
    who = {"session": session, "robot": agent.name, "text": text, "store": store}
    declared = _declared(robot, table)
    return agent.ask("hello", HELLO_S + declared["patience"], who=who, **declared)


def _declared(robot: RobotTable, table: FleetTable) -> Record:
    """Return what the fleet declares for a robot."""
    return {
        "lease": table.lease,
        "grace": table.grace,
        "setup": robot.setup or None,
        "stop": robot.stop,
        "stop_limit": table.stop_limit,
        "battery": robot.battery or None,
        "firmware": robot.firmware or None,
        "calibration": robot.calibration or None,
        "checks": robot.checks or (),
        "topic_rates": dict(robot.topic_rates or {}),
        "variables": dict(robot.variables),
        "patience": table.lease + table.grace + 2 * table.stop_limit + SETTLE_S,
    }
