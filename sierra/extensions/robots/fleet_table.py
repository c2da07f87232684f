"""The table `[runners.robots]`: a fleet of robots, and the limits within which they execute runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from sierra.config.field_types import NAME, OF_PYTHON, Argv, Command, Grace, Line, Positive, Size, Table
from sierra.config.robots_table import BASE, ROBOT
from sierra.errors import ConfigError
from sierra.util.text import like

Battery = Line | Annotated[tuple[str, ...], Field(min_length=1)]
Topic = Annotated[str, StringConstraints(pattern=r"^/?[A-Za-z][A-Za-z0-9_/]*$")]
Nothing = Literal[""]
RobotName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
REPLACED = ("setup", "stop", "battery", "firmware", "calibration", "checks", "topic_rates")
"""Keys of the fleet that a robot may have, too. Then its own value counts, also if it is empty."""
VARIABLES = "variables of setup, stop and program; those of `[environment]` replace them for the program"
SETUP = "a line that bash executes; programs get the variables that it sets"
STOP = (
    "the command that brings a robot to a standstill, also if no program of a run executes; []: it needs none. "
    "It is executed there when a session begins, at the first sign that a run ends, and after the last process of the run"
)
BATTERY = "how to read the charge of the battery in percent: a file, or a list with a command that prints it"
FIRMWARE = "a command that prints the version of the firmware; recorded before each run"
CALIBRATION = "the calibration file, whose SHA-256 is recorded before each run; absolute, or in ~/"
CHECKS = "commands that must succeed before a run, within 10 s; all are executed at once"
TOPIC_RATES = "fewest messages per second of topics of ROS 1 before a run, as `rostopic hz` measures them in up to 8 s"
LINK_OPTIONS = "options of the link, before those in `[links]`"


class RobotTable(Table):
    """One robot of the fleet. Its keys count before those of the fleet; an empty one, such as "" or [], means none."""

    host: Line = Field(description="its name in your configuration of OpenSSH, or `user@host:port`")
    address: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9:.%_-]+$")] | None = Field(
        None,
        description="its address for the other robots of a run; default: the one in its own network that SSH reaches",
        examples=["192.168.1.21"],
    )
    group: Annotated[str, StringConstraints(pattern=NAME)] = Field(
        ROBOT, description="the group of places that it can take: `robot`, `base`, or a name in `[robots.groups]`"
    )
    variables: Mapping[str, str] = Field(default_factory=dict, description=VARIABLES)
    setup: Line | Nothing | None = Field(None, description=SETUP)
    stop: Argv | None = Field(None, description=STOP)
    battery: Line | Nothing | tuple[str, ...] | None = Field(None, description=BATTERY)
    firmware: Argv | None = Field(None, description=FIRMWARE)
    calibration: Line | Nothing | None = Field(None, description=CALIBRATION)
    checks: tuple[Command, ...] | None = Field(None, description=CHECKS)
    topic_rates: Mapping[Topic, Positive] | None = Field(None, description=TOPIC_RATES)
    link_options: Mapping[str, Any] = Field(default_factory=dict, description=LINK_OPTIONS)


class FleetTable(Table):
    """A fleet of robots, each of which is reached over SSH, and the limits within which they execute runs."""

    fleet: Mapping[RobotName, RobotTable] = Field(
        default_factory=dict,
        description="the robots by name; runs take them in this order",
        examples=[{"tb1": {"host": "pi@192.168.1.21"}, "tb2": {"host": "pi@192.168.1.22"}}],
    )
    use: tuple[str, ...] = Field(
        (), description="names of the robots and groups that are used; default: all", examples=[["tb1"]]
    )
    link: Line = Field("fabric", description="the link to all robots: `fabric` or `openssh`")
    link_options: Mapping[str, Any] = Field(default_factory=dict, description=LINK_OPTIONS, examples=[{"connect": 10.0}])
    folder: Annotated[str, StringConstraints(pattern=r"^(~/)?[A-Za-z0-9/._+@-]+$")] = Field(
        ".cache/sierra-robot", description="folder for runs on each robot: absolute, or within the home folder there"
    )
    python: Annotated[Line, OF_PYTHON] = "python3"
    variables: Mapping[str, str] = Field(default_factory=dict, description=VARIABLES, examples=[{"TZ": "UTC"}])
    setup: Line | None = Field(None, description=SETUP, examples=["source /opt/ros/noetic/setup.bash"])
    stop: Argv | None = Field(None, description=STOP, examples=[["motor", "0"]])
    stop_limit: Positive = Field(5.0, description="time limit of the stop command, in seconds")
    lease: Annotated[float, Field(ge=0.5, le=600)] = Field(
        5.0, description="time after which a robot that hears nothing from this machine ends its run, in seconds"
    )
    grace: Grace = 2.0
    battery: Battery | None = Field(None, description=BATTERY, examples=["/sys/class/power_supply/BAT0/capacity"])
    battery_min: Annotated[float, Field(ge=0, le=100)] = Field(20.0, description="charge in percent below which no run starts")
    firmware: Command | None = Field(None, description=FIRMWARE, examples=[["cat", "/etc/firmware"]])
    calibration: Line | None = Field(None, description=CALIBRATION, examples=["~/calibration.yaml"])
    disk_min: Size = Field(
        100_000_000,
        description="free space below which no run starts, on each robot and on this machine, in bytes or as in `1 GB`",
    )
    clock_error: Positive = Field(
        0.05,
        description="largest error of the measurement of a robot's clock with which a run starts, and largest error by clocks "
        "that were set or slewed during a run with which stamps are converted, in seconds",
    )
    clock_drift: Positive | None = Field(
        None,
        description="largest change of a robot's clock against that of this machine during a run, in seconds; a run with a "
        "larger one has failed. By default, a remark is recorded if stamps cannot be converted (`robot_clocks.remark`)",
    )
    checks: tuple[Command, ...] = Field(
        (), description=CHECKS, examples=[[["timeout", "8", "rostopic", "echo", "-n1", "/scan"]]]
    )

    topic_rates: Mapping[Topic, Positive] = Field(default_factory=dict, description=TOPIC_RATES, examples=[{"/scan": 4.0}])

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        for key in ("host", "address"):
            robots: dict[str | None, list[str]] = {}
            for name, robot in self.fleet.items():
                robots.setdefault(getattr(robot, key), []).append(name)
            if twice := [value for value, names in robots.items() if value is not None and len(names) > 1]:
                raise ValueError(f"{' and '.join(robots[twice[0]])} have the same {key} {twice[0]!r}")
        groups = {robot.group for robot in self.fleet.values()}
        if unknown := [name for name in self.use if name not in self.fleet and name not in groups]:
            known = ", ".join([*self.fleet, *sorted(groups)])
            raise ValueError(f"use: unknown robot or group {unknown[0]!r}; known are {known}")
        if lacking := [name for name, robot in self.fleet.items() if robot.stop is None and self.stop is None]:
            raise ValueError(f"{lacking[0]} has no stop command; give stop = [...], or stop = [] if it needs none")
        return self

    def used(self) -> dict[str, RobotTable]:
        """Return the robots to use, by name, with what the fleet has for them."""
        chosen = (name for name, one in self.fleet.items() if not self.use or name in self.use or one.group in self.use)
        return {name: self.robot(name) for name in chosen}

    def robot(self, name: str) -> RobotTable:
        """Return a robot with what the fleet has for it, where it has nothing of its own."""
        own = self.fleet[name]
        of_fleet = {key: getattr(self, key) for key in REPLACED if getattr(own, key) is None}
        merged = {key: {**getattr(self, key), **getattr(own, key)} for key in ("variables", "link_options")}
        return own.model_copy(update={**of_fleet, **merged})


def check_groups(table: FleetTable, declared: Collection[str]) -> None:
    """Raise ConfigError for a robot of a group that no place can have, so that no run would ever take the robot."""
    known = list(dict.fromkeys((*declared, ROBOT, BASE)))
    for name, one in table.used().items():
        if one.group not in known:
            hint = like(one.group, known, "[robots.groups] can declare it, and there are")
            raise ConfigError(f"{name}: no place is of the group {one.group!r}; {hint}")


def allocate(table: FleetTable, places: Sequence[tuple[int, str]]) -> dict[int, str]:
    """Return the robot for each place of a run; `places` are their numbers, ascending, with their groups.

    A group that no robot names is taken by robots of the group `robot`. Raises ConfigError if there are too few of them.
    """
    free: dict[str, list[str]] = {}
    for name, robot in table.used().items():
        free.setdefault(robot.group, []).append(name)
    fleet = 'the fleet with its "use"' if table.use else "the fleet"
    have = {group: f"{fleet} has {len(names)}" for group, names in free.items()}
    named = {robot.group for robot in table.fleet.values()} | {BASE}
    sources = {number: group if group in named else ROBOT for number, group in places}
    taken: dict[int, str] = {}
    for number, source in sources.items():
        if not free.get(source):
            need = Counter(sources.values())[source]
            raise ConfigError(_too_few(source, have.get(source, f"{fleet} has 0"), need, possible=number - 1))
        taken[number] = free[source].pop(0)
    return taken


def _too_few(group: str, have: str, need: int, possible: int) -> str:
    """Return what is wrong with a fleet that has too few robots of a group for runs of more than `possible` robots."""
    if group == BASE:
        return 'a run needs a base station, but the fleet has none; give a host group = "base" in [runners.robots.fleet]'
    sizes = "1 robot" if possible == 1 else f"1 to {possible} robots"
    remedy = f"runs of {sizes} are possible" if possible else "add some to [runners.robots.fleet]"
    return f"a run needs {need} robots of the group {group!r}, but {have}; {remedy}"
