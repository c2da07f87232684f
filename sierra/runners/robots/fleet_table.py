"""The table `[runners.robots]`: a fleet of robots, and the limits within which they execute runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Self

from pydantic import Field, StringConstraints, model_validator

from sierra.config.field_types import NAME, Argv, Command, Line, Positive, Size, Table
from sierra.config.robots_table import BASE, ROBOT
from sierra.errors import ConfigError

RobotName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]


class RobotTable(Table):
    """One robot of the fleet."""

    host: Line
    """Its name in the user's OpenSSH configuration, or `user@host:port`."""
    group: Annotated[str, StringConstraints(pattern=NAME)] = ROBOT
    """The group of places that it can take: `robot`, `base`, or a name in `[robots.groups]`."""
    variables: Mapping[str, str] = {}
    """Variables that its setup line, its stop command and its part of a run get."""
    setup: Line | None = None
    """As `setup` of the fleet, which it replaces; so do the next three."""
    stop: Argv | None = None
    battery: Line | Command | None = None
    link_options: Mapping[str, Any] = {}
    """Options of the link that differ from those of the fleet."""


class FleetTable(Table):
    """The table `[runners.robots]`."""

    fleet: Mapping[RobotName, RobotTable] = {}
    """The robots by name. Runs take them in this order."""
    use: tuple[str, ...] = ()
    """The robots and groups to use now; empty: all."""
    link: Line = "fabric"
    """The link to the robots: `fabric` or `openssh`."""
    link_options: Mapping[str, Any] = {}
    """Options of this link, as in `[links.NAME]`."""
    folder: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9/._+@~-]+$")] = ".cache/sierra-robot"
    """The folder on each robot: absolute, or relative to the home folder there."""
    python: Line = "python3"
    """The Python there, 3.8 or newer."""
    setup: Line | None = None
    """A line that bash executes before a run. Programs get the variables that it sets."""
    stop: Argv | None = None
    """The command that brings a robot to a standstill, executed there whenever a run ends. Empty: it needs none."""
    stop_limit: Positive = 5.0
    """The seconds that the stop command may take."""
    lease: Annotated[float, Field(ge=0.5, le=600)] = 5.0
    """The seconds after which a robot that hears nothing of this process ends its run."""
    grace: Positive = 2.0
    """The seconds between SIGTERM and SIGKILL."""
    battery: Line | Command | None = None
    """How to read the battery's charge in percent: a file, or a command that prints it."""
    battery_min: Annotated[float, Field(ge=0, le=100)] = 20.0
    """The charge in percent below which no run starts."""
    disk_min: Size = 100_000_000
    """The free space below which no run starts."""
    clock_error: Positive = 0.05
    """The seconds by which the measurement of a robot's clock may be wrong."""
    checks: tuple[Command, ...] = ()
    """Commands that must succeed on each robot before a run."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        counts = Counter(one.host for one in self.fleet.values())
        if twice := [host for host, count in counts.items() if count > 1]:
            names = [name for name, one in self.fleet.items() if one.host == twice[0]]
            raise ValueError(f"{' and '.join(names)} have the same host {twice[0]!r}")
        groups = {one.group for one in self.fleet.values()}
        if unknown := [name for name in self.use if name not in self.fleet and name not in groups]:
            known = ", ".join([*self.fleet, *sorted(groups)])
            raise ValueError(f"use: unknown robot or group {unknown[0]!r}; known are {known}")
        if lacking := [name for name, one in self.fleet.items() if one.stop is None and self.stop is None]:
            raise ValueError(f"{lacking[0]} has no stop command; give stop = [...], or stop = [] if it needs none")
        return self

    def used(self) -> dict[str, RobotTable]:
        """Return the robots to use, by name."""
        return {name: one for name, one in self.fleet.items() if not self.use or name in self.use or one.group in self.use}


def allocate(table: FleetTable, groups: Sequence[tuple[int, str]]) -> dict[int, str]:
    """Return the robot for each place of a run; `groups` are the places with their groups.

    A group that no robot names is taken by robots of the group `robot`. Raises ConfigError if there are too few of them.
    """
    free: dict[str, list[str]] = {}
    for name, one in table.used().items():
        free.setdefault(one.group, []).append(name)
    sizes = {group: len(names) for group, names in free.items()}
    named = {one.group for one in table.fleet.values()} | {BASE}
    taken: dict[int, str] = {}
    for place, group in groups:
        source = group if group in named else ROBOT
        if not free.get(source):
            raise ConfigError(_too_few(sizes, [one if one in named else ROBOT for _, one in groups], source))
        taken[place] = free[source].pop(0)
    return taken


def _too_few(sizes: Mapping[str, int], groups: Iterable[str], group: str) -> str:
    have, need = sizes.get(group, 0), Counter(groups)[group]
    if group == BASE:
        return 'a run needs a base station, but the fleet has none; give a host group = "base" in [runners.robots.fleet]'
    possible = f"1 to {have} are possible" if have else "add some to [runners.robots.fleet]"
    return f"a run needs {need} robots of the group {group!r}, but the fleet has {have}; {possible}"
