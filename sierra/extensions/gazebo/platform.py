"""The platform `gazebo`: a world (SDF) of Gazebo classic in which SIERRA sets the seed, the length, the physics and the robots.

A small program lies beside the world of each run. It starts `gzserver`, lets it make exact numbers of steps, and ends it. It is
an input file, so it is part of the identity of runs, and a replay uses the recorded one.

Robots come from a `<population>` of the world, which Gazebo inserts with its own random numbers, or are copies of a model
that SIERRA writes into the world of each run. `robots` makes the copies.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from typing import Annotated, ClassVar, Literal

from pydantic import Field, PositiveInt, StringConstraints

from sierra.config.field_types import Positive
from sierra.design.platforms.base import Platform, Spanned, driver_files, driver_path, population_size
from sierra.extensions.gazebo import robots
from sierra.extensions.gazebo.robots import COPIES, SEED, Area, Start
from sierra.plugin import Add, Change, ConfigError, Criterion, Project, QueryError, Set, Table, TemplateError, TemplateView
from sierra.util.text import short_number

INPUT, DRIVER, PARTS = "input.world", "gazebo_driver.py", ("gazebo_driver.py", "gazebo_transport.py")
WORLD = "/sdf/world"
PHYSICS = f"{WORLD}/physics"
STEP = f"{PHYSICS}/max_step_size"
POPULATION = f"{WORLD}/population"
DEFAULT_STEP = "0.001"
RATE = "20000"
"""Steps per second of wall-clock time at most. Without a limit (0), a paused Gazebo would use all of a processor."""
GZ_SIM = f"{WORLD}//plugin[starts-with(@filename, 'gz-sim') or contains(@filename, 'ignition-gazebo')]/@filename"
CRITERIA: Mapping[str, str] = {"population_size": "number of robots: of a population, or copies of the model `robot`"}
TABLE = "[platforms.gazebo]"

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][\w-]*$")]
Folder = Annotated[str, StringConstraints(pattern=r"^\w[\w./-]*$")]


class GazeboOptions(Table):
    """The options of Gazebo classic."""

    length: Positive = Field(10.0, description="simulated time in seconds")
    interval: Positive = Field(1.0, description="simulated time between two rows of an output, in seconds")
    step: Positive | None = Field(
        None, description="simulated time of one step (max_step_size) in seconds; default: as in the world", examples=[0.005]
    )
    engine: Literal["ode", "bullet", "simbody", "dart"] | None = Field(
        None, description="physics engine, if the installed Gazebo has it; default: as in the world", examples=["ode"]
    )
    threads: PositiveInt | None = Field(
        None,
        description="threads in which ODE computes groups of bodies that do not touch each other; default: as in the world",
    )
    robot: Name | None = Field(
        None,
        description="name of the model of the world that population_size copies; default: the model of the only <population>",
        examples=["robot"],
    )
    starts: tuple[Start, ...] = Field(
        (),
        description="places of the copies, in their order: `[x, y]`, `[x, y, yaw]` or `[x, y, z, roll, pitch, yaw]`, in metres "
        "and radians; what is left out is as in the world",
        examples=[[[0.0, 0.0], [1.0, 0.0, 1.57]]],
    )
    start_area: Area | None = Field(
        None,
        description="area in which the seed of each run places the copies",
        examples=[{"x": [-2.0, 2.0], "y": [-1.0, 1.0], "distance": 0.4}],
    )
    models: tuple[Folder, ...] = Field((), description="folders of the project that contain models, which `model://` names")
    plugins: tuple[Folder, ...] = Field((), description="folders of the project that contain libraries of plug-ins")
    resources: tuple[Folder, ...] = Field((), description="folders of the project that contain other files, such as meshes")
    ignore: tuple[Annotated[str, StringConstraints(pattern=r"^[^-{}][^{}]*$")], ...] = Field(
        (), description="parts of errors that Gazebo reports ([Err]) and that do not make a run fail", examples=[["Camera.cc"]]
    )
    server: Annotated[str, StringConstraints(pattern=r"^[^-{}\s][^{}\s]*$")] = Field(
        "gzserver", description="the program gzserver, if it is not in PATH", examples=["/opt/gazebo/bin/gzserver"]
    )


class Gazebo(Platform):
    """The platform `gazebo`."""

    contract = 1
    Options: ClassVar[type[Table]] = GazeboOptions

    def __init__(self, project: Project, options: GazeboOptions) -> None:
        if project.template is None:
            raise ConfigError('platform "gazebo" needs one template, as in: template = "arena.world"; others belong to files')
        if options.robot and bool(options.starts) == bool(options.start_area):
            raise ConfigError(f"{TABLE}: robot needs places for its copies: set either starts or start_area")
        if not options.robot and (options.starts or options.start_area):
            raise ConfigError(f"{TABLE}: starts and start_area need robot, the name of the model that they place")
        _whole(options.length, options.interval, "length", "intervals")
        self._driver = driver_path(project.template, DRIVER, is_among_files=bool(project.files))
        self._python = project.command or ("{python}",)
        self._options = options

    def changes(self, template: TemplateView) -> tuple[Change, ...]:
        options, changes = self._options, list[Change]()
        if options.robot and template.find(self._robot()):
            changes.append(Set(self._robot(), "1", attribute=COPIES, expect=1, why=f"{TABLE} robot"))
        if not template.find(PHYSICS):
            return tuple(changes)  # the check of the input refuses it
        changes.append(self._part(template, "real_time_update_rate", RATE, "no limit of the speed"))
        if options.engine:
            changes.append(Set(PHYSICS, options.engine, attribute="type", expect=1, why=f"{TABLE} engine"))
        if options.step:
            changes.append(self._part(template, "max_step_size", short_number(options.step, 17), f"{TABLE} step"))
        if options.threads:
            changes.append(self._part(template, "ode/solver/island_threads", str(options.threads), f"{TABLE} threads"))
        return tuple(changes)

    def seed_changes(self) -> tuple[Change, ...]:
        """Return the change that gives the seed to the drawn starts; gzserver gets it as an argument."""
        return (Set(WORLD, "{seed}", attribute=SEED, expect=1, why="the seed"),) if self._options.start_area else ()

    def criterion(self, criterion: Criterion, template: TemplateView) -> Spanned | None:
        if criterion.name not in CRITERIA:
            return None
        return population_size(criterion.scale, self._population(template))

    def criteria(self) -> Mapping[str, str]:
        return CRITERIA

    def check(self, document: TemplateView, template: TemplateView) -> None:
        """Refuse a world that gzserver would not load, load in part, or simulate in another way than the options say."""
        _check_world(document)
        _check_populations(document)
        if self._options.threads and document.find(f"{PHYSICS}/@type") != ("ode",):
            raise TemplateError(f"{TABLE} threads: only the physics engine ode has threads; leave it out")
        step = (document.find(STEP) or (DEFAULT_STEP,))[0].strip()
        if not re.fullmatch(r"[0-9]*\.?[0-9]+(e-?[0-9]{1,2})?", step) or float(step) <= 0:
            raise TemplateError(f"max_step_size: {step!r} is not a time in seconds; use one such as 0.001")
        _whole(self._options.interval, step, "interval", "steps")
        if self._options.robot:
            self._check_robot(document)

    def command(self) -> tuple[str, ...]:
        options = self._options
        words = ["--seed", "{seed}", "--length", repr(options.length), "--interval", repr(options.interval)]
        if options.server != "gzserver":
            words += ["--server", options.server]
        for name in ("models", "plugins", "resources"):
            if folders := getattr(options, name):
                words += [f"--{name}", *(f"{{project}}/{folder}" for folder in folders)]
        if options.ignore:
            words += ["--ignore", *options.ignore]
        return (*self._python, self._driver, "{input}", "{output}", *words)

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        if self._options.robot:
            document = robots.written(document, self._options.starts, self._options.start_area)
        return (INPUT, document), *driver_files(__file__, *PARTS)

    def _part(self, template: TemplateView, name: str, value: str, why: str) -> Change:
        """Return the change that sets a text below the physics; elements that are missing are added."""
        above, _, missing = PHYSICS, "", name
        while missing and template.find(f"{above}/{missing.partition('/')[0]}"):
            first, _, missing = missing.partition("/")
            above = f"{above}/{first}"
        if not missing:
            return Set(above, value, expect=1, why=why)
        xml = value
        for tag in reversed(missing.split("/")):
            xml = f"<{tag}>{xml}</{tag}>"
        return Add(above, xml, expect=1, why=why)

    def _robot(self) -> str:
        name = self._options.robot
        return f"{WORLD}/model[@name='{name}']|{WORLD}/include[normalize-space(name)='{name}']"

    def _population(self, template: TemplateView) -> str:
        """Return the path of the number of robots. Raises QueryError."""
        if self._options.robot:
            self._check_robot(template)
            return f"{WORLD}/*/@{COPIES}"
        count = len(template.find(POPULATION))
        if count != 1:
            raise QueryError(f"population_size: the world has {count} elements <population>; set robot in {TABLE} to a model")
        return f"{POPULATION}/model_count"

    def _check_robot(self, document: TemplateView) -> None:
        """Refuse a world without the model to copy, or with other models that have the names of its copies."""
        name, count = self._options.robot, len(document.find(self._robot()))
        if count != 1:
            known = ", ".join(document.find(f"{WORLD}/model/@name|{WORLD}/include/name")[:8]) or "none"
            raise TemplateError(f"{TABLE} robot: the world has {count} models {name!r}; its models are {known}")
        if not document.find(
            f"{WORLD}/include[normalize-space(name)='{name}']|{WORLD}/model[@name='{name}']/*[self::link or self::include]"
        ):
            raise TemplateError(f"{TABLE} robot: the model {name!r} has no link, so nothing would move; add one")


def _check_world(document: TemplateView) -> None:
    """Refuse what is no world of Gazebo classic, and what would be downloaded."""
    names = document.find(f"{WORLD}/@name")
    if len(document.find(WORLD)) != 1 or len(names) != 1:
        raise TemplateError('a world of Gazebo must have the root sdf and one world with a name, as in <world name="arena">')
    if not re.fullmatch(r"[A-Za-z0-9_-]+", names[0]):
        raise TemplateError(
            f"the world's name {names[0]!r} cannot be part of the names of topics; use letters, digits, _ and -"
        )
    engines = document.find(f"{PHYSICS}/@type")
    if foreign := document.find(GZ_SIM) or tuple(engine for engine in engines if engine == "ignored"):
        raise TemplateError(f'{foreign[0]!r} is of gz-sim, which platform "gazebo" cannot run; use platform "command" for it')
    if len(document.find(PHYSICS)) != 1 or len(engines) != 1:
        raise TemplateError('the world must have one physics with a type; add <physics type="ode"> with max_step_size')
    for uri in document.find("//uri"):
        if uri.strip().startswith(("http://", "https://")):
            raise TemplateError(
                f"{uri.strip()!r} would be downloaded; add the model to a folder of the project, and this to models"
            )


def _check_populations(document: TemplateView) -> None:
    """Refuse populations that Gazebo would leave out with no more than a message."""
    for number, _ in enumerate(document.find(POPULATION), 1):
        path = f"({POPULATION})[{number}]"
        name = (document.find(f"{path}/@name") or ("",))[0]
        if len(document.find(f"{path}/model")) != 1:
            raise TemplateError(f"the population {name!r} must have one model, of which Gazebo makes copies")
        if not document.find(f"{path}/box/size|{path}/cylinder/radius"):
            raise TemplateError(f"the population {name!r} has no box or cylinder that says where its models are; add one")
        counts = document.find(f"{path}/model_count")
        if len(counts) != 1 or not re.fullmatch(r"\s*[1-9][0-9]{0,5}\s*", counts[0]):
            raise TemplateError(f"the population {name!r} needs a model_count of 1 or more")


def _whole(whole: float, part: float | str, name: str, parts: str) -> None:
    """Check that one time is a whole number of others, as they are written. Raises ConfigError."""
    count = Fraction(repr(whole)) / Fraction(str(part))
    if count.denominator != 1:
        raise ConfigError(f"{TABLE} {name}: {whole:g} s is not a whole number of {parts} of {float(part):g} s")
