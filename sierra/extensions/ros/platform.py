"""The platform `ros`: a launch file in which SIERRA sets the seed, the length and the number of robots.

A small program lies beside the launch file of each run and starts it: see `drivers/ros_driver.py`. It is an input file, so it
is part of the identity of runs, and a replay uses the recorded one. Ports, domains and paths are chosen when a run starts, and
are in no id.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field, StringConstraints

from sierra.config.change_tables import StartPoses
from sierra.config.field_types import Positive
from sierra.config.robots_table import RobotsTable
from sierra.design.platforms.base import Platform, Spanned, driver_files, driver_path, population_size
from sierra.extensions.ros.launch import KEEPER, POSE, ROOT, SETTINGS, Launch1, Launch2, Robots, Shared
from sierra.plugin import Add, Change, ConfigError, Criterion, Project, QueryError, Set, Table, TemplateError, TemplateView
from sierra.plugin import Pose as StartPose

TABLE = "[platforms.ros]"
DRIVER, OF_ROS_1 = "ros_driver.py", ("ros1_run.py", "ros_timekeeper.py")
OF_ROS_2 = ("ros2_run.py", "ros2_launcher.py", "ros2_watcher.py", "ros2_fleet.py")
"""The program that starts a run, and those that it needs beside it."""
PYTHON = "/usr/bin/python3"
"""The Python of ROS 1 on Debian and Ubuntu: nodes name it in their first line."""
CRITERIA: Mapping[str, str] = {"population_size": "number of robots: copies of the group that is one robot"}

Inside = Annotated[str, StringConstraints(pattern=r"^\w[\w./-]*$")]
RosName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
NodeName = Annotated[str, StringConstraints(pattern=r"^/?[A-Za-z][A-Za-z0-9_/]*$")]


def _with_slashes(topics: str) -> str:
    """Check that each alternative of a regular expression can be the name of a topic."""
    depth = 0
    for character, following in itertools.pairwise(f"{topics} "):
        depth += (character == "(") - (character == ")")
        if character == "|" and depth == 0 and following != "/":
            raise ValueError("each alternative must begin with /, as in /a/odom|/b/odom or /(a|b)/odom")
    return topics


Topic = Annotated[str, StringConstraints(pattern=r"^/[A-Za-z0-9_/.*+?|\[\]()-]*$"), AfterValidator(_with_slashes)]


class RobotKind(Table):
    """A kind of robot: how its copies are called, and what they need."""

    prefix: RosName | None = Field(
        None,
        description="beginning of the names of robots, such as `tb3_`; default: the namespace of the group, without digits",
    )
    model: Inside | None = Field(None, description="value of $(arg model) in the group of the robot", examples=["burger"])
    setup: str | None = Field(
        None, description="script that bash reads before ROS is started", examples=["/opt/ros/noetic/setup.bash"]
    )


class RosOptions(StartPoses):
    """The options of ROS."""

    ros: Literal[1, 2] = Field(1, description="generation of ROS: 1 (roslaunch) or 2 (ros2 launch)")
    length: Positive | None = Field(None, description="length of a run in seconds; default: as in the template")
    ticks_per_second: Positive | None = Field(None, description="ticks per second; default: as in the template")
    packages: tuple[Inside, ...] = Field((), description="folders of the project with packages of ROS")
    setup: str | None = Field(
        None, description="script that bash reads before ROS is started", examples=["/opt/ros/noetic/setup.bash"]
    )
    group: RosName | None = Field(
        None,
        description="namespace of the group that is one robot; default: the only group with a namespace",
        examples=["tb3_0"],
    )
    robots: Mapping[str, RobotKind] = Field(default_factory=dict, description="kinds of robots, by name")
    robot: str | None = Field(None, description="kind of the robots; default: the only one of `robots`", examples=["burger"])
    wait_for: tuple[NodeName, ...] = Field(
        (),
        description="nodes that end by themselves, such as `walker` or `/robot0/walker`: a run ends when all of them have "
        "ended, instead of after its length",
    )
    patience: Positive = Field(
        60.0, description="seconds until all nodes must be there, and that nodes in `wait_for` have after the length"
    )
    barrier: bool = Field(
        True, description="whether the time begins only when the master knows all nodes; false: programs that are no nodes"
    )
    use_sim_time: bool = Field(False, description="whether nodes use the simulated time that a simulator publishes as /clock")
    record: tuple[Topic, ...] = Field(
        (), description="topics, or regular expressions of topics, that each run records into a bag", examples=[["/.*/odom"]]
    )
    may_lose: bool = Field(
        False, description="whether a run of ROS 2 is good although its recorder has lost messages; its log says how many"
    )
    seed_parameter: RosName | Literal[""] = Field(
        "seed", description="parameter with which all nodes of ROS 2 get the seed; empty: only `sierra_random_seed`"
    )


class Ros(Platform):
    """The platform `ros`."""

    contract = 1
    Options: ClassVar[type[Table]] = RosOptions

    def __init__(self, project: Project, options: RosOptions) -> None:
        if project.template is None:
            raise ConfigError('platform "ros" needs one template, as in: template = "swarm.launch"')
        self._options = options
        self._kind = _kind(options)
        self._on_robots = project.robots is not None
        trials = project.added("trials", None)
        self._placed_by_hand = bool(trials and trials.supervised and (trials.poses or trials.draw_poses))
        self._is_xml = not project.template.endswith((".yaml", ".yml"))
        if not self._is_xml and options.ros == 1:
            raise ConfigError('platform "ros": launch files of ROS 1 are XML; a launch file in YAML needs ros = 2')
        if not self._is_xml and options.length is None:
            raise ConfigError(f"{TABLE}: a launch file in YAML needs length")
        if (options.poses or options.random_poses) and not self._is_xml:
            raise ConfigError(f"{TABLE}: poses and random_poses need a launch file in XML; write the poses into that in YAML")
        if (options.poses or options.random_poses) and self._placed_by_hand:
            raise ConfigError(
                f"[trials] and {TABLE} both declare start poses; remove those in [trials], the map shows the others"
            )
        self._has_base = project.robots is not None and project.robots.base is not None and not project.robots.base.command
        self._shared = _shared(project.robots, options, has_base=self._has_base)
        if self._shared == "domain" and not self._is_xml:
            raise ConfigError(f"{TABLE}: SIERRA does not split launch files in YAML between robots; use a launch file in XML")
        self._input = "input.launch" if options.ros == 1 else f"input.launch{Path(project.template).suffix}"
        self._driver = driver_path(project.template, DRIVER, is_among_files=bool(project.files))
        self._python = project.command or ((PYTHON,) if options.ros == 1 else ("{python}",))
        self._dialect = Launch1() if options.ros == 1 else Launch2()
        arguments = (("model", self._kind.model),) if self._kind.model else ()
        names = options.group, self._kind.prefix
        self._robots = Robots(self._dialect, *names, arguments, options.start, self._shared, self._has_base)

    def changes(self, template: TemplateView) -> tuple[Change, ...]:
        if not self._is_xml:
            return ()
        options, settings, why = self._options, self._settings(template), f"{TABLE}: settings of the run"
        changes: list[Change] = []
        if isinstance(self._dialect, Launch2):
            parameters = {f"{SETTINGS}_{name}": f"$(var {SETTINGS}_{name})" for name in settings}
            parameters |= {options.seed_parameter: f"$(var {SETTINGS}_random_seed)"} if options.seed_parameter else {}
            parameters |= {"use_sim_time": "true"} if options.use_sim_time else {}
            changes += self._dialect.parameters(template, parameters, why)  # before the variables, so that they come after them
        changes += self._dialect.settings(template, settings, why)
        if isinstance(self._dialect, Launch1):
            if options.use_sim_time:
                time = '<param name="/use_sim_time" type="bool" value="true"/>'
                changes.append(Add(ROOT, time, at=0, expect=1, why=f"{TABLE} use_sim_time"))
            changes.append(Add(ROOT, KEEPER, expect=1, why="platform ros: the time keeper"))
            if options.record:
                changes.append(Add(ROOT, self._dialect.recorder(options.record), expect=1, why=f"{TABLE} record"))
        return tuple(changes)

    def seed_changes(self) -> tuple[Change, ...]:
        if not self._is_xml:
            return ()
        seed = Set(self._dialect.setting("random_seed"), "{seed}", expect=1, why="the seed")
        place = Set(self._dialect.setting("place"), "{robot}", expect=1, why="the place of a robot in its run")
        return (seed, place) if self._on_robots else (seed,)

    def criterion(self, criterion: Criterion, template: TemplateView) -> Spanned | None:
        if criterion.name not in CRITERIA:
            return None
        if not self._is_xml:
            raise QueryError("population_size: SIERRA does not copy groups in YAML; use a launch file in XML")
        if not self._has_robots(template):
            groups = ", ".join(template.find(self._dialect.group)) or "none"
            raise QueryError(f"population_size: one group must be one robot, but there are: {groups}; set group in {TABLE}")
        axis, points = population_size(criterion.scale, self._dialect.setting("population_size"))
        for value in axis.values:
            try:
                self._robots.check(int(value))
            except TemplateError as error:
                raise QueryError(f"population_size={value}: {error}") from error
        return axis, points

    def criteria(self) -> Mapping[str, str]:
        return CRITERIA

    def check(self, document: TemplateView, template: TemplateView) -> None:
        """Raise TemplateError for a launch file that SIERRA cannot execute as one run on this machine.

        Such files never end, have another root or another length, start several robots under one name, give robots poses that
        `[trials]` declares too, or name another machine. Of files in YAML, only the root is checked.
        """
        if not document.find(f"{ROOT}/self::*"):
            raise TemplateError("the root of a launch file must be launch")
        if not self._is_xml:
            return
        if self._options.ros == 1:
            self._check_end(document)
        elif self._options.length is None:
            raise TemplateError(f"runs of ROS 2 would never end; set length in {TABLE}")
        elif document.find(self._dialect.setting("length")) != (repr(self._options.length),):
            raise TemplateError(f"the length of runs of ROS 2 is the option length in {TABLE}; no change can set it")
        if document.find(self._dialect.unnamed):
            example = '<group ns="robot">' if self._options.ros == 1 else '<push_ros_namespace namespace="robot"/>'
            raise TemplateError(
                f"a group with nodes has no namespace, so that copies of it would be one robot; write {example}"
            )
        names = document.find(self._dialect.group)
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise TemplateError(f"two groups have the namespace {twice!r}, so that their nodes would replace each other")
        self._check_poses(document)
        if machines := document.find("//machine/@name | //@machine"):
            raise TemplateError(f"the launch file names another machine ({machines[0]!r}); runs of SIERRA stay on one")

    def _check_poses(self, document: TemplateView) -> None:
        """Refuse poses in `[trials]` if the launch file tells robots its own."""
        names = " or ".join(f"@name='{name}'" for name in POSE)
        found = document.find(f"{ROOT}/group/{self._dialect.argument}[{names}]/@name") if self._placed_by_hand else ()
        if found:
            raise TemplateError(
                f"[trials] declares start poses, but the launch file gives robots its own argument {found[0]}; declare the "
                f"poses in {TABLE} instead: robots and the map get them from there"
            )

    def _check_end(self, document: TemplateView) -> None:
        length = document.find(self._dialect.setting("length"))
        if not length:
            raise TemplateError(f"the launch file has no length, so that runs would never end; set length in {TABLE}")
        if not re.fullmatch(r"[0-9]*\.?[0-9]+|[0-9]+\.", length[0]) or float(length[0]) == 0:
            raise TemplateError(f"the length {length[0]!r} is not a positive number of seconds")
        if not document.find(f"{ROOT}/node[@name='sierra_timekeeper'][@required='true']/@name"):
            raise TemplateError(
                "the required node sierra_timekeeper, which ends runs, was removed or changed; leave it as it is"
            )

    def command(self) -> tuple[str, ...]:
        options = self._options
        launcher = ("roslaunch",) if options.ros == 1 else ("ros2", "--ros", "2", "--length", repr(options.length))
        words = [word for folder in options.packages for word in ("--packages", f"{{project}}/{folder}")]
        setup = self._kind.setup or options.setup
        words += ("--setup", setup) if setup else ()
        words += (word for node in options.wait_for for word in ("--await", node))
        words += ("--patience", repr(options.patience))
        words += () if options.barrier else ("--no-barrier",)
        words += ("--share-master",) if self._shared == "master" else ()
        words += ("--fleet", "base" if self._has_base else "robots") if self._shared == "domain" else ()
        words += ("--sim-time",) if options.use_sim_time else ()
        words += ("--may-lose",) if options.may_lose else ()
        words += (word for topic in options.record for word in ("--record", topic))
        words += ("--bag", "run.bag" if options.ros == 1 else "run") if options.record else ()
        return (*self._python, self._driver, "{input}", "{output}", *launcher, *words)

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        made = self._robots.made(document) if self._is_xml else document
        return (self._input, made), *driver_files(__file__, DRIVER, *(OF_ROS_1 if self._options.ros == 1 else OF_ROS_2))

    def start_poses(self, document: bytes) -> tuple[StartPose, ...]:
        """Return what the launch file of a run tells its robots; see `sierra.plugin.Placing`."""
        found = self._robots.read_poses(document) if self._robots.poses else ()
        return tuple(StartPose(x, y, round(math.degrees(yaw) % 360, 1)) for x, y, yaw in found)

    def _settings(self, template: TemplateView) -> dict[str, str]:
        """Return the values of the settings that the template gets."""
        options, dialect = self._options, self._dialect
        settings = {"random_seed": "0"}
        if self._has_robots(template):
            settings["population_size"] = (template.find(dialect.setting("population_size")) or ("1",))[0]
        if self._on_robots:
            settings["place"] = "1"
        for name in ("length", "ticks_per_second"):
            if (value := getattr(options, name)) is not None:
                settings[name] = repr(value) if name == "length" else repr(value).removesuffix(".0")
        return settings if self._shared == "master" else {**settings, "output": "$(env SIERRA_OUTPUT)"}

    def _has_robots(self, template: TemplateView) -> bool:
        """Return whether one group of the template stands for the robots."""
        names = template.find(self._dialect.group)
        return names.count(self._options.group) == 1 if self._options.group else len(names) == 1


def _shared(robots: RobotsTable | None, options: RosOptions, *, has_base: bool) -> Shared | None:
    """Return what all robots of a run share. Raises ConfigError if one of them would not take part."""
    if robots is None:
        return None
    if options.ros == 1:
        return "master" if has_base else None
    if robots.count == 1 and not has_base:
        return None
    for name, group in robots.groups.items():
        if group.command:
            raise ConfigError(
                f"{TABLE}: the robots of a run share a domain of ROS 2, and wait for each other; remove the command of "
                f"robots.groups.{name}"
            )
    return "domain"


def _kind(options: RosOptions) -> RobotKind:
    """Return the kind of the robots. Raises ConfigError for an unknown name, or if several could be meant."""
    known = ", ".join(options.robots) or "none"
    if options.robot is None:
        if len(options.robots) > 1:
            raise ConfigError(f"{TABLE}: there are several kinds of robots ({known}); choose one: robot = …")
        return next(iter(options.robots.values()), RobotKind())
    if options.robot not in options.robots:
        raise ConfigError(f"{TABLE}: unknown robot {options.robot!r}; known are {known}")
    return options.robots[options.robot]
