"""Checks of the robots of the fleet, for `sierra doctor --hosts`.

The agent is started as for a run. It executes the setup line, the stop command and a program, and reads battery, firmware and
calibration: no run starts if one of them fails.
"""

from __future__ import annotations

import os
import queue
import shlex
from collections.abc import Iterator
from functools import partial

from sierra.config.plugin_registry import RUNNERS
from sierra.config.project_file import Project
from sierra.extensions.hosts.host_checks import HostToCheck, battery, check, zone
from sierra.extensions.robots import agent_start
from sierra.extensions.robots.agent_link import AgentLink, Refused
from sierra.extensions.robots.fleet_table import FleetTable, RobotTable
from sierra.extensions.robots.trial import CHECK_S
from sierra.runners.links.base import Link
from sierra.setup.doctor import Check
from sierra.util.hashing import short

REMEDIES = {
    "stop": "stop the robot by hand, and correct stop in sierra.toml",
    "setup": "correct setup in sierra.toml",
    "lock": "try again when it is free",
}
"""The remedies for what an agent refuses, by the part of its first request that has failed."""


def of_fleet(project: Project, link: str | None) -> dict[str, HostToCheck]:
    """Return the robots that runs use, by name; `link` is the link to use, by default that of the fleet."""
    tables = project.runners
    table = RUNNERS.options("robots", tables["robots"]) if "robots" in tables else None
    if not isinstance(table, FleetTable):  # there is none, or a plug-in has this name
        return {}
    chosen = link or table.link
    return {
        name: HostToCheck(
            name,
            robot.host,
            chosen,
            {**project.links.get(chosen, {}), **(robot.link_options if chosen == table.link else {})},
            python=table.python,
            folder=table.folder,
            disk_min=table.disk_min,
            own=partial(checks_of_robot, robot, table),
        )
        for name, robot in table.used().items()
    }


def checks_of_robot(robot: RobotTable, fleet: FleetTable, host: HostToCheck, link: Link) -> Iterator[Check]:
    """Start the agent as for a run, and yield what it has found."""
    link.python = fleet.python
    agent = AgentLink(host.name, link, fleet.lease, queue.SimpleQueue())
    try:
        own = robot.model_copy(update={"checks": (), "topic_rates": {}})
        hello = agent_start.start(agent, own, fleet, f"doctor {os.getpid()}", "")
        yield zone(host, hello)
        yield Check(f"{host.name}: stop", "ok", f"{shlex.join(robot.stop)}: succeeds" if robot.stop else "needs no command")
        yield Check(f"{host.name}: runs", "ok", f"a program was executed in {hello['folder']}")
        checked = agent.ask("check", CHECK_S)
        for name, reason in checked["unread"].items():
            yield check(host, name, False, f"not readable: {reason}", f"correct {name} in sierra.toml")
        yield from battery(host, checked["battery"], fleet.battery_min)
        if checked.get("firmware"):
            yield Check(f"{host.name}: firmware", "ok", checked["firmware"])
        if checked.get("calibration"):
            yield Check(f"{host.name}: calibration", "ok", f"{robot.calibration} {short(checked['calibration'])}")
    except Refused as error:
        reason = str(error).removeprefix(f"{host.name}: ")
        yield Check(f"{host.name}: {error.about or 'runs'}", "missing", reason, REMEDIES.get(error.about, ""))
    finally:
        agent.close()
